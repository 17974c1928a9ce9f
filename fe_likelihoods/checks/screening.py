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

__all__ = ["Screened", "check_data", "check_phases", "check_sensors", "check_steps_of_mass", "repair_lines", "screen"]

# No horizontal ground acceleration above 2.8 g was recorded (Tsukidate 2011); responses leave room for impacts.
LARGEST_PEAKS = {"motion": (3.0, "g"), "acceleration": (20.0, "g"), "displacement": (10.0, "m")}
SHORT_STEP = 1e-3  # [s]: accelerations below the top are then right to about 4 %
REAL_PHASES = 10.0  # [deg]; 0 of 7200 right shapes (errors to 0.1); those named: real parts with a MAC of 0.96 to 0.997

LEAVE_OUT, SUBTRACT = "Leave these samples out", "Subtract it, unless the structure did move so"
FAULTS = {  # kind, text and action
    "clipped": ("A sensor is clipped", "has its largest or smallest value for several samples in a row, {}", LEAVE_OUT),
    "stuck": ("A sensor was stuck", "stands still {}, while it moves before and after", LEAVE_OUT),
    "straight": ("A channel has gaps", "is a straight line {}, as over missing samples", LEAVE_OUT),
    "gap": ("A channel has gaps", "has no samples {}", "They are left out"),
    "spikes": ("A channel has spikes", "has spikes of one to three samples {}", LEAVE_OUT),
    "offset": ("A channel has an offset", "has the same mean in all its parts, about {}", SUBTRACT),
    "drift": ("A channel drifts", "has a mean that changes steadily, from {}", SUBTRACT),
    "noise": ("A channel is mostly noise", "has samples that hardly depend on each other (correlation {})", ""),
}


def check_data(measurements: Measurements, record: Record | Sequence[Record] | None = None) -> tuple[Finding, ...]:
    """Look for faults that measurements and motions show by themselves; nothing is simulated.

    A channel is clipped, was stuck, has spikes, gaps, an offset or a drift, or is mostly noise: each finding says when,
    and has the line of ``[measurements]`` in a TOML file that deals with it. In Python, set these samples to NaN, or
    subtract the offset. Sizes are relative to the channel itself (`fe_likelihoods.checks.sensor_faults`).

    Parameters
    ----------
    measurements : Measurements
    record : Record, Events, or a list of records, optional
        The base motions.

    Returns
    -------
    tuple of Finding
        The most severe first, empty if nothing was found: faults of sensors, sizes that are not plausible in SI units,
        and channels that never change.

    Examples
    --------
    >>> in_mm = measurements.values * [[1.0], [1000.0]]  # displacements in mm, given as m
    >>> for finding in check_data(Measurements(measurements.channels, record.dt, in_mm), record):
    ...     print(finding.severity, finding)
    care A size is not plausible: The peak of channel displacement is ...
    """
    given = record if isinstance(record, list | tuple) else [] if record is None else [record]
    motions = [part for each in given for part in getattr(each, "records", (each,))]
    sizes = [(f"motion {each.name}", "motion", each.acceleration) for each in motions]
    found, silent = list[Finding](), list[str]()
    for channel, values in zip(measurements.channels, measurements.values, strict=True):
        known = values[np.isfinite(values)]
        sizes += [(f"channel {channel.name}", channel.dimension, known)] if len(known) else []
        equal = len(known) > 1 and np.ptp(known) == 0.0  # of data without time, zeros alone are no sign of life
        silent += [channel.name] if equal and (measurements.is_history or known[0] == 0.0) else []
    for name, kind, values in sizes:
        peak, (largest, unit) = float(np.abs(values).max()), LARGEST_PEAKS.get(kind, (np.inf, ""))
        if unit and (shown := from_si(peak, unit).item()) > largest:
            text = f"The peak of {name} is {shown:.3g} {unit}."
            action = "Check the unit of its file. A number without a unit is in SI units (m, m/s²)."
            found.append(Finding("A size is not plausible", CARE, text, action, {"peak": peak}))
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
    size: float
    missing: tuple[tuple[str, str], ...] = ()  # first and last times of the samples that are to be left out
    baseline: tuple[tuple[str, float], ...] = ()  # points of a line through the offset or drift: time, and value
    is_motion: bool = False


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
            if not padding and each.kind != "noise":  # zeros after a motion, and white noise, are usual
                found.append(_placed(motion.name, "m/s²", each, motion.dt)._replace(is_motion=True))
    return found


