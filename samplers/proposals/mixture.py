"""Mixtures of multivariate Student t, fitted to weighted points: the shape of a population, as a density to draw from.

Few components follow a population with several modes or a bent ridge well enough to propose from it; heavy tails keep
the ratio of target and proposal bounded where the fit is too narrow. The number of components is the one of the best
Bayesian information criterion. The points carry weights, so the criterion counts the effective number of them.

Fits are made in the coordinates that whiten the whole population: a parameter of 2e-4 s beside one of 3e10 Pa is no
matter. They contain no chance: the same points
and weights give the same mixture.

References
----------
Peel & McLachlan (2000), Statistics and Computing 10, doi:10.1023/A:1008981510081 (expectation-maximisation for t)
Schwarz (1978), Ann. Stat. 6(2), doi:10.1214/aos/1176344136 (the criterion)
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from .shears import Shear, bend, find_shears, straighten
from .support_bounds import SupportBounds, from_unbounded, log_abs_det_jacobian, only_felt, to_unbounded

__all__ = [
    "Mixture",
    "draw",
    "fit_mixture",
    "flatten",
    "invert_roots",
    "location_and_root",
    "log_density",
    "log_responsibilities",
    "unflatten",
]

DOF = 6.0
FEW_POINTS = 5.0
SMALLEST_PIVOT = 1e-7
SMALLEST_SD = 1e-150
ITERATIONS = 30
ENOUGH = 1e-3
TRIAL_ITERATIONS = 4
RIDGE = 1e-10
NEGLIGIBLE = 1e-3
SHEAR_NUMBERS = 4


class Mixture(NamedTuple):
    """A mixture of K multivariate Student t.

    Attributes
    ----------
    weights : (K,) float — sum 1.
    means : (K, ndim) float
    roots : (K, ndim, ndim) float — lower-triangular roots of the scale matrices (covariance times (dof - 2) / dof).
    inverses : (K, ndim, ndim) float — of the roots.
    dof : float — degrees of freedom.
    shears : tuple of Shear — the components live among the points that these have straightened,
    edges : SupportBounds, optional — after these have been moved to infinity.
    """

    weights: np.ndarray
    means: np.ndarray
    roots: np.ndarray
    inverses: np.ndarray
    dof: float
    shears: tuple[Shear, ...] = ()
    edges: SupportBounds | None = None


def location_and_root(coords: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean (ndim,) and a lower-triangular root (ndim, ndim) of the weighted covariance, always regular.

    The root is standard deviations times the root of the correlation matrix. With less than five effective points a
    dimension the correlations are not known and are shrunk towards zero; where the matrix is singular all the same, its
    diagonal is raised until it is not.
    """
    mean = weights @ coords
    centred = coords - mean
    sd = np.sqrt(weights @ centred**2)
    # a parameter without spread keeps a sliver of it, in its own unit
    sd = np.maximum(sd, np.maximum(1e-12 * coords.std(axis=0), np.maximum(np.spacing(np.abs(mean)), SMALLEST_SD)))
    standard = centred / sd
    correlation = (standard * weights[:, None]).T @ standard

    ndim = len(mean)
    shrinkage = max(0.0, 1.0 - 1.0 / (weights @ weights) / (FEW_POINTS * ndim))
    correlation *= 1.0 - shrinkage
    np.fill_diagonal(correlation, 1.0)
    jitter = 0.0
    while True:
        try:
            root = np.linalg.cholesky((correlation + jitter * np.eye(ndim)) / (1.0 + jitter))
            if root.diagonal().min() > SMALLEST_PIVOT:
                return mean, sd[:, None] * root
        except np.linalg.LinAlgError:
            pass
        jitter = max(10.0 * jitter, 1e-12)


def invert_roots(roots: np.ndarray) -> np.ndarray:
    """Inverses of lower-triangular matrices (K, ndim, ndim)."""
    # by substitution, for all at once: LAPACK takes milliseconds for seven rows where its threads are kept waiting
    ndim = roots.shape[-1]
    inverses = np.zeros_like(roots)
    for i in range(ndim):
        row = -np.einsum("kj,kjl->kl", roots[:, i, :i], inverses[:, :i])
        row[:, i] += 1.0
        inverses[:, i] = row / roots[:, i, i, None]
    return inverses


