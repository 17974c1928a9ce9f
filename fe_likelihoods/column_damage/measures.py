"""Damage measures: what a response says about the state of a column after each event.

`damage_measures` makes the quantities that `fe_likelihoods.propagate` evaluates for every sample, and
`fe_likelihoods.damage` turns the prediction into probabilities of limit states. The definitions are in
``docs/damage.rst``.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from ..prediction.quantities import ChannelQuantity, MeanOfLast, dissipated_energy, peak
from ..signals.channels import Channel
from ..signals.records import Events, Record
from ..signals.sampling import SAME_TIME
from .park_ang import ParkAng, park_ang_constants

if TYPE_CHECKING:
    from ..models.rc_column import RCColumn

# largest strains at the places of a column: the outermost bar and the surface at each side of a section
STRAIN_MEASURES = ("bar tension", "cover compression")
_NEEDED = {  # measures of the whole structure, and the outputs that they need
    "peak drift": ("displacement",),
    "residual drift": ("displacement",),
    "dissipated energy": ("displacement", "base_shear"),
    "Park-Ang index": ("displacement", "base_shear"),
}


@dataclass(frozen=True, eq=False)
class DamageMeasures(Sequence):
    """Quantities of a prediction: measures of damage after each event. Made by `damage_measures`."""

    quantities: tuple[ChannelQuantity, ...]  # for each event: of the structure, then of each place from the base up
    events: tuple[str, ...]
    measures: tuple[str, ...]  # of the whole structure; lengths are divided by `height` ("drift")
    heights: np.ndarray  # (n_sections,) at which strains are known [m]
    height: float  # to which drifts refer [m]
    yield_strain: float  # nominal, of the bars

    def __len__(self) -> int:
        return len(self.quantities)

    def __getitem__(self, k: Any) -> Any:
        return self.quantities[k]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all measures."""
        return self.measures + (STRAIN_MEASURES if len(self.heights) else ())

    def split(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Name the values (..., n_quantities) of a prediction.

        Per measure of the structure (..., n_events); for "bar tension" and "cover compression" (..., n_events,
        n_sections, 2), whose last axis is the side: negative, then positive positions in the direction of loading.
        """
        n, values = len(self.measures), values.reshape(*values.shape[:-1], len(self.events), -1)
        named = {name: values[..., k] for k, name in enumerate(self.measures)}
        named |= {name: np.abs(each) / self.height for name, each in named.items() if name.endswith("drift")}
        if len(self.heights):
            strains = values[..., n:].reshape(*values.shape[:-1], len(self.heights), 2, 2)
            named |= {name: strains[..., k] for k, name in enumerate(STRAIN_MEASURES)}
        return named


def damage_outputs(column: RCColumn) -> tuple[str, ...]:
    """Outputs of a column that the measures of damage need.

    Displacement of the top, base shear, and at every section (`RCColumn.section_heights`) the strains of the outermost
    bars of each side (at their positions, which differ between the sides for an odd number of bars) and of the surface
    at both sides.

    Examples
    --------
    >>> from dataclasses import replace
    >>> complete = replace(column, outputs=damage_outputs(column))
    >>> len(complete.channels)
    22
    """
    return ("displacement", "base_shear", *(name for places in _places(column)[1] for name in places))


def damage_measures(
    column: RCColumn,
    *,
    measures: Sequence[str] | None = None,
    park_ang: ParkAng | None = None,
    settle: float = 5.0,
) -> DamageMeasures:
    """Make the quantities of a prediction that describe damage.

    Parameters
    ----------
    column : RCColumn
        The column that will be propagated, under a `Record`, with the outputs `damage_outputs`. Under `Events` there
        are measures after each event.
    measures : sequence of str, optional
        Names of measures: "peak drift", "residual drift", "dissipated energy", "Park-Ang index", "bar tension" and
        "cover compression" (``docs/damage.rst``). Default: all.
    park_ang : ParkAng, optional
        Constants of the damage index. Default: `park_ang_constants` at nominal parameters.
    settle : float
        The residual drift is the mean over this length at the end of an event and of the pause after it [s].

    Raises
    ------
    ValueError
        If a measure is unknown or lacks an output, the model is no column under a `Record`, or a setting is impossible.

    Examples
    --------
    >>> measures = damage_measures(column, measures=["peak drift"])
    >>> predicted = propagate(column, np.ones((3, 5)), quantity=measures)
    >>> measures.split(predicted.mean)["peak drift"].round(4)
    array([0.0091])
    """
    if not isinstance(settle, Real) or not 0.0 < settle < math.inf:
        raise ValueError(f"settle must be positive [s]; got {settle!r}")
    heights, places = _places(column)
    known = (*_NEEDED, *STRAIN_MEASURES)
    chosen = known if measures is None else tuple(measures)
    if not chosen or len(set(chosen)) != len(chosen) or set(chosen) - set(known):
        raise ValueError(f"measures must be some of {', '.join(known)}, each once; got {measures!r}")
    if not set(chosen) & set(STRAIN_MEASURES):
        heights, places = np.zeros(0), ()
    structure = [name for name in _NEEDED if name in chosen]
    needed = dict.fromkeys(output for name in structure for output in _NEEDED[name])
    names = {channel.name for channel in column.channels}
    if lacking := [name for name in (*needed, *itertools.chain(*places)) if name not in names]:
        raise ValueError(
            f"the column lacks the outputs {', '.join(lacking)} that {', '.join(chosen)} need; add them, "
            "dataclasses.replace(column, outputs=damage_outputs(column)), or choose other measures="
        )
    if "Park-Ang index" in chosen:
        park_ang = park_ang_constants(column) if park_ang is None else park_ang
        park_ang.check()
    mean, index = MeanOfLast(max(1, round(settle / column.dt))), functools.partial(_index, constants=park_ang)
    quantities: list[ChannelQuantity] = []
    windows = _windows(column.loading, column.n_steps, column.dt)
    for event, first, stop, rest in windows:
        so_far = slice(0, rest)
        found = {
            "peak drift": peak("displacement", slice(first, stop)),
            "residual drift": ChannelQuantity("displacement", mean, slice(first, rest)),
            "dissipated energy": dissipated_energy("base_shear", "displacement", so_far),
            "Park-Ang index": ChannelQuantity("displacement", index, so_far, ("base_shear",), describe=_of_index),
        }
        found = {name: found[name] for name in structure}
        for z, (left_bar, left, right_bar, right) in zip(heights, places, strict=True):
            for side, bar, surface in (("-", left_bar, left), ("+", right_bar, right)):
                at = f"at {z:g} m, {side} side"
                found[f"bar tension {at}"] = ChannelQuantity(bar, np.max, so_far)
                found[f"cover compression {at}"] = ChannelQuantity(surface, _compression, so_far)
        quantities += (
            replace(each, name=f"{name} after {event}", n_steps=int(column.n_steps)) for name, each in found.items()
        )
    return DamageMeasures(
        tuple(quantities),
        tuple(event for event, *_ in windows),
        tuple(structure),
        heights,
        float(column.height),
        float(column.steel.fy / column.steel.es),
    )


def _index(displacement: np.ndarray, force: np.ndarray, constants: ParkAng) -> float:
    energy = 0.5 * (force[1:] + force[:-1]) @ np.diff(displacement)
    largest = np.abs(displacement).max() + constants.beta / constants.yield_force * energy
    return float(largest / constants.ultimate_displacement)


def _of_index(channel: Channel) -> Channel:
    return Channel(f"Park-Ang index of {channel.name}", "dimensionless", "1")


def _compression(strain: np.ndarray) -> float:
    return float(-np.min(strain))


def _places(column: RCColumn) -> tuple[np.ndarray, tuple[tuple[str, ...], ...]]:
    """Heights of the sections, and outputs of the bar and the surface at the negative, then the positive side."""
    from ..models.rc_column import RCColumn

    if not isinstance(column, RCColumn) or not isinstance(column.loading, Record):
        raise ValueError(f"expected an RCColumn under a Record; got {type(column).__name__}")
    heights = np.unique(np.round(column.section_heights, 9))
    (left, right), surface = column.section.outermost_bars, 0.5 * column.diameter
    return heights, tuple(tuple(f"strain@{z:.10g}:{x:.10g}" for x in (left, -surface, right, surface)) for z in heights)


def _windows(events: Record, n_steps: int, dt: float) -> list[tuple[str, int, int, int]]:
    """Of each event: name, first sample, one past its last, and one past the last in the pause that follows."""
    if not isinstance(events, Events):
        return [(events.name, 0, n_steps, n_steps)]
    firsts = [math.ceil(w.start / dt - SAME_TIME) for w in events.windows]
    stops = [min(math.floor(w.end / dt + SAME_TIME) + 1, n_steps) for w in events.windows]
    return list(zip(events.names, firsts, stops, [*firsts[1:], n_steps], strict=True))
