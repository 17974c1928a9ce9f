r"""Marginal likelihood of one test under a normal population of its parameters, from stored posterior samples.

With a test's posterior samples :math:`u_j` of weights :math:`w_j`, its prior density :math:`p_0` and its evidence
:math:`Z`, the marginal likelihood under a population density :math:`p(u \mid \varphi)` is

.. math::

   m(\varphi) = Z \int q(u) \frac{p(u \mid \varphi)}{p_0(u)}\, du
   \approx Z \sum_j w_j \frac{p(u_j \mid \varphi)}{p_0(u_j)},

where :math:`q` is the posterior density. The sum has large errors where the population is much narrower than the
posterior. Its samples are therefore combined with points of the density proportional to :math:`q\, p(u \mid \varphi)`,
which is a mixture of normal distributions if :math:`q` is the fitted mixture. See ``docs/theory/hierarchy.rst``.

References
----------
E. Veach, L. J. Guibas (1995), Optimally combining sampling techniques for Monte Carlo rendering, Proc. SIGGRAPH 95,
419-428, doi:10.1145/218380.218498.
"""

import itertools
from functools import cache
from typing import NamedTuple

import numpy as np

from .stored_posterior import DescribedPosterior

__all__ = [
    "PopulationMarginal",
    "draw_parameters",
    "draw_products",
    "inverse_prior",
    "log_density",
    "population_marginal",
    "product_with_population",
    "sample_weights",
]

_LOG_TWO_PI = np.log(2.0 * np.pi)
_LARGEST_EXCESS = 3.0  # by which the log inverse prior density may exceed its largest value at the samples
_CHUNK = 2**15  # values of a temporary array, which fits into the cache of the processor
_RANDOM_NODES = 128
_LARGEST_EXPONENT = 700.0
_DRAWS = 16
_JITTER = 1e-12


class PopulationMarginal(NamedTuple):
    """Marginal likelihood of a test at n hyper-parameters."""

    log_value: np.ndarray  # (n,), logarithm of the marginal likelihood over the evidence
    sample_share: np.ndarray  # (n,), of this value from the samples; the rest is from the fitted mixture


class Product(NamedTuple):
    """Product of a fitted mixture and a normal population, at n hyper-parameters."""

    log_masses: np.ndarray  # (n, n_components), log integrals of component times population
    means: np.ndarray  # (n, n_components, n_varying)
    factors: np.ndarray  # matrices A with covariances A A^T (n, n_components, n_varying, n_varying)


