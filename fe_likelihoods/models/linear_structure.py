"""Linear structures on several moving supports, solved exactly.

Slowly growing support displacements g cause displacements R g of the degrees of freedom, with the influence matrix R.
The total displacements are x = R g + u, and the dynamic part u satisfies ::

    M u'' + C u' + K u = -M R a(t),        x'' = u'' + R a = -M^-1 (C u' + K u)

with the accelerations a of the supports (Chopra 2012, section 9.7; damping forces of the quasi-static part are
neglected, as usual). C need not be diagonalised by the modes of M and K. In the state (u, u') the equations are of
first order and uncouple in the complex modes, q' = lam q + f(t). With accelerations that are linear between their
samples, each mode has a closed-form solution without time-stepping error (``docs/theory/time_integration.rst``).

`LinearStructure` is a model of any object that computes these matrices from parameters. Two such objects are a bridge
deck and a frame (`fe_likelihoods.models.linear_structure_parts`).

References
----------
A. K. Chopra, Dynamics of Structures, 4th edition, Prentice Hall, 2012.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import eigh

from ..kernels.complex_modes import superpose_modes
from ..kernels.jit import KERNEL_HASH
from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.sampling import same_sampling, sample_window
from ..signals.sdof import hold_integrals
from ..simulation.model import SimulationFailed
from .external import ExternalModel

__all__ = [
    "LinearStructure",
    "LinearSystem",
    "Parts",
    "StructureResponse",
    "modal_damping",
    "respond_structure",
]

_LARGEST_CONDITION = 1e8  # condition number of the complex modes at which half of the digits are lost


class LinearSystem(NamedTuple):
    """Matrices of a linear structure with n degrees of freedom, and the positions of its sensors.

    Attributes
    ----------
    mass, damping, stiffness : ndarray[n, n]
        Matrices in any consistent units: only M^-1 C [1/s] and M^-1 K [1/s²] matter.
    influence : ndarray[n, n_supports]
        Static displacements under unit displacements of the supports [-]; ones for a structure on a single support.
    shape : ndarray[n_channels, n]
        Weight of the absolute acceleration of each degree of freedom in each channel [-].
    direct : ndarray[n_channels, n_supports]
        Weight of the acceleration of each support in each channel [-].
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    influence: np.ndarray
    shape: np.ndarray
    direct: np.ndarray


class StructureResponse(NamedTuple):
    """Response of the degrees of freedom.

    Attributes
    ----------
    displacement : ndarray[n, n_steps]
        Displacement relative to R g [m].
    velocity : ndarray[n, n_steps]
        Velocity relative to R g [m/s].
    acceleration : ndarray[n, n_steps]
        Absolute acceleration [m/s²].
    """

    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


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
    """Compute the damping matrix from modal damping ratios: C = M Phi diag(2 zeta omega) Phi^T M.

    Parameters
    ----------
    mass, stiffness : ndarray[n, n]
        Symmetric matrices, positive definite.
    ratios : ndarray[n]
        Fractions zeta of critical damping of the undamped modes Phi, lowest frequency first.

    Returns
    -------
    ndarray[n, n]
        Damping matrix.

    Raises
    ------
    SimulationFailed
        If the stiffness is not positive definite.
    """
    squares, modes = eigh(stiffness, mass)
    if not squares[0] > 0.0:
        raise SimulationFailed(
            f"the stiffness must be positive definite; its smallest eigenvalue is {squares[0]:g} 1/s2"
        )
    return mass @ (modes * (2.0 * np.asarray(ratios) * np.sqrt(squares))) @ modes.T @ mass


def respond_structure(system: LinearSystem, support_acceleration: np.ndarray, dt: float) -> StructureResponse:
    """Compute the exact response, from rest, to support accelerations that are linear between their samples.

    Parameters
    ----------
    system : LinearSystem
        Matrices of the structure.
    support_acceleration : ndarray[n_supports, n_steps]
        Absolute accelerations of the supports [m/s²].
    dt : float
        Time step of the samples [s].

    Returns
    -------
    StructureResponse

    Raises
    ------
    SimulationFailed
        If two complex modes coincide, so that the equations do not uncouple (a mode with exactly critical damping, or
        without stiffness), or if the mass is singular.
    """
    modes = _modes(system)
    n, n_steps = len(system.mass), support_acceleration.shape[1]
    response = np.zeros((3 * n, n_steps))
    _superpose(modes, modes.shapes.reshape(-1, 3 * n), support_acceleration, dt, response)
    return StructureResponse(*response.reshape(3, n, n_steps))


