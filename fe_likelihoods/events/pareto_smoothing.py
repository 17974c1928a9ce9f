r"""Importance weights with a smoothed upper tail, and the shape of this tail, which says whether they can be used.

The largest weights are replaced by the expected order statistics of a generalised Pareto distribution that is fitted to
them. Its shape k is below 0.5 where the weights have a variance; above 0.7 averages with these weights are unreliable.

References
----------
A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry (2024), Pareto smoothed importance sampling, Journal of Machine
Learning Research 25(72), 1-58.

J. Zhang, M. A. Stephens (2009), A new and efficient estimation method for the generalized Pareto distribution,
Technometrics 51, 316-325, doi:10.1198/tech.2009.08017.
"""

import numpy as np

__all__ = ["LARGEST_SHAPE", "pareto_shape", "smoothed_weights"]

LARGEST_SHAPE = 0.7  # Vehtari et al. (2024), section 3.2.4
_FEWEST = 5  # weights of a tail


def pareto_shape(weights: np.ndarray) -> float:
    """Shape of a generalised Pareto distribution fitted to the largest of n weights; -inf where it has no tail.

    The estimate of Zhang and Stephens (2009), with the prior of Vehtari et al. (2024), section 3.2 and appendix: the
    largest of 0.2 n and 3 sqrt(n) weights, whichever is less. NaN for fewer than 25 weights.
    """
    ordered = np.sort(weights)
    size = _tail_size(len(ordered))
    if size < _FEWEST:
        return np.nan
    excess = ordered[-size:] - ordered[-size - 1]
    excess = excess[excess > 1e-12 * ordered[-1]]
    return -np.inf if len(excess) < _FEWEST else _fit(excess)[0]


def smoothed_weights(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Pareto smoothed importance weights, and the shape of their tail.

    Parameters
    ----------
    log_weights : (n,) ndarray
        Logarithms of the importance weights, up to a constant; none is infinite or NaN.

    Returns
    -------
    weights : (n,) ndarray
        They sum to one. No weight is larger than the largest one before smoothing.
    shape : float
        As `pareto_shape`.
    """
    weights = np.exp(log_weights - log_weights.max())
    shape, size = pareto_shape(weights), _tail_size(len(weights))
    if np.isfinite(shape):
        order = np.argsort(weights, kind="stable")
        tail, threshold = order[-size:], weights[order[-size - 1]]
        excess = weights[tail] - threshold
        excess = excess[excess > 1e-12]
        shape, scale = _fit(excess)
        positions = (np.arange(len(excess)) + 0.5) / len(excess)
        expected = -np.log1p(-positions) if abs(shape) < 1e-12 else np.expm1(-shape * np.log1p(-positions)) / shape
        weights[tail[-len(excess) :]] = np.minimum(threshold + scale * expected, 1.0)
    return weights / weights.sum(), shape


def _tail_size(n: int) -> int:
    return int(min(0.2 * n, 3.0 * np.sqrt(n)))


def _fit(excess: np.ndarray) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution from sorted positive excesses over a threshold."""
    n = len(excess)
    index = np.arange(1, 31 + int(np.sqrt(n)))
    theta = 1.0 / excess[-1] + (1.0 - np.sqrt(len(index) / (index - 0.5))) / (3.0 * excess[int(n / 4 + 0.5) - 1])
    shapes = np.log1p(-theta[:, None] * excess).mean(axis=1)
    profile = n * (np.log(-theta / shapes) - shapes - 1.0)
    shares = np.exp(profile - profile.max())
    mean = (theta * shares).sum() / shares.sum()
    shape = np.log1p(-mean * excess).mean()
    scale = -shape / mean  # of the estimate without the prior of the shape, as Vehtari et al. do
    return float((n * shape + 5.0) / (n + 10.0)), float(scale)
