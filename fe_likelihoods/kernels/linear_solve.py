"""Solution of A x = b for the small banded symmetric matrices of a column, by A = L D L' without pivoting.

A column of n elements has 3 n degrees of freedom, numbered from the base up, so that the half bandwidth is 5. The
tangent may be indefinite after the peak of the force; L D L' needs non-zero pivots only (Golub & Van Loan 2013, section
4.1.2). A zero pivot gives infinities or NaN, which the caller recognises as a failed iteration.

References
----------
G. H. Golub, C. F. Van Loan, Matrix computations, 4th edition, Johns Hopkins University Press, 2013.
"""

from __future__ import annotations

from .jit import kernel

__all__ = ["copy_vector", "copy_matrix", "solve_banded"]

HALF_BANDWIDTH = 5


@kernel(inline=True)
def copy_vector(a, b):
    """Copy the vector `a` to `b`."""
    for i in range(a.shape[0]):
        b[i] = a[i]


@kernel(inline=True)
def copy_matrix(a, b):
    """Copy the matrix `a` to `b`."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            b[i, k] = a[i, k]


@kernel
def solve_banded(a, b):
    """Overwrite `b` (n,) with the solution x of a x = b, and the upper half of the symmetric `a` (n, n)."""
    n = b.shape[0]
    for j in range(n):
        high = min(n, j + HALF_BANDWIDTH + 1)
        inverse = 1.0 / a[j, j]
        for i in range(j + 1, high):
            factor = a[j, i] * inverse
            b[i] -= factor * b[j]
            for k in range(i, high):
                a[i, k] -= factor * a[j, k]
    for j in range(n - 1, -1, -1):
        v = b[j]
        for i in range(j + 1, min(n, j + HALF_BANDWIDTH + 1)):
            v -= a[j, i] * b[i]
        b[j] = v / a[j, j]
