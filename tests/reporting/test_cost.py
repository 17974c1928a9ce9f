"""Estimates of the cost of a run, compared with the run."""

import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler, estimate_cost
from samplers.cost import _scheduled, _wall_times
from samplers.tempering.expected_cost import Expected
from samplers.tempering.settings import Settings
from tests.contract.targets import Gaussian
from tests.reporting.test_progress import oscillating, posterior_of


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


def test_the_run_begins_with_the_timed_points():
    posterior = posterior_of(oscillating())
    estimate = estimate_cost(posterior, 64, seed=4)
    made = posterior.report()["simulations"]
    assert made == 6 and len(estimate.seconds) == 3  # three to start workers, three that count
    sampler = SMCSampler(64, posterior.ndim, posterior, vectorize=True, seed=4)
    posterior(sampler._functions.draw_prior(64, sampler._random))
    assert posterior.report()["simulations"] == 64
    # another seed has other points
    posterior(SMCSampler(64, posterior.ndim, posterior, seed=5)._functions.draw_prior(64, np.random.RandomState(5)))
    assert posterior.report()["simulations"] == 128


def test_the_table():
    posterior = posterior_of(oscillating())
    estimate = estimate_cost(posterior, 250, workers=16, seed=4)
    lines = str(estimate).splitlines()
    assert repr(estimate) == str(estimate) and lines[0] == "SMCSampler, 250 walkers, 3 parameters"
    for word in ("one evaluation (3 timed)", "evaluations", "wall time, 16 workers", "asynchronous=True", "guide"):
        assert any(word in line for line in lines), word
    assert "guide" not in str(estimate_cost(Gaussian(), 250, seed=1))


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
    with pytest.raises(ValueError, match="6 of 6 draws of the prior have a log-probability of -inf"):
        estimate_cost(impossible)
