"""Resampling: from weighted points to as many equally weighted ones.

Every scheme is unbiased: point i is copied n w_i times on average. They differ in the noise they add. Multinomial draws
are independent; residual keeps the whole part of n w_i and draws the rest; stratified and systematic place one uniform
number in each n-th of the cumulated weights, the latter the same one, and add least.

Reference: Douc, Cappe & Moulines (2005), Comparison of resampling schemes for particle filtering, ISPA,
doi:10.1109/ISPA.2005.195385.
"""

from collections.abc import Callable

import numpy as np

__all__ = ["RESAMPLING", "multinomial", "residual", "stratified", "systematic"]

Random = np.random.RandomState | np.random.Generator


def _locate(weights: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Index of the point that owns each position (in [0, 1)) of the cumulated weights."""
    cumulated = np.cumsum(weights)
    return np.searchsorted(cumulated / cumulated[-1], positions, side="right")


def multinomial(weights: np.ndarray, random: Random) -> np.ndarray:
    """Independent draws.

    Parameters
    ----------
    weights : (n,) float — non-negative, sum 1.
    random : RandomState or Generator.

    Returns
    -------
    (n,) int — indices of the points that live on, ascending. The other schemes take and return the same.
    """
    return _locate(weights, np.sort(random.uniform(size=len(weights))))


def stratified(weights: np.ndarray, random: Random) -> np.ndarray:
    """One independent uniform number in each n-th of the cumulated weights."""
    n = len(weights)
    return _locate(weights, (np.arange(n) + random.uniform(size=n)) / n)


def systematic(weights: np.ndarray, random: Random) -> np.ndarray:
    """The same uniform number in each n-th of the cumulated weights."""
    n = len(weights)
    return _locate(weights, (np.arange(n) + random.uniform()) / n)


def residual(weights: np.ndarray, random: Random) -> np.ndarray:
    """floor(n w_i) copies of each point, the rest drawn independently from what is left of the weights."""
    n = len(weights)
    expected = n * weights
    copies = np.floor(expected).astype(int)
    left = expected - copies
    missing = n - copies.sum()
    if missing > 0:
        drawn = _locate(left, random.uniform(size=missing))
        copies += np.bincount(drawn, minlength=n)
    return np.repeat(np.arange(n), copies)


RESAMPLING: dict[str, Callable[[np.ndarray, Random], np.ndarray]] = {
    "multinomial": multinomial,
    "residual": residual,
    "stratified": stratified,
    "systematic": systematic,
}
