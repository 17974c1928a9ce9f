"""The column paper's two readings, and the default, on a mimic of the column paper's posterior (target T1)."""

import importlib.util

import numpy as np
import pytest

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL


@pytest.fixture(scope="module")
def targets(shared):
    """The targets T1 to T4 in the form the samplers ask for."""
    spec = importlib.util.spec_from_file_location("sampler_targets", shared / "benchmarks" / "sampler_targets.py")
    targets = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(targets)

    class Target:
        def __init__(self, name):
            self.__dict__.update(targets.TARGETS[name]())
            self.ndim = len(self.prior)

        def log_prior(self, x):
            return targets.prior_log_density(self.prior, x)

        def __call__(self, x):
            return self.log_prior(x) + self.log_likelihood(x)

        def sample_prior(self, n, rng):
            return targets.prior_transform(self.prior, rng.random_sample((n, len(self.prior))))

    return {name: Target(name) for name in targets.TARGETS}


@pytest.fixture
def column(targets):
    return targets["T1"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "preset, stages, evaluations",
    [
        pytest.param(RAMANCHA_2022_CONSTANT, 126, 1.04e6, marks=pytest.mark.slow),
        (RAMANCHA_2022_LITERAL, 30, 235e3),
    ],
    ids=["constant", "literal"],
)
def test_readings_of_table_1(column, preset, stages, evaluations, seed):
    sampler = SMCSampler(1000, 7, column, vectorize=True, seed=seed, **preset)
    sampler.run_mcmc(None, 1)
    assert len(sampler.ladder) == pytest.approx(stages, rel=0.05)
    assert sampler.evaluations == pytest.approx(evaluations, rel=0.05)
    assert {s.moves for s in sampler.ladder} == {10}
    z = (sampler.get_chain(flat=True).mean(axis=0) - column.mean) / column.sd
    # 1000 points, correlated after ten steps of a random walk: about four times fewer independent ones
    assert np.max(np.abs(z)) < 4 * np.sqrt(4 / 1000)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["T1", "T2"])  # on T3 and T4, the error varies from seed to seed
def test_published_tmcmc_fails_with_a_warning(targets, name, seed):
    target = targets[name]
    sampler = TMCMCSampler(1000, target.ndim, target, vectorize=True, seed=seed, **CHING_CHEN_2007)
    with pytest.warns(SamplingWarning):
        sampler.run_mcmc(None, 1)
    z = (sampler.get_chain(flat=True).mean(axis=0) - target.mean) / target.sd
    assert np.sqrt(np.mean(z**2)) > 0.3


# most evaluations, largest error of the mean in posterior sd (rms), of the mode's weight, of the log-evidence
