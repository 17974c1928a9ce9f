r"""A hierarchical model without one of its tests, for all tests in turn, from one set of hyper-samples.

The posterior of the hyper-parameters without test k is that of all tests divided by the marginal likelihood of test k:

.. math::

   p(\varphi \mid D_{-k}) \propto \frac{p(\varphi \mid D)}{m_k(\varphi)}, \qquad
   p(D_k \mid D_{-k}) = \left(E\left[\frac{1}{m_k(\varphi)}\right]\right)^{-1},

the expectation over :math:`p(\varphi \mid D)`. The hyper-samples are weighted with :math:`1 / m_k`. Where these weights
are unusable, because the test has moved the population far, the population without it is sampled anew. No model is
simulated in either case. See ``docs/theory/hierarchy.rst``.

References
----------
A. Vehtari, A. Gelman, J. Gabry (2017), Practical Bayesian model evaluation using leave-one-out cross-validation and
WAIC, Statistics and Computing 27, 1413-1432, doi:10.1007/s11222-016-9696-4.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .hierarchical_posterior import HierarchicalPosterior
from .hierarchy import Hierarchy
from .inputs import as_points
from .pareto_smoothing import LARGEST_SHAPE, smoothed_weights

__all__ = ["LeftOut", "leave_one_out"]

_FEWEST_EFFECTIVE = 50.0  # hyper-samples
_WALKERS, _STEPS = 128, 400  # of a new run, half of the steps is left out
_FEWEST_TIMES = 10.0  # autocorrelation times in the steps that are used


class LeftOut(NamedTuple):
    """The population without one test.

    Attributes
    ----------
    hierarchy : Hierarchy
        Population of the other tests.
    pareto_shape : float
        Shape of the tail of the weights 1 / m_k [-].
    effective_samples : float
        Effective number of hyper-samples after weighting.
    sampled : bool
        Whether the population was sampled anew, because the shape is above 0.7 or fewer than 50 effective samples are
        left.
    log_density : float
        Logarithm of the predictive density of all data of the test given the other tests, a proper score: larger is
        better. NaN if its `StoredPosterior` has no `log_evidence`.
    log_density_error : float
        Standard error of it from the number of hyper-samples and the error of the evidence.
    """

    hierarchy: Hierarchy
    pareto_shape: float
    effective_samples: float
    sampled: bool
    log_density: float
    log_density_error: float


def leave_one_out(
    hierarchy: Hierarchy, *, sample: Callable[[HierarchicalPosterior], Any] | None = None, seed: int = 0
) -> dict[str, LeftOut]:
    """Leave each test out of a hierarchical model in turn. No simulation is run.

    Parameters
    ----------
    hierarchy : Hierarchy
        Population of two tests or more.
    sample : callable, optional
        Function of a `HierarchicalPosterior` that returns samples (n, ndim) of its hyper-parameters, for tests that
        weights cannot leave out. Default: emcee with differential evolution, 128 walkers that start from the weighted
        hyper-samples, and 400 steps, of which the second half is used.
    seed : int
        Seed of resampling and of the default sampler.

    Returns
    -------
    dict of str to LeftOut
        For each test.

    Raises
    ------
    ValueError
        For a hierarchy of a single test.

    Warns
    -----
    UserWarning
        If tests are left out by new samples, which names them, and if such a run was too short.

    Examples
    --------
    >>> for name, left_out in leave_one_out(hierarchy).items():
    ...     prediction = predict_new_event(left_out.hierarchy, posteriors[name], None, quantity=peak("deck"))
    """
    posterior = hierarchy.posterior
    if len(posterior.tests) < 2:
        raise ValueError(f"leave_one_out needs two tests or more; got {', '.join(map(repr, posterior.tests))}")
    log_marginals = posterior.log_marginals(hierarchy.samples)
    rng, found, anew = np.random.default_rng(seed), {}, []
    for k, name in enumerate(posterior.tests):
        rest, own = posterior.without(name), log_marginals[:, k]
        weights, shape = smoothed_weights(own.min() - own)
        effective = float(1.0 / np.square(weights).sum())
        sampled = bool(shape > LARGEST_SHAPE or effective < min(_FEWEST_EFFECTIVE, 0.5 * len(own)))
        rows = _systematic(weights, len(own), rng)
        samples = hierarchy.samples[rows]
        if sampled:
            anew.append(f"{name!r} (Pareto shape {shape:.2f}, {effective:.0f} effective samples)")
            samples = (
                _sample_anew(rest, samples, rng) if sample is None else as_points(sample(rest), rest.parameter_names)
            )
            own = posterior.log_marginals(samples)[:, k]
            weights = np.full(len(own), 1.0 / len(own))
            effective = float(len(np.unique(samples, axis=0)))
        log_density, error = _log_mean(own, weights)
        stored = posterior.tests[name]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what limits the tests was said of all of them; checks have the rest
            population = Hierarchy(rest, samples, seed)
        found[name] = LeftOut(
            population,
            shape,
            effective,
            sampled,
            np.nan if stored.log_evidence is None else log_density,
            float(np.hypot(error, stored.log_evidence_error)),
        )
    if anew:
        warnings.warn(
            f"these tests have moved the population so far that weights cannot leave them out: {', '.join(anew)}. The "
            "population without them was sampled anew, without simulations",
            stacklevel=2,
        )
    return found


def _systematic(weights: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """Rows drawn by systematic resampling, in random order."""
    cumulative = np.cumsum(weights)
    positions = (np.arange(size) + rng.random()) / size * cumulative[-1]
    return rng.permutation(np.minimum(np.searchsorted(cumulative, positions), len(weights) - 1))


def _log_mean(log_values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Logarithm of a weighted mean of exponentials, and its standard error."""
    largest = log_values.max()
    values = np.exp(log_values - largest)
    mean = weights @ values
    error = np.sqrt(np.square(weights * (values - mean)).sum()) / mean
    return float(largest + np.log(mean)), float(error)


def _sample_anew(posterior: HierarchicalPosterior, start: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Samples of the hyper-parameters from an ensemble that starts at the weighted samples."""
    import emcee

    walkers = max(_WALKERS, 4 * posterior.ndim)
    # different points: weighted samples, and pairs of them a little apart
    first = start[rng.integers(len(start), size=walkers)]
    spread = np.maximum(start.std(axis=0), 1e-3 * np.abs(start).mean(axis=0))
    proposals = first + 0.3 * spread * rng.standard_normal((20, walkers, posterior.ndim))
    for proposed in proposals:
        moved = np.isfinite(posterior.log_prior(proposed))
        first = np.where(moved[:, None], proposed, first)
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(walkers, posterior.ndim, posterior.log_prob, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(int(rng.integers(2**31))).get_state()
    sampler.run_mcmc(first, _STEPS, skip_initial_state_check=True)
    used = _STEPS // 2
    time = float(np.max(sampler.get_autocorr_time(discard=_STEPS - used, quiet=True, tol=0)))
    if not used > _FEWEST_TIMES * time:
        warnings.warn(
            f"a population of {len(posterior.tests)} tests was sampled for {used / time:.1f} "
            f"autocorrelation times, {_FEWEST_TIMES:.0f} are needed: give sample= with another sampler",
            stacklevel=4,
        )
    return sampler.get_chain(discard=_STEPS - used, thin=max(int(time / 2.0), 1), flat=True)
