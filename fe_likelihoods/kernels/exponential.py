"""Exponential of a small matrix, computed by one thread in a fixed order, so that its bits are always the same.

`scipy.linalg.expm` uses LAPACK, which may divide a solve among threads, and the last bit then depends on their number:
a worker process with one thread would compute another response than a process with two.

The method is scaling and squaring with a Taylor series (Moler & Van Loan 2003, methods 1 and 3)::

    exp(a) = (sum_k (a / 2^s)^k / k!)^(2^s)

References
----------
C. Moler, C. Van Loan, Nineteen dubious ways to compute the exponential of a matrix, twenty-five years later, SIAM
Review 45(1), 2003, doi:10.1137/S00361445024180.
"""

import numpy as np

from .jit import kernel

__all__ = ["matrix_exponential"]

_TERMS = 16
_LARGEST = 1e15  # largest row sum; it needs some fifty squarings


@kernel
def matrix_exponential(a, out, work):
    """Write exp(a) to `out`.

    The number of squarings s makes the largest row sum of a / 2^s at most 1/2. The series ends after k = 16; the sum of
    the omitted terms is below 1e-19 of the total.

    Parameters
    ----------
    a : ndarray (n, n)
    out : ndarray (n, n)
        Written: exp(a), or NaN where `a` is not finite or a row sum is 1e15 or more.
    work : ndarray (2, n, n)
        Scratch.
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
    # Horner's scheme: I + a (I + a/2 (I + a/3 (...)))
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
    """Write a b to `out`; zeros in `a`, of which a first-order system has many, are skipped."""
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
        for k in range(n):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(n):
                    out[i, j] += factor * b[k, j]
