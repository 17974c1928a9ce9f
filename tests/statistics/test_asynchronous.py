"""Asynchronous recycling, and rounds of a guide, where the time of an evaluation depends on what is to be found."""

import numpy as np
import pytest

from samplers import SMCSampler
from tests.contract.targets import Gaussian
from tests.simulated_cluster import SimulatedCluster
from tests.statistics import analytic_posteriors as analytic
from tests.tempering.guides import LearningGuide

SEEDS = range(4)


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_a_narrow_mode_with_long_runs_is_kept():
    """Its evaluations take 100 times as long: proposals made of early arrivals lost it in 20 of 20 runs."""
    for seed in SEEDS:
        target = analytic.modes(seed, 2, 4, 18.0, 3.0, 20.0, "normal")
        cluster = SimulatedCluster(
            target, 64, lambda x, t=target: np.where(t.responsibilities(x)[:, 1] > 0.5, 100.0, 1.0)
        )
        sampler = SMCSampler(250, 4, cluster, vectorize=True, seed=1000 + seed, asynchronous=True)
        shares = target.responsibilities(sampler.run_mcmc(None, 0).coords).mean(axis=0)
        assert np.max(np.abs(shares - target.shares)) < 0.15
        assert abs(sampler.log_evidence - target.log_evidence) < 4.0 * sampler.log_evidence_error


class FailsSlowly(Gaussian):
    """A tenth of the prior fails."""

    def __call__(self, x):
        return np.where(x[:, 0] < -1.28, np.nan, super().__call__(x))


@pytest.mark.parametrize("factor", [0.01, 100.0], ids=["quick failures", "slow failures"])
def test_failures_of_another_length_do_not_stop_a_run(factor):
    """The points that arrive together are no fair sample: all of them may have failed."""
    target = FailsSlowly(3, sd=0.05)
    cluster = SimulatedCluster(target, 64, lambda x: np.where(x[:, 0] < -1.28, factor, 1.0))
    sampler = SMCSampler(250, 3, cluster, vectorize=True, seed=1, asynchronous=True)
    sampler.run_mcmc(None, 0)
    assert sampler.failure_count > 10
    assert abs(sampler.log_evidence - target.log_evidence) < 4.0 * sampler.log_evidence_error


class AlwaysFails(Gaussian):
    def __call__(self, x):
        return np.full(len(x), np.nan)


def test_a_run_of_failures_is_stopped():
    cluster = SimulatedCluster(AlwaysFails(3), 16, lambda x: np.ones(len(x)))
    sampler = SMCSampler(250, 3, cluster, vectorize=True, seed=1, asynchronous=True)
    with pytest.raises(RuntimeError, match="max_failure_share"):
        sampler.run_mcmc(None, 0)


def deviations_with_a_guide(seeds=30):
    """Deviations (3,) of log-evidence, mean and variance of a parameter, in standard errors of the mean over the seeds.

    Half of the posterior, where the first parameter is large, takes about 100 times as long.
    """

    def length(x):
        return np.where(x[:, 0] > target.mean[0], random.uniform(50.0, 150.0, len(x)), 1.0)

    numbers = []
    for seed in range(seeds):
        target, random = Gaussian(2, sd=0.05), np.random.default_rng(seed)
        cluster = SimulatedCluster(target, 32, length)
        guide = LearningGuide(target, target.mean, [np.diag((2.0 * target.sd) ** 2)])
        sampler = SMCSampler(80, 2, cluster, vectorize=True, seed=seed, guide=guide, asynchronous=True)
        z = (sampler.run_mcmc(None, 0).coords[:, 0] - target.mean[0]) / target.sd[0]
        evidence = (sampler.log_evidence - target.log_evidence) / sampler.log_evidence_error
        numbers.append((evidence, z.mean(), z.var() - 1.0))
    numbers = np.array(numbers)
    return numbers.mean(axis=0) / (numbers.std(axis=0, ddof=1) / np.sqrt(seeds))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_rounds_of_a_guide_do_not_prefer_short_runs():
    assert np.all(np.abs(deviations_with_a_guide()) < 3.0)
