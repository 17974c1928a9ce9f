r"""Damage measures: what a response says about the state of a structure after each event.

`damage_measures` makes the quantity that `fe_likelihoods.propagate` evaluates for every sample, and
`fe_likelihoods.damage` turns the prediction into probabilities of limit states. The definitions are in
``docs/damage.rst``. They need force, displacement and strain channels; `damage_outputs` names a column's channels.

The response of an event is described by the equivalent linear oscillator, the least-squares fit

.. math:: a = -\omega^2 (u - u_0) - 2 \xi \omega \dot u

of the absolute acceleration :math:`a` to the displacement :math:`u` relative to the base and its velocity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from ..prediction.quantities import ChannelQuantity, MeanOfLast
from ..signals.events import Events
from ..signals.records import Record
from ..signals.sampling import same_step
from .park_ang import ParkAng, park_ang_constants

__all__ = ["SIDES", "STRAIN_MEASURES", "DamageMeasures", "Sensors", "damage_measures", "damage_outputs"]

STRAIN_MEASURES = ("bar tension", "cover compression")
"""Largest strains at the places of a column; the first channel of each place is on a bar, the second on the surface."""

SIDES = ("-", "+")
"""Sides of a section: at negative and at positive positions in the direction of loading."""

_NEEDED = {
    "peak drift": ("displacement",),
    "residual drift": ("displacement",),
    "dissipated energy": ("displacement", "force"),
    "Park-Ang index": ("displacement", "force"),
    "period": ("displacement", "acceleration"),
    "damping": ("displacement", "acceleration"),
    "stiffness ratio": ("displacement", "acceleration"),
    "damping change": ("displacement", "acceleration"),
}
"""Measures of the whole structure, and the kinds of channels that they need."""


class Sensors(NamedTuple):
    """Channels that the measures need; an empty text for a channel that does not exist."""

    displacement: str  # relative to the base [m]
    force: str  # restoring force that belongs to it [N]
    acceleration: str  # absolute [m/s²]
    heights: np.ndarray  # (n_sections,) at which strains are known [m]
    strains: tuple[tuple[str, ...], ...]  # per section from the base: bar, surface at the negative, then positive side


class _Window(NamedTuple):
    """Sample indices of one event: its first, one past its last, and one past the last in the pause that follows."""

    name: str
    first: int
    stop: int
    rest: int


@dataclass(frozen=True, eq=False)
class DamageMeasures:
    """Quantity of a prediction: measures of damage after each event. Made by `damage_measures`.

    Attributes
    ----------
    events : tuple of str
        Names of the events.
    measures : tuple of str
        Measures of the whole structure. Lengths are divided by `height` ("drift").
    sensors : Sensors
        Channels that are used.
    height, diameter : float
        Height to which drifts refer, and diameter of the column [m]; 1 and NaN for another model.
    park_ang : ParkAng or None
        Constants of the damage index.
    yield_strain : float
        Nominal yield strain of the bars; NaN for another model.
    settle : float
        Length of the last part of an event and of the pause after it, over which the residual drift is averaged [s].
    """

    events: tuple[str, ...]
    measures: tuple[str, ...]
    sensors: Sensors
    height: float
    diameter: float
    park_ang: ParkAng | None
    yield_strain: float
    settle: float
    rows: Mapping[str, int]
    windows: tuple[_Window, ...]
    n_steps: int
    dt: float

    def __call__(self, response: np.ndarray) -> np.ndarray:
        """Measures (n_events, n_measures + 4 n_sections) of a response (n_channels, n_steps) [SI].

        First the measures of the whole structure, then, for every section from the base up, the largest tensile strain
        of the bar and compressive strain of the surface at the negative side, and the same at the positive side. Raises
        ValueError if the response and the model for which the measures were made differ in length.
        """
        if response.shape[-1] != self.n_steps:
            raise ValueError(
                f"these measures are for responses of {self.n_steps} samples, got {response.shape[-1]}: use "
                "damage_measures(model.with_record(record)) for a prediction under another record"
            )
        parts = [self._structure(response)]
        if self.sensors.strains:
            strains = response[[self.rows[name] for places in self.sensors.strains for name in places]]
            signs = np.tile([1.0, -1.0], len(strains) // 2)[:, None]
            peaks = [(signs * strains[:, w.first : w.rest]).max(axis=1) for w in self.windows]
            parts.append(np.maximum.accumulate(peaks))  # a strain that was exceeded once has left its damage
        return np.concatenate(parts, axis=1)

    def split(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Name the entries of values (..., n_events, n_values) that `__call__` returned.

        Returns
        -------
        dict of str to ndarray
            Per measure of the structure (..., n_events); for "bar tension" and "cover compression"
            (..., n_events, n_sections, 2), whose last axis is the side.
        """
        n = len(self.measures)
        named = {name: values[..., k] for k, name in enumerate(self.measures)}
        if self.sensors.strains:
            strains = values[..., n:].reshape(*values.shape[:-1], len(self.sensors.heights), 2, 2)
            named |= {name: strains[..., k] for k, name in enumerate(STRAIN_MEASURES)}
        return named

    @property
    def final_values(self) -> dict[str, ChannelQuantity]:
        """Residual displacements by name, for the remark on a structure that still moves; empty if not measured."""
        names = [f"{self.sensors.displacement} after {event}" for event in self.events]
        return dict(zip(names, self._residual, strict=True)) if "residual drift" in self.measures else {}

    @property
    def _residual(self) -> list[ChannelQuantity]:
        """Residual displacement after each event."""
        mean = MeanOfLast(max(1, round(self.settle / self.dt)))
        return [ChannelQuantity(self.sensors.displacement, mean, slice(w.first, w.rest)) for w in self.windows]

    def _structure(self, response: np.ndarray) -> np.ndarray:
        """Measures of the whole structure, shape (n_events, n_measures)."""
        u = response[self.rows[self.sensors.displacement]] if self.sensors.displacement else None
        found: dict[str, np.ndarray] = {}
        if u is not None:
            found["peak drift"] = np.array([np.abs(u[w.first : w.stop]).max() for w in self.windows]) / self.height
            found["residual drift"] = np.array(
                [abs(each.evaluate([u], self.dt)) / self.height for each in self._residual]
            )
        if self.sensors.force:
            force = response[self.rows[self.sensors.force]]
            work = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(u))])
            energy = found["dissipated energy"] = np.array([work[w.rest - 1] for w in self.windows])
            if self.park_ang is not None:
                largest = np.array([np.abs(u[: w.rest]).max() for w in self.windows])  # pauses included
                found["Park-Ang index"] = self.park_ang.index(largest, energy)
        if self.sensors.acceleration:
            acceleration = response[self.rows[self.sensors.acceleration]]
            velocity = np.gradient(u, self.dt)
            fits = [
                _oscillator(acceleration[w.first : w.stop], u[w.first : w.stop], velocity[w.first : w.stop])
                for w in self.windows
            ]
            found["period"], found["damping"] = np.array(fits).T
            found["stiffness ratio"] = (found["period"][0] / found["period"]) ** 2
            found["damping change"] = found["damping"] - found["damping"][0]
        return (
            np.stack([found[name] for name in self.measures], axis=1)
            if self.measures
            else np.empty((len(self.windows), 0))
        )


