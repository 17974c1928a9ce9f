"""Findings about measurements and motions, before any simulation."""

import json
import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from ..signals.records import Record
from ..units import from_si
from .finding import CARE, HALF, NOTE, Finding, by_severity
from .sensor_faults import SensorFault, find_sensor_faults

__all__ = ["Screened", "check_data", "check_sensors", "repair_lines", "screen"]

LEAVE_OUT, SUBTRACT = "Leave these samples out", "Subtract it, unless the structure did move so"
FAULTS = {  # kind, text and action
    "clipped": ("A sensor is clipped", "has its largest or smallest value for several samples in a row, {}", LEAVE_OUT),
    "stuck": ("A sensor was stuck", "stands still {}, while it moves before and after", LEAVE_OUT),
    "straight": ("A channel has gaps", "is a straight line {}, as over missing samples", LEAVE_OUT),
    "gap": ("A channel has gaps", "has no samples {}", "They are left out"),
    "spikes": ("A channel has spikes", "has spikes of one to three samples {}", LEAVE_OUT),
    "offset": ("A channel has an offset", "has the same mean in all its parts, about {}", SUBTRACT),
    "drift": ("A channel drifts", "has a mean that changes steadily, from {}", SUBTRACT),
}


def check_data(measurements: Measurements, record: Record | Sequence[Record] | None = None) -> tuple[Finding, ...]:
    """Look for faults that measurements and motions show by themselves; nothing is simulated.

    A channel is clipped, was stuck, or has spikes, gaps, an offset or a drift: each finding says when, and has the line
    of ``[measurements]`` in a TOML file that deals with it. In Python, set these samples to NaN, or subtract the
    offset. Sizes are relative to the channel itself (`fe_likelihoods.checks.sensor_faults`).

    Parameters
    ----------
    measurements : Measurements
    record : Record, Events, or a list of records, optional
        The base motions.

    Returns
    -------
    tuple of Finding
        The most severe first, empty if nothing was found: faults of sensors, and channels that never change.

    Examples
    --------
    >>> dead = np.where(measurements.time < 5.0, measurements.values, 0.0)
    >>> for finding in check_data(Measurements(measurements.channels, record.dt, dead), record):
    ...     print(finding.severity, finding)
    care A sensor was stuck: ...
    """
    given = record if isinstance(record, list | tuple) else [] if record is None else [record]
    motions = [part for each in given for part in getattr(each, "records", (each,))]
    found, silent = list[Finding](), list[str]()
    for channel, values in zip(measurements.channels, measurements.values, strict=True):
        known = values[np.isfinite(values)]
        equal = len(known) > 1 and np.ptp(known) == 0.0  # of data without time, zeros alone are no sign of life
        silent += [channel.name] if equal and (measurements.is_history or known[0] == 0.0) else []
    screened, rests = screen(measurements, motions), len(motions) > len(given)  # no sensor measures between events
    found += check_sensors(each for each in screened if each.kind != "gap" or not rests)
    if silent:
        text, action = f"All samples of {', '.join(silent)} are equal.", "Leave it out, or read another column."
        found.append(Finding("A sensor was silent", CARE, text, action))
    return tuple(each._replace(about="input") for each in by_severity(found))


class Screened(NamedTuple):
    """A fault of one channel, with times [s] as texts."""

    name: str
    unit: str  # of the channel; empty if it is not known
    kind: str  # a key of `FAULTS`
    missing: tuple[tuple[str, str], ...] = ()  # first and last times of the samples that are to be left out
    baseline: tuple[tuple[str, float], ...] = ()  # points of a line through the offset or drift: time, and value
    is_motion: bool = False

    @property
    def line(self) -> str:
        """The value in TOML that deals with it."""
        name, unit = json.dumps(self.name, ensure_ascii=False), self.unit or "?"
        if not self.baseline:
            return ", ".join(f"[{name}, {first}, {last}]" for first, last in self.missing)
        key = self.name if re.fullmatch("[A-Za-z0-9_-]+", self.name) else name
        return f"{key} = [" + ", ".join(f'[{time}, "{value:.4g} {unit}"]' for time, value in self.baseline) + "]"


