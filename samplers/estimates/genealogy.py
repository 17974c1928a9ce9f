"""Genealogy of a population: founders of the points, and the standard error of a mean that accounts for them.

Resampling copies points, and moves separate the copies only gradually: only groups of points with different ancestors
(founders) are independent. Copies that still agree count as one point, and copies that have separated count as several
(Lee & Whiteley 2018, Olsson & Douc 2019; the equation is in ``docs/theory/tempering``). Older founders account for more
of the annealing but leave fewer groups, so the oldest generation that still has enough founders is used.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri, stdtrit

# Points or groups of points that a variance needs: with 6 founders of 60 walkers, standard errors were too small by a
# factor of up to ten.
FEWEST_FOR_VARIANCE = 10


def student_factor(freedom: float | np.ndarray) -> float | np.ndarray:
    """Factor of a standard error whose variance has few degrees of freedom: two errors then cover 95 %."""
    return stdtrit(freedom, 0.975) / ndtri(0.975)


def trace_founders(founders: Sequence[np.ndarray], ancestors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Founders (n,) of each point after one more resampling by `ancestors` (n,), per generation, the oldest first.

    A generation is dropped once it has fewer than ten founders; the last one is kept.
    """
    traced = [generation[ancestors] for generation in founders] + [ancestors]
    while len(traced) > 1 and len(np.unique(traced[0])) < FEWEST_FOR_VARIANCE:
        traced.pop(0)
    return tuple(traced)


def standard_error_of_mean(chain: np.ndarray, founders: np.ndarray) -> np.ndarray:
    """Standard error (ndim,) of the mean of a chain (nsteps, nwalkers, ndim) whose walkers have `founders` (nwalkers,).

    Infinite if all walkers have one founder.
    """
    _, group = np.unique(founders, return_inverse=True)
    count = group.max() + 1
    if count == 1:
        return np.full(chain.shape[2], np.inf)
    deviations = chain.mean(axis=0)
    deviations -= deviations.mean(axis=0)
    sums = np.zeros((count, chain.shape[2]))  # over each group with one founder
    np.add.at(sums, group, deviations)
    return np.sqrt(count / (count - 1) * np.sum(sums**2, axis=0)) / chain.shape[1]
