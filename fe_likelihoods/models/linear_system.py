"""Matrices of a linear structure on moving supports, their complex modes, and the exact response.

The equations are in `fe_likelihoods.models.linear_structure`; ``docs/theory/time_integration.rst`` has their solution.
"""

from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import eigh

from ..kernels.complex_modes import superpose_modes
from ..signals.sdof import hold_integrals
from ..simulation.model import SimulationFailed

__all__ = [
    "ComplexModes",
    "LinearSystem",
    "Parts",
    "complex_modes",
    "modal_damping",
    "superpose",
]

_LARGEST_CONDITION = 1e8  # condition number of the complex modes at which half the digits are lost


class LinearSystem(NamedTuple):
    """Matrices of a linear structure with n degrees of freedom, and the positions of its sensors.

    Units need only be consistent: M^-1 C [1/s] and M^-1 K [1/s²] matter.
    """

    mass: np.ndarray  # (n, n)
    damping: np.ndarray  # (n, n)
    stiffness: np.ndarray  # (n, n)
    influence: np.ndarray  # (n, n_supports) static displacements under unit support displacements [-]
    shape: np.ndarray  # (n_channels, n) weight of each absolute acceleration in a channel [-]
    direct: np.ndarray  # (n_channels, n_supports) weight of each support acceleration [-]


class Parts(Protocol):
    """Interface of the structures that `LinearStructure` simulates.

    The ``repr`` of the object must contain everything that the matrices depend on, because it enters the fingerprint.
    """

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @property
    def n_supports(self) -> int:
        """Number of supports."""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels, which are absolute accelerations."""

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters (n_parameters,); raises `SimulationFailed` if they describe no structure."""


def modal_damping(mass: np.ndarray, stiffness: np.ndarray, ratios: np.ndarray) -> np.ndarray:
    """Damping matrix (n, n) of modal damping ratios (n,): C = M Phi diag(2 zeta omega) Phi^T M.

    Mass and stiffness are symmetric; Phi are the undamped modes, lowest frequency first. Raises SimulationFailed if the
    stiffness is not positive definite.
    """
    squares, modes = eigh(stiffness, mass)
    if not squares[0] > 0.0:
        raise SimulationFailed(
            f"the stiffness must be positive definite; its smallest eigenvalue is {squares[0]:g} 1/s2"
        )
    return mass @ (modes * (2.0 * np.asarray(ratios) * np.sqrt(squares))) @ modes.T @ mass


class ComplexModes(NamedTuple):
    """Complex modes; of each conjugate pair only one is stored, with doubled shapes."""

    eigenvalues: np.ndarray  # (m,) [1/s]
    participation: np.ndarray  # (m, n_supports) forcing of the mode under unit support accelerations
    shapes: np.ndarray  # (m, 3, n) in displacement, velocity and absolute acceleration


def complex_modes(system: LinearSystem) -> ComplexModes:
    """Compute the complex modes of a structure.

    Raises SimulationFailed if two complex modes coincide, so that the equations do not uncouple (a mode with exactly
    critical damping, or without stiffness), or if the mass is singular.
    """
    n = len(system.mass)
    try:
        lower = -np.linalg.solve(system.mass, np.hstack([system.stiffness, system.damping]))
        eigenvalues, vectors = np.linalg.eig(np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower]))
        # scaled, because displacements and velocities differ by the size of the frequencies
        rows = np.repeat([max(1.0, np.abs(eigenvalues).max()), 1.0], n)[:, None]
        condition = np.linalg.cond(rows * vectors / np.linalg.norm(rows * vectors, axis=0))
    except np.linalg.LinAlgError as error:
        raise SimulationFailed(f"the complex modes cannot be found: {error}") from error
    if not condition < _LARGEST_CONDITION:
        raise SimulationFailed(
            f"two complex modes coincide (condition {condition:.1e}): a damping is critical, or a stiffness is zero"
        )
    participation = np.linalg.solve(vectors, np.vstack([np.zeros_like(system.influence), -system.influence]))
    # displacement phi, velocity lam phi, and absolute acceleration -M^-1 (C lam + K) phi = lam^2 phi
    shapes = np.stack([vectors[:n], vectors[n:], eigenvalues * vectors[n:]]).transpose(2, 0, 1)
    kept = eigenvalues.imag >= 0.0
    twice = np.where(eigenvalues.imag > 0.0, 2.0, 1.0)[:, None, None]
    return ComplexModes(
        eigenvalues[kept].astype(complex), participation[kept].astype(complex), (twice * shapes)[kept] + 0j
    )


def superpose(
    modes: ComplexModes, shapes: np.ndarray, support_acceleration: np.ndarray, dt: float, out: np.ndarray
) -> None:
    """Add the response with these shapes (m, n_rows) of the modes to `out` (n_rows, n_steps)."""
    decay = np.exp(modes.eigenvalues * dt)
    constant, slope = np.array([hold_integrals(complex(z)) for z in modes.eigenvalues * dt]).T
    superpose_modes(
        decay,
        dt * (constant - slope),
        dt * slope,
        modes.participation,
        np.ascontiguousarray(shapes),
        np.ascontiguousarray(support_acceleration, dtype=float),
        out,
    )
