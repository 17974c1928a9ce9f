r"""A hierarchical model without one of its tests, for all tests in turn, from one set of hyper-samples.

The posterior of the hyper-parameters without test k is their posterior given all tests, divided by the marginal
likelihood of test k:

.. math::

   p(\varphi \mid D_{-k}) \propto \frac{p(\varphi \mid D)}{m_k(\varphi)}, \qquad
   p(D_k \mid D_{-k}) = \left(E\left[\frac{1}{m_k(\varphi)}\right]\right)^{-1},

the expectation over :math:`p(\varphi \mid D)`. The hyper-samples are weighted with :math:`1 / m_k` where these weights
are nearly even. Otherwise the population without the test may be where no hyper-sample is, which weights cannot show:
it is sampled anew, through populations in which the test counts less and less, :math:`p(\varphi \mid D_{-k}) m_k^t`
with t from 1 to 0. The predictive density is then a product of ratios between neighbouring populations, each by bridge
sampling. If a test's prior of a common parameter is narrower than the other priors, the population is always sampled
anew: beyond the bounds of this prior :math:`m_k` is zero, so that no hyper-sample is there. No model is simulated in
either case. See ``docs/theory/hierarchy.rst``.

References
----------
A. Vehtari, A. Gelman, J. Gabry (2017), Practical Bayesian model evaluation using leave-one-out cross-validation and
WAIC, Statistics and Computing 27, 1413-1432, doi:10.1007/s11222-016-9696-4.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from samplers.estimates.bridge import log_ratio
from samplers.estimates.pareto import LARGEST_SHAPE, smoothed_weights
from samplers.estimates.weights import effective_sample_size
from samplers.resampling import systematic

from ..checks.finding import warn
from ..checks.stored_posteriors import check_chain_length
from ..priors.points import as_points
from ..text_tables import number, text_table
from .hierarchical_posterior import HierarchicalPosterior
from .hierarchy_result import Hierarchy
from .reweighting import ends_within

__all__ = ["LeftOut", "without_each"]

_SMALLEST_SHARE = 0.5  # effective hyper-samples of all: fewer may hide a region without samples
_WALKERS, _BLOCK, _MOST_STEPS = 128, 200, 4000
_FEWEST_TIMES = 10.0  # autocorrelation times in the steps that are used, the second half


class LeftOut(NamedTuple):
    """The population without one test.

    It was sampled anew if the shape is 0.7 or more, less than half of the hyper-samples are effective, or the prior of
    the test leaves out values of a common parameter that the others permit. The log predictive density of all the
    test's data given the other tests is a proper score: larger is better. It is NaN if its `StoredPosterior` has no
    `log_evidence`, and where no sample of the population without the test is within the test's prior. Its error is from
    the number of hyper-samples (taken as independent), the number of new samples, and the error of the evidence.
    """

    hierarchy: Hierarchy  # population of the other tests
    pareto_shape: float  # of the weights 1 / m_k [-]
    effective_samples: float  # hyper-samples after weighting, or new samples
    sampled: bool
    log_density: float
    log_density_error: float

    @property
    def cells(self) -> dict[str, str]:
        """The numbers as texts by headings, for `leave_one_out`."""
        return {
            "log density": number(self.log_density, 5),
            "its error": number(self.log_density_error, 2),
            "effective samples": f"{self.effective_samples:.0f}",
            "Pareto shape": number(self.pareto_shape, 2),
            "sampled anew": "yes" if self.sampled else "no",
        }

    def __str__(self) -> str:
        return text_table([list(self.cells), list(self.cells.values())])


def without_each(
    hierarchy: Hierarchy, sample: Callable[[HierarchicalPosterior], Any] | None, seed: int
) -> dict[str, LeftOut]:
    """The population without each test in turn, see `fe_likelihoods.leave_one_out`."""
    posterior = hierarchy.posterior
    if len(posterior.tests) < 2:
        raise ValueError(f"leave_one_out needs two tests or more; got {', '.join(map(repr, posterior.tests))}")
    different = len(np.unique(hierarchy.samples, axis=0))
    if different < 2 * posterior.ndim:
        raise ValueError(
            f"leave_one_out: expected {2 * posterior.ndim} different hyper-samples or more, twice the number of "
            f"hyper-parameters; got {different}: sample the population with more walkers or steps"
        )
    log_marginals = posterior.log_marginals(hierarchy.samples)
    for name, column in zip(posterior.tests, log_marginals.T, strict=True):
        if impossible := int((~np.isfinite(column)).sum()):
            raise ValueError(
                f"leave_one_out: expected samples of the posterior of all tests; {impossible} of {len(column)} "
                f"hyper-samples are impossible under test {name!r}, such as common parameters beyond the bounds of its "
                "prior: start the walkers where HierarchicalPosterior.log_prob is finite"
            )
    rng, found = np.random.default_rng(seed), {}
    for k, name in enumerate(posterior.tests):
        rest, own = posterior.without(name), log_marginals[:, k]
        weights, shape = smoothed_weights(own.min() - own)
        effective = float(1.0 / np.square(weights).sum())
        even = shape < LARGEST_SHAPE and effective >= _SMALLEST_SHARE * len(own)
        cut_off = ends_within(posterior, name, others=rest.tests)
        sampled = not even or bool(cut_off)
        if not sampled:
            samples = hierarchy.samples[rng.permutation(systematic(weights, rng))]
            log_density, error = _log_mean(own, weights)
        elif sample is None:
            samples, log_density, error = _sample_anew(posterior, k, hierarchy.samples, own, rng)
        else:
            samples = as_points(sample(rest), rest.parameter_names)
            log_density, error = log_ratio(own, posterior.log_marginals(samples)[:, k])
        if np.isnan(log_density):
            warnings.warn(
                f"leave_one_out: no sample of the population without test {name!r} is possible under this test, whose "
                f"prior of {', '.join(cut_off)} ends beside that population: its predictive density is not known. "
                "Sample this test again with the prior of the hierarchical model",
                stacklevel=2,
            )
        stored = posterior.tests[name]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what limits the tests was said of all of them; checks have the rest
            population = Hierarchy(rest, samples, seed)
        found[name] = LeftOut(
            population,
            shape,
            float(len(np.unique(samples, axis=0))) if sampled else effective,
            sampled,
            np.nan if stored.log_evidence is None else log_density,
            float(np.hypot(error, stored.log_evidence_error)),
        )
    return found


def _log_mean(log_values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Logarithm of a weighted mean of exponentials, and its standard error."""
    largest = log_values.max()
    values = np.exp(log_values - largest)
    mean = weights @ values
    error = np.sqrt(np.square(weights * (values - mean)).sum()) / mean
    return float(largest + np.log(mean)), float(error)


