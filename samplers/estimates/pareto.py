"""The Pareto tail of importance weights: its shape says whether they can be used (``docs/theory/evidence``).

If the shape k is below 0.5, the weights have a variance; above 0.7, points that were not drawn dominate the mean.
"""

import numpy as np

# Weights with a larger Pareto shape have no useful mean (Vehtari et al. 2024, section 3.2.4).
LARGEST_SHAPE = 0.7
# Fewer weights determine no shape.
FEWEST_OF_TAIL = 5
# Share of the sum of all weights by which the largest ones must exceed the next one for their shape to matter.
SMALLEST_EXCESS = 0.05


def pareto_shape(log_weights: np.ndarray) -> float:
    """Shape of the tail of weights, given by their logarithms (n,), -inf allowed; inf for too few weights.

    It is 0 for a tail of less than 5 % of the sum: nearly equal weights have errors whose shape says nothing about the
    mean.
    """
    finite = log_weights[log_weights > -np.inf]
    count = int(min(len(log_weights) / 5.0, 3.0 * np.sqrt(len(log_weights))))
    if count < FEWEST_OF_TAIL or len(finite) <= count:
        return float("inf")
    ordered = np.sort(np.exp(finite - finite.max()))
    excess = ordered[-count:] - ordered[-count - 1]
    if excess.sum() < SMALLEST_EXCESS * ordered.sum():
        return 0.0
    excess = excess[excess > np.finfo(float).eps]  # of the largest weight: smaller ones are rounding
    return _fit(excess) if len(excess) >= FEWEST_OF_TAIL else float("inf")


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
