"""Estimates of the cost of a run, compared with the run."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, FunctionModel, LocalPool, Measurements
from samplers import SMCSampler, TMCMCSampler, estimate_cost, timing
from samplers.cost import _scheduled, _wall_times
from samplers.tempering.expected_cost import Expected
from samplers.tempering.settings import Settings
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


@pytest.mark.parametrize("slow", [4, pytest.param(5, marks=pytest.mark.slow)])
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


def test_long_points_are_timed_at_once(monkeypatch):
    def made(workers, runs=3):
        cluster = SimulatedCluster(Gaussian(), workers, lambda x: np.ones(len(x)))
        sizes, submit = [], cluster.submit
        cluster.submit = lambda coords: sizes.append(len(coords)) or submit(coords)
        assert estimate_cost(cluster, 40, runs=runs, seed=1).evaluated == sum(sizes)
        return sizes

    # cheap points start all workers, after the first ones have shown that they are cheap
    assert made(1) == [1, 1, 1, 1] and made(4) == [4, 1, 1, 1] and made(20) == [8, 20, 1, 1, 1]
    assert made(64) == [8, 29, 1, 1, 1]  # as many as the run has draws of the prior
    monkeypatch.setattr(timing, "LONG", -1.0)
    assert made(64) == [8, 3] and made(4) == [4, 3] and made(2) == [2, 1, 1, 1] and made(64, 9) == [8, *[1] * 9]


def test_the_run_begins_with_the_timed_points():
    posterior = posterior_of(oscillating())
    estimate = estimate_cost(posterior, 64, seed=4)
    made = posterior.report()["simulations"]
    assert made == estimate.evaluated == 4 and len(estimate.seconds) == 3  # one to start, three that count
    sampler = SMCSampler(64, posterior.ndim, posterior, vectorize=True, seed=4)
    posterior(sampler._functions.draw_prior(64, sampler._random))
    assert posterior.report()["simulations"] == 64
    # another seed has other points
    posterior(SMCSampler(64, posterior.ndim, posterior, seed=5)._functions.draw_prior(64, np.random.RandomState(5)))
    assert posterior.report()["simulations"] == 128


@pytest.mark.parametrize(("pool", "on_disk"), [(None, True), (2, False), pytest.param(2, True, marks=pytest.mark.slow)])
def test_points_that_are_cached_are_not_timed(pool, on_disk, tmp_path):
    """A second estimate with the same seed, in the same process or with the same file; and one after a whole run."""

    def make():
        likelihood = FELikelihood(*slow, pool=pool, cache=tmp_path / "cache.db" if on_disk else None)
        return posterior_of(likelihood)

    slow = sleeping(0.03)
    first = posterior = make()
    earlier = estimate_cost(first, 20, seed=4)
    assert earlier.cached == 0 and "cached" not in str(earlier)
    for n in (0, 20):
        posterior = make() if on_disk else first
        if n:
            posterior(posterior.sample_prior(n, np.random.RandomState(4)))  # all draws of a sampler
        before = posterior.report()["simulations"]
        estimate = estimate_cost(posterior, 20, seed=4)
        made = posterior.report()["simulations"] - before
        assert made == estimate.evaluated - estimate.cached >= 4 and estimate.cached >= (n or 4)
        assert len(estimate.seconds) == 3 and estimate.seconds.min() >= 0.03
        assert f"{estimate.cached} cached, 3 timed" in str(estimate) and estimate.any_simulated


def sleeping(seconds):
    """A model that takes a time [s], and its measurements."""
    channels = (Channel("top", "displacement", "mm"),)
    model = FunctionModel(Sleeping(seconds), ("a", "b"), channels, dt=0.01, n_steps=3, version="1")
    return model, Measurements(channels, 0.01, np.ones((1, 3)))


@dataclass(frozen=True)
class Sleeping:
    seconds: float

    def __call__(self, theta):
        time.sleep(self.seconds)
        return 0.01 * np.array([theta[0], theta[1], theta[0] * theta[1]])[None]


def test_a_posterior_that_never_simulates_is_timed_and_says_so():
    class Recalled(Gaussian):
        def report(self):
            return {"simulations": 0}

    estimate = estimate_cost(Recalled(), 20, seed=1)
    assert not estimate.any_simulated and len(estimate.seconds) == 3 and estimate.evaluated == 40
    assert "no point needed a simulation: the times are those of cached points" in str(estimate)


def test_the_table():
    posterior = posterior_of(oscillating())
    estimate = estimate_cost(posterior, 250, workers=16, seed=4)
    lines = str(estimate).splitlines()
    assert repr(estimate) == str(estimate) and lines[0] == "SMCSampler, 250 walkers, 3 parameters"
    for word in (
        "one evaluation (4 made, 3 timed)",
        "evaluations",
        "wall time, 16 workers",
        "asynchronous=True",
        "guide",
    ):
        assert any(word in line for line in lines), word
    assert "guide" not in str(estimate_cost(Gaussian(), 250, seed=1))


def test_without_recycling_the_table_says_why_no_asynchronous_time():
    few = estimate_cost(Gaussian(), 100, seed=1)
    assert few.asynchronous is None and "only with recycling" in str(few).splitlines()[-1]
    assert estimate_cost(Gaussian(), 100, seed=1, recycle=True).asynchronous is not None
    assert estimate_cost(Gaussian(), 250, seed=1, recycle=False).asynchronous is None
    with pytest.raises(ValueError, match="recycle=True cannot act here"):
        estimate_cost(Gaussian(), 250, TMCMCSampler, recycle=True)


def test_lists_are_scheduled_in_order():
    assert _scheduled(np.array([3.0, 1.0, 1.0, 2.0]), 2) == 4.0
    assert _scheduled(np.array([3.0, 1.0, 1.0, 2.0]), 1) == 7.0
    assert _scheduled(np.array([3.0, 1.0]), 8) == 3.0


def test_uneven_durations_cost_a_synchronous_run_more():
    choice = Settings(recycle=True), Expected(4000.0, 5000.0, 6000.0), 500, 5
    uneven, even = np.array([0.2, 1.0, 5.0]) / 6.2 * 3.0, np.array([1.0, 1.0, 1.0])
    for workers, least in ((1, 0.9), (64, 1.2)):
        waiting, flowing = _wall_times(*choice, uneven, workers, True)
        assert waiting.likely > least * flowing.likely
    waiting, flowing = _wall_times(*choice, even, 50, True)
    assert waiting.likely == pytest.approx(100.0) and flowing.likely == pytest.approx(100.0)  # 5000 / 50 workers
    assert waiting.low == pytest.approx(80.0) and waiting.high == pytest.approx(120.0)
    assert _wall_times(*choice, even, 50, False)[1] is None


def test_an_asynchronous_run_never_takes_longer():
    for seconds in np.random.default_rng(1).lognormal(0.0, 1.0, (30, 3)):
        waiting, flowing = _wall_times(Settings(recycle=True), Expected(4e3, 5e3, 6e3), 500, 5, seconds, 1, True)
        assert np.all(np.array(flowing) <= np.array(waiting))


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