def damage_outputs(column: Any) -> tuple[str, ...]:
    """Return the outputs of a column that the measures of damage need.

    Parameters
    ----------
    column : RCColumn
        The column.

    Returns
    -------
    tuple of str
        Displacement and acceleration of the top, base shear, and at every section (`RCColumn.section_heights`) the
        strains of the outermost bars of each side (at their positions, which differ between the sides for an odd number
        of bars) and of the surface at both sides.

    Examples
    --------
    >>> from dataclasses import replace
    >>> complete = replace(column, outputs=damage_outputs(column))
    >>> len(complete.channels)
    23
    """
    sensors = _column_sensors(column)
    names = (sensors.displacement, sensors.acceleration, sensors.force)
    return names + tuple(name for places in sensors.strains for name in places)


def damage_measures(
    model: Any,
    *,
    measures: Sequence[str] | None = None,
    displacement: str = "",
    force: str = "",
    acceleration: str = "",
    height: float = 1.0,
    events: Events | None = None,
    park_ang: ParkAng | None = None,
    settle: float = 5.0,
) -> DamageMeasures:
    """Make the quantity of a prediction that describes damage.

    Parameters
    ----------
    model : Model
        The model that will be propagated. An `RCColumn` under a `Record` needs the outputs `damage_outputs`.
    measures : sequence of str, optional
        Names of measures: "peak drift", "residual drift", "dissipated energy", "Park-Ang index", "period", "damping",
        "stiffness ratio", "damping change", "bar tension" and "cover compression" (``docs/damage.rst``). Default: all
        for a column; for another model, all measures whose channels are named.
    displacement, force, acceleration : str
        Channels of a model that is not a column: relative displacement [m], the restoring force that does work on it
        [N], absolute acceleration of the same place [m/s²].
    height : float
        Length by which displacements of another model are divided [m]. 1: they remain displacements.
    events : Events, optional
        Excitation of another model, for measures after each event. Default: ``model.record``, if the model has it; one
        event otherwise. A column needs none: its events are known from its loading.
    park_ang : ParkAng, optional
        Constants of the damage index. Default for a column: `park_ang_constants` at nominal parameters.
    settle : float
        The residual drift is the mean over this length at the end of an event and of the pause after it [s].

    Returns
    -------
    DamageMeasures
        The `quantity` of `fe_likelihoods.propagate`.

    Raises
    ------
    ValueError
        If a measure is unknown or needs a channel that the model lacks, the column is not under a `Record`, `events` is
        not the excitation of the model, or a setting is out of range.

    Examples
    --------
    >>> measures = damage_measures(model, displacement="displacement", measures=["peak drift"], height=3.0)
    >>> predicted = propagate(posterior, samples, quantity=measures)
    >>> predicted.mean.round(4)  # doctest: +SAMPLED
    array([[0.0275]])
    """
    from ..models.rc_column import RCColumn

    if not all(isinstance(x, Real) and 0.0 < x < math.inf for x in (settle, height)):
        raise ValueError(f"settle and height must be positive; got {settle!r} s and {height!r} m")
    names = {channel.name for channel in model.channels}
    if isinstance(model, RCColumn):
        if displacement or force or acceleration or events is not None or height != 1.0:
            raise ValueError("channels, height and events of an RCColumn are known; leave these arguments out")
        sensors, wanted = _column_sensors(model), (*_NEEDED, *STRAIN_MEASURES)
        height, diameter, events = model.height, model.diameter, model.loading
        yield_strain = model.steel.fy / model.steel.es
    else:
        sensors = Sensors(displacement, force, acceleration, np.zeros(0), ())
        wanted = tuple(name for name, kinds in _NEEDED.items() if all(getattr(sensors, kind) for kind in kinds))
        wanted = tuple(name for name in wanted if name != "Park-Ang index" or park_ang is not None)
        diameter = yield_strain = math.nan
        events = _excitation(model, events)
    chosen = wanted if measures is None else _checked_measures(measures)
    required = _required(chosen, sensors)
    lacking = [name for name in required if name not in names]
    if lacking:
        raise ValueError(
            f"the model lacks the outputs {', '.join(lacking)} that {_users(chosen, sensors, lacking)} need; "
            + (
                "add them, dataclasses.replace(column, outputs=damage_outputs(column)), or choose other measures="
                if isinstance(model, RCColumn)
                else f"its channels are {', '.join(sorted(names))}"
            )
        )
    if "Park-Ang index" in chosen:
        if park_ang is None and not isinstance(model, RCColumn):
            raise ValueError("the Park-Ang index needs its constants: give park_ang=ParkAng(...)")
        park_ang = park_ang_constants(model) if park_ang is None else park_ang
        park_ang.check()
    used = sensors._replace(
        **{kind: name if name in required else "" for kind, name in zip(sensors._fields[:3], sensors[:3], strict=True)}
    )
    if not set(chosen) & set(STRAIN_MEASURES):
        used = used._replace(heights=np.zeros(0), strains=())
    order = [channel.name for channel in model.channels]
    return DamageMeasures(
        events=events.names if isinstance(events, Events) else (getattr(events, "name", "event"),),
        measures=tuple(name for name in _NEEDED if name in chosen),
        sensors=used,
        height=float(height),
        diameter=float(diameter),
        park_ang=park_ang if "Park-Ang index" in chosen else None,
        yield_strain=float(yield_strain),
        settle=float(settle),
        rows={name: order.index(name) for name in required},
        windows=_windows(events, model.n_steps, model.dt),
        n_steps=int(model.n_steps),
        dt=float(model.dt),
    )


