"""Estimates of the cost of a run, compared with the run."""

import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler, estimate_cost
from samplers.cost import as_duration
from tests.contract.targets import Gaussian
from tests.judgement.test_checks import Plateau
from tests.reporting.test_progress import oscillating, posterior_of


@pytest.mark.parametrize(("sampler", "nwalkers"), [(SMCSampler, 250), (SMCSampler, 100), (TMCMCSampler, 100)])
def test_the_range_contains_the_run(sampler, nwalkers):
    posterior = Gaussian(5, 0.02)
    estimate = estimate_cost(posterior, nwalkers, sampler, seed=1)
    made = sampler(nwalkers, 5, posterior, vectorize=True, seed=1)
    made.run_mcmc(None, 0)
    assert estimate.fewest <= made.evaluations <= estimate.most < 9.0 * estimate.fewest


def test_the_run_begins_with_the_timed_points():
    posterior = posterior_of(oscillating())
    estimate = estimate_cost(posterior, 64, seed=4)
    made = posterior.report()["simulations"]
    assert made == 4 and len(estimate.seconds) == 3  # one to start, three that count
    sampler = SMCSampler(64, posterior.ndim, posterior, vectorize=True, seed=4)
    posterior(sampler._target.sample_prior(64, sampler._random))
    assert posterior.report()["simulations"] == 64
    # another seed has other points
    posterior(SMCSampler(64, posterior.ndim, posterior, seed=5)._target.sample_prior(64, np.random.RandomState(5)))
    assert posterior.report()["simulations"] == 128


def test_the_table():
    estimate = estimate_cost(posterior_of(oscillating()), 250, workers=16, seed=4)
    shortest, longest = (n * estimate.seconds.mean() / 16 for n in (estimate.fewest, estimate.most))
    assert as_duration(shortest, longest) in str(estimate)
    recycled, moved = (estimate_cost(Gaussian(), 250, seed=1, recycle=choice).fewest for choice in (True, False))
    assert recycled != moved


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"runs": 1}, "runs must be at least 2"),
        ({"workers": 0}, "workers must be at least 1"),
        ({"posterior": lambda x: 0.0}, "ndim"),
        ({"nwalkers": 4}, "at least 2 ndim"),
        ({"posterior": Plateau(-np.inf)}, "4 of 4 draws of the prior have a log-probability of -inf"),
    ],
)
def test_what_cannot_be_estimated_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        estimate_cost(**{"posterior": Gaussian(), **arguments})
