"""Mixtures of multivariate Student t, fitted to weighted points: an approximation of a population as a density.

Heavy tails keep the ratio of target to proposal bounded if the fit is too narrow. Fits by expectation-maximisation
(Peel & McLachlan 2000, doi:10.1023/A:1008981510081) are deterministic, in coordinates that whiten the population; the
number of components minimises the Bayesian information criterion (Schwarz 1978, doi:10.1214/aos/1176344136), with the
effective number of points as sample size. Equations, constants and their reasons are in ``docs/theory/proposals``.
"""

import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from ..resampling import systematic
from .transforms import (
    Bound,
    Shear,
    apply_shears,
    find_shears,
    from_unbounded,
    invert_shears,
    log_abs_det_jacobian,
    near_bounds,
    to_unbounded,
)

# Attempts to draw inside a region. With one, 2 of 4 runs on a Student t3 in a box ended with a wrong evidence.
ROUNDS = 50
# Degrees of freedom: heavier tails than a Gaussian, and finite fourth moments.
DOF = 6.0
# Fewer degrees of freedom that are tried for points with heavier tails; above 2, where variances are finite. Standard
# deviations of a Student t3 in 10 dimensions are .93 to .96 of the true ones, without these .78 to .86, unnoticed.
HEAVIER = 3.0
# Limits of expectation-maximisation: number of iterations, and gain in mean log-likelihood below which it stops. For a
# proposal, a trial of one, the density of a population, and another such fit that starts near its end.
PROPOSAL, TRIAL, ACCURATE, AGAIN = (30, 1e-3), (4, 1e-3), (100, 1e-6), (20, 1e-6)
# Added to the diagonal of the pooled covariance of the whitened points.
RIDGE = 1e-10
# Points with less than this share of the mean weight are left out of the fit.
NEGLIGIBLE = 1e-3
MOST_COMPONENTS = 6  # with 8, 60 runs of recycling on several modes and bent ridges need as many evaluations
# Numbers per shear that the criterion counts: mean, sd, linear and quadratic coefficient.
PARAMETERS_PER_SHEAR = 4
# Effective points per dimension that determine a covariance; with fewer, correlations are shrunk towards zero. Means of
# populations from 46 samples of 8 parameters differ by .1 to .2 standard deviations.
POINTS_PER_DIMENSION = 5.0
# Smallest such shrinkage. Without it, 123 of 200 fits to exactly dependent parameters have a singular matrix.
SMALLEST_SHRINKAGE = 1e-12
# Smallest standard deviation, for parameters that do not vary.
SMALLEST_SD = 1e-150


class Mixture(NamedTuple):
    """A mixture of K multivariate Student t, or of normal distributions for infinite degrees of freedom.

    Components are defined in the space after `bounds` and then `shears` are applied (the component space).
    """

    weights: np.ndarray  # (K,), with sum 1
    means: np.ndarray  # (K, ndim), locations
    roots: np.ndarray  # (K, ndim, ndim), lower-triangular roots of the scale matrices, covariance times (dof - 2) / dof
    inverses: np.ndarray  # (K, ndim, ndim), of the roots
    dof: float  # degrees of freedom
    shears: tuple[Shear, ...] = ()  # maps that remove curvature
    bounds: tuple[Bound, ...] = ()  # removed by the transformation to the whole real line

    @property
    def covariances(self) -> np.ndarray:
        """Scale matrices of the components, shape (K, ndim, ndim)."""
        return self.roots @ self.roots.transpose(0, 2, 1)

    def widened(self, factor: float) -> "Mixture":
        """The same mixture with the standard deviations of all components times a factor."""
        return self._replace(roots=factor * self.roots, inverses=self.inverses / factor)


