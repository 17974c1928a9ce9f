"""Estimates of the cost of a run, compared with the run."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, FunctionModel, Measurements
from fe_likelihoods.simulation.local_pool import LocalPool
from samplers import SMCSampler, TMCMCSampler, estimate_cost
from samplers.cost import as_duration
from tests.contract.targets import Gaussian
from tests.reporting.test_progress import oscillating, posterior_of
from tests.simulated_cluster import SimulatedCluster


@pytest.mark.parametrize(("sampler", "nwalkers"), [(SMCSampler, 250), (SMCSampler, 100), (TMCMCSampler, 100)])
def test_the_range_contains_the_run(sampler, nwalkers):
    posterior = Gaussian(5, 0.02)
    estimate = estimate_cost(posterior, nwalkers, sampler, seed=1)
    made = sampler(nwalkers, 5, posterior, vectorize=True, seed=1)
    made.run_mcmc(None, 0)
    assert estimate.evaluations.low <= made.evaluations <= estimate.evaluations.high
    assert estimate.evaluations.high < 8.0 * estimate.evaluations.low  # a range that says something
    wider = estimate_cost(Gaussian(5, 2.0), nwalkers, sampler, seed=1)  # a posterior that is nearly the prior
    assert wider.evaluations.likely < 0.7 * estimate.evaluations.likely


@dataclass(frozen=True)
class SlowAtFirst:
    """A model of some milliseconds, whose first `slow` runs wait, in whichever processes."""

    folder: Path
    slow: int
    seconds: float

    def __call__(self, theta):
        for number in range(self.slow):
            try:
                (self.folder / str(number)).touch(exist_ok=False)
            except FileExistsError:
                continue
            time.sleep(self.seconds)
            break
        return 0.01 * np.array([theta[0], theta[1], theta[0] * theta[1]])[None]


@pytest.mark.slow
@pytest.mark.parametrize("slow", [4, 5])
def test_the_start_of_the_workers_is_not_timed(slow, tmp_path):
    channels = (Channel("top", "displacement", "mm"),)
    function = SlowAtFirst(tmp_path, slow, 1.5)
    model = FunctionModel(function, ("a", "b"), channels, dt=0.01, n_steps=3, version="1")
    with LocalPool(4) as pool:
        posterior = posterior_of(FELikelihood(model, Measurements(channels, 0.01, np.ones((1, 3))), pool=pool))
        estimate = estimate_cost(posterior, 250, seed=4)
    assert estimate.workers == 4 and estimate.evaluated == 7 and len(estimate.seconds) == 3
    # one slow run more than there are workers is timed
    assert (estimate.seconds >= 1.5).sum() == slow - 4


def test_workers_are_started_and_points_timed_at_the_same_time():
    def made(workers, runs=3):
        cluster = SimulatedCluster(Gaussian(), workers, lambda x: np.ones(len(x)))
        sizes, submit = [], cluster.submit
        cluster.submit = lambda coords: sizes.append(len(coords)) or submit(coords)
        assert estimate_cost(cluster, 40, runs=runs, seed=1).evaluated == sum(sizes)
        return sizes

    assert made(1) == [1, 1, 1, 1] and made(2) == [2, 2, 1] and made(20) == [20, 3]
    assert made(64) == [37, 3]  # as many as the run has draws of the prior
    assert made(4, 9) == [4, 4, 4, 1]


def test_the_run_begins_with_the_timed_points():
    posterior = posterior_of(oscillating())
    estimate = estimate_cost(posterior, 64, seed=4)
    made = posterior.report()["simulations"]
    assert made == estimate.evaluated == 4 and len(estimate.seconds) == 3  # one to start, three that count
    sampler = SMCSampler(64, posterior.ndim, posterior, vectorize=True, seed=4)
    posterior(sampler._target.sample_prior(64, sampler._random))
    assert posterior.report()["simulations"] == 64
    # another seed has other points
    posterior(SMCSampler(64, posterior.ndim, posterior, seed=5)._target.sample_prior(64, np.random.RandomState(5)))
    assert posterior.report()["simulations"] == 128


def test_cached_points_are_told(tmp_path):
    """A second estimate with the same seed."""
    posterior = posterior_of(oscillating())
    assert estimate_cost(posterior, 20, seed=4).cached == 0
    again = estimate_cost(posterior, 20, seed=4)
    assert again.cached == again.evaluated == 4 and "4 points were cached" in str(again)


def test_the_table():
    estimate = estimate_cost(posterior_of(oscillating()), 250, workers=16, seed=4)
    first, *rows = str(estimate).splitlines()
    assert repr(estimate) == str(estimate) and first == "SMCSampler, 250 walkers, 3 parameters"
    starts = ("one evaluation (4 made, 3 timed)  ", "evaluations  ", "wall time, 16 workers  ")
    assert all(row.startswith(start) for row, start in zip(rows, starts, strict=True))


def test_the_wall_time_is_the_range_of_evaluations_by_the_mean_duration():
    estimate = estimate_cost(Gaussian(), 100, workers=5, seed=1)
    expected = np.array(estimate.evaluations) * estimate.seconds.mean() / 5
    np.testing.assert_allclose(estimate.wall_time, expected)
    assert as_duration(estimate.wall_time.low, estimate.wall_time.high) in str(estimate)
    assert estimate.time_of(500) == as_duration(*[100.0 * estimate.seconds.mean()] * 2)
    with pytest.raises(TypeError, match="unexpected keyword argument 'recycle'"):
        estimate_cost(Gaussian(), 250, TMCMCSampler, recycle=True)
    recycled, moved = (estimate_cost(Gaussian(), 250, seed=1, recycle=choice).evaluations for choice in (True, False))
    assert recycled != moved


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (2.1 * 3600, 3.4 * 3600, "about 2.1 to 3.4 h"),
        (5.0, 5.0, "about 5 s"),
        (30.0, 150.0, "about 0.5 to 2.5 min"),
        (40 * 3600, 300 * 3600, "about 1.7 to 12 d"),
        (0.0, 100.0, "about 0 to 100 s"),
    ],
)
def test_durations_as_text(low, high, text):
    assert as_duration(low, high) == text


def test_what_cannot_be_estimated_is_refused():
    with pytest.raises(ValueError, match="runs must be at least 2"):
        estimate_cost(Gaussian(), runs=1)
    with pytest.raises(ValueError, match="workers must be at least 1"):
        estimate_cost(Gaussian(), workers=0)
    with pytest.raises(ValueError, match="ndim"):
        estimate_cost(lambda x: 0.0)
    with pytest.raises(ValueError, match="at least 2 ndim"):
        estimate_cost(Gaussian(5), nwalkers=4)
    impossible = Gaussian()
    impossible.log_likelihood = lambda x: -np.inf
    with pytest.raises(ValueError, match="4 of 4 draws of the prior have a log-probability of -inf"):
        estimate_cost(impossible)