def _sample_anew(
    posterior: HierarchicalPosterior, k: int, samples: np.ndarray, own: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, float, float]:
    """Samples without test k, its log predictive density and error, by a sequence in which the test counts less."""
    power, log_density, variance = 1.0, 0.0, 0.0
    while power > 0.0:
        lower = _next_power(own, power)
        weights = np.exp((lower - power) * (own - own.min()))
        rows = rng.permutation(systematic(weights, rng))
        new = _ensemble(partial(_log_prob, posterior, k, lower), samples[rows], rng)
        new_own = posterior.log_marginals(new)[:, k]
        ratio, error = log_ratio((power - lower) * own, (power - lower) * new_own)
        # neighbouring ratios share samples and depend on each other: at most twice the variance of independent ones
        log_density, variance = log_density + ratio, variance + 2.0 * error**2
        power, samples, own = lower, new, new_own
    return samples, log_density, float(np.sqrt(variance))


def _log_prob(posterior: HierarchicalPosterior, k: int, power: float, x: np.ndarray) -> np.ndarray:
    """Log-density of the hyper-parameters in which the likelihood of test k has this power."""
    log_density = posterior.log_prior(x)
    inside = log_density > -np.inf
    if inside.any():
        marginals = posterior.log_marginals(x[inside])
        # no difference of sums: it is NaN where the test is impossible
        marginals[:, k] = power * marginals[:, k] if power > 0.0 else 0.0
        log_density[inside] += marginals.sum(axis=1)
    return log_density


def _next_power(own: np.ndarray, power: float) -> float:
    """The smallest power whose weights leave half of the samples effective; 0 if possible."""

    def share(lower: float) -> float:
        return effective_sample_size((lower - power) * own) / len(own)

    low, high = 0.0, power
    if share(low) >= _SMALLEST_SHARE:
        return low
    while high - low > 1e-3 * power:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if share(middle) >= _SMALLEST_SHARE else (middle, high)
    return high if high < power else 0.5 * power


def _ensemble(log_prob: Callable[[np.ndarray], np.ndarray], start: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Samples of a density, about one autocorrelation time apart, from an ensemble with differential evolution."""
    import emcee

    ndim = start.shape[1]
    walkers = max(_WALKERS, 4 * ndim)
    first = start[rng.integers(len(start), size=walkers)]
    # weighted samples are repeated: points a little apart, where they are possible
    apart = first + 0.3 * start.std(axis=0) * rng.standard_normal(first.shape)
    first = np.where(np.isfinite(log_prob(apart))[:, None], apart, first)
    # not emcee's DESnookerMove, whose samples are too narrow (emcee 3.1.6): see tests/contract/test_emcee_moves.py
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DEMove(gamma0=1.0), 0.2)]
    sampler = emcee.EnsembleSampler(walkers, ndim, log_prob, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(int(rng.integers(2**31))).get_state()
    state, time = first, np.inf
    while sampler.iteration < 2.0 * _FEWEST_TIMES * time and sampler.iteration < _MOST_STEPS:
        state = sampler.run_mcmc(state, _BLOCK, skip_initial_state_check=True)
        half = sampler.iteration // 2
        moved = (np.ptp(sampler.get_chain(discard=half), axis=0) > 0.0).all()  # emcee divides by the variance of each
        times = sampler.get_autocorr_time(discard=half, quiet=True, tol=0) if moved else np.inf
        time = float(np.max(times)) if np.isfinite(times).all() else np.inf
    warn(check_chain_length(sampler.iteration / 2.0 / time, _FEWEST_TIMES), stacklevel=5)
    thin = int(np.ceil(time)) if np.isfinite(time) else 1
    return sampler.get_chain(discard=sampler.iteration // 2, thin=max(thin, 1), flat=True)
