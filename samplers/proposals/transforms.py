"""Transformations that make a population nearly Gaussian: maps without bounds, and shears without curvature.

A sampler knows only whether a point lies in the support, without a simulation, so each bound is bracketed and bisected
along a line. If other points lie beyond it, the support is not a box, and the parameter is treated as unbounded. A
shear subtracts a parabola in one parameter from another one: its Jacobian determinant is 1, so densities carry over
without a correction. Equations, sources and choices are in ``docs/theory/proposals``.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import expit

# The search for a bound starts at the range of the points and doubles the distance; a factor of 2^30 means no bound.
DOUBLINGS = 30
# Halvings of the bracket, down to the rounding of a double.
BISECTIONS = 55
# A bound matters if it lies within so many standard deviations from the population mean.
NEAR = 4.0


class Bound(NamedTuple):
    """Bounds of one parameter times a sign, which is -1 for an upper bound alone: a single bound is always the lower
    one. Its scale is the distance at which the map changes from logarithmic to linear.
    """

    index: int  # of the parameter
    sign: float
    low: float
    high: float
    scale: float  # 1 for two bounds


def find_support_bounds(inside: Callable[[np.ndarray], np.ndarray], coords: np.ndarray) -> np.ndarray:
    """Find the bounds (2, ndim) of the support along the axes through the first of points (n, ndim) in it, by about 85
    calls of `inside`, (m, ndim) -> (m,). Each lies at most one bisection step outside the support, and beyond all
    points, or is infinite: otherwise the support is not a box.
    """
    ndim, span = coords.shape[1], np.ptp(coords, axis=0)
    parameter, side = np.repeat(np.arange(ndim), 2), np.tile([-1.0, 1.0], ndim)
    start = coords[0, parameter]

    def reaches(which: np.ndarray, distance: np.ndarray) -> np.ndarray:
        probes = np.repeat(coords[:1], len(which), axis=0)
        probes[np.arange(len(which)), parameter[which]] = start[which] + side[which] * distance
        return inside(probes)

    within, beyond = np.zeros(2 * ndim), np.full(2 * ndim, np.inf)
    distance = span[parameter]
    for _ in range(DOUBLINGS):
        searching = np.flatnonzero(np.isinf(beyond))
        if len(searching) == 0:
            break
        found = reaches(searching, distance[searching])
        within[searching[found]] = distance[searching[found]]
        beyond[searching[~found]] = distance[searching[~found]]
        distance = 2.0 * distance
    which = np.flatnonzero(np.isfinite(beyond))
    for _ in range(BISECTIONS if len(which) else 0):
        middle = 0.5 * (within[which] + beyond[which])
        found = reaches(which, middle)
        within[which[found]] = middle[found]
        beyond[which[~found]] = middle[~found]
    low, high = (start + side * beyond).reshape(ndim, 2).T
    return np.array(
        [np.where(low < coords.min(axis=0), low, -np.inf), np.where(high > coords.max(axis=0), high, np.inf)]
    )


def near_bounds(bounds: np.ndarray, coords: np.ndarray, weights: np.ndarray) -> tuple[Bound, ...]:
    """Those of the bounds (2, ndim) within four standard deviations from the mean of a weighted population (n, ndim),
    (n,). The scale of a single one is the variance of the parameter over the distance between mean and bound.
    """
    mean = weights @ coords
    sd, found = np.sqrt(weights @ (coords - mean) ** 2), []
    for j, distances in enumerate(np.transpose([mean - bounds[0], bounds[1] - mean])):
        low, high = (0.0 < distances) & (distances < NEAR * sd[j])
        if low and high:
            found.append(Bound(j, 1.0, *bounds[:, j], 1.0))
        elif low:
            found.append(Bound(j, 1.0, bounds[0, j], np.inf, sd[j] ** 2 / distances[0]))
        elif high:
            found.append(Bound(j, -1.0, -bounds[1, j], np.inf, sd[j] ** 2 / distances[1]))
    return tuple(found)


def to_unbounded(bounds: Sequence[Bound], coords: np.ndarray) -> np.ndarray:
    """Transform points (n, ndim) to the whole real line: ``log(exp((x - low) / scale) - 1)`` for a lower bound,
    likewise for an upper bound, the logit between two. Points on or beyond a bound become zero.
    """
    coords = coords.copy()
    for bound in bounds:
        from_low, from_high, _ = _distances(bound, coords)
        if bound.high < np.inf:
            coords[:, bound.index] = np.log(from_low) - np.log(from_high)
        else:  # near log(t) if t is small, near t if t is large
            coords[:, bound.index] = bound.sign * (from_low + np.log(-np.expm1(-from_low)))
    return coords


def _distances(bound: Bound, coords: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (n,) from both bounds over a scale, 1 where one is not positive, and whether both are positive."""
    x = bound.sign * coords[:, bound.index]
    from_low, from_high = (x - bound.low) / bound.scale, (bound.high - x) / bound.scale
    good = (from_low > 0.0) & (from_high > 0.0)
    return np.where(good, from_low, 1.0), np.where(good, from_high, 1.0), good


