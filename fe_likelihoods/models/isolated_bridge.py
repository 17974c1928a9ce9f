"""Seismically isolated bridge: a rigid deck on two flexible piers, with sliders, rubber devices and fluid dampers.

The five degrees of freedom, relative to the shake table, are q = [deck, pier 1 and its rotation, pier 2 and its
rotation]. Each pier is a massless cantilever with a rigid block at its tip, which carries the isolators. The bearing
displacement is deck minus top of block, and the isolator force (friction, rubber, dampers) acts on both. Everything
except friction and the higher terms of the rubber is linear and is integrated exactly
(`fe_likelihoods.kernels.isolated_bridge`).

The equations, the laws of the devices and the channels are in ``docs/theory/isolated_bridge.rst``. Most nominal values
are assumed, so the results describe a bridge *like* the tested one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.sampling import rest_samples, same_step, sample_window
from .base import BuiltInModel, remark_on_range
from .isolated_bridge_bearings import ALL_CHANNELS, CHANNELS, Bearing, Damper, Pier, Rubber
from .isolated_bridge_system import (
    FORMS,
    BridgeMatrices,
    PreparedBridge,
    prepare_bridge,
    run_bridge,
)
from .validation import (
    check_described,
    check_integer,
    check_names,
    check_nominal,
    described,
    invalid,
    structure,
)

PARAMETERS = ("fmin_1", "df_1", "a_1", "fmin_2", "df_2", "a_2", "Kd_1", "C0_1", "Kd_2", "C0_2")
_NOMINAL_UNITS = {
    f"{name}_{pier}": unit
    for pier in (1, 2)
    for name, unit in zip(("a", "Kd", "C0"), ("s/m", "N/m", "N s/m"), strict=True)
}
_LONGEST_STEP = 0.25e-3  # of the default [s]


@structure
@dataclass(frozen=True, eq=False)
class IsolatedBridge(BuiltInModel):
    """Isolated bridge on a shake table; theta holds multiples of the nominal parameters.

    Raises
    ------
    ValueError
        If an argument is out of range, or the arguments do not fit together.

    Notes
    -----
    At the default step, displacements, forces and peaks have errors below 0.05 % of the peak of a channel
    (``docs/theory/time_integration.rst``). With "coulomb" forces and accelerations jump when a bearing begins or ceases
    to stick; steps are halved there until the instant is known within h/64.

    The channels of the two piers and of the deck are:

    ========================  ================================================================================
    ``Ub_1``, ``Ub_2``        displacement of the bearing [m]
    ``Fb_1``, ``Fb_2``        force of the isolator: friction, rubber and dampers [N]
    ``drift_1``, ``drift_2``  displacement of the block's top relative to the table [m]
    ``shear_1``, ``shear_2``  elastic shear force of the pier [N]
    ``acc_p1``, ``acc_p2``    absolute acceleration of the block's top [m/s²]
    ``Ud``, ``acc_d``         displacement of the deck relative to the table [m], absolute acceleration [m/s²]
    ========================  ================================================================================

    ``mean_Ub``, ``mean_Fb``, ``mean_drift``, ``mean_shear`` and ``mean_acc_p`` are means over the two piers.

    Each value of theta is a multiple of a nominal value (`nominal`). The parameters of the two piers are:

    ======================  ==================================================================
    ``fmin_1``, ``fmin_2``  friction coefficient at rest [-]
    ``df_1``, ``df_2``      increase of the friction coefficient at high velocity [-]
    ``a_1``, ``a_2``        rate of this increase with velocity [s/m]
    ``Kd_1``, ``Kd_2``      spring stiffness of one damper [N/m]
    ``C0_1``, ``C0_2``      dashpot coefficient of one damper [N s/m]
    ======================  ==================================================================

    Examples
    --------
    >>> bridge = IsolatedBridge(record.resample(0.005), outputs=("Ub_1", "Fb_1"))
    >>> bridge.parameter_names
    ('fmin_1', 'df_1', 'a_1', 'fmin_2', 'df_2', 'a_2', 'Kd_1', 'C0_1', 'Kd_2', 'C0_2')
    >>> bridge.simulate(np.ones(10)).shape
    (2, 1991)
    """

    record: Record = described("", "Table acceleration at the scale of the model, linear between its samples")
    deck_mass: float = described("kg", "Mass of the deck", "positive", 140e3 / 9.81)
    piers: tuple[Pier, Pier] = described("", "The piers", default=(Pier(), Pier()))
    bearings: tuple[Bearing, Bearing] = described(
        "", "The bearings on the piers", default=(Bearing(), Bearing(f_min=0.050, df=0.070, a=28.0))
    )
    dampers: tuple[Damper, Damper] = described(
        "", "The dampers at the piers", default=(Damper(), Damper(2700e3, 14.80e3))
    )
    rubber: Rubber = described(
        "", "Rubber devices, the same at both piers; they have no parameters in theta", default=Rubber()
    )
    outputs: tuple[str, ...] | None = described(
        "", "Names of the channels (see the notes); default: all twelve that are not means", default=None
    )
    parameters: tuple[str, ...] = described(
        "", "Names of the parameters in theta (``IsolatedBridge`` lists them)", default=PARAMETERS
    )
    nominal_units: ClassVar[dict[str, str]] = _NOMINAL_UNITS
    friction: str = described("", '"bouc-wen" (regularised), or "coulomb" (exact)', default="bouc-wen")
    step: float | None = described(
        "s", "Integration step, which divides the record's; default: the longest up to 0.25 ms", "positive", None
    )
    every: int = described("", "The response has one sample per ``every`` samples of the record", default=1)
    vertical: Record | None = described(
        "",
        "Vertical table acceleration, positive upwards, at the samples of the record",
        default=None,
        more="It multiplies the load on the bearings by 1 + a_v/g, or by zero where that is negative.",
    )

    def __post_init__(self) -> None:
        if self.outputs is None:
            object.__setattr__(self, "outputs", ALL_CHANNELS)
        self._check_parts()
        self._check_integration()
        self._check_names()
        sequences = dict(
            outputs=self.outputs,
            parameters=self.parameters,
            piers=self.piers,
            bearings=self.bearings,
            dampers=self.dampers,
        )
        for name, values in sequences.items():
            object.__setattr__(self, name, tuple(values))

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        values = {}
        for i, (bearing, damper) in enumerate(zip(self.bearings, self.dampers, strict=True), 1):
            values |= {f"fmin_{i}": bearing.f_min, f"df_{i}": bearing.df, f"a_{i}": bearing.a}
            values |= {f"Kd_{i}": damper.stiffness, f"C0_{i}": damper.viscosity}
        return {name: values[name] for name in PARAMETERS}

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the response, in order."""
        return tuple(CHANNELS[name] for name in self.outputs)

    @property
    def dt(self) -> float:
        """Time step of the response [s]."""
        return self.record.dt * self.every

    @property
    def n_steps(self) -> int:
        """Number of response samples."""
        return (self.record.n_steps - 1) // self.every + 1

    @property
    def integration_step(self) -> float:
        """Integration step [s]: `step`, or the default."""
        if self.step is not None:
            return self.step
        ratio = self.record.dt / _LONGEST_STEP
        divisions = max(1, math.ceil(ratio * (1.0 - 1e-6)))
        return _LONGEST_STEP if abs(ratio - divisions) <= 1e-6 * ratio else self.record.dt / divisions

    @property
    def matrices(self) -> BridgeMatrices:
        """Matrices of deck and piers, which do not depend on theta."""
        return BridgeMatrices.assemble(self.deck_mass, self.piers, self.rubber)

    def with_record(self, record: Record | tuple[Record, Record]) -> IsolatedBridge:
        """Return the same bridge under another table acceleration.

        `record` is the horizontal acceleration, or a pair of the horizontal and the vertical acceleration.
        """
        horizontal, vertical = _components(record)
        return replace(self, record=horizontal, vertical=vertical)

    def followed_by(self, record: Record | tuple[Record, Record], rest: float = 10.0) -> IsolatedBridge:
        """Return the same bridge under its present records, a pause and further table accelerations.

        The pause of `rest` [s] is lengthened to a whole number of response steps. If only one of the two excitations
        has a vertical acceleration, it is zero during the other. Errors are as for `Record.followed_by`.
        """
        horizontal, vertical = _components(record)
        n_zeros = rest_samples(rest, self.record.dt)
        n_zeros += -(self.record.n_steps + n_zeros) % self.every
        rest = n_zeros * self.record.dt
        joined = None
        if self.vertical is not None or vertical is not None:
            joined = (self.vertical or self.record.scale(0.0)).followed_by(vertical or horizontal.scale(0.0), rest)
        return replace(self, record=self.record.followed_by(horizontal, rest), vertical=joined)

    def first(self, seconds: float) -> IsolatedBridge:
        """Return the same bridge up to the sample at `seconds` [s] of its response; errors as for other models."""
        last = sample_window("the response", self.n_steps, self.dt, 0.0, seconds).stop - 1
        stop = last * self.every * self.record.dt
        vertical = None if self.vertical is None else self.vertical.trim(0.0, stop)
        return replace(self, record=self.record.trim(0.0, stop), vertical=vertical)

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        prepared = self._prepared
        drivers = run_bridge(self, prepared, theta)
        largest = np.abs(prepared.linear.kinematics @ drivers[:5]).max()
        if largest > prepared.rubber_range:
            at = dict(zip(self.parameters, theta.tolist(), strict=True))
            remark_on_range(
                self,
                f"a bearing displacement of {1e3 * largest:.1f} mm exceeds the {1e3 * prepared.rubber_range:.1f} mm "
                f"for which the law of the rubber holds; the law was continued along its tangent, at {at}. This model "
                "gives no further warnings: compare the displacements with the limit, or extend the law (Rubber.limit)",
            )
        return prepared.to_channels @ drivers[:, :: self.every]

    def _prepare(self) -> PreparedBridge:
        return prepare_bridge(self)

    def _check_parts(self) -> None:
        """Raise ValueError for parts of the wrong type or number."""
        if not isinstance(self.record, Record):
            kind = type(self.record).__name__
            raise invalid("a Record of the table acceleration", kind, "read one with fe_likelihoods.read_record")
        pairs = (("piers", self.piers, Pier), ("bearings", self.bearings, Bearing), ("dampers", self.dampers, Damper))
        for name, pair, kind in pairs:
            if not isinstance(pair, Sequence) or len(pair) != 2 or not all(isinstance(part, kind) for part in pair):
                raise invalid(f"two of {kind.__name__}(...) as {name}", pair, "give one for each pier")
        if not isinstance(self.rubber, Rubber):
            raise invalid("Rubber(...) as rubber", self.rubber, "import it from fe_likelihoods")
        if self.bearings[0].gamma != self.bearings[1].gamma:
            given = [bearing.gamma for bearing in self.bearings]
            raise invalid("the same gamma for both bearings", given, "it is a constant of the friction law")
        if self.vertical is not None and (
            not isinstance(self.vertical, Record)
            or self.record.n_steps != self.vertical.n_steps
            or not same_step(self.record.dt, self.vertical.dt)
        ):
            raise invalid(
                f"a vertical Record of {self.record.n_steps} samples at {self.record.dt} s, like the horizontal one",
                self.vertical,
                "resample and trim both in the same way",
            )

    def _check_integration(self) -> None:
        """Raise ValueError for settings of the integration that are out of range."""
        check_described(self)
        check_integer("every", self.every, 1, max(1, self.record.n_steps - 1))
        if self.friction not in FORMS:
            raise invalid(f"friction out of {tuple(FORMS)}", self.friction, 'the default is "bouc-wen"')
        ratio = self.record.dt / self.integration_step
        if ratio < 0.999 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            whole = self.record.dt / max(1, math.ceil(ratio))
            raise invalid(
                f"an integration step that divides the record's {self.record.dt:.6g} s",
                self.step,
                f"use step={whole:.6g}, or Record.resample to a multiple of the step",
            )

    def _check_names(self) -> None:
        """Raise ValueError for unknown or repeated names of outputs and parameters."""
        check_names("outputs", self.outputs, CHANNELS, "mean_Ub and others are means over the piers")
        check_names("parameters", self.parameters, PARAMETERS, "see IsolatedBridge.nominal for their values")
        check_nominal(self.parameters, self.nominal)


def _components(record: Record | tuple[Record, Record]) -> tuple[Record, Record | None]:
    """Horizontal and vertical acceleration of a record or a pair of records; no vertical one for a single record."""
    if isinstance(record, Record):
        return record, None
    pair = tuple(record) if isinstance(record, tuple | list) else ()
    if len(pair) != 2 or not all(isinstance(each, Record) for each in pair):
        raise invalid("a Record, or a horizontal and a vertical Record", record, "the acceleration of the table")
    return pair