def population_marginal(described: DescribedPosterior, center: np.ndarray, sd: np.ndarray) -> PopulationMarginal:
    """Marginal likelihood of a test under normal populations, with n centres (n, d) of its parameters.

    The first n_varying parameters vary between tests, with standard deviations (n, n_varying); the others are common,
    and their centres are their values.
    """
    size = max(1, _CHUNK // (len(described.points) * sd.shape[-1]))
    parts = [_marginal(described, center[i : i + size], sd[i : i + size]) for i in range(0, max(len(center), 1), size)]
    return PopulationMarginal(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def sample_weights(described: DescribedPosterior, center: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Weights (n, m) of a test's samples under n populations, which sum to one in each row; no parameter may be common.

    They are zero in a row where no sample has a density above the smallest float.
    """
    log_weights = log_density(described.points, center, sd) + described.log_weights - described.log_prior
    largest = log_weights.max(axis=1, keepdims=True)
    weights = np.exp(log_weights - np.where(np.isfinite(largest), largest, 0.0))
    total = weights.sum(axis=1, keepdims=True)
    return weights / np.where(total > 0.0, total, 1.0)


def draw_parameters(
    described: DescribedPosterior, center: np.ndarray, sd: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """One draw (n, d) of a test's parameters given each of n hyper-parameters.

    It is chosen among the stored samples and random points from the product of mixture and population, with the weights
    of `population_marginal`.
    """
    result = np.empty((len(center), center.shape[-1]))
    products = draw_products(described, center, sd, _DRAWS, rng)
    for i, drawn in enumerate(products):
        one, spread, points = center[i : i + 1], sd[i : i + 1], drawn
        weights = inverse_prior(described, drawn)
        if center.shape[-1] == sd.shape[-1]:
            share = _share_of_samples(described)
            points = np.concatenate([described.points, drawn])
            own = share * np.exp(described.log_weights) * inverse_prior(described, described.points)
            weights = np.concatenate([own, (1.0 - share) / _DRAWS * weights])
            log_mass = np.logaddexp.reduce(product_with_population(described, one, spread).log_masses[0])
            inverse = np.exp(np.minimum(log_mass - log_density(points, one, spread)[0], _LARGEST_EXPONENT))
            weights /= share * inverse + 1.0 - share
        total = weights.sum()
        # without any possible point (a test beside the population) the product itself is the best description
        result[i] = points[rng.choice(len(points), p=weights / total) if total > 0.0 else -1]
    return result


def draw_products(
    described: DescribedPosterior, center: np.ndarray, sd: np.ndarray, size: int, rng: np.random.Generator
) -> np.ndarray:
    """Draws (n, size, d) of the normalised product of the mixture and n populations, with the common parameters."""
    (n, dim), varying = center.shape, sd.shape[-1]
    product = product_with_population(described, center, sd)
    cumulative = np.cumsum(np.exp(product.log_masses - product.log_masses.max(axis=1, keepdims=True)), axis=1)
    positions = rng.random((n, size)) * cumulative[:, -1:]
    which = (positions[:, :, None] > cumulative[:, None, :-1]).sum(axis=2)
    rows, normal = np.arange(n)[:, None], rng.standard_normal((n, size, varying))
    drawn = product.means[rows, which] + np.einsum("nsvw,nsw->nsv", product.factors[rows, which], normal)
    return np.concatenate([drawn, np.broadcast_to(center[:, None, varying:], (n, size, dim - varying))], axis=-1)


def inverse_prior(described: DescribedPosterior, points: np.ndarray) -> np.ndarray:
    """Inverse prior density (...) of points (..., d), times its smallest value at the samples.

    It is zero outside the bounds of the prior, where the likelihood is taken as zero. Where no samples are, it is
    limited.
    """
    log_prior, lowest = described.log_prior_at(points), described.log_prior.min()
    return np.exp(lowest - np.maximum(log_prior, lowest - _LARGEST_EXCESS)) * (log_prior > -np.inf)


def product_with_population(described: DescribedPosterior, center: np.ndarray, sd: np.ndarray) -> Product:
    """Product of a test's mixture and normal populations; arguments as for `population_marginal`."""
    varying, dim = sd.shape[-1], center.shape[-1]
    total = np.tile(described.covariances, (len(center), 1, 1, 1))
    diagonal = np.arange(varying)
    total[..., diagonal, diagonal] += np.square(sd)[:, None]
    lower = np.linalg.cholesky(total)
    offset = center[:, None] - described.means
    scaled = np.linalg.solve(lower, offset[..., None])[..., 0]
    log_masses = described.log_shares - 0.5 * np.square(scaled).sum(axis=-1) - 0.5 * dim * _LOG_TWO_PI
    log_masses = log_masses - np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
    gain = np.linalg.solve(total, np.tile(described.covariances[..., :varying], (len(center), 1, 1, 1)))
    means = described.means[:, :varying] + np.einsum("ncdv,ncd->ncv", gain, offset)
    # the covariance C - C (C + S)^-1 C, written as S (C + S)^-1 C because the difference loses all digits for small S
    covariances = np.square(sd)[:, None, :, None] * gain[..., :varying, :]
    return Product(log_masses, means, _roots(covariances, np.einsum("cvv->cv", described.covariances)[:, :varying]))


def _roots(covariances: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Matrices A with covariance A A^T (n, c, v, v); `largest` (c, v) are upper limits of the variances.

    Cholesky factors, or eigenvectors where round-off has made a covariance indefinite (correlations near 1).
    """
    deviations = np.sqrt(np.maximum(np.einsum("ncvv->ncv", covariances), _JITTER**2 * largest))
    correlations = covariances / deviations[..., :, None] / deviations[..., None, :]
    correlations = 0.5 * (correlations + correlations.swapaxes(-1, -2)) + _JITTER * np.eye(covariances.shape[-1])
    try:
        roots = np.linalg.cholesky(correlations)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(correlations)
        roots = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return deviations[..., None] * roots


def log_density(points: np.ndarray, center: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Logarithm of independent normal densities (n, m) at points (m, d) or (n, m, d), for means and sd (n, d)."""
    total = sum(np.square((points[..., k] - center[:, k, None]) / sd[:, k, None]) for k in range(sd.shape[1]))
    return -0.5 * total - (np.log(sd).sum(axis=1) + 0.5 * sd.shape[1] * _LOG_TWO_PI)[:, None]


def _marginal(described: DescribedPosterior, center: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n, varying = len(center), sd.shape[-1]
    product = product_with_population(described, center, sd)
    node_weights, directions = _nodes(varying)
    nodes = product.means[:, :, None] + np.einsum("ncvw,jw->ncjv", product.factors, directions)
    is_common = center.shape[-1] > varying
    values = np.tile(center[:, None, None, varying:], (1, *nodes.shape[1:3], 1))
    of_prior = inverse_prior(described, np.concatenate([nodes, values], axis=-1)).reshape(n, -1)
    lowest = described.log_prior.min()
    log_mass = product.log_masses.max(axis=1)
    masses = np.exp(product.log_masses - log_mass[:, None])
    log_mass += np.log(masses.sum(axis=1))
    masses /= masses.sum(axis=1, keepdims=True)
    of_mixture = (masses[:, :, None] * node_weights).reshape(n, -1) * of_prior
    of_samples = np.zeros(n)
    if not is_common:  # samples of a common parameter do not have its exact value
        # The mixture of both densities of points is q(u) [s + (1 - s) p(u | phi) / M]: s is the share of the samples,
        # and q(u) p(u | phi) / M the density of the nodes.
        share = _share_of_samples(described)

        def ratio(points: np.ndarray) -> np.ndarray:
            inverse = np.exp(np.minimum(log_mass[:, None] - log_density(points, center, sd), _LARGEST_EXPONENT))
            return 1.0 / (share * inverse + 1.0 - share)

        of_samples = share * (ratio(described.points) @ np.exp(described.log_weights + lowest - described.log_prior))
        of_mixture = (1.0 - share) * of_mixture * ratio(nodes.reshape(n, -1, varying))
    of_mixture = of_mixture.sum(axis=1)
    total = of_samples + of_mixture
    with np.errstate(divide="ignore", invalid="ignore"):
        return log_mass + np.log(total) - lowest, np.where(total > 0.0, of_samples / total, 0.0)


def _share_of_samples(described: DescribedPosterior) -> float:
    """Share of the stored samples among all points: the mixture is worth as many samples as give its error."""
    size = described.effective_sample_size
    return size / (size + min(max(described.mixture.fit_error, 1e-3) ** -2, size))


@cache
def _nodes(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights (m,) and nodes (m, dim) of an integral over independent standard normal variables.

    A product of Gauss-Hermite rules in up to four dimensions, and pairs of opposite random directions in more.
    """
    if dim > 4:
        half = np.random.default_rng(dim).standard_normal((_RANDOM_NODES // 2, dim))
        return np.full(_RANDOM_NODES, 1.0 / _RANDOM_NODES), np.concatenate([half, -half])
    order = {1: 9, 2: 5, 3: 3, 4: 3}[dim]
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    weights = weights / weights.sum()
    indices = np.array(list(itertools.product(range(order), repeat=dim)))
    return weights[indices].prod(axis=1), nodes[indices]