def from_unbounded(bounds: Sequence[Bound], coords: np.ndarray) -> np.ndarray:
    """Transform points (n, ndim) back: the inverse of `to_unbounded`."""
    coords = coords.copy()
    for index, sign, low, high, scale in bounds:
        z = coords[:, index]
        if high < np.inf:
            width = high - low
            # measured from the nearer bound, to keep the last digits
            coords[:, index] = np.where(z < 0.0, low + width * expit(z), high - width * expit(-z))
        else:
            coords[:, index] = sign * (low + scale * np.logaddexp(0.0, sign * z))
    return coords


def log_abs_det_jacobian(bounds: Sequence[Bound], coords: np.ndarray) -> np.ndarray:
    """Log-determinant (n,) of the Jacobian of `to_unbounded` at points (n, ndim); -inf on and beyond a bound."""
    total = np.zeros(len(coords))
    for bound in bounds:
        from_low, from_high, good = _distances(bound, coords)
        if bound.high < np.inf:
            slope = np.log(bound.high - bound.low) - np.log(from_low) - np.log(from_high)
        else:
            slope = -np.log(bound.scale) - np.log(-np.expm1(-from_low))
        total = np.where(good, total + slope, -np.inf)
    return total


# ---------------------------------------------------------------- shears

# Smallest share that the quadratic term must explain, of the variance that linear terms in all other parameters leave.
MIN_CURVATURE = 0.1
# Share of the standard deviation of a target below which nothing is left of it: the points are too few to show a
# curvature.
DEGENERATE = 1e-6


class Shear(NamedTuple):
    """A map that subtracts ``linear t + quadratic t^2`` from one parameter, where ``t = (x[source] - mean) / sd``."""

    target: int  # index of the parameter that is changed
    source: int  # index of the parameter that the change depends on
    mean: float  # of the source, in its unit, as sd
    sd: float
    linear: float  # coefficient in the unit of the target, as quadratic
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
    """Find at most 2 ndim shears that remove the curvature of weighted points (n, ndim), the most curved pair first.
    Each must explain a tenth of the variance that linear terms in all other parameters leave, and improve the Bayesian
    information criterion for the pairs that were searched: 20 correlated parameters with ten bends, 500 walkers, took
    66 to 75 thousand evaluations with the linear term of the source alone, and take 13 to 15.
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
        correlation = weighted.T @ t + DEGENERATE**2 * np.eye(ndim)
        precision = np.linalg.inv(correlation)
        # covariance of the target (rows), given all other parameters, with the square of the source (columns)
        covariance = precision @ third
        left = np.maximum(fourth - 1.0 - np.sum(third * covariance, axis=0), 1e-12)
        explained = covariance**2 / left
        explained /= np.diagonal(precision)[:, None] + explained
        np.fill_diagonal(explained, 0.0)
        target, source = (int(i) for i in np.unravel_index(explained.argmax(), explained.shape))
        share = min(float(explained[target, source]), 1.0 - 1e-12)
        if share < MIN_CURVATURE or -(effective - ndim) * math.log1p(-share) < cost:
            break
        quadratic = share / covariance[target, source]
        linear = correlation[target, source] - quadratic * third[source, source]
        shear = Shear(target, source, mean[source], sd[source], sd[target] * linear, sd[target] * quadratic)
        straight = apply_shears([shear], coords)
        rest = straight[:, target] - weights @ straight[:, target]
        if not weights @ rest**2 > (DEGENERATE * sd[target]) ** 2:  # few different points lie on any parabola
            break
        shears.append(shear)
        coords = straight
    return tuple(shears)
