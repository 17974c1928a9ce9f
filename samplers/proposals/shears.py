"""Quadratic shears: triangular maps that remove the curvature of a population, one pair of parameters at a time.

If the data determine only a combination of parameters, such as the product of two stiffnesses, the posterior is a
curved ridge that a small number of ellipsoids cannot cover. A shear

    x_target <- x_target - a t - b t^2,   t = (x_source - mean) / sd,

removes the curvature. It is a triangular map with unit Jacobian determinant, and its inverse adds what was subtracted.
Densities therefore carry over without a correction, and a step that is symmetric in the transformed points is symmetric
in the original ones.

The maps are those by which Haario, Saksman & Tamminen (1999) construct banana-shaped targets from Gaussians, applied in
the opposite direction. Parno & Marzouk (2018) describe triangular maps as preconditioners for sampling in general. The
greedy selection of pairs by the Bayesian information criterion is a choice of this project; see
``docs/theory/proposals``.

References
----------
Haario, H., Saksman, E. & Tamminen, J. (1999), Adaptive proposal distribution for random walk Metropolis algorithm,
Computational Statistics 14, doi:10.1007/s001800050022

Parno, M. D. & Marzouk, Y. M. (2018), Transport map accelerated Markov chain Monte Carlo, SIAM/ASA Journal on
Uncertainty Quantification 6(2), doi:10.1137/17M1134640
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["Shear", "apply_shears", "find_shears", "invert_shears"]

# Smallest share of the variance left by the linear term that the quadratic term must explain.
MIN_CURVATURE = 0.1
# Share of its standard deviation below which nothing is left of a target: the points are too few to show a curvature.
DEGENERATE = 1e-6


class Shear(NamedTuple):
    """A map that subtracts ``linear t + quadratic t^2`` from one parameter, where ``t = (x[source] - mean) / sd``.

    Attributes
    ----------
    target : int
        Index of the parameter that is changed.
    source : int
        Index of the parameter that the change depends on.
    mean, sd : float
        Mean and standard deviation of the source, in its unit.
    linear, quadratic : float
        Coefficients, in the unit of the target.
    """

    target: int
    source: int
    mean: float
    sd: float
    linear: float
    quadratic: float


def _shift(shear: Shear, coords: np.ndarray) -> np.ndarray:
    t = (coords[:, shear.source] - shear.mean) / shear.sd
    return (shear.linear + shear.quadratic * t) * t


def apply_shears(shears: Sequence[Shear], coords: np.ndarray) -> np.ndarray:
    """Transform points (n, ndim): remove the curvature."""
    coords = coords.copy()
    for shear in shears:
        coords[:, shear.target] -= _shift(shear, coords)
    return coords


def invert_shears(shears: Sequence[Shear], coords: np.ndarray) -> np.ndarray:
    """Transform points (n, ndim) back: the inverse of `apply_shears`."""
    coords = coords.copy()
    for shear in reversed(shears):
        coords[:, shear.target] += _shift(shear, coords)
    return coords


def find_shears(coords: np.ndarray, weights: np.ndarray) -> tuple[Shear, ...]:
    """Find shears that remove the curvature of a population, greedily: the most curved pair of parameters first.

    A pair is curved if the square of the source explains at least a tenth of the variance of the target that its linear
    term leaves, and if the gain in likelihood exceeds the penalty of the Bayesian information criterion. The penalty
    includes the number of pairs that were searched.

    Parameters
    ----------
    coords : ndarray, shape (n, ndim)
        Points.
    weights : ndarray, shape (n,)
        Non-negative weights with sum 1.

    Returns
    -------
    tuple of Shear
        At most ``2 ndim`` shears, in the order of application; empty if nothing is curved.
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
        # covariance of the target (rows) with the square of the source (columns), after removal of the linear term
        covariance = third - correlation * own
        left = np.maximum(fourth - 1.0 - own**2, 1e-12) * np.maximum(1.0 - correlation**2, 1e-12)
        explained = covariance**2 / left
        np.fill_diagonal(explained, 0.0)
        target, source = (int(i) for i in np.unravel_index(explained.argmax(), explained.shape))
        share = min(float(explained[target, source]), 1.0 - 1e-12)
        if share < MIN_CURVATURE or -effective * math.log1p(-share) < cost:
            break
        quadratic = covariance[target, source] / max(fourth[source] - 1.0 - own[source] ** 2, 1e-12)
        linear = correlation[target, source] - quadratic * own[source]
        shear = Shear(target, source, mean[source], sd[source], sd[target] * linear, sd[target] * quadratic)
        straight = apply_shears([shear], coords)
        rest = straight[:, target] - weights @ straight[:, target]
        if not weights @ rest**2 > (DEGENERATE * sd[target]) ** 2:  # few different points lie on any parabola
            break
        shears.append(shear)
        coords = straight
    return tuple(shears)
