"""Linear structures on several moving supports, solved exactly.

Supports that move by different amounts carry a structure along: displacements x of its degrees of freedom are R g under
support displacements g that grow slowly, with the influence matrix R. What is left, u = x - R g, vibrates ::

    M u'' + C u' + K u = -M R a(t),        x'' = u'' + R a = -M^-1 (C u' + K u)

with the accelerations a of the supports (Chopra 2012, section 9.7; damping forces of the slow part are left
out, as usual). C need not have the modes of M and K. Of first order, in the state (u, u'), the equations come apart in
the complex modes, each q' = lam q + f(t), and with accelerations that are straight lines between their samples each has
a closed form: no time-stepping error, as in `linear_oscillator`.

`LinearStructure` makes a model of anything that turns parameters into these matrices; `linear_parts` has a bridge deck
and a frame.

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
from ..signals.sampling import sample_window
from ..signals.sdof import hold_integrals
from ..simulation.model import SimulationFailed
from .external import CheckedModel

__all__ = [
    "LinearStructure",
    "LinearSystem",
    "Parts",
    "StructureResponse",
    "modal_damping",
    "respond_structure",
]

_LARGEST_CONDITION = 1e8  # of the complex modes: half of the digits


class LinearSystem(NamedTuple):
    """Matrices of a linear structure with n degrees of freedom, and what its sensors measure.

    mass, damping, stiffness : (n, n) float — in any units that agree: only M^-1 C [1/s] and M^-1 K [1/s²] matter.
    influence : (n, n_supports) float — displacements under unit displacements of the supports, slowly; a structure that
        stands on one support and is not sheared by it has ones [-].
    shape : (n_channels, n) float — share of each degree of freedom's absolute acceleration in each channel [-].
    direct : (n_channels, n_supports) float — and of each support's acceleration [-].
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    influence: np.ndarray
    shape: np.ndarray
    direct: np.ndarray


class StructureResponse(NamedTuple):
    """Response of the degrees of freedom, each (n, n_steps): `displacement` [m] and `velocity` [m/s] relative to R g,
    absolute `acceleration` [m/s²]."""

    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class Parts(Protocol):
    """What `LinearStructure` needs to know of a structure. Its repr tells everything that the matrices depend on."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters."""

    @property
    def n_supports(self) -> int:
        """Number of supports."""

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels, all of them absolute accelerations."""

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters (n_parameters,); `SimulationFailed` where there are none."""


def modal_damping(mass: np.ndarray, stiffness: np.ndarray, ratios: np.ndarray) -> np.ndarray:
    """Damping matrix (n, n) that gives the undamped modes, slowest first, these fractions (n,) of critical damping.

    M Phi diag(2 zeta omega) Phi^T M with mass-normalised modes Phi; M and K symmetric, M positive definite.
    """
    squares, modes = eigh(stiffness, mass)
    if not squares[0] > 0.0:
        raise SimulationFailed(
            f"the stiffness must be positive definite; its smallest eigenvalue is {squares[0]:g} 1/s2"
        )
    return mass @ (modes * (2.0 * np.asarray(ratios) * np.sqrt(squares))) @ modes.T @ mass


def respond_structure(system: LinearSystem, support_acceleration: np.ndarray, dt: float) -> StructureResponse:
    """Exact response, from rest, to accelerations of the supports that are linear between their samples.

    Parameters
    ----------
    system : LinearSystem
    support_acceleration : (n_supports, n_steps) float
        [m/s²]
    dt : float
        Time step of the samples [s].

    Returns
    -------
    StructureResponse

    Raises
    ------
    SimulationFailed
        If two complex modes coincide (a mode with exactly critical damping, or without stiffness): they do not come
        apart then; and if the mass is singular.
    """
    modes = _modes(system)
    n, n_steps = len(system.mass), support_acceleration.shape[1]
    response = np.zeros((3 * n, n_steps))
    _superpose(modes, modes.shapes.reshape(-1, 3 * n), support_acceleration, dt, response)
    return StructureResponse(*response.reshape(3, n, n_steps))


