"""SupportBounds of the prior's support: found by asking, and moved to infinity where a population feels them.

A posterior that piles up at an edge, a damping ratio near zero say, is cut off there, and no mixture of bells follows
it in many dimensions. In the logarithm of the distance from the edge, or the logit between two, there is no edge. Which
points lie in the support of the prior costs no simulation to ask, so the edges of each parameter are bracketed and
bisected from several points; where these do not agree, the support is no box and the parameter is left as it is.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import expit

__all__ = [
    "SupportBounds",
    "from_unbounded",
    "find_support_bounds",
    "log_abs_det_jacobian",
    "only_felt",
    "to_unbounded",
]

PROBES = 3
DOUBLINGS = 30
BISECTIONS = 55
AGREEMENT = 1e-9
FELT = 4.0


class SupportBounds(NamedTuple):
    """Where the parameters end.

    Attributes
    ----------
    low, high : (ndim,) float — edges; -inf and inf where there is none.
    span : (ndim,) float — a length of each parameter, so that logarithms know no unit.
    """

    low: np.ndarray
    high: np.ndarray
    span: np.ndarray


def find_support_bounds(inside: Callable[[np.ndarray], np.ndarray], coords: np.ndarray) -> SupportBounds:
    """SupportBounds of the support that some points (n, ndim) lie in.

    Parameters
    ----------
    inside : function of points (m, ndim) that tells which lie in the support; called some 85 times.
    coords : (n, ndim) float — points in the support, such as draws of the prior.
    """
    ndim = coords.shape[1]
    span = np.ptp(coords, axis=0)
    rows = coords[np.linspace(0, len(coords) - 1, PROBES).astype(int)]
    # one probe for each row, parameter and side
    row, parameter, side = (a.ravel() for a in np.meshgrid(range(PROBES), range(ndim), (-1.0, 1.0), indexing="ij"))
    start = rows[row, parameter]

    def reaches(which: np.ndarray, distance: np.ndarray) -> np.ndarray:
        probes = rows[row[which]]
        probes[np.arange(len(which)), parameter[which]] = start[which] + side[which] * distance
        return inside(probes)

    within, beyond = np.zeros(len(row)), np.full(len(row), np.inf)
    distance = span[parameter]
    for _ in range(DOUBLINGS):
        searching = np.flatnonzero(np.isinf(beyond))
        if len(searching) == 0:
            break
        found = reaches(searching, distance[searching])
        within[searching[found]] = distance[searching[found]]
        beyond[searching[~found]] = distance[searching[~found]]
        distance = 2.0 * distance
    bounded = np.isfinite(beyond)
    which = np.flatnonzero(bounded)
    for _ in range(BISECTIONS if len(which) else 0):
        middle = 0.5 * (within[which] + beyond[which])
        found = reaches(which, middle)
        within[which[found]] = middle[found]
        beyond[which[~found]] = middle[~found]

    edges = np.where(bounded, start + side * beyond, side * np.inf).reshape(PROBES, ndim, 2)
    with np.errstate(invalid="ignore"):
        agree = np.ptp(edges, axis=0) <= AGREEMENT * span[:, None]
    low = np.where(agree[:, 0], edges[:, :, 0].min(axis=0), -np.inf)
    high = np.where(agree[:, 1], edges[:, :, 1].max(axis=0), np.inf)
    return SupportBounds(low, high, np.where(span > 0.0, span, 1.0))


def only_felt(edges: SupportBounds, coords: np.ndarray, weights: np.ndarray) -> SupportBounds:
    """The edges within four standard deviations of the mean of a weighted population (n, ndim), (n,)."""
    mean = weights @ coords
    reach = FELT * np.sqrt(weights @ (coords - mean) ** 2)
    low = np.where(mean - edges.low < reach, edges.low, -np.inf)
    high = np.where(edges.high - mean < reach, edges.high, np.inf)
    return SupportBounds(low, high, edges.span)


def _kinds(edges: SupportBounds) -> list[tuple[int, bool, bool]]:
    """The parameters that have an edge: index, whether below, whether above."""
    below, above = np.isfinite(edges.low), np.isfinite(edges.high)
    return [(int(j), bool(below[j]), bool(above[j])) for j in np.flatnonzero(below | above)]


def to_unbounded(edges: SupportBounds, coords: np.ndarray) -> np.ndarray:
    """Points (n, ndim) without edges; those beyond an edge are put at zero, `log_abs_det_jacobian` tells them."""
    coords = coords.copy()
    for j, below, above in _kinds(edges):
        x = coords[:, j]
        from_low = np.maximum((x - edges.low[j]) / edges.span[j], 0.0) if below else 1.0
        from_high = np.maximum((edges.high[j] - x) / edges.span[j], 0.0) if above else 1.0
        good = (from_low > 0.0) & (from_high > 0.0)
        coords[:, j] = np.log(np.where(good, from_low, 1.0)) - np.log(np.where(good, from_high, 1.0))
    return coords


def from_unbounded(edges: SupportBounds, coords: np.ndarray) -> np.ndarray:
    """Points (n, ndim) between the edges, of points without edges."""
    coords = coords.copy()
    for j, below, above in _kinds(edges):
        z = coords[:, j]
        if below and above:
            width = edges.high[j] - edges.low[j]
            # from the nearer edge, for the last digits
            coords[:, j] = np.where(z < 0.0, edges.low[j] + width * expit(z), edges.high[j] - width * expit(-z))
        elif below:
            coords[:, j] = edges.low[j] + edges.span[j] * np.exp(np.minimum(z, 700.0))
        else:
            coords[:, j] = edges.high[j] - edges.span[j] * np.exp(np.minimum(-z, 700.0))
    return coords


def log_abs_det_jacobian(edges: SupportBounds, coords: np.ndarray) -> np.ndarray:
    """Log of the determinant (n,) of `to_unbounded` at points (n, ndim); -inf beyond an edge."""
    total = np.zeros(len(coords))
    for j, below, above in _kinds(edges):
        from_low = np.maximum(coords[:, j] - edges.low[j], 0.0) if below else 1.0
        from_high = np.maximum(edges.high[j] - coords[:, j], 0.0) if above else 1.0
        good = (from_low > 0.0) & (from_high > 0.0)
        width = edges.high[j] - edges.low[j] if below and above else 1.0
        slope = np.log(width) - np.log(np.where(good, from_low, 1.0)) - np.log(np.where(good, from_high, 1.0))
        total = np.where(good, total + slope, -np.inf)
    return total
