r"""A hierarchical model without one of its tests, for all tests in turn, from one set of hyper-samples.

The posterior of the hyper-parameters without test k is their posterior given all tests, divided by the marginal
likelihood of test k:

.. math::

   p(\varphi \mid D_{-k}) \propto \frac{p(\varphi \mid D)}{m_k(\varphi)}, \qquad
   p(D_k \mid D_{-k}) = \left(E\left[\frac{1}{m_k(\varphi)}\right]\right)^{-1},

the expectation over :math:`p(\varphi \mid D)`. The hyper-samples are weighted with :math:`1 / m_k` where these weights
are nearly even. Otherwise the population without the test may be where no hyper-sample is, which weights cannot show:
it is sampled anew, and the predictive density is the ratio of both normalising constants, by bridge sampling. With
common parameters it is always sampled anew: beyond the bounds of a test's prior :math:`m_k` is zero, so that no
hyper-sample is there. No model is simulated in either case. See ``docs/theory/hierarchy.rst``.

References
----------
A. Vehtari, A. Gelman, J. Gabry (2017), Practical Bayesian model evaluation using leave-one-out cross-validation and
WAIC, Statistics and Computing 27, 1413-1432, doi:10.1007/s11222-016-9696-4.
"""

import warnings
from typing import NamedTuple

import numpy as np

from samplers.estimates.bridge import log_ratio
from samplers.estimates.pareto import LARGEST_SHAPE, smoothed_weights
from samplers.resampling import systematic

from ..text_tables import number, text_table
from .hierarchical_posterior import HierarchicalPosterior
from .hierarchy_result import Hierarchy

__all__ = ["LeftOut", "without_each"]

_SMALLEST_SHARE = 0.5  # effective hyper-samples of all: fewer may hide a region without samples
_WALKERS, _STEPS = 500, 4  # of a new run: a test that 1 % of 500 samples permit has a density with an error of 0.7


class LeftOut(NamedTuple):
    """The population without one test.

    It was sampled anew if the shape is 0.7 or more, less than half of the hyper-samples are effective, or parameters
    are common to all tests. The log predictive density of all the test's data given the other tests is a proper score:
    larger is better. It is NaN if its `StoredPosterior` has no `log_evidence`, and where no sample of the population
    without the test is within the test's prior. Its error is from the number of hyper-samples (taken as independent),
    the number of new samples, and the error of the evidence.
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


def without_each(hierarchy: Hierarchy, seed: int) -> dict[str, LeftOut]:
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
        sampled = not even or bool(posterior.common)
        if not sampled:
            samples = hierarchy.samples[rng.permutation(systematic(weights, rng))]
            log_density, error = _log_mean(own, weights)
        else:
            samples = _sample(rest, int(rng.integers(2**31)))
            log_density, error = log_ratio(own, posterior.log_marginals(samples)[:, k])
        if np.isnan(log_density):
            warnings.warn(
                f"leave_one_out: no sample of the population without test {name!r} is possible under this test, whose "
                f"prior of {', '.join(posterior.common)} ends beside that population: its predictive density is not "
                "known. Sample this test again with the prior of the hierarchical model",
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


def _sample(posterior: HierarchicalPosterior, seed: int) -> np.ndarray:
    """Samples (n, ndim) of a posterior of hyper-parameters."""
    from samplers import SMCSampler

    run = SMCSampler(_WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed)
    run.run_mcmc(None, _STEPS)
    return run.get_chain(flat=True)
