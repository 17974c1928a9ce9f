"""Linear structures on several moving supports, solved exactly.

Slowly growing support displacements g displace the degrees of freedom by R g, with the influence matrix R. The total
displacements are x = R g + u, and the dynamic part u satisfies ::

    M u'' + C u' + K u = -M R a(t),        x'' = u'' + R a = -M^-1 (C u' + K u)

with the support accelerations a (Chopra 2012, section 9.7; damping forces of the quasi-static part are neglected, as
usual). C need not be diagonalised by the modes of M and K. In the state (u, u') the equations are of first order and
uncouple in the complex modes, q' = lam q + f(t). With accelerations that are linear between their samples, each mode
has a closed-form solution without time-stepping error (``docs/theory/time_integration.rst``).

`LinearStructure` makes a model from any object that computes these matrices from parameters: a bridge deck, a frame, or
a building as a sum of modes (`fe_likelihoods.models.frames_and_decks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..kernels.complex_modes import superpose_modes
from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.response_spectrum import hold_integrals
from ..signals.sampling import same_step, sample_window
from ..simulation.model import SimulationFailed
from .frames_and_decks import LinearSystem, Structure
from .undamped_modes import Modes, undamped_modes
from .user_model import ExternalModel
from .validation import check_theta

_MOTIONS = ("displacement", "velocity", "relative_acceleration")
_LARGEST_CONDITION = 1e8  # condition number of the complex modes at which half the digits are lost


class Sensor(NamedTuple):
    """A channel of a `LinearStructure`."""

    name: str
    quantity: str
    row: int  # channel of the structure at its place
    to: int | None = None  # channel of the structure that it is relative to; None: the supports, or absolute
    motion: int | None = None  # 0 displacement, 1 velocity, 2 relative acceleration; None absolute acceleration


def _sensors(structure: Structure, outputs: Sequence[str]) -> tuple[Sensor, ...]:
    """Resolve the names of outputs; ValueError as for `LinearStructure`."""
    names, found = tuple(structure.channel_names), []
    for output in outputs:
        kind, _, place = str(output).partition("@")
        of, _, to = (place, "", "") if place in names else place.partition(":")
        if output in names:
            found.append(Sensor(output, "absolute acceleration", names.index(output)))
        elif kind in _MOTIONS and of in names and (not to or (to in names and to != of and structure.n_supports == 1)):
            quantity = f"relative {kind.split('_')[-1]}"
            row, other = names.index(of), names.index(to) if to else None
            found.append(Sensor(output, quantity, row, other, _MOTIONS.index(kind)))
        else:
            raise ValueError(
                f"LinearStructure: expected outputs out of {', '.join(names)}, one of {', '.join(_MOTIONS)} with @ and "
                f"one of them, such as displacement@{names[-1]}, or, on one support, with two of them, such as "
                f"displacement@{names[-1]}:{names[0]}; got {output!r}"
            )
    if isinstance(outputs, str) or len({each.name for each in found}) < len(found):
        raise ValueError(f"LinearStructure: expected a sequence of outputs, each once; got {outputs!r}")
    return tuple(found)


class LinearStructure(ExternalModel):
    """Linear structure under recorded accelerations of its supports, at rest at their first sample.

    Parameters
    ----------
    structure : BridgeDeck, ShearFrame, or an object with the interface `Structure`
        Parameters and matrices of the structure.
    supports : Record or sequence of Record
        Absolute accelerations of the supports, with the same step and length, in the order that `structure` documents.
    unit : str
        Display unit of the channels.
    lead : float
        Time before the first sample of the channels [s]. The motion of the supports during this time is simulated but
        not compared with measurements, so that a part of a record need not start from rest.
    outputs : sequence of str, optional
        Names of the channels. ``"roof"``, a channel of `structure`, is the absolute acceleration there.
        ``"displacement@roof"``, ``"velocity@roof"`` and ``"relative_acceleration@roof"`` are relative to the support,
        or to the quasi-static motion R g of several supports; ``"displacement@roof:floor 2"`` is relative to another
        channel, the drift of the storeys between them. Default: the absolute accelerations of all channels.

    Raises
    ------
    ValueError
        If an output is unknown or repeated, there are no supports, their steps or lengths differ, the structure has
        another number of supports, or fewer than two samples are after `lead`.

    Examples
    --------
    >>> building = LinearStructure(frame, record, outputs=("floor 1", "displacement@roof:floor 1"))
    >>> building.parameter_names
    ('stiffness_1', 'stiffness_2', 'damping_1', 'damping_2')
    >>> acceleration, drift = building.simulate([1.1, 0.9, 0.03, 0.03])
    """

    path_dependent = False

    def __init__(
        self,
        structure: Structure,
        supports: Record | Sequence[Record],
        unit: str = "g",
        lead: float = 0.0,
        outputs: Sequence[str] | None = None,
    ) -> None:
        supports = (supports,) if isinstance(supports, Record) else tuple(supports)
        if not supports or not all(isinstance(support, Record) for support in supports):
            raise ValueError(f"LinearStructure: expected Records of the support accelerations; got {supports!r}")
        first = supports[0]
        for support in supports[1:]:
            if first.n_steps != support.n_steps or not same_step(first.dt, support.dt):
                raise ValueError(
                    f"LinearStructure: expected supports with the same step and length; got {first.n_steps} samples at "
                    f"{first.dt} s ({first.name}) and {support.n_steps} at {support.dt} s ({support.name}); use "
                    "Record.resample and Record.trim"
                )
        if len(supports) != structure.n_supports:
            raise ValueError(
                f"LinearStructure: expected one record for each of the {structure.n_supports} supports of "
                f"{type(structure).__name__}; got {len(supports)}"
            )
        names = tuple(structure.channel_names)
        self.outputs = None if outputs is None or tuple(outputs) == names else tuple(outputs)
        self.sensors = _sensors(structure, names if outputs is None else outputs)
        units = {"displacement": "mm", "velocity": "mm/s"}
        channels = tuple(
            Channel(each.name, each.quantity, units.get(each.quantity.split()[-1], unit)) for each in self.sensors
        )
        self._window = sample_window("the supports", first.n_steps, first.dt, lead, None)
        super().__init__(tuple(structure.parameter_names), channels, first.dt, self._window.stop - self._window.start)
        self.structure = structure
        self.supports = supports
        self.unit = unit
        self.lead = float(lead)
        self._acceleration = np.stack([support.acceleration for support in supports])
        motions = [support.fingerprint for support in self.supports]
        self.fingerprint = self._digest(repr(self.structure), self._window.start, motions, *(self.outputs or ()))

    def with_record(self, record: Record | Sequence[Record]) -> LinearStructure:
        """Return the same structure, with its lead, under other support accelerations; errors as for a new one."""
        return type(self)(self.structure, record, self.unit, self.lead, self.outputs)

    def followed_by(self, record: Record | Sequence[Record], rest: float = 10.0) -> LinearStructure:
        """Return the same structure under its present motions, a pause of `rest` [s] and further support motions."""
        further = self.with_record(record).supports
        joined = [own.followed_by(each, rest) for own, each in zip(self.supports, further, strict=True)]
        return self.with_record(joined)

    def first(self, seconds: float) -> LinearStructure:
        """Return the same structure up to the sample at `seconds` [s] of its response; ValueError as `Record.trim`."""
        last = self._window.start + sample_window("the response", self.n_steps, self.dt, 0.0, seconds).stop
        return self.with_record([support.trim(0.0, (last - 1) * self.dt) for support in self.supports])

    def modes(self, theta: ArrayLike, n: int | None = None) -> Modes:
        """Return the lowest n undamped modes (default: all), with shapes (n, n_channels) at the channels.

        `theta` is as for `simulate`. Raises SimulationFailed as `undamped_modes`.
        """
        values = check_theta(theta, self.parameter_names)
        system = self.structure.assemble(values)
        modes = undamped_modes(system.stiffness, system.mass, n)
        return modes._replace(shapes=modes.shapes @ system.shape.T)

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        motion = self._acceleration
        system = self.structure.assemble(theta)
        modes = _complex_modes(system)
        weights, direct = system.shape, system.direct
        if self.outputs is not None:
            weights = np.array(
                [weights[each.row] - (0.0 if each.to is None else weights[each.to]) for each in self.sensors]
            )
            direct = direct[[each.row for each in self.sensors]]
        shapes = modes.shapes[:, 2] @ weights.T
        for c, each in enumerate(self.sensors):
            if each.motion is not None:
                shapes[:, c] = modes.shapes[:, each.motion] @ weights[c]
                direct[c] = -weights[c] @ system.influence if each.motion == 2 else 0.0
        out = np.einsum("cs,st->ct", direct, motion)
        _superpose(modes, shapes, motion, self.dt, out)
        return out[:, self._window]


class _ComplexModes(NamedTuple):
    """Complex modes; of each conjugate pair only one is stored, with doubled shapes."""

    eigenvalues: np.ndarray  # (m,) [1/s]
    participation: np.ndarray  # (m, n_supports) forcing of the mode under unit support accelerations
    shapes: np.ndarray  # (m, 3, n) in displacement, velocity and absolute acceleration


def _complex_modes(system: LinearSystem) -> _ComplexModes:
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
    return _ComplexModes(
        eigenvalues[kept].astype(complex), participation[kept].astype(complex), (twice * shapes)[kept] + 0j
    )


def _superpose(
    modes: _ComplexModes, shapes: np.ndarray, support_acceleration: np.ndarray, dt: float, out: np.ndarray
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
