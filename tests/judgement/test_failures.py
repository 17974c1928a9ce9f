"""Failures among the final points end the posterior, not the data: the verdict says so, and only then."""

import numpy as np
import pytest
from scipy import stats

from samplers import SMCSampler, TMCMCSampler
from samplers.judgement.failures import NearFailures, failures_near
from tests.contract.targets import Box, Gaussian

N = 250


class Cut(Gaussian):
    """A Gaussian whose simulations fail above a limit of the first parameter, and return NaN or -inf then.

    Without failures, the mean of the first parameter is 0.70 and its standard deviation 0.05.
    """

    def __init__(self, limit, way, ndim=2, sd=0.05):
        super().__init__(ndim=ndim, sd=sd)
        self.limit, self.way, self.failed = limit, way, 0

    def __call__(self, x):
        values, failed = np.array(super().__call__(x)), np.asarray(x)[..., 0] > self.limit
        self.failed += int(np.sum(failed))
        values[failed] = np.nan if self.way == "nan" else -np.inf
        return values


class Counting(Cut):
    """As a posterior of finite-element models, it says which simulations failed."""

    def failures_at(self, x):
        return ["too far" if each[0] > self.limit else "" for each in np.asarray(x)]


def run(posterior, Sampler=SMCSampler, nwalkers=N, steps=1, **options):
    options = {"vectorize": True, "seed": 1, "max_failure_share": 0.99} | options
    sampler = Sampler(nwalkers, posterior.ndim, posterior, **options)
    sampler.run_mcmc(None, steps)
    return sampler


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize(
    "options", [{}, {"recycle": False, "nwalkers": 80}, {"Sampler": TMCMCSampler, "nwalkers": 80}], ids=str
)
@pytest.mark.parametrize("way", ["nan", "inf", "counted"])
def test_a_run_that_is_piled_up_against_failures_says_so(way, options):
    """Control: -inf without a count of failures means impossible parameters."""
    posterior = (Counting if way == "counted" else Cut)(0.7, way)
    sampler = run(posterior, **options)
    near = sampler._near
    assert (near.place == "border") == (sampler.verdict.status == "not usable") == (way != "inf")
    said = [r for r in sampler.verdict.reasons if "end the posterior there" in r]
    assert [f"{near.failed} of {near.evaluated} evaluated points" in r for r in said] == [True] * (way != "inf")
    # the points cannot tell: mean and standard deviation are those of half a Gaussian
    samples = sampler.get_chain(flat=True)[:, 0]
    mean, sd = Gaussian(ndim=2, sd=0.05).mean[0], Gaussian(ndim=2, sd=0.05).sd[0]
    half = stats.truncnorm(-np.inf, (0.7 - mean) / sd, loc=mean, scale=sd)
    error = half.std() * np.sqrt(1.0 / sampler.verdict.effective_sample_size + 1.0 / len(samples))
    assert samples.max() <= 0.7 and abs(samples.mean() - half.mean()) < 4.0 * error < half.std()


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("way", ["nan", "inf", "counted"])
def test_control_failures_away_from_the_posterior_are_no_concern(way):
    posterior = (Counting if way == "counted" else Cut)(0.9, way)
    sampler = run(posterior)
    assert posterior.failed > 10 and sampler._near.place == "away"
    assert sampler.verdict.status == "converged"


def test_control_a_bound_of_the_prior_is_no_failure():
    """The posterior leans against a corner of the box, outside of which nothing is evaluated."""
    sampler = run(Box([0.0, 0.0], [1.0, 1.0], lambda x: -20.0 * np.sum(x, axis=-1)))
    assert sampler._near == NearFailures(0, 0) and sampler.verdict.status == "converged"


class RulesOut(Cut):
    """Its second parameter is impossible above 0.7, which `possible` tells without a simulation."""

    def __call__(self, x):
        values = np.array(super().__call__(x))
        values[~self.possible(x)] = -np.inf
        return values

    def possible(self, x):
        return np.asarray(x)[..., 1] < 0.7


class CountingRulesOut(RulesOut, Counting):
    """The same, with reasons of failures."""


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("Posterior", [RulesOut, CountingRulesOut])
def test_what_is_known_to_be_impossible_is_no_failure(Posterior):
    sampler = run(Posterior(5.0, "inf"))
    assert sampler._near.failed == 0 and sampler.verdict.status == "converged"
    # failures beside it still count
    near = run(Posterior(0.7, "inf"))._near
    assert (near.place == "border") == (Posterior is CountingRulesOut)


def test_the_region_is_that_of_the_samples_in_any_units(rng):
    samples = rng.standard_normal((400, 2))
    failed, succeeded = rng.uniform(-4.0, 4.0, size=(100, 2)), rng.uniform(-4.0, 4.0, size=(300, 2))
    found = failures_near(samples, failed, succeeded)
    scale = np.array([2e-4, 3e10])
    assert failures_near(samples * scale, failed * scale, succeeded * scale) == found
    inside = np.sum(failed**2, axis=1) < np.quantile(np.sum(samples**2, axis=1), 0.99)
    assert abs(found.failed - inside.sum()) <= 4 and found.evaluated > found.failed


