"""Tests of whether initial points can be draws of the prior.

Annealing must start from draws of the prior: a ball of points, as is usual in emcee, gives a wrong evidence and
wrong weights of modes. If there are draws to compare with, two-sample Kolmogorov-Smirnov tests compare each parameter,
its distance from the median of the draws (which tests the scale), and the distance of the points from the centre (which
tests all parameters together). The tests are valid for any prior, also with ties.

If only the density is known, the points make Metropolis steps that leave it invariant. If x is a draw, then (x, x') and
(x', x) have the same distribution, so any function of x' minus the same function of x is symmetric about zero (Besag &
Clifford 1989, Generalized Monte Carlo significance tests, doi:10.1093/biomet/76.4.633). A ball spreads instead.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import special, stats

__all__ = ["SEED", "compare_with_draws", "draws_to_compare", "spread_by_metropolis"]

LEVEL = 1e-4  # probability of a false alarm in a run
FRESH_PER_POINT, FEWEST_FRESH, MOST_FRESH = 40, 4_000, 200_000
LARGEST_TIED_SHARE = 0.5  # in a continuous parameter
METROPOLIS_STEPS = 20
FEWEST_FOR_METROPOLIS = 32  # signed ranks of fewer points cannot reach the level
SEED = 20_131  # the tests use separate random numbers, so that they change no run


def draws_to_compare(n: int) -> int:
    """Number of fresh draws with which to compare `n` points."""
    return int(np.clip(FRESH_PER_POINT * n, FEWEST_FRESH, MOST_FRESH))


def compare_with_draws(coords: np.ndarray, fresh: np.ndarray, names: Sequence = ()) -> str:
    """Why points (n, ndim) and fresh draws (m, ndim) cannot have the same distribution; empty if they can.

    A reason contains the name of the parameter that differs most, or its index where there are no `names`.
    """
    n, ndim = coords.shape
    names = names if len(names) == ndim else range(ndim)
    if len(np.unique(fresh, axis=0)) == len(fresh) and (distinct := len(np.unique(coords, axis=0))) < n:
        return f"only {distinct} of {n} points are different"
    for name, points, draws in zip(names, coords.T, fresh.T, strict=True):
        distinct = len(np.unique(points))
        if 1.0 - distinct / n > LARGEST_TIED_SHARE and len(np.unique(draws)) == len(draws):
            return f"only {distinct} of {n} values of parameter {name} are different"
    reference, draws = np.array_split(fresh, 2)  # the reference defines the centre, the draws are compared
    centre = np.median(reference, axis=0)
    tested, expected = (
        np.column_stack([x, np.abs(x - centre), _squared_radii(x, reference)]).T for x in (coords, draws)
    )
    p_values = [stats.ks_2samp(x, y, method="asymp").pvalue for x, y in zip(tested, expected, strict=True)]
    worst = int(np.argmin(p_values))
    if p_values[worst] * len(p_values) >= LEVEL:
        return ""
    if worst == 2 * ndim:
        where = "close to" if np.median(tested[-1]) < np.median(expected[-1]) else "far from"
        return f"together, the parameters are too {where} the centre of the draws (p = {p_values[worst]:.1g})"
    j = worst % ndim
    low, middle, high = np.quantile(fresh[:, j], [0.25, 0.5, 0.75])
    width = (high - low) or 1.0
    ratio, shift = (
        np.ptp(np.quantile(coords[:, j], [0.25, 0.75])) / width,
        abs(np.median(coords[:, j]) - middle) / width,
    )
    return (
        f"the interquartile range of parameter {names[j]} is {ratio:.2g} times the range of the draws, and the "
        f"median differs by {shift:.2g} interquartile ranges (p = {p_values[worst]:.1g})"
    )


def _squared_radii(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (n,) from the centre of reference draws, in normal scores of the ranks."""
    ordered = np.sort(reference, axis=0).T

    def scores(x: np.ndarray) -> np.ndarray:
        pairs = zip(ordered, x.T, strict=True)
        ranks = [np.searchsorted(column, values) + np.searchsorted(column, values, "right") for column, values in pairs]
        return special.ndtri((np.transpose(ranks) + 1) / (2 * len(reference) + 2))

    z = scores(points)
    covariance = np.atleast_2d(np.cov(scores(reference), rowvar=False))
    return np.sum((z @ np.linalg.pinv(covariance, hermitian=True)) * z, axis=1)


def spread_by_metropolis(coords: np.ndarray, log_density: Callable[[np.ndarray], np.ndarray]) -> str:
    """Why points (n, ndim) cannot be draws of a density (m, ndim) -> (m,), normalised or not; empty if they can.

    Each half of the points makes steps that are differences between points in the other half; signed ranks compare the
    distances from the mean of the other half before and after.
    """
    (n, ndim), random = coords.shape, np.random.RandomState(SEED)
    if n < FEWEST_FOR_METROPOLIS:
        return ""
    if np.any(np.ptp(coords, axis=0) == 0.0):
        return "a parameter has the same value in all points"
    halves = np.array_split(coords[random.permutation(n)], 2)
    for start, other in (halves, halves[::-1]):
        points, log_values = start, log_density(start)
        for _ in range(METROPOLIS_STEPS):
            first, second = random.randint(len(other), size=(2, len(points)))
            proposed = points + 2.38 / np.sqrt(2 * ndim) * (other[first] - other[second])
            log_proposed = log_density(proposed)
            accepted = np.log(random.uniform(size=len(points))) < log_proposed - log_values
            points = np.where(accepted[:, None], proposed, points)
            log_values = np.where(accepted, log_proposed, log_values)
        centre, scale = other.mean(axis=0), other.std(axis=0)
        scale[scale == 0.0] = 1.0
        before, after = (np.sum(((x - centre) / scale) ** 2, axis=1) for x in (start, points))
        change = (after - before)[after != before]
        if len(change) > 1 and (p := stats.wilcoxon(change).pvalue) < LEVEL / 2:
            verb = "spreads" if np.median(change) > 0.0 else "contracts"
            return f"the population {verb} in Metropolis steps that keep this density (p = {p:.1g})"
    return ""