def _excitation(model: Any, events: Any) -> Any:
    """Excitation whose events are the windows; ValueError if `events` is not the model's excitation."""
    own = getattr(model, "record", None)
    own = own if isinstance(own, Record) else None
    if events is None:
        return own
    if not isinstance(events, Record):
        raise ValueError(f"events must be the Events that the model runs; got {events!r}")
    if own is not None and not (same_step(own.dt, events.dt) and np.array_equal(own.acceleration, events.acceleration)):
        raise ValueError(
            f"events={events.name!r} ({events.n_steps} samples, {events.dt:g} s) are not the excitation of the model, "
            f"{own.name!r} ({own.n_steps} samples, {own.dt:g} s): leave events= out, or use model.with_record(events)"
        )
    length = (model.n_steps - 1) * model.dt
    if own is None and abs(events.duration - length) > max(events.dt, model.dt):
        raise ValueError(
            f"the events last {events.duration:g} s and the response of the model {length:g} s: give the Events that "
            "the model runs"
        )
    return events


def _column_sensors(column: Any) -> Sensors:
    from ..models.rc_column import RCColumn

    if not isinstance(column, RCColumn) or not isinstance(column.loading, Record):
        raise ValueError(f"expected an RCColumn under a Record; got {type(column).__name__}")
    heights = np.unique(np.round(column.section_heights, 9))
    (left, right), surface = column.section.outermost_bars, 0.5 * column.diameter
    places = [tuple(f"strain@{z:.10g}:{x:.10g}" for x in (left, -surface, right, surface)) for z in heights]
    return Sensors("displacement", "base_shear", "acceleration", heights, tuple(places))