def screen(measurements: Measurements, motions: Iterable[Record] = ()) -> list[Screened]:
    """Faults of every channel that has any, and of motions; none of data without time, such as modes."""
    found, of = list[Screened](), measurements
    rows = zip(of.channels, of.steps, of.starts, of.values, strict=True) if of.is_history else ()
    for channel, step, start, values in rows:
        shown = from_si(values, channel.unit)
        faults = (*find_sensor_faults(shown, channel.dimension), *_gaps(shown))
        found += [_placed(channel.name, channel.unit, each, step, start) for each in faults]
    for motion in motions:
        for each in find_sensor_faults(motion.acceleration, "acceleration"):
            padding = each.kind == "stuck" and all(last == motion.n_steps - 1 for _, last in each.spans)
            if not padding:  # zeros after a motion are usual
                found.append(_placed(motion.name, "m/s²", each, motion.dt)._replace(is_motion=True))
    return found


def _gaps(x: np.ndarray) -> list[SensorFault]:
    """Two missing samples in a row, or more, of the rate that a channel has."""
    known = np.flatnonzero(np.isfinite(x))
    distances = np.diff(known) if len(known) > 1 else np.ones(1)
    spans = tuple((known[k] + 1, known[k + 1] - 1) for k in np.flatnonzero(HALF * distances > np.median(distances)))
    return [SensorFault("gap", spans)] if spans else []


def _placed(name: str, unit: str, fault: SensorFault, step: float, start: float = 0.0) -> Screened:
    """A fault with times to a tenth of a step."""
    digits = max(0, 1 - math.floor(math.log10(step)))
    spans = tuple((f"{start + a * step:.{digits}f}", f"{start + b * step:.{digits}f}") for a, b in sorted(fault.spans))
    places = start + step * np.linspace(0.0, fault.spans[0][1], max(len(fault.level), 2))
    baseline = tuple((f"{at:.{digits}f}", value) for at, value in zip(places, fault.level, strict=False))
    return Screened(name, unit, fault.kind, () if baseline else spans, baseline)


def repair_lines(found: Sequence[Screened], marks: Sequence[str | float] = ()) -> list[str]:
    """Lines of ``[measurements]`` that deal with all faults, and with texts or numbers that stand for no sample."""
    missing = [json.dumps(each, ensure_ascii=False) for each in marks]
    missing += [each.line for each in found if not each.baseline]
    lines = [f"missing = [{', '.join(missing)}]"] if missing else []
    points = ", ".join(each.line for each in found if each.baseline)
    return [*lines, f"baseline = {{{points}}}"] if points else lines


def check_sensors(screened: Iterable[Screened]) -> list[Finding]:
    """Findings about faults of sensors, one for each channel and kind, with times and the line that deals with it."""
    found = []
    for each in screened:
        kind, text, do = FAULTS[each.kind]
        places = [first if first == last else f"{first} to {last}" for first, last in each.missing]
        more = f" and at {len(places[3:])} more" if places[3:] else ""  # the line for the TOML file has all
        ends = [f"{value:.3g}" for _, value in each.baseline]
        words = f"{' to '.join(dict.fromkeys((ends[0], ends[-1])))} {each.unit}" if ends else ""
        words = words.rstrip() or f"at {', '.join(places[:3])} s{more}"
        action = f"{do}; in [measurements] of a TOML file: {repair_lines([each])[0]}."
        if each.is_motion:
            action = "Check the file, or take another record of the motion: a motion needs all samples."
        name = f"The motion {each.name}" if each.is_motion else each.name
        severity = NOTE if each.kind == "gap" else CARE
        found.append(Finding(kind, severity, f"{name} {text.format(words)}.", action))
    return found