class Plane:
    """A log-likelihood of two parameters with a flat prior between -6 and 6, some of whose simulations fail."""

    ndim = 2

    def __init__(self, log_likelihood, fails):
        self.log_likelihood, self.fails, self.failed = log_likelihood, fails, 0

    def log_prior(self, x):
        return np.where(np.all(np.abs(x) < 6.0, axis=-1), -2.0 * np.log(12.0), -np.inf)

    def sample_prior(self, n, rng=None):
        return np.random.default_rng(rng).uniform(-6.0, 6.0, size=(n, 2))

    def __call__(self, x):
        x = np.asarray(x)
        failed = self.fails(x) & (self.log_prior(x) > -np.inf)
        self.failed += int(np.sum(failed))
        return np.where(failed, np.nan, self.log_prior(x) + self.log_likelihood(x))


def gaussian(x):
    return -0.5 * np.sum(x**2, axis=-1)


def bent(x):
    """A ridge along x1 = x0² - 2 whose conditional standard deviation is 0.2."""
    return -0.5 * (x[..., 0] / 1.3) ** 2 - 0.5 * ((x[..., 1] - x[..., 0] ** 2 + 2.0) / 0.2) ** 2


def gamma(x):
    """Gamma with shape 2 and scale 0.5 in x0 + 6, standard normal in x1."""
    return np.log(np.maximum(x[..., 0] + 6.0, 1e-300)) - 2.0 * (x[..., 0] + 6.0) - 0.5 * x[..., 1] ** 2


def scattered(x):
    """4 % of all points, without any order."""
    return np.abs(np.sin(x @ np.array([12.9898, 78.233]) * 43758.5453)) % 1.0 < 0.04


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("seed", [101, 102])  # of 12 seeds, 12, 11, 10 and 11 pass the last four cases
@pytest.mark.parametrize(
    ("log_likelihood", "fails", "place", "status"),
    [
        (bent, lambda x: x[..., 1] > x[..., 0] ** 2 - 0.8, "away", "converged"),
        (gaussian, lambda x: x[..., 0] > 4.0, "away", "converged"),
        (gaussian, scattered, "beside", "usable"),
        (gamma, lambda x: x[..., 0] > -3.5, "beside", "usable"),
        (gaussian, lambda x: x[..., 0] > 1.3, "border", "not usable"),
    ],
    ids=["inside a bend", "4 sd away", "scattered", "beyond the upper 4 %", "beyond the upper 10 %"],
)
def test_the_place_of_the_failures(log_likelihood, fails, place, status, seed):
    """The standard deviation is right in the first three cases, and 20 % too small in the others."""
    posterior = Plane(log_likelihood, fails)
    sampler = run(posterior, nwalkers=200, seed=seed, recycle=False)
    assert posterior.failed > 10
    assert (sampler._near.place, sampler.verdict.status) == (place, status)
    words = {"beside": "if these failures are scattered", "border": "end the posterior there"}
    assert [each for each in words if words[each] in str(sampler.verdict)] == [place] * (place in words)


@pytest.mark.parametrize(
    ("failed", "evaluated", "place"),
    [(7, 221, "beside"), (16, 200, "border"), (20, 995, "beside"), (42, 1020, "border")],
)
def test_a_few_failures_more_than_the_limit_are_chance(failed, evaluated, place):
    """Counts of runs, guided and plain, whose failures begin at 2 standard deviations (right), and at 1 and 1.5."""
    assert NearFailures(failed, evaluated, 10, False, evaluated).place == place


@pytest.mark.parametrize(("gap", "place"), [(6.0, "beside"), (1.3, "border")])
def test_failures_beside_a_bend_do_not_border_on_it(gap, place, rng):
    def draws(n, scale):
        x = rng.normal(size=n)
        return np.column_stack([x, 1.5 * x**2 + 0.2 * scale * rng.normal(size=n)])

    def fails(points):
        return points[:, 1] - 1.5 * points[:, 0] ** 2 > 0.2 * gap

    evaluated, samples = np.concatenate([draws(1500, 2.0**k) for k in (4, 3, 2, 1, 0, 0)]), draws(2000, 1.0)
    has_failed = fails(evaluated)
    near = failures_near(samples[~fails(samples)][:500], evaluated[has_failed], evaluated[~has_failed])
    assert near.place == place


def test_walkers_in_one_place_have_no_region(rng):
    """As where a limit ended the run after a collapse; the smallest number of points that span a region has one."""
    failed, succeeded = rng.normal(0.0, 1.0, (40, 2)), rng.normal(0.0, 1.0, (40, 2))
    for samples in (np.full((30, 2), 0.1), np.repeat([[0.1, 0.3], [0.2, 0.5]], 15, axis=0)):
        assert failures_near(samples, failed, succeeded) == NearFailures(0, 0)
    triangle = np.repeat([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]], 10, axis=0)
    assert failures_near(triangle, failed, succeeded).evaluated > 0
