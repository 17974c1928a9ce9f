"""Straightening bent ridges: shears that take the curvature out of a population, one pair of parameters at a time.

Where data fix only a combination of parameters, such as a product of two stiffnesses, the posterior is a bent ridge
that no few ellipsoids cover. A shear

    x_target <- x_target - a t - b t^2,   t = (x_source - mean) / sd,

makes it straight. It has unit Jacobian and is inverted by adding what was subtracted, so that densities are carried
over as they are, and a step that is symmetric among the straight points is symmetric among the bent ones.

Reference: Haario, Saksman & Tamminen (1999), Computational Statistics 14, doi:10.1007/s001800050022 (bananas as shears
of Gaussians).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["Shear", "bend", "find_shears", "straighten"]

LEAST_CURVATURE = 0.1


class Shear(NamedTuple):
    """Subtract ``linear t + quadratic t^2`` from parameter `target`, where ``t = (x[source] - mean) / sd``."""

    target: int
    source: int
    mean: float
    sd: float
    linear: float
    quadratic: float


def _shift(shear: Shear, coords: np.ndarray) -> np.ndarray:
    t = (coords[:, shear.source] - shear.mean) / shear.sd
    return (shear.linear + shear.quadratic * t) * t


def straighten(shears: Sequence[Shear], coords: np.ndarray) -> np.ndarray:
    """Straight points (n, ndim) of bent ones."""
    coords = coords.copy()
    for shear in shears:
        coords[:, shear.target] -= _shift(shear, coords)
    return coords


def bend(shears: Sequence[Shear], coords: np.ndarray) -> np.ndarray:
    """Bent points (n, ndim) of straight ones."""
    coords = coords.copy()
    for shear in reversed(shears):
        coords[:, shear.target] += _shift(shear, coords)
    return coords


def find_shears(coords: np.ndarray, weights: np.ndarray) -> tuple[Shear, ...]:
    """Shears that straighten a population, found greedily: the most curved pair of parameters first.

    A pair counts as curved if the square of the source explains at least a tenth of what its linear part leaves of the
    target, and if the gain in likelihood pays for the search over all pairs (Bayesian information criterion, with the
    number of pairs among the costs).

    Parameters
    ----------
    coords : (n, ndim) float
    weights : (n,) float — non-negative, sum 1.
    """
    effective = 1.0 / (weights @ weights)
    ndim = coords.shape[1]
    cost = math.log(max(effective, 2.0)) + 2.0 * math.log(max(ndim * (ndim - 1), 1))
    shears = []
    while len(shears) < 2 * ndim:
        mean = weights @ coords
        sd = np.sqrt(weights @ (coords - mean) ** 2)
        if not np.all(sd > 0.0):
            break
        t = (coords - mean) / sd
        weighted = t * weights[:, None]
        third, fourth = weighted.T @ t**2, weights @ t**4
        correlation = weighted.T @ t
        own = np.diagonal(third)
        # covariance of the target (rows) and the variance of the source's square (columns), its linear part taken out
        covariance = third - correlation * own
        left = np.maximum(fourth - 1.0 - own**2, 1e-12) * np.maximum(1.0 - correlation**2, 1e-12)
        explained = covariance**2 / left
        np.fill_diagonal(explained, 0.0)
        target, source = (int(i) for i in np.unravel_index(explained.argmax(), explained.shape))
        share = min(float(explained[target, source]), 1.0 - 1e-12)
        if share < LEAST_CURVATURE or -effective * math.log1p(-share) < cost:
            break
        quadratic = covariance[target, source] / max(fourth[source] - 1.0 - own[source] ** 2, 1e-12)
        linear = correlation[target, source] - quadratic * own[source]
        shear = Shear(target, source, mean[source], sd[source], sd[target] * linear, sd[target] * quadratic)
        shears.append(shear)
        coords = straighten([shear], coords)
    return tuple(shears)