def _distances(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (n, K)."""
    z = (coords - mixture.means[:, None]) @ mixture.inverses.transpose(0, 2, 1)
    return np.einsum("kij,kij->ik", z, z, order="C")


def _component_log_densities(mixture: Mixture, distances: np.ndarray) -> np.ndarray:
    """Log of weight times density (n, K) of each component, from squared Mahalanobis distances (n, K)."""
    ndim, dof = mixture.means.shape[1], mixture.dof
    log_root = np.log(np.diagonal(mixture.roots, axis1=1, axis2=2)).sum(axis=1)
    if dof == math.inf:
        powers = 0.5 * distances
    else:
        powers = distances / dof
        np.log1p(powers, out=powers)
        powers *= 0.5 * (dof + ndim)
    return np.log(mixture.weights) + _log_constant(ndim, dof) - log_root - powers


@cache
def _log_constant(ndim: int, dof: float) -> float:
    """Log density of the standard multivariate Student t at its location; the standard normal density for dof = inf."""
    if dof == math.inf:
        return -0.5 * ndim * math.log(2.0 * math.pi)
    return float(gammaln(0.5 * (dof + ndim)) - gammaln(0.5 * dof)) - 0.5 * ndim * math.log(dof * math.pi)


def log_responsibilities(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Log of the responsibilities (n, K): probabilities that each point (n, ndim) came from each component."""
    parts = log_components(mixture, to_component_space(mixture, coords))
    return parts - _log_sum(parts)[:, None]


def log_components(mixture: Mixture, points: np.ndarray) -> np.ndarray:
    """Log of weight times density (n, K) of each component at points (n, ndim) of the component space."""
    return _component_log_densities(mixture, _distances(mixture, points))


def to_component_space(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Transform points (n, ndim) to the space in which the components are defined: first bounds, then shears."""
    return apply_shears(mixture.shears, to_unbounded(mixture.bounds, coords))


def from_component_space(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Transform points (n, ndim) back to the parameters: the inverse of `to_component_space`."""
    return from_unbounded(mixture.bounds, invert_shears(mixture.shears, coords))


def _log_sum(parts: np.ndarray) -> np.ndarray:
    """Row-wise log-sum-exp (n,) of finite numbers (n, K)."""
    top = parts.max(axis=1)
    return top + np.log(np.sum(np.exp(parts - top[:, None]), axis=1))


def log_density(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Log density (n,) of the mixture at points (n, ndim), in the parameters; -inf beyond a bound."""
    log_sum = _log_sum(log_components(mixture, to_component_space(mixture, coords)))
    return log_sum + log_abs_det_jacobian(mixture.bounds, coords)


def draw(mixture: Mixture, n: int, random: np.random.RandomState) -> np.ndarray:
    """Draw points (n, ndim) from the mixture, in random order.

    Systematic resampling gives the number of draws per component, which differs from ``n`` times the weight by
    less than one.
    """
    ndim = mixture.means.shape[1]
    component = systematic(mixture.weights, random, n)
    z = random.standard_normal((n, ndim))
    if mixture.dof < math.inf:
        z *= np.sqrt(mixture.dof / random.chisquare(mixture.dof, size=n))[:, None]
    coords = np.empty((n, ndim))
    for k in range(len(mixture.weights)):
        rows = component == k
        coords[rows] = mixture.means[k] + z[rows] @ mixture.roots[k].T
    return from_component_space(mixture, coords[random.permutation(n)])


def draw_inside(
    mixture: Mixture, n: int, random: np.random.RandomState, inside: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, int]:
    """At most `n` draws (m, ndim) of a mixture inside a region, and the number of draws made to obtain them.

    `inside` is a function of points (m, ndim) that returns (m,) bool; it is called up to 50 times.
    """
    kept, found, made = [], 0, 0
    for _ in range(ROUNDS):
        coords = draw(mixture, n, random)
        good = np.flatnonzero(inside(coords))[: n - found]
        kept.append(coords[good])
        found += len(good)
        if found == n:
            return np.concatenate(kept), made + int(good[-1]) + 1
        made += n
    return np.concatenate(kept), made


def fit_mixture(coords: np.ndarray, weights: np.ndarray, bounds: np.ndarray | None = None) -> Mixture:
    """Fit a mixture to points (n, ndim) with weights (n,) of sum 1. The Bayesian information criterion chooses
    components, degrees of freedom, shears, and which `bounds` (2, ndim) near the population a transformation removes.
    """
    near = () if bounds is None else near_bounds(bounds, coords, weights)
    kept, effective, tried = weights > 0.0, 1.0 / (weights @ weights), []
    # the criterion of a density in the parameters contains the Jacobian determinant of the transformation
    volumes = {bound: float(weights[kept] @ log_abs_det_jacobian([bound], coords[kept])) for bound in near}
    for removed in dict.fromkeys(_bounds_to_remove(volumes, coords, weights)):
        points = to_unbounded(removed, coords)
        volume = sum(volumes[bound] for bound in removed)
        for shears in dict.fromkeys([(), find_shears(points, weights)]):
            mixture, criterion = _fit_components(shears, points, weights)
            tried.append((criterion - 2.0 * effective * volume, mixture._replace(bounds=removed)))
    return min(tried, key=lambda each: each[0])[1]


def _bounds_to_remove(volumes: dict[Bound, float], coords: np.ndarray, weights: np.ndarray) -> Iterator[tuple]:
    """Choices of bounds: none and all, and where these lead if one after the other is removed or put back that a normal
    distribution follows better so. A transformation bends a parameter that depends linearly on others: of several that
    are tied to each other, none alone is worth putting back. `volumes` are mean log-determinants.
    """
    _, root = location_and_root(np.column_stack([coords, to_unbounded(tuple(volumes), coords)]), weights)
    effective = max(1.0 / (weights @ weights), 2.0)
    cost = 0.5 * math.log(effective) / effective  # as much as a parameter of the density in the criterion

    @cache
    def misfit(removed: frozenset[Bound]) -> float:
        columns = np.arange(coords.shape[1])
        columns[[bound.index for bound in removed]] += len(columns)
        own = np.linalg.qr(root[columns].T, mode="r").diagonal()
        return float(np.log(np.abs(own)).sum()) - sum(volumes[bound] for bound in removed)

    for bounds in (frozenset(), frozenset(volumes)):
        yield tuple(sorted(bounds))
        while volumes and misfit(best := min((bounds ^ {one} for one in volumes), key=misfit)) < misfit(bounds) - cost:
            bounds = best
        yield tuple(sorted(bounds))


def fit_normals(coords: np.ndarray, effective: float, start: Mixture | None = None) -> Mixture:
    """Fit a mixture of normal distributions to points (n, ndim) of equal weight, accurately enough for a density.
    `effective` points are independent; a fit from a `start` keeps its number of components.
    """
    weights = np.full(len(coords), 1.0 / len(coords))
    if start is not None:
        responsibilities = np.exp(log_responsibilities(start, coords))
        mean, root = location_and_root(coords, weights)
        white = (coords - mean) @ invert_roots(root[None])[0].T
        return _unwhitened(_maximise(white, weights, effective, responsibilities, math.inf, AGAIN)[0], mean, root)
    return _fit_components((), coords, weights, math.inf, effective, ACCURATE)[0]


def leave_out(mixture: Mixture, coords: np.ndarray, weights: np.ndarray, parts: np.ndarray) -> list[Mixture]:
    """Mixtures fitted without one part of the points each, by one step from a fit to all points (n, ndim) with weights
    (n,) of sum 1; `parts` (n,) are numbered from 0.
    """
    points = to_component_space(mixture, coords)
    responsibilities = np.exp(log_responsibilities(mixture, coords))
    stretch = np.ones_like(responsibilities)
    if mixture.dof < math.inf:
        stretch *= (mixture.dof + points.shape[1]) / (mixture.dof + _distances(mixture, points))
    mean, root = location_and_root(points, weights)
    white = (points - mean) @ invert_roots(root[None])[0].T
    kept, found = weights > NEGLIGIBLE / len(weights), []
    for part in range(parts.max() + 1):
        rows = kept & (parts != part)
        rows = rows if rows.any() else kept
        own = weights[rows] / weights[rows].sum()
        fitted = _components(white[rows], own, 1.0 / (own @ own), responsibilities[rows], stretch[rows], mixture.dof)
        found.append(_unwhitened(fitted, mean, root)._replace(shears=mixture.shears, bounds=mixture.bounds))
    return found


def _fit_components(
    shears: tuple[Shear, ...],
    coords: np.ndarray,
    weights: np.ndarray,
    dof: float = DOF,
    effective: float | None = None,
    limits: tuple[int, float] = PROPOSAL,
) -> tuple[Mixture, float]:
    """Fit a mixture to points transformed by given shears; return it with its criterion."""
    coords = apply_shears(shears, coords)
    mean, root = location_and_root(coords, weights)
    kept = weights > NEGLIGIBLE / len(weights)
    weights = weights[kept] / weights[kept].sum()
    white = (coords[kept] - mean) @ invert_roots(root[None])[0].T
    effective = 1.0 / (weights @ weights) if effective is None else effective
    ndim = white.shape[1]

    best, log_likelihood = _maximise(white, weights, effective, np.ones((len(white), 1)), dof, limits)
    best_criterion = _criterion(1, ndim, effective, log_likelihood)
    for count in range(2, MOST_COMPONENTS + 1):
        if effective < count * (ndim + 2) or not (starts := _splits(best, white, weights)):
            break
        tried = [_maximise(white, weights, effective, responsibilities, dof, TRIAL) for responsibilities in starts]
        found, _ = max(tried, key=lambda trial: trial[1])
        found, log_likelihood = _maximise(
            white, weights, effective, np.exp(log_responsibilities(found, white)), dof, limits
        )
        criterion = _criterion(len(found.weights), ndim, effective, log_likelihood)
        if criterion >= best_criterion:
            break
        best, best_criterion = found, criterion
    if dof < math.inf:
        best, best_criterion = _with_heavier_tails(best, best_criterion, white, weights, effective)

    mixture = _unwhitened(best, mean, root)._replace(shears=shears)
    volume = 2.0 * effective * float(np.sum(np.log(root.diagonal())))
    return mixture, best_criterion + volume + len(shears) * PARAMETERS_PER_SHEAR * math.log(max(effective, 2.0))


def _unwhitened(mixture: Mixture, mean: np.ndarray, root: np.ndarray) -> Mixture:
    """A mixture of points that were whitened with a mean and a root, in the coordinates before."""
    roots = root @ mixture.roots
    return Mixture(mixture.weights, mean + mixture.means @ root.T, roots, invert_roots(roots), mixture.dof)


def _with_heavier_tails(
    best: Mixture, best_criterion: float, white: np.ndarray, weights: np.ndarray, effective: float
) -> tuple[Mixture, float]:
    """Lower the fitted degrees of freedom if the criterion improves, also with a single component, whose tails
    several may have represented.
    """
    penalty = math.log(max(effective, 2.0))
    starts = [np.ones((len(white), 1))]
    if len(best.weights) > 1:
        starts.append(np.exp(log_responsibilities(best, white)))
    tried = [_maximise(white, weights, effective, responsibilities, HEAVIER) for responsibilities in starts]
    criteria = [_criterion(len(m.weights), white.shape[1], effective, value) + penalty for m, value in tried]
    if min(criteria) >= best_criterion:
        return best, best_criterion
    return tried[int(np.argmin(criteria))][0], min(criteria)


def _criterion(count: int, ndim: int, effective: float, log_likelihood: float) -> float:
    """Bayesian information criterion of `count` components with mean log-likelihood `log_likelihood`."""
    n_parameters = count * (1 + ndim + ndim * (ndim + 1) // 2) - 1
    return n_parameters * math.log(max(effective, 2.0)) - 2.0 * effective * log_likelihood


def _splits(mixture: Mixture, white: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Starting assignments (n, K + 1) with one more component: each is split at its mean, along the directions of
    smallest and largest fourth moments (invariant coordinate selection: Tyler et al. 2009, J. R. Stat. Soc. B 71(3),
    doi:10.1111/j.1467-9868.2009.00706.x).
    """
    owner = log_responsibilities(mixture, white).argmax(axis=1)
    count, ndim = len(mixture.weights), white.shape[1]
    starts = []
    for k in range(count):
        rows = np.flatnonzero(owner == k)
        if len(rows) < 2 * (ndim + 1):
            continue
        own = weights[rows] / weights[rows].sum()
        mean, root = location_and_root(white[rows], own)
        z = (white[rows] - mean) @ invert_roots(root[None])[0].T
        _, directions = np.linalg.eigh((z * (own * np.sum(z**2, axis=1))[:, None]).T @ z)
        for direction in {0, ndim - 1}:
            new = owner.copy()
            new[rows[z @ directions[:, direction] > 0.0]] = count
            if np.any(new == k) and np.any(new == count):
                starts.append((new[:, None] == np.arange(count + 1)) * 1.0)
    return starts


def _maximise(
    white: np.ndarray,
    weights: np.ndarray,
    effective: float,
    responsibilities: np.ndarray,
    dof: float,
    limits: tuple[int, float] = PROPOSAL,
) -> tuple[Mixture, float]:
    """Expectation-maximisation from initial responsibilities (n, K); return the mixture and its mean log-likelihood."""
    ndim = white.shape[1]
    stretch = np.ones_like(responsibilities)
    last = -np.inf
    iterations, tolerance = limits
    for _ in range(iterations):
        mixture = _components(white, weights, effective, responsibilities, stretch, dof)
        distances = _distances(mixture, white)
        parts = _component_log_densities(mixture, distances)
        total = _log_sum(parts)
        log_likelihood = float(weights @ total)
        if log_likelihood - last < tolerance:
            break
        last = log_likelihood
        responsibilities = np.exp(parts - total[:, None])
        stretch = (dof + ndim) / (dof + distances) if dof < math.inf else np.ones_like(distances)
    return mixture, log_likelihood


def _components(
    white: np.ndarray,
    weights: np.ndarray,
    effective: float,
    responsibilities: np.ndarray,
    stretch: np.ndarray,
    dof: float,
) -> Mixture:
    """Maximisation step. Components that hold less than one effective point are removed."""
    ndim = white.shape[1]
    owned = weights[:, None] * responsibilities
    mass = owned.sum(axis=0)
    alive = mass * effective >= 1.0
    if not alive.any():
        alive = mass == mass.max()
    mass = mass[alive]
    pulled = owned.T[alive] * stretch.T[alive]
    means = (pulled @ white) / pulled.sum(axis=1)[:, None]
    centred = white - means[:, None]
    scales = (centred * pulled[:, :, None]).transpose(0, 2, 1) @ centred / mass[:, None, None]
    pooled = (mass / mass.sum() @ scales.reshape(len(mass), -1)).reshape(ndim, ndim) + RIDGE * np.eye(ndim)
    counts = (effective * mass)[:, None, None]
    roots = np.linalg.cholesky((counts * scales + ndim * pooled) / (counts + ndim))
    return Mixture(mass / mass.sum(), means, roots, invert_roots(roots), dof)


def location_and_root(coords: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean (ndim,) and a lower-triangular, non-singular root (ndim, ndim) of the weighted covariance.

    With fewer than five effective points per dimension the correlations are shrunk towards zero.
    """
    mean = weights @ coords
    centred = coords - mean
    sd = np.sqrt(weights @ centred**2)
    # a parameter that does not vary gets a tiny standard deviation, in its own unit
    sd = np.maximum(sd, np.maximum(1e-12 * coords.std(axis=0), np.maximum(np.spacing(np.abs(mean)), SMALLEST_SD)))
    standard = centred / sd
    few = 1.0 - 1.0 / (weights @ weights) / (POINTS_PER_DIMENSION * len(mean))
    correlation = (1.0 - max(few, SMALLEST_SHRINKAGE)) * (standard * weights[:, None]).T @ standard
    np.fill_diagonal(correlation, 1.0)
    return mean, sd[:, None] * np.linalg.cholesky(correlation)


def invert_roots(roots: np.ndarray) -> np.ndarray:
    """Inverses of lower-triangular matrices (K, ndim, ndim)."""
    # Substitution for all matrices at once. LAPACK takes milliseconds for seven rows when its threads have to wait.
    ndim = roots.shape[-1]
    inverses = np.zeros_like(roots)
    for i in range(ndim):
        row = -np.einsum("kj,kjl->kl", roots[:, i, :i], inverses[:, :i])
        row[:, i] += 1.0
        inverses[:, i] = row / roots[:, i, i, None]
    return inverses
