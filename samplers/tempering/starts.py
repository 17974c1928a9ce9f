"""Tests of whether starting points can be draws of the density that they are said to be drawn from.

The evidence, and with it the posterior of several modes, is right only if the annealing starts from draws of its
starting density, by default the prior. A ball of points, as is usual in emcee, gives a wrong evidence.

Where the prior can be drawn from, the points are compared with fresh draws: each parameter by its Kolmogorov-Smirnov
distance, location and scale, all parameters together by the distance from the centre and by the energy distance
(Szekely and Rizzo). All of these depend on ranks or permutations only, so that they are valid for any prior. Points
that are more even than random draws, such as stratified or quasi-random ones, pass.

Where only the density p is known, the points are moved by Metropolis steps that have p as stationary distribution. If
a point x is a draw of p, then (x, x') and (x', x) have the same distribution, whatever the number of steps, so the sign
of any difference h(x') - h(x) is random. A ball spreads instead. No normalising constant is needed.

References
----------
Szekely, G. J. & Rizzo, M. L. (2013), Energy statistics: a class of statistics based on distances, Journal of
Statistical Planning and Inference 143(8), doi:10.1016/j.jspi.2013.03.018
Besag, J. & Clifford, P. (1989), Generalized Monte Carlo significance tests, Biometrika 76(4),
doi:10.1093/biomet/76.4.633
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import special, stats
from scipy.spatial.distance import cdist

__all__ = ["SEED", "Comparison", "compare_with_draws", "draws_to_compare", "spread_by_metropolis"]

# Probability of a false alarm of all tests of ranks together, and of the energy distance. Both are small, since the
# tests are made in every run that is given its start.
RANK_LEVEL = 1e-4
PERMUTATIONS = 9_999
BATCH = 99
# Fresh draws per starting point, and the least and most of them: their own scatter is then small.
FRESH_PER_POINT = 20
FEWEST_FRESH, MOST_FRESH = 2_000, 100_000
# The energy distance is computed from at most so many starting points and fresh draws.
MOST_POINTS, MOST_COMPARED = 250, 500
# A value that so large a share of the points has is no draw of a continuous distribution.
LARGEST_TIED_SHARE = 0.5
METROPOLIS_STEPS = 20
METROPOLIS_LEVEL = 1e-4
FEWEST_FOR_METROPOLIS = 32  # with fewer points, signs alone cannot reach the level
# The tests have random numbers of their own, so that they change no run.
SEED = 20_131


class Comparison(NamedTuple):
    """What a test has found.

    Attributes
    ----------
    reason : str
        Why the points cannot be draws of the density; empty if they can.
    parameter : int, optional
        The parameter that differs most; None if only all parameters together differ.
    """

    reason: str
    parameter: int | None = None


def draws_to_compare(n: int) -> int:
    """Number of fresh draws with which to compare `n` points."""
    return 2 * int(np.clip(FRESH_PER_POINT * n, FEWEST_FRESH, MOST_FRESH))


def compare_with_draws(coords: np.ndarray, fresh: np.ndarray) -> Comparison:
    """Compare points with fresh draws.

    Parameters
    ----------
    coords : (n, ndim) float
        The points, n > 1.
    fresh : (m, ndim) float
        Fresh draws, m = ``draws_to_compare(n)``.

    Returns
    -------
    Comparison
    """
    ndim, random = coords.shape[1], np.random.RandomState(SEED)
    reference, second = np.array_split(fresh, 2)
    if copied := _copies(coords, reference):
        return copied
    scores, reference_scores = (_normal_scores(points, reference, random) for points in (coords, second))
    tests = [_p_values(scores[:, j], coords[:, j], reference[:, j]) for j in range(ndim)]
    radii = [_radii(points, reference_scores) for points in (scores, reference_scores)]
    of_radius = _normal_scores(radii[0][:, None], radii[1][:, None], random)[:, 0]
    together = _p_values(of_radius, *radii)
    count = 3 * (ndim + 1)
    lowest = np.array([min(p_values) for p_values in tests])
    worst = int(np.argmin(lowest))
    if lowest[worst] * count < RANK_LEVEL:
        return Comparison(_describe(coords[:, worst], fresh[:, worst], lowest[worst]), worst)
    if min(together) * count < RANK_LEVEL:
        inner = np.median(radii[0]) < np.median(radii[1])
        where = "too close to" if inner else "too far from"
        return Comparison(f"together, the parameters are {where} the centre of the draws (p = {min(together):.1g})")
    if _energy_distance_is_extreme(scores, reference_scores, random):
        p = 1.0 / (PERMUTATIONS + 1)
        return Comparison(f"together, the parameters are distributed differently (energy distance, p < {p:.1g})")
    return Comparison("")


def _copies(coords: np.ndarray, fresh: np.ndarray) -> Comparison | None:
    """Whether points are copies of each other, or share values, where draws never are."""
    n = len(coords)
    if len(np.unique(fresh, axis=0)) == len(fresh) and (distinct := len(np.unique(coords, axis=0))) < n:
        return Comparison(f"only {distinct} of {n} points are different")
    for j in range(coords.shape[1]):
        tied = 1.0 - len(np.unique(coords[:, j])) / n
        if tied > LARGEST_TIED_SHARE and len(np.unique(fresh[:, j])) == len(fresh):
            return Comparison(f"only {len(np.unique(coords[:, j]))} of {n} values are different", j)
    return None


def _normal_scores(points: np.ndarray, reference: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    """Standard normal quantiles (n, ndim) of the ranks of points among reference draws (m, ndim), ties at random."""
    scores = np.empty(points.shape)
    for j, column in enumerate(reference.T):
        column = np.sort(column)
        low, high = (np.searchsorted(column, points[:, j], side=side) for side in ("left", "right"))
        rank = low + random.uniform(size=len(points)) * (high - low + 1)
        scores[:, j] = special.ndtri(rank / (len(column) + 1))
    return scores


def _p_values(scores: np.ndarray, points: np.ndarray, reference: np.ndarray) -> tuple[float, float, float]:
    """Two-sided p-values of distance, location and scale of points (n,) with the normal scores (n,)."""
    n, m = len(scores), len(reference)
    widened = np.sqrt(1.0 + n / m)  # the scores contain the scatter of the reference
    location = abs(np.sum(scores)) / np.sqrt(n) / widened
    square, side = np.sum(scores**2), stats.chi2(n)
    tail = min(float(side.cdf(square)), float(side.sf(square)))
    scale = -special.ndtri(max(tail, 1e-300)) / widened
    distance = float(stats.ks_2samp(points, reference, method="asymp").pvalue)
    return distance, float(2.0 * special.ndtr(-location)), float(min(2.0 * special.ndtr(-scale), 1.0))


def _radii(scores: np.ndarray, reference_scores: np.ndarray) -> np.ndarray:
    """Squared distances (n,) from the centre, with the correlations of the reference."""
    correlation = np.atleast_2d(np.cov(reference_scores, rowvar=False))
    inverse = np.linalg.pinv(correlation, hermitian=True)
    return np.sum((scores @ inverse) * scores, axis=1)


def _energy_distance_is_extreme(scores: np.ndarray, reference: np.ndarray, random: np.random.RandomState) -> bool:
    """Whether the energy distance of two sets is larger than after each of many exchanges of their members."""
    first = scores if len(scores) <= MOST_POINTS else scores[random.permutation(len(scores))[:MOST_POINTS]]
    pooled = np.concatenate([first, reference[: max(MOST_COMPARED, len(first))]])
    n, m, total = len(first), len(pooled) - len(first), len(pooled)
    distances = cdist(pooled, pooled)
    rows, everything = distances.sum(axis=1), distances.sum()

    def energy(members: np.ndarray) -> np.ndarray:
        """Energy distance of the members (k, total) and the others."""
        inner = np.sum((members @ distances) * members, axis=1)
        across = members @ rows - inner
        return 2.0 * across / (n * m) - inner / n**2 - (everything - 2.0 * across - inner) / m**2

    members = np.zeros((BATCH, total))
    members[0, :n] = 1.0
    observed = energy(members[:1])[0]
    for _ in range(PERMUTATIONS // BATCH):
        chosen = np.argpartition(random.uniform(size=(BATCH, total)), n, axis=1)[:, :n]
        members[:] = 0.0
        np.put_along_axis(members, chosen, 1.0, axis=1)
        if np.max(energy(members)) >= observed:
            return False
    return True


def _describe(points: np.ndarray, fresh: np.ndarray, p: float) -> str:
    """How the values of one parameter differ from fresh draws."""
    low, high = np.quantile(fresh, [0.25, 0.75])
    width, centre = (high - low) or 1.0, np.median(fresh)
    ratio = np.subtract(*np.quantile(points, [0.75, 0.25])) / width
    shift = abs(np.median(points) - centre) / width
    return (
        f"the interquartile range is {ratio:.2g} times that of the draws, and the median differs by {shift:.2g} "
        f"interquartile ranges (p = {p:.1g})"
    )


def spread_by_metropolis(coords: np.ndarray, log_density: Callable[[np.ndarray], np.ndarray]) -> Comparison:
    """Compare points with themselves after Metropolis steps that keep a density.

    The steps of one half of the points have the covariance of the other half. The distance from the centre of that
    half is compared before and after, by the signed ranks of the differences.

    Parameters
    ----------
    coords : (n, ndim) float
        The points, n > 1.
    log_density : callable
        Function of points (m, ndim) that returns their log-density (m,), normalised or not.

    Returns
    -------
    Comparison
    """
    (n, ndim), random = coords.shape, np.random.RandomState(SEED)
    if n < FEWEST_FOR_METROPOLIS:
        return Comparison("")
    order = random.permutation(n)
    halves = order[: n // 2], order[n // 2 :]
    start, root, centre = coords.copy(), np.empty((n, ndim, ndim)), np.empty((n, ndim))
    for half, other in (halves, halves[::-1]):
        deviations = coords[other] - coords[other].mean(axis=0)
        scale = deviations.std(axis=0)
        if len(other) > 2 * ndim and np.all(scale > 0.0):
            correlation = np.cov(deviations / scale, rowvar=False).reshape(ndim, ndim)
            root[half] = scale[:, None] * np.linalg.cholesky(correlation + 1e-6 * np.eye(ndim))
        else:
            root[half] = np.diag(scale)
        centre[half] = coords[other].mean(axis=0)
    if not np.all(np.isfinite(root)) or np.any(np.diagonal(root, axis1=1, axis2=2) == 0.0):
        return Comparison("a parameter has the same value in all points")
    points, log_values = start.copy(), log_density(start)
    for _ in range(METROPOLIS_STEPS):
        step = np.einsum("nij,nj->ni", root, random.standard_normal((n, ndim)))
        proposed = points + 2.38 / np.sqrt(ndim) * step
        log_proposed = log_density(proposed)
        accepted = np.log(random.uniform(size=n)) < log_proposed - log_values
        points[accepted], log_values[accepted] = proposed[accepted], log_proposed[accepted]
    before, after = (
        np.sum(np.linalg.solve(root, (where - centre)[..., None])[..., 0] ** 2, axis=1) for where in (start, points)
    )
    for half in halves:
        change = np.log(after[half]) - np.log(before[half])
        change = change[change != 0.0]
        if len(change) < 2:
            continue
        p = float(stats.wilcoxon(change).pvalue)
        if p < METROPOLIS_LEVEL / 2:
            verb = "spreads" if np.median(change) > 0.0 else "contracts"
            return Comparison(f"The population {verb} in Metropolis steps that keep this density (p = {p:.1g})")
    return Comparison("")