class _Modes(NamedTuple):
    """Complex modes; of each conjugate pair only one is stored, with doubled shapes.

    Attributes
    ----------
    eigenvalues : ndarray[m]
        Eigenvalues [1/s].
    participation : ndarray[m, n_supports]
        Forcing of the mode under unit accelerations of the supports.
    shapes : ndarray[m, 3, n]
        Shapes in displacement, velocity and absolute acceleration.
    """

    eigenvalues: np.ndarray
    participation: np.ndarray
    shapes: np.ndarray


def _modes(system: LinearSystem) -> _Modes:
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
    return _Modes(eigenvalues[kept].astype(complex), participation[kept].astype(complex), (twice * shapes)[kept] + 0j)


def _superpose(modes: _Modes, shapes: np.ndarray, support_acceleration: np.ndarray, dt: float, out: np.ndarray) -> None:
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


class LinearStructure(ExternalModel):
    """Linear structure under recorded accelerations of its supports, at rest at their first sample.

    Parameters
    ----------
    parts : BridgeDeck, ShearFrame, or an object with the interface `Parts`
        Parameters and matrices of the structure.
    supports : Record or sequence of Record
        Absolute accelerations of the supports, with the same step and length, in the order that `parts` documents.
    unit : str
        Display unit of the channels.
    lead : float
        Time before the first sample of the channels [s]. The motion of the supports during this time is simulated but
        not compared with measurements, so that a part of a record need not start from rest.

    Raises
    ------
    ValueError
        If there are no supports, their steps or lengths differ, `parts` has another number of supports, or the lead
        leaves fewer than two samples.

    Examples
    --------
    >>> model = LinearStructure(BridgeDeck("ch7"), [footing, south_end, north_end])
    >>> (acceleration,) = model.simulate([3.7, 0.09, 0.8])
    """

    path_dependent = False

    def __init__(self, parts: Parts, supports: Record | Sequence[Record], unit: str = "g", lead: float = 0.0) -> None:
        supports = (supports,) if isinstance(supports, Record) else tuple(supports)
        if not supports or not all(isinstance(support, Record) for support in supports):
            raise ValueError(
                f"LinearStructure: expected Records of the accelerations of the supports; got {supports!r}"
            )
        first = supports[0]
        for support in supports[1:]:
            if not same_sampling(first.dt, first.n_steps, support.dt, support.n_steps):
                raise ValueError(
                    f"LinearStructure: expected supports with the same step and length; got {first.n_steps} samples at "
                    f"{first.dt} s ({first.name}) and {support.n_steps} at {support.dt} s ({support.name}); use "
                    "Record.resample and Record.trim"
                )
        if len(supports) != parts.n_supports:
            raise ValueError(
                f"LinearStructure: expected one record for each of the {parts.n_supports} supports of "
                f"{type(parts).__name__}; got {len(supports)}"
            )
        channels = tuple(Channel(name, "absolute acceleration", unit) for name in parts.channel_names)
        self._window = sample_window("the supports", first.n_steps, first.dt, lead, None)
        super().__init__(parts.parameter_names, channels, first.dt, first.n_steps - self._window.start)
        self.parts = parts
        self.supports = supports
        self.unit = unit
        self.lead = float(lead)
        self._acceleration = np.stack([support.acceleration for support in supports])
        self.fingerprint = self._digest(KERNEL_HASH, repr(parts), self._window.start, [s.fingerprint for s in supports])

    def with_record(self, record: Record | Sequence[Record]) -> LinearStructure:
        """Return the same structure under other accelerations of its supports; errors as for a new one."""
        return type(self)(self.parts, record, self.unit, self.lead)

    def followed_by(self, record: Record | Sequence[Record], rest: float = 10.0) -> LinearStructure:
        """Return the same structure under its own motions, a pause of `rest` [s] and further motions of its supports.

        Its response ends with the samples of ``with_record(record)``. Errors are those of `Record.followed_by`.
        """
        further = self.with_record(record).supports
        joined = [own.followed_by(each, rest) for own, each in zip(self.supports, further, strict=True)]
        return self.with_record(joined)

    def first(self, seconds: float) -> LinearStructure:
        """Return the same structure under the first part of its records.

        Parameters
        ----------
        seconds : float
            Time of the last sample of the response [s], which starts after the lead; between two samples, the earlier
            one is the last.

        Returns
        -------
        LinearStructure
            Its response is the first part of the response of this model.

        Raises
        ------
        ValueError
            If the time is not within the response, or fewer than two samples remain.
        """
        last = self._window.start + sample_window("the response", self.n_steps, self.dt, 0.0, seconds).stop - 1
        return self.with_record([support.trim(0.0, last * self.dt) for support in self.supports])

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        system = self.parts.assemble(theta)
        modes = _modes(system)
        out = np.einsum("cs,st->ct", system.direct, self._acceleration)
        _superpose(modes, modes.shapes[:, 2] @ system.shape.T, self._acceleration, self.dt, out)
        return out[:, self._window]
