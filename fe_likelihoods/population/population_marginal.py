r"""Marginal likelihood of one test under a normal population of its parameters, from a mixture fitted to its posterior.

With a test's posterior density :math:`q`, the density of its prior :math:`p_0` and its evidence :math:`Z`, the marginal
likelihood under a population density :math:`p(u \mid \varphi)` is

.. math::

   m(\varphi) = Z \int q(u) \frac{p(u \mid \varphi)}{p_0(u)}\, du .

With :math:`q` the fitted mixture of normal distributions, :math:`q\, p(u \mid \varphi)` is a mixture as well, over
which the inverse prior density is integrated by Gauss-Hermite rules. See ``docs/theory/hierarchy.rst``.
"""

import itertools
from functools import cache
from typing import NamedTuple

import numpy as np

from ..priors.truncated_normal_integrals import HALF_LOG_TWO_PI
from .stored_posterior import DescribedPosterior

__all__ = ["draw_products", "inverse_prior", "population_marginal"]

_LARGEST_EXCESS = 3.0  # by which the log inverse prior density may exceed its largest value at the samples
_CHUNK = 2**15  # values of a temporary array, which fits into the cache of the processor
_RANDOM_NODES = 128
_JITTER = 1e-12


class Product(NamedTuple):
    """Product of a fitted mixture and a normal population, at n hyper-parameters."""

    log_masses: np.ndarray  # (n, n_components), log integrals of component times population
    means: np.ndarray  # (n, n_components, n_varying)
    factors: np.ndarray  # matrices A with covariances A A^T (n, n_components, n_varying, n_varying)


def population_marginal(described: DescribedPosterior, center: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Log marginal likelihood (n,) of a test over its evidence, under normal populations with n centres (n, d).

    The first n_varying parameters vary between tests, with standard deviations (n, n_varying); the others are common,
    and their centres are their values.
    """
    size = max(1, _CHUNK // (len(_nodes(sd.shape[-1])[0]) * len(described.means) * center.shape[-1]))
    parts = [_marginal(described, center[i : i + size], sd[i : i + size]) for i in range(0, max(len(center), 1), size)]
    return np.concatenate(parts)


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
    log_prior, lowest = described.log_prior_at(points), described.lowest
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
    log_masses = described.log_shares - 0.5 * np.square(scaled).sum(axis=-1) - dim * HALF_LOG_TWO_PI
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


def _marginal(described: DescribedPosterior, center: np.ndarray, sd: np.ndarray) -> np.ndarray:
    varying = sd.shape[-1]
    product = product_with_population(described, center, sd)
    node_weights, directions = _nodes(varying)
    nodes = product.means[:, :, None] + np.einsum("ncvw,jw->ncjv", product.factors, directions)
    common = np.tile(center[:, None, None, varying:], (1, *nodes.shape[1:3], 1))
    of_prior = inverse_prior(described, np.concatenate([nodes, common], axis=-1)) @ node_weights
    largest = product.log_masses.max(axis=1, keepdims=True)
    total = (np.exp(product.log_masses - largest) * of_prior).sum(axis=1)
    with np.errstate(divide="ignore"):
        return largest[:, 0] + np.log(total) - described.lowest


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
