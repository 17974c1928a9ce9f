"""Roots of weighted covariance matrices that stay non-singular for few points and for parameters of any unit.

The choices are described in ``docs/theory/proposals``.
"""

import numpy as np

__all__ = ["invert_roots", "location_and_root"]

# With fewer effective points per dimension, correlations are shrunk towards zero.
MIN_POINTS_PER_DIMENSION = 5.0
# Smallest diagonal entry accepted in the root of a correlation matrix.
SMALLEST_PIVOT = 1e-7
# Smallest standard deviation, for parameters that do not vary.
SMALLEST_SD = 1e-150


def location_and_root(coords: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and a non-singular root of the weighted covariance.

    The root is the standard deviations times the root of the correlation matrix. With fewer than five effective points
    per dimension the correlations are poorly determined and are shrunk towards zero. If the matrix is still singular,
    its diagonal is increased until it is not.

    Parameters
    ----------
    coords : ndarray, shape (n, ndim)
        Points.
    weights : ndarray, shape (n,)
        Non-negative weights with sum 1.

    Returns
    -------
    mean : ndarray, shape (ndim,)
        Weighted mean.
    root : ndarray, shape (ndim, ndim)
        Lower-triangular root of the covariance.
    """
    mean = weights @ coords
    centred = coords - mean
    sd = np.sqrt(weights @ centred**2)
    # a parameter that does not vary gets a tiny standard deviation, in its own unit
    sd = np.maximum(sd, np.maximum(1e-12 * coords.std(axis=0), np.maximum(np.spacing(np.abs(mean)), SMALLEST_SD)))
    standard = centred / sd
    correlation = (standard * weights[:, None]).T @ standard

    ndim = len(mean)
    shrinkage = max(0.0, 1.0 - 1.0 / (weights @ weights) / (MIN_POINTS_PER_DIMENSION * ndim))
    correlation *= 1.0 - shrinkage
    np.fill_diagonal(correlation, 1.0)
    jitter = 0.0
    while True:
        try:
            root = np.linalg.cholesky((correlation + jitter * np.eye(ndim)) / (1.0 + jitter))
            if root.diagonal().min() > SMALLEST_PIVOT:
                return mean, sd[:, None] * root
        except np.linalg.LinAlgError:
            pass
        jitter = max(10.0 * jitter, 1e-12)


def invert_roots(roots: np.ndarray) -> np.ndarray:
    """Inverses of lower-triangular matrices (K, ndim, ndim)."""
    # Substitution for all matrices at once. LAPACK takes milliseconds for seven rows when its threads have to wait.
    ndim = roots.shape[-1]
    inverses = np.zeros_like(roots)
    for i in range(ndim):
        row = -np.einsum("kj,kjl->kl", roots[:, i, :i], inverses[:, :i])
        row[:, i] += 1.0
        inverses[:, i] = row / roots[:, i, i, None]
    return inverses
