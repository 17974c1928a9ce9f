r"""Families: points that descend from one, and the error of a posterior mean that takes them for what they are.

Resampling makes copies, and moves tell the copies apart only slowly: points of common descent are no independent draws.
Whole families are. With :math:`\bar x` the mean over all points and :math:`x_i` what point i contributes to it,

.. math:: \mathrm{Var}(\bar x) \approx N^{-2} \sum_k \Big( \sum_{i \in k} (x_i - \bar x) \Big)^2

sums over families k. Copies that still agree count as one point, copies that have parted count as several, and nobody
has to say which. Where the points are the walkers of a chain, :math:`x_i` is the mean along the walker, so that its own
correlation in time is counted too. The longer ago the founders lived, the more of the climb is accounted for, and the
fewer families are left to average over: as in the fixed-lag estimator, a compromise is struck.

References
----------
Lee & Whiteley (2018), Biometrika 105(3), doi:10.1093/biomet/asy028 (variance from the genealogy of one run)
Olsson & Douc (2019), Bernoulli 25(2), doi:10.3150/18-BEJ1029 (founders a few generations back)
"""

import numpy as np

__all__ = ["follow", "standard_error_of_mean"]

QUORUM = 0.1


def follow(generations: list[np.ndarray], ancestors: np.ndarray, quorum: float = QUORUM) -> list[np.ndarray]:
    """Families of a population after one more resampling, by founders of ever younger generations.

    Parameters
    ----------
    generations : list of (n,) int — what this function returned last; empty before the first resampling.
    ancestors : (n,) int — former index of each point.
    quorum : float — founders so long ago that fewer than this share of n families are left are forgotten.

    Returns
    -------
    list of (n,) int — for each generation of founders, the oldest first, the founder of each point. Never empty: the
    parents themselves are kept, however few they are.
    """
    followed = [founders[ancestors] for founders in generations] + [ancestors]
    while len(followed) > 1 and len(np.unique(followed[0])) < quorum * len(ancestors):
        followed.pop(0)
    return followed


def standard_error_of_mean(chain: np.ndarray, families: np.ndarray) -> np.ndarray:
    """Standard error of the mean of a chain, whose walkers belong to families.

    Parameters
    ----------
    chain : (nsteps, nwalkers, ndim) float
    families : (nwalkers,) int — the same number for walkers of the same family.

    Returns
    -------
    (ndim,) float — in the parameters' units; inf if all walkers are of one family, which tells nothing.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    chain, families = np.asarray(chain, dtype=float), np.asarray(families)
    if chain.ndim != 3 or families.shape != chain.shape[1:2] or chain.size == 0:
        raise ValueError(
            f"a chain (nsteps, nwalkers, ndim) and the family of each walker are needed; got {chain.shape} and "
            f"{families.shape}"
        )
    _, family = np.unique(families, return_inverse=True)
    count = family.max() + 1
    if count == 1:
        return np.full(chain.shape[2], np.inf)
    deviations = chain.mean(axis=0)
    deviations -= deviations.mean(axis=0)
    sums = np.zeros((count, chain.shape[2]))
    np.add.at(sums, family, deviations)
    return np.sqrt(count / (count - 1) * np.sum(sums**2, axis=0)) / chain.shape[1]