def _gaps(x: np.ndarray) -> list[SensorFault]:
    """Two missing samples in a row, or more, of the rate that a channel has."""
    known = np.flatnonzero(np.isfinite(x))
    distances = np.diff(known) if len(known) > 1 else np.ones(1)
    spans = [
        (int(known[k]) + 1, int(known[k + 1]) - 1) for k in np.flatnonzero(HALF * distances > np.median(distances))
    ]
    return [SensorFault("gap", tuple(spans), sum(last - first + 1 for first, last in spans) / len(x))] if spans else []


def _placed(name: str, unit: str, fault: SensorFault, step: float, start: float = 0.0) -> Screened:
    """A fault with times to a tenth of a step."""
    digits = max(0, 1 - math.floor(math.log10(step)))
    spans = [(f"{start + a * step:.{digits}f}", f"{start + b * step:.{digits}f}") for a, b in sorted(fault.spans)]
    missing = () if fault.level or fault.kind == "noise" else tuple(spans)
    places = start + step * np.linspace(0.0, fault.spans[0][1], max(len(fault.level), 2))
    baseline = tuple((f"{at:.{digits}f}", value) for at, value in zip(places, fault.level, strict=False))
    return Screened(name, unit, fault.kind, float(fault.size), missing, baseline)


def repair_lines(found: Iterable[Screened], marks: Sequence[str | float] = ()) -> list[str]:
    """Lines of ``[measurements]`` that deal with all faults, and with texts or numbers that stand for no sample."""
    missing, points, noisy = [json.dumps(each, ensure_ascii=False) for each in marks], list[str](), list[str]()
    for each in found:
        name = json.dumps(each.name, ensure_ascii=False)
        missing += [f"[{name}, {first}, {last}]" for first, last in each.missing]
        if each.baseline:
            line = ", ".join(f'[{time}, "{value:.4g} {each.unit or "?"}"]' for time, value in each.baseline)
            points.append(f"{each.name if re.fullmatch('[A-Za-z0-9_-]+', each.name) else name} = [{line}]")
        noisy += [each.name] if each.kind == "noise" else []
    lines = [f"missing = [{', '.join(missing)}]"] if missing else []
    lines += [f"baseline = {{{', '.join(points)}}}"] if points else []
    return lines + ([f"# leave out of columns, or of channels: {', '.join(noisy)}"] if noisy else [])


def check_sensors(screened: Iterable[Screened]) -> list[Finding]:
    """Findings about faults of sensors, one for each channel and kind, with times and the line that deals with it."""
    found = []
    for each in screened:
        kind, text, do = FAULTS[each.kind]
        places = [first if first == last else f"{first} to {last}" for first, last in each.missing]
        more = f" and at {len(places[3:])} more" if places[3:] else ""  # the line for the TOML file has all
        words = f"at {', '.join(places[:3])} s{more}" if places else f"{each.size:.2f}"
        if each.baseline:
            ends = each.baseline[:: max(len(each.baseline) - 1, 1)]
            words = f"{' to '.join(f'{value:.3g}' for _, value in ends)} {each.unit}".rstrip()
        (line,) = repair_lines([each])
        action = f"{do}; in [measurements] of a TOML file: {line}." if do else f"{line[2].upper()}{line[3:]}."
        if each.is_motion:
            action = "Check the file, or take another record of the motion: a motion needs all samples."
        name = f"The motion {each.name}" if each.is_motion else each.name
        severity = NOTE if each.kind in ("noise", "gap") else CARE
        found.append(Finding(kind, severity, f"{name} {text.format(words)}.", action, {each.name: each.size}))
    return found


def check_steps_of_mass(names: Sequence[str], step: float) -> list[Finding]:
    """Accelerations below the top of a column, whose own mass vibrates above 20 Hz, by integration steps [s]."""
    text = (
        f"{', '.join(names)}: accelerations below the top contain vibrations above 20 Hz, which a step of {step:.2g} s "
        "does not resolve (with 1/256 s, they are wrong by 48 %)."
    )
    action = f"Give substeps= so that a step is {SHORT_STEP:.2g} s or shorter, and compare different n_elements."
    long = bool(names) and step > SHORT_STEP
    return [Finding("The steps are long for an acceleration", CARE, text, action, {"step": step})] if long else []


def check_phases(scatter: np.ndarray) -> list[Finding]:
    """Whether complex mode shapes are real up to a factor, by the scatter of the phases of each (m,) [deg]."""
    found = {f"shape {k + 1}": float(each) for k, each in enumerate(scatter) if each > REAL_PHASES}
    shown = ", ".join(f"{each:.0f} degrees ({name})" for name, each in found.items())
    text = f"The phases of complex mode shapes scatter by {shown}; their real parts are taken."
    action = "Identify these modes again, or leave their shapes out: dampers or noise make shapes complex."
    return [Finding("Mode shapes are complex", CARE, text, action, found)] if found else []