def _checked_measures(measures: Sequence[str]) -> tuple[str, ...]:
    known = (*_NEEDED, *STRAIN_MEASURES)
    chosen = (measures,) if isinstance(measures, str) else tuple(measures)
    if not chosen or len(set(chosen)) != len(chosen) or set(chosen) - set(known):
        raise ValueError(f"measures must be some of {', '.join(known)}, each once; got {measures!r}")
    return chosen


def _required(measures: Sequence[str], sensors: Sensors) -> tuple[str, ...]:
    """Channels that the measures need, in the order of the sensors."""
    kinds = {kind for name in measures for kind in _NEEDED.get(name, ())}
    for kind in sorted(kinds):
        if not getattr(sensors, kind):
            users = ", ".join(name for name in measures if kind in _NEEDED.get(name, ()))
            raise ValueError(f"{users} cannot be known without a channel of {kind}: name it, {kind}=...")
    strains = [name for places in sensors.strains for name in places] if set(measures) & set(STRAIN_MEASURES) else []
    if set(measures) & set(STRAIN_MEASURES) and not strains:
        raise ValueError(f"{' and '.join(STRAIN_MEASURES)} are measures of an RCColumn; choose other measures=")
    return (*(getattr(sensors, kind) for kind in sensors._fields[:3] if kind in kinds), *strains)


def _users(measures: Sequence[str], sensors: Sensors, lacking: Sequence[str]) -> str:
    """Measures that need one of the channels that the model lacks."""
    return ", ".join(name for name in measures if set(_required([name], sensors)) & set(lacking))


def _windows(events: Any, n_steps: int, dt: float) -> tuple[_Window, ...]:
    """Samples of the response that belong to each event."""
    if not isinstance(events, Events):
        return (_Window(getattr(events, "name", "event"), 0, n_steps, n_steps),)
    firsts = [math.ceil(w.start / dt - 1e-6) for w in events.windows]
    stops = [min(math.floor(w.end / dt + 1e-6) + 1, n_steps) for w in events.windows]
    rests = [*firsts[1:], n_steps]
    return tuple(map(_Window, events.names, firsts, stops, rests))


def _oscillator(acceleration: np.ndarray, displacement: np.ndarray, velocity: np.ndarray) -> tuple[float, float]:
    """Period [s] and damping ratio of the equivalent linear oscillator; NaN where the fit has no stiffness."""
    terms = np.stack([displacement, velocity, np.ones_like(velocity)])
    # normal equations of scaled terms: three of them, and many samples
    scale = np.sqrt((terms**2).sum(axis=1))
    if not scale.all():
        return math.nan, math.nan
    terms = terms / scale[:, None]
    stiffness, viscous, _ = -np.linalg.solve(terms @ terms.T, terms @ acceleration) / scale
    if not stiffness > 0.0:
        return math.nan, math.nan
    omega = math.sqrt(stiffness)
    return 2.0 * math.pi / omega, viscous / (2.0 * omega)
