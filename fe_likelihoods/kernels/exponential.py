"""Exponential of a small matrix by one thread in one order, so that it has the same bits on every engine.

LAPACK's, on which :func:`scipy.linalg.expm` stands, divides a solve among its threads, and the last bit follows their
number: a worker that has one thread would simulate another response than the process that has two.
"""

import numpy as np

from .jit import kernel

__all__ = ["matrix_exponential"]

_TERMS = 16
_LARGEST = 1e15  # of a row sum: far beyond, yet few squarings


@kernel
def matrix_exponential(a, out, work):
    """exp(a) = (sum_k (a / 2^s)^k / k!)^(2^s), with s so that the largest row sum of a / 2^s is at most 1/2.

    The terms after the last, k = 16, are together below 1e-19 of the sum.

    Parameters
    ----------
    a : ndarray (n, n)
    out : ndarray (n, n)
        exp(a) is put here; NaN where `a` is not finite, or so large that the exponential could not be.
    work : ndarray (2, n, n)
        Overwritten.
    """
    n = a.shape[0]
    scaled, product = work[0], work[1]
    norm = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(a[i, j])
        if not row < _LARGEST:
            for k in range(n):
                for j in range(n):
                    out[k, j] = np.nan
            return
        norm = max(norm, row)
    squarings, scale = 0, 1.0
    while norm * scale > 0.5:
        squarings += 1
        scale *= 0.5
    # Horner: I + a (I + a/2 (I + a/3 (...)))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = scale * a[i, j]
            out[i, j] = 0.0
        out[i, i] = 1.0
    for k in range(_TERMS, 0, -1):
        _multiply(scaled, out, product)
        for i in range(n):
            for j in range(n):
                out[i, j] = product[i, j] / k
            out[i, i] += 1.0
    for _ in range(squarings):
        _multiply(out, out, product)
        for i in range(n):
            for j in range(n):
                out[i, j] = product[i, j]


@kernel
def _multiply(a, b, out):
    """out = a b; zeros of a, of which a system of first order has many, cost nothing."""
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
        for k in range(n):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(n):
                    out[i, j] += factor * b[k, j]