def _distances(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (n, K)."""
    distances = np.empty((len(coords), len(mixture.means)))
    for k, (mean, inverse) in enumerate(zip(mixture.means, mixture.inverses, strict=True)):
        z = (coords - mean) @ inverse.T
        distances[:, k] = np.einsum("ij,ij->i", z, z)
    return distances


def _from_distances(mixture: Mixture, distances: np.ndarray) -> np.ndarray:
    ndim, dof = mixture.means.shape[1], mixture.dof
    constant = gammaln(0.5 * (dof + ndim)) - gammaln(0.5 * dof) - 0.5 * ndim * math.log(dof * math.pi)
    log_root = np.sum(np.log(np.diagonal(mixture.roots, axis1=1, axis2=2)), axis=1)
    return np.log(mixture.weights) + constant - log_root - 0.5 * (dof + ndim) * np.log1p(distances / dof)


def log_responsibilities(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Log probability (n, K) that a point (n, ndim) came from a component."""
    parts = _from_distances(mixture, _distances(mixture, flatten(mixture, coords)))
    return parts - _log_sum(parts)[:, None]


def flatten(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Points (n, ndim) as the components see them: without edges, straightened."""
    return straighten(mixture.shears, coords if mixture.edges is None else to_unbounded(mixture.edges, coords))


def unflatten(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Points (n, ndim) as they are, of points as the components see them."""
    coords = bend(mixture.shears, coords)
    return coords if mixture.edges is None else from_unbounded(mixture.edges, coords)


def _log_sum(parts: np.ndarray) -> np.ndarray:
    """Logarithm of the sum of exponentials along the rows (n, K) of finite numbers."""
    top = parts.max(axis=1)
    return top + np.log(np.sum(np.exp(parts - top[:, None]), axis=1))


def log_density(mixture: Mixture, coords: np.ndarray) -> np.ndarray:
    """Log density (n,) at points (n, ndim); -inf beyond an edge."""
    log_sum = _log_sum(_from_distances(mixture, _distances(mixture, flatten(mixture, coords))))
    return log_sum if mixture.edges is None else log_sum + log_abs_det_jacobian(mixture.edges, coords)


def draw(mixture: Mixture, n: int, random: np.random.RandomState) -> np.ndarray:
    """Independent draws (n, ndim); the components get their shares as evenly as whole numbers allow."""
    ndim = mixture.means.shape[1]
    cumulated = np.cumsum(mixture.weights)
    component = np.searchsorted(cumulated / cumulated[-1], (np.arange(n) + random.uniform()) / n, side="right")
    z = random.standard_normal((n, ndim))
    z *= np.sqrt(mixture.dof / random.chisquare(mixture.dof, size=n))[:, None]
    coords = np.empty((n, ndim))
    for k in range(len(mixture.weights)):
        rows = component == k
        coords[rows] = mixture.means[k] + z[rows] @ mixture.roots[k].T
    return unflatten(mixture, coords[random.permutation(n)])


def fit_mixture(
    coords: np.ndarray,
    weights: np.ndarray,
    max_components: int = 6,
    edges: SupportBounds | None = None,
    dof: float = DOF,
) -> Mixture:
    """Mixture of the best Bayesian information criterion.

    Components are added one by one, each by cutting one in two, as long as the criterion improves. Each covariance is
    shrunk towards the mean one of the components, with the weight of ``ndim`` points. Where shears straighten the
    population (see `samplers.proposals.shears`) and improve the criterion, the components are fitted to the straight points.

    Parameters
    ----------
    coords : (n, ndim) float
    weights : (n,) float — non-negative, sum 1. Points that carry less than 1e-3 of the mean weight are left out.
    max_components : int
    edges : SupportBounds, optional — of the support; those that the population feels are moved to infinity if that pays.
    dof : float — degrees of freedom, above 2.
    """
    mixture, criterion = _fit_bent(coords, weights, max_components, dof)
    felt = None if edges is None else only_felt(edges, coords, weights)
    if felt is not None and np.any(np.isfinite([felt.low, felt.high])):
        opened, other = _fit_bent(to_unbounded(felt, coords), weights, max_components, dof)
        kept = weights > 0.0
        other -= 2.0 / (weights @ weights) * float(weights[kept] @ log_abs_det_jacobian(felt, coords[kept]))
        if other < criterion:
            return opened._replace(edges=felt)
    return mixture


def _fit_bent(coords: np.ndarray, weights: np.ndarray, max_components: int, dof: float) -> tuple[Mixture, float]:
    """The best mixture of points, straightened where that pays, and its criterion."""
    shears = find_shears(coords, weights)
    if not shears:
        return _fit_straight((), coords, weights, max_components, dof)
    sheared, criterion = _fit_straight(shears, coords, weights, max_components, dof)
    # to pay, doing without shears may not need many components more
    most = min(max_components, len(sheared.weights) + 2)
    plain, other = _fit_straight((), coords, weights, most, dof)
    return (sheared, criterion) if criterion < other else (plain, other)


def _fit_straight(
    shears: tuple[Shear, ...], coords: np.ndarray, weights: np.ndarray, max_components: int, dof: float
) -> tuple[Mixture, float]:
    """The best mixture of points straightened by given shears, and its criterion."""
    coords = straighten(shears, coords)
    mean, root = location_and_root(coords, weights)
    kept = weights > NEGLIGIBLE / len(weights)
    weights = weights[kept] / weights[kept].sum()
    white = (coords[kept] - mean) @ invert_roots(root[None])[0].T
    effective = 1.0 / (weights @ weights)
    ndim = white.shape[1]

    best, log_likelihood = _maximise(white, weights, effective, np.ones((len(white), 1)), dof)
    best_criterion = _criterion(1, ndim, effective, log_likelihood)
    for count in range(2, max_components + 1):
        if effective < count * (ndim + 2):
            break
        starts = _splits(best, white, weights)
        if not starts:
            break
        tried = [_maximise(white, weights, effective, shares, dof, TRIAL_ITERATIONS) for shares in starts]
        found, _ = max(tried, key=lambda trial: trial[1])
        found, log_likelihood = _maximise(white, weights, effective, np.exp(log_responsibilities(found, white)), dof)
        criterion = _criterion(len(found.weights), ndim, effective, log_likelihood)
        if criterion >= best_criterion:
            break
        best, best_criterion = found, criterion

    roots = root @ best.roots
    mixture = Mixture(best.weights, mean + best.means @ root.T, roots, invert_roots(roots), dof, shears)
    volume = 2.0 * effective * float(np.sum(np.log(root.diagonal())))
    return mixture, best_criterion + volume + len(shears) * SHEAR_NUMBERS * math.log(max(effective, 2.0))


def _criterion(count: int, ndim: int, effective: float, log_likelihood: float) -> float:
    numbers = count * (1 + ndim + ndim * (ndim + 1) // 2) - 1
    return numbers * math.log(max(effective, 2.0)) - 2.0 * effective * log_likelihood


def _splits(mixture: Mixture, white: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Hard assignments with one component more: each component cut in two, across two directions.

    The directions are those of the smallest and the largest fourth moment of the component's points: two groups show in
    the former if they are of similar size and in the latter if one is small, however many other directions there are
    (invariant coordinate selection: Tyler et al. 2009, doi:10.1111/j.1467-9868.2009.00706.x).
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
            projected = z @ directions[:, direction]
            new = owner.copy()
            new[rows[projected > _cut(projected, own)]] = count
            if np.any(new == k) and np.any(new == count):
                starts.append((new[:, None] == np.arange(count + 1)) * 1.0)
    return starts


def _cut(values: np.ndarray, weights: np.ndarray) -> float:
    """Where to cut weighted numbers (n,) in two so that the squares within the parts are least."""
    order = np.argsort(values, kind="stable")
    mass, moment = np.cumsum(weights[order])[:-1], np.cumsum((weights * values)[order])
    between = (moment[-1] * mass - moment[:-1]) ** 2 / (mass * np.maximum(1.0 - mass, 1e-300))
    best = int(between.argmax())
    return 0.5 * (values[order[best]] + values[order[best + 1]])


def _maximise(
    white: np.ndarray,
    weights: np.ndarray,
    effective: float,
    shares: np.ndarray,
    dof: float,
    iterations: int = ITERATIONS,
) -> tuple[Mixture, float]:
    """Expectation-maximisation from first shares (n, K): the mixture and its mean log-likelihood."""
    ndim = white.shape[1]
    stretch = np.ones_like(shares)
    last = -np.inf
    for _ in range(iterations):
        mixture = _components(white, weights, effective, shares, stretch, dof)
        distances = _distances(mixture, white)
        parts = _from_distances(mixture, distances)
        total = _log_sum(parts)
        log_likelihood = float(weights @ total)
        if log_likelihood - last < ENOUGH:
            break
        last = log_likelihood
        shares = np.exp(parts - total[:, None])
        stretch = (dof + ndim) / (dof + distances)
    return mixture, log_likelihood


def _components(
    white: np.ndarray, weights: np.ndarray, effective: float, shares: np.ndarray, stretch: np.ndarray, dof: float
) -> Mixture:
    """The maximisation step; components that hold less than one effective point are dropped."""
    ndim = white.shape[1]
    owned = weights[:, None] * shares
    mass = owned.sum(axis=0)
    alive = mass * effective >= 1.0
    if not alive.any():
        alive = mass == mass.max()
    owned, stretch, mass = owned[:, alive], stretch[:, alive], mass[alive]
    pulled = owned * stretch
    means = (pulled.T @ white) / pulled.sum(axis=0)[:, None]
    scales = np.empty((len(mass), ndim, ndim))
    for k, mean in enumerate(means):
        centred = white - mean
        scales[k] = (centred * pulled[:, k, None]).T @ centred / mass[k]
    pooled = np.tensordot(mass / mass.sum(), scales, axes=1) + RIDGE * np.eye(ndim)
    counts = (effective * mass)[:, None, None]
    roots = np.linalg.cholesky((counts * scales + ndim * pooled) / (counts + ndim))
    return Mixture(mass / mass.sum(), means, roots, invert_roots(roots), dof)
