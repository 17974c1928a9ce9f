"""The column paper's two readings, and the default, on a mimic of the column paper's posterior (target T1)."""

import importlib.util

import numpy as np
import pytest

from samplers import RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL, SMCSampler


@pytest.fixture(scope="module")
def column(shared):
    """The target T1 in the form the samplers ask for."""
    spec = importlib.util.spec_from_file_location("sampler_targets", shared / "benchmarks" / "sampler_targets.py")
    targets = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(targets)

    class Column:
        def __init__(self):
            self.__dict__.update(targets.TARGETS["T1"]())

        def log_prior(self, x):
            return targets.prior_log_density(self.prior, x)

        def __call__(self, x):
            return self.log_prior(x) + self.log_likelihood(x)

        def sample_prior(self, n, rng):
            return targets.prior_transform(self.prior, rng.random_sample((n, len(self.prior))))

    return Column()


@pytest.mark.parametrize(
    "preset, stages, evaluations",
    [(RAMANCHA_2022_CONSTANT, 126, 1.04e6), (RAMANCHA_2022_LITERAL, 30, 235e3)],
    ids=["constant", "literal"],
)
def test_readings_of_table_1(column, preset, stages, evaluations, seed):
    sampler = SMCSampler(1000, 7, column, vectorize=True, seed=seed, **preset)
    sampler.run_mcmc(None, 1)
    assert len(sampler.ladder) == pytest.approx(stages, rel=0.05)
    assert sampler.evaluations == pytest.approx(evaluations, rel=0.05)
    assert {s.moves for s in sampler.ladder} == {10}
    z = (sampler.get_chain(flat=True).mean(axis=0) - column.mean) / column.sd
    # 1000 points, correlated after ten steps of a random walk: some four times fewer independent ones
    assert np.max(np.abs(z)) < 4 * np.sqrt(4 / 1000)


def test_default_on_the_column(column, seed):
    sampler = SMCSampler(500, 7, column, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 6)
    chain = sampler.get_chain(flat=True)
    assert np.max(np.abs(chain.mean(axis=0) - column.mean) / column.sd) < 4 * np.sqrt(1 / 750)
    assert np.max(np.abs(chain.std(axis=0) / column.sd - 1)) < 4 * np.sqrt(0.5 / 750)
    assert abs(sampler.log_evidence - column.log_evidence) < 1.5
    assert sampler.evaluations < 100e3
