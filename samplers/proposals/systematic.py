"""Systematic sampling: indices drawn by their weights, as evenly as whole numbers allow.

Reference: Douc, Cappé & Moulines (2005), Comparison of resampling schemes for particle filtering, ISPA,
doi:10.1109/ISPA.2005.195385.
"""

import numpy as np

__all__ = ["locate", "systematic"]


def locate(weights: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Index of the item that contains each position of the cumulative weights, scaled to [0, 1).

    Parameters
    ----------
    weights : (n,) float
        Non-negative, not all zero.
    positions : (m,) float
        In [0, 1).

    Returns
    -------
    (m,) int
        Indices in [0, n).
    """
    cumulative = np.cumsum(weights)
    # a position can be rounded up to 1
    return np.minimum(np.searchsorted(cumulative / cumulative[-1], positions, side="right"), len(weights) - 1)


def systematic(
    weights: np.ndarray, random: np.random.RandomState | np.random.Generator, size: int | None = None
) -> np.ndarray:
    """Indices at equal distances along the cumulative weights, shifted by one uniform number.

    Parameters
    ----------
    weights : (n,) float
        Non-negative, not all zero.
    random : RandomState or Generator
        Source of the uniform number.
    size : int, optional
        Number of indices; n by default.

    Returns
    -------
    (size,) int
        Indices in ascending order; index i occurs ``size * weights[i]`` times, rounded up or down.
    """
    n = len(weights) if size is None else size
    return locate(weights, (np.arange(n) + random.uniform()) / n)