class _Modes(NamedTuple):
    """Complex modes, of conjugate ones only one, which counts twice.

    eigenvalues : (m,) complex [1/s]
    participation : (m, n_supports) complex — forcing of the mode under unit accelerations of the supports.
    shapes : (m, 3, n) complex — in displacement, velocity and absolute acceleration.
    """

    eigenvalues: np.ndarray
    participation: np.ndarray
    shapes: np.ndarray


def _modes(system: LinearSystem) -> _Modes:
    n = len(system.mass)
    try:
        lower = -np.linalg.solve(system.mass, np.hstack([system.stiffness, system.damping]))
        eigenvalues, vectors = np.linalg.eig(np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower]))
        # displacements and velocities differ in size by the frequencies, which is no matter of coinciding modes
        rows = np.repeat([max(1.0, np.abs(eigenvalues).max()), 1.0], n)[:, None]
        condition = np.linalg.cond(rows * vectors / np.linalg.norm(rows * vectors, axis=0))
    except np.linalg.LinAlgError as error:
        raise SimulationFailed(f"the complex modes cannot be found: {error}") from error
    if not condition < _LARGEST_CONDITION:
        raise SimulationFailed(
            f"two complex modes coincide (condition {condition:.1e}): is a damping critical, or a stiffness zero?"
        )
    participation = np.linalg.solve(vectors, np.vstack([np.zeros_like(system.influence), -system.influence]))
    # displacement phi, velocity lam phi; absolute acceleration lam^2 phi, as that is what M^-1 K and C leave
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


class LinearStructure(CheckedModel):
    """A linear structure under recorded accelerations of its supports, at rest at their first sample.

    Parameters
    ----------
    parts : BridgeDeck, ShearFrame, or another object of the kind of `Parts`
        What the structure is made of.
    supports : Record or sequence of Record
        Absolute accelerations of the supports, of one step and length; in the order that `parts` states.
    unit : str
        Display unit of the channels.
    lead : float
        Time [s] before the first sample of the channels: the supports' motion in it only brings the structure into the
        state that it has there. So a part of a record can be measured, without starting it from rest.

    Raises
    ------
    ValueError
        If there are no supports, they differ in step or length, `parts` has no place for so many, or the lead leaves
        fewer than two samples.

    Examples
    --------
    >>> model = LinearStructure(BridgeDeck("ch7"), [footing, south_end, north_end])
    >>> (acceleration,) = model.simulate([3.7, 0.09, 0.8])
    """

    def __init__(self, parts: Parts, supports: Record | Sequence[Record], unit: str = "g", lead: float = 0.0) -> None:
        supports = (supports,) if isinstance(supports, Record) else tuple(supports)
        if not supports or not all(isinstance(support, Record) for support in supports):
            raise ValueError(f"LinearStructure: expected the Records of the supports' accelerations; got {supports!r}")
        first = supports[0]
        for support in supports[1:]:
            if support.n_steps != first.n_steps or abs(support.dt - first.dt) > 1e-9 * first.dt:
                raise ValueError(
                    f"LinearStructure: expected supports of one step and length; got {first.n_steps} samples at "
                    f"{first.dt} s ({first.name}) and {support.n_steps} at {support.dt} s ({support.name}): use "
                    "Record.resample and Record.trim"
                )
        if len(supports) != parts.n_supports:
            raise ValueError(
                f"LinearStructure: {type(parts).__name__} stands on {parts.n_supports} supports; "
                f"got {len(supports)} records"
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
        """The same structure under other accelerations of its supports; ValueError as for a new one."""
        return type(self)(self.parts, record, self.unit, self.lead)

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        system = self.parts.assemble(theta)
        modes = _modes(system)
        out = np.einsum("cs,st->ct", system.direct, self._acceleration)
        _superpose(modes, modes.shapes[:, 2] @ system.shape.T, self._acceleration, self.dt, out)
        return out[:, self._window]
