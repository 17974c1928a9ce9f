"""The Pareto tail of importance weights: its shape says whether they can be used (``docs/theory/evidence``).

If the shape k is below 0.5, the weights have a variance; above 0.7, points that were not drawn dominate the mean.
"""

import numpy as np

__all__ = ["LARGEST_SHAPE", "pareto_shape", "tail_size"]

# Weights with a larger Pareto shape have no useful mean (Vehtari et al. 2024, section 3.2.4).
LARGEST_SHAPE = 0.7
# Fewer weights determine no shape.
FEWEST_OF_TAIL = 5
# Range of the largest weights, as a share of the largest, up to which they are equal.
SMALLEST_RANGE = 1e-9


def tail_size(n: int) -> int:
    """Number of the largest of n weights whose shape is estimated."""
    return int(min(n / 5.0, 3.0 * np.sqrt(n)))


def pareto_shape(log_weights: np.ndarray) -> float:
    """Shape of the tail of weights, given by their logarithms (n,), -inf allowed.

    It is -inf for weights without a tail, and inf for too few weights.
    """
    excess, shape = _excess(log_weights)
    return shape if excess is None else _fit(excess)


def _excess(log_weights: np.ndarray) -> tuple[np.ndarray | None, float]:
    """Positive excesses of the largest weights over the next one, ascending, in units of the largest weight.

    None, and the shape, if they have no distribution.
    """
    finite = log_weights[log_weights > -np.inf]
    count = tail_size(len(log_weights))
    if count < FEWEST_OF_TAIL or len(finite) <= count:
        return None, float("inf")
    ordered = np.sort(np.exp(finite - finite.max()))
    tail = ordered[-count:] - ordered[-count - 1]
    if tail[-1] <= SMALLEST_RANGE:
        return None, float("-inf")
    tail = tail[tail > 0.0]
    return (tail, np.nan) if len(tail) >= FEWEST_OF_TAIL else (None, float("inf"))


def _fit(excess: np.ndarray) -> float:
    """Shape of a generalised Pareto distribution from ascending excesses (n,) over a threshold."""
    n = len(excess)
    grid = 30 + int(np.sqrt(n))
    quartile = excess[max(int(n / 4.0 + 0.5) - 1, 0)]
    theta = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shapes = np.mean(np.log1p(-theta[:, None] * excess), axis=1)
    profile = n * (np.log(-theta / shapes) - shapes - 1.0)
    posterior = np.exp(profile - profile.max())
    theta = float(theta @ posterior / posterior.sum())
    shape = float(np.mean(np.log1p(-theta * excess)))
    # A weak prior towards 0.5 stabilises the shape from few weights (Vehtari et al. 2024).
    return (n * shape + 5.0) / (n + 10.0)
