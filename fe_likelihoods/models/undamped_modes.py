r"""Undamped modes of a structure, and their derivatives.

The modes satisfy :math:`K \phi = \lambda M \phi` with :math:`\phi^T M \phi = 1` and :math:`\lambda = (2 \pi f)^2`.
Their derivatives by a parameter, with the derivatives K' and M' of the matrices, are

.. math::

    \lambda_j' = \phi_j^T (K' - \lambda_j M') \phi_j, \qquad
    \phi_j' = \sum_{k \ne j} \frac{\phi_k^T (K' - \lambda_j M') \phi_j}{\lambda_j - \lambda_k} \phi_k
    - \tfrac{1}{2} (\phi_j^T M' \phi_j) \phi_j .

The sum over all other modes is the vector that Nelson's method finds by a solution of linear equations. It has no part
in the space of modes that coincide, whose basis is arbitrary.

References
----------
R. B. Nelson, Simplified calculation of eigenvector derivatives, AIAA Journal 14(9), 1976, 1201-1205,
doi:10.2514/3.7211.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from ..simulation.model import SimulationFailed

_ROUND_OFF = 1e-8  # of matrices that are symmetric, as a share of the largest element
_CANCELS = 1e-14  # energy of the lowest mode, as a share of the sum of its terms' sizes: round-off of a free structure
_MASSLESS = 1e-15  # eigenvalue 1 / lambda, as a share of the largest one: round-off
_FREE = "the structure can move without deformation, or its stiffness matrix is not positive definite"
_COINCIDENT = 2e-6  # relative difference of eigenvalues whose modes are any basis of their space


class Modes(NamedTuple):
    """Undamped modes, the lowest first."""

    frequencies: np.ndarray  # (n,) [Hz]
    shapes: np.ndarray  # (n, n_dofs), with a modal mass of 1


def undamped_modes(stiffness: Any, mass: Any, n: int | None = None) -> Modes:
    """Lowest n modes (default: all) of symmetric matrices (n_dofs, n_dofs), NumPy arrays or SciPy sparse ones.

    The largest eigenvalues 1 / lambda of the inverse problem M phi = (1 / lambda) K phi are the low modes to full
    precision, and degrees of freedom may have no mass. Sparse matrices use the Lanczos method with shift and invert.
    SimulationFailed if the matrices are not finite, not symmetric or of different shapes, the structure can move
    without deformation, or fewer than n degrees of freedom have a positive mass.
    """
    in_band = sparse.issparse(stiffness) or sparse.issparse(mass)
    stiffness, mass = (sparse.csc_array(each) if in_band else np.asarray(each, float) for each in (stiffness, mass))
    if stiffness.ndim != 2 or stiffness.shape[0] != stiffness.shape[1] or stiffness.shape != mass.shape:
        raise SimulationFailed(
            f"stiffness and mass must be square matrices of one size; they are {stiffness.shape} and {mass.shape}"
        )
    for what, matrix in (("stiffness", stiffness), ("mass", mass)):
        largest, skew = abs(matrix).max(), abs(matrix - matrix.T).max()
        if not np.isfinite(largest) or not skew <= _ROUND_OFF * largest:
            raise SimulationFailed(f"the {what} matrix is not finite and symmetric: its asymmetry is {skew:.3g}")
    size = stiffness.shape[0]
    n = size if n is None else n
    if n > size:
        raise SimulationFailed(f"a structure with {size} degrees of freedom has no {n} modes: set n_modes to {size}")
    try:
        if in_band and n < size - 1:
            from scipy.sparse.linalg import eigsh  # slow to import

            start = np.random.default_rng(0).standard_normal(size)  # the same in each run, and orthogonal to no mode
            squares, shapes = eigsh(stiffness, n, mass, sigma=0.0, v0=start)
            order = np.argsort(squares)
            squares, shapes = squares[order], shapes[:, order].T
        else:
            dense = (each.toarray() if in_band else each for each in (mass, stiffness))
            inverse, shapes = eigh(*dense, subset_by_index=[size - n, size - 1])
            inverse, shapes = inverse[::-1], shapes[:, ::-1].T
            if not inverse[-1] > _MASSLESS * inverse[0]:
                raise SimulationFailed(f"fewer than {n} degrees of freedom have a positive mass: compute fewer modes")
            squares, shapes = 1.0 / inverse, shapes / np.sqrt(inverse)[:, None]
    except (np.linalg.LinAlgError, RuntimeError, ArithmeticError) as error:
        raise SimulationFailed(f"{_FREE}: {error}") from error
    lowest = np.abs(shapes[0])
    if not squares[0] > _CANCELS * (lowest @ (abs(stiffness) @ lowest)):
        raise SimulationFailed(f"{_FREE}: the lowest eigenvalue is {squares[0]:.3g} 1/s2")
    return Modes(np.sqrt(squares) / (2.0 * np.pi), shapes)


def mode_derivatives(modes: Modes, stiffness_slope: np.ndarray, mass_slope: np.ndarray) -> Modes:
    """Derivatives of all modes of a structure (n = n_dofs) by parameters, whose matrices' derivatives are given.

    Slopes are (n_parameters, n_dofs, n_dofs); the results (n_parameters, n) and (n_parameters, n, n_dofs).
    """
    squares = np.square(2.0 * np.pi * modes.frequencies)
    stiff, heavy = (modes.shapes @ slope @ modes.shapes.T for slope in (stiffness_slope, mass_slope))
    coupling = stiff - squares[:, None] * heavy  # [p, j, k]: phi_j (K' - lambda_j M') phi_k
    apart = squares[:, None] - squares
    with np.errstate(divide="ignore"):
        inverse = np.where(abs(apart) > _COINCIDENT * squares[:, None], 1.0 / apart, 0.0)
    weights = coupling * inverse
    own = np.arange(len(squares))
    weights[:, own, own] = -0.5 * heavy[:, own, own]
    slopes = coupling[:, own, own] / (8.0 * np.pi**2 * modes.frequencies)
    return Modes(slopes, weights @ modes.shapes)
