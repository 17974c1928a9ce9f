"""Asynchronous recycling, where the time of an evaluation depends on what is to be found."""

import numpy as np
import pytest

from samplers import SMCSampler
from tests.contract.targets import Gaussian
from tests.simulated_cluster import SimulatedCluster
from tests.statistics import analytic_posteriors as analytic

SEEDS = range(4)


class OfPoints:
    """A target of batches as a function of one point."""

    def __init__(self, target):
        self._target, self.sample_prior = target, target.sample_prior

    def log_prior(self, x):
        return float(self._target.log_prior(x[None])[0])

    def __call__(self, x):
        return float(self._target(x[None])[0])


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_a_narrow_mode_with_long_runs_is_kept():
    """Its evaluations take 100 times as long: proposals made of early arrivals lost it in 20 of 20 runs."""
    for seed in SEEDS:
        target = analytic.modes(seed, 2, 4, 18.0, 3.0, 20.0, "normal")
        cluster = SimulatedCluster(64, lambda x, t=target: 100.0 if t.responsibilities(x[None])[0, 1] > 0.5 else 1.0)
        sampler = SMCSampler(250, 4, OfPoints(target), pool=cluster, seed=1000 + seed, asynchronous=True)
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
    cluster = SimulatedCluster(64, lambda x: factor if x[0] < -1.28 else 1.0)
    sampler = SMCSampler(250, 3, OfPoints(target), pool=cluster, seed=1, asynchronous=True)
    sampler.run_mcmc(None, 0)
    assert sampler.failure_count > 10
    assert abs(sampler.log_evidence - target.log_evidence) < 4.0 * sampler.log_evidence_error


class AlwaysFails(Gaussian):
    def __call__(self, x):
        return np.full(len(x), np.nan)


def test_a_run_of_failures_is_stopped():
    cluster = SimulatedCluster(16, lambda x: 1.0)
    sampler = SMCSampler(250, 3, OfPoints(AlwaysFails(3)), pool=cluster, seed=1, asynchronous=True)
    with pytest.raises(RuntimeError, match="max_failure_share"):
        sampler.run_mcmc(None, 0)
