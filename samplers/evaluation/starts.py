"""Test of whether initial points can be draws of the prior.

Annealing must start from draws of the prior: a ball of points, as is usual in emcee, gives a wrong evidence and wrong
weights of modes. The points make Metropolis steps that leave the density of the prior invariant. If x is a draw, then
(x, x') and (x', x) have the same distribution, so any function of x' minus the same function of x is symmetric about
zero (Besag & Clifford 1989, Generalized Monte Carlo significance tests, doi:10.1093/biomet/76.4.633). A ball spreads.
"""

from collections.abc import Callable

import numpy as np

from ..finding import FALSE_ALARM
from ..moves.population_moves import BEST_SCALE

METROPOLIS_STEPS = 20  # a ball of half the width of the prior is then found in 42 to 100 % of the cases (docs/results)
SEED = 20_131  # separate random numbers, so that the test changes no run


def not_of_the_prior(coords: np.ndarray, log_prior: Callable[[np.ndarray], np.ndarray]) -> str:
    """Why points (n, ndim) cannot be draws of a density (m, ndim) -> (m,), normalised or not; empty if they can. Each
    half makes steps by differences of the other half, and signed ranks compare distances from its mean before and
    after.
    """
    (n, ndim), random = coords.shape, np.random.RandomState(SEED)
    if 2.0 ** (1 - n // 2) > FALSE_ALARM / 2:  # signed ranks of so few points cannot reach the level
        return ""
    from scipy.stats import wilcoxon  # slow to import

    if np.any(np.ptp(coords, axis=0) == 0.0):
        return "a parameter has the same value in all points"
    halves = np.array_split(coords[random.permutation(n)], 2)
    for start, other in (halves, halves[::-1]):
        points, log_values = start, log_prior(start)
        for _ in range(METROPOLIS_STEPS):
            first, second = random.randint(len(other), size=(2, len(points)))
            proposed = points + BEST_SCALE / np.sqrt(2 * ndim) * (other[first] - other[second])
            log_proposed = log_prior(proposed)
            accepted = np.log(random.uniform(size=len(points))) < log_proposed - log_values
            points = np.where(accepted[:, None], proposed, points)
            log_values = np.where(accepted, log_proposed, log_values)
        centre, scale = other.mean(axis=0), other.std(axis=0)
        scale[scale == 0.0] = 1.0
        before, after = (np.sum(((x - centre) / scale) ** 2, axis=1) for x in (start, points))
        change = (after - before)[after != before]
        if len(change) > 1 and (p := wilcoxon(change).pvalue) < FALSE_ALARM / 2:
            verb = "spreads" if np.median(change) > 0.0 else "contracts"
            return f"the population {verb} in Metropolis steps that keep the prior (p = {p:.1g})"
    return ""
