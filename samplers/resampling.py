"""Resampling: from weighted points to equally weighted points.

All schemes are unbiased: point i is copied n w_i times on average. They differ in the noise that they add. Multinomial
resampling draws independently. Residual resampling keeps the integer part of n w_i and draws the rest. Stratified and
systematic resampling divide the cumulative weights into n equal parts and place one uniform number in each part;
systematic resampling uses the same number in all parts and adds the least noise.

Reference: Douc, Cappé & Moulines (2005), Comparison of resampling schemes for particle filtering, ISPA,
doi:10.1109/ISPA.2005.195385.
"""

from collections.abc import Callable

import numpy as np

__all__ = ["RESAMPLING", "locate", "multinomial", "residual", "stratified", "systematic"]

Random = np.random.RandomState | np.random.Generator


def locate(weights: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Index (m,) of the item that contains each of the positions (m,) in [0, 1) along the cumulative weights (n,)."""
    cumulative = np.cumsum(weights)
    # a position can be rounded up to 1
    return np.minimum(np.searchsorted(cumulative / cumulative[-1], positions, side="right"), len(weights) - 1)


def systematic(weights: np.ndarray, random: Random, size: int | None = None) -> np.ndarray:
    """Indices (size,), ascending, at equal distances along the cumulative weights (n,), shifted by one uniform number.

    Index i occurs ``size * weights[i]`` times, rounded up or down; `size` is n by default.
    """
    n = len(weights) if size is None else size
    return locate(weights, (np.arange(n) + random.uniform()) / n)


def multinomial(weights: np.ndarray, random: Random) -> np.ndarray:
    """Independent draws (n,) of indices, ascending, by weights (n,) with sum 1; other schemes have these arguments."""
    return locate(weights, np.sort(random.uniform(size=len(weights))))


def stratified(weights: np.ndarray, random: Random) -> np.ndarray:
    """One independent uniform number in each of n equal parts of the cumulative weights."""
    n = len(weights)
    return locate(weights, (np.arange(n) + random.uniform(size=n)) / n)


def residual(weights: np.ndarray, random: Random) -> np.ndarray:
    """floor(n w_i) copies of each point; the rest is drawn independently from the remaining weights."""
    n = len(weights)
    expected = n * weights
    copies = np.floor(expected).astype(int)
    remainder = expected - copies
    missing = n - copies.sum()
    if missing > 0:
        drawn = locate(remainder, random.uniform(size=missing))
        copies += np.bincount(drawn, minlength=n)
    return np.repeat(np.arange(n), copies)


RESAMPLING: dict[str, Callable[[np.ndarray, Random], np.ndarray]] = {
    "multinomial": multinomial,
    "residual": residual,
    "stratified": stratified,
    "systematic": systematic,
}
