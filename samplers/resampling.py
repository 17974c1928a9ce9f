"""Resampling: from weighted points to equally weighted points.

Both schemes are unbiased: point i is copied n w_i times on average. Multinomial resampling draws independently, as the
papers do. Systematic resampling divides the cumulative weights into n equal parts, places the same uniform number in
each, and adds the least noise.

Reference: Douc, Cappé & Moulines (2005), Comparison of resampling schemes for particle filtering, ISPA,
doi:10.1109/ISPA.2005.195385.
"""

from collections.abc import Callable

import numpy as np

GRID = 4096.0  # logarithms are rounded to 1 / 4096, so that a constant added to all of them changes nothing

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


def multinomial(weights: np.ndarray, random: Random, size: int | None = None) -> np.ndarray:
    """Independent draws (size,) of indices, ascending, by weights (n,) with sum 1; `size` is n by default."""
    return locate(weights, np.sort(random.uniform(size=len(weights) if size is None else size)))


RESAMPLING: dict[str, Callable[..., np.ndarray]] = {
    "multinomial": multinomial,
    "systematic": systematic,
}
