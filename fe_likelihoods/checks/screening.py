"""Findings about measurements and motions, before any simulation."""

import json
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from ..signals.records import Record
from ..units import from_si
from .finding import CARE, NOTE, Finding, about, by_severity
from .sensor_faults import SensorFault, find_sensor_faults, straight_parts

__all__ = [
    "Screened",
    "check_data",
    "check_phases",
    "check_sensors",
    "check_steps_of_mass",
    "repair_lines",
    "screen",
    "screen_motion",
]

# No horizontal ground acceleration above 2.8 g was recorded (Tsukidate 2011); responses leave room for impacts.
LARGEST_PEAKS = {"motion": (3.0, "g"), "acceleration": (20.0, "g"), "displacement": (10.0, "m")}
SHORT_STEP = 1e-3  # [s]: accelerations below the top are then right to about 4 %
MOST_PLACES = 3  # that a finding lists; the line for the TOML file has all
REAL_PHASES = 10.0  # [deg]; 0 of 7200 right shapes (errors to 0.1); those named: real parts with a MAC of 0.96 to 0.997


def check_data(measurements: Measurements, record: Record | Sequence[Record] | None = None) -> tuple[Finding, ...]:
    """Look for faults that measurements and motions show by themselves; nothing is simulated.

    A channel is clipped, was stuck, has spikes, an offset or a drift, or is mostly noise: each finding says when, and
    has the line of ``[measurements]`` in a TOML file that deals with it. In Python, set these samples to NaN, or
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
    motions = record if isinstance(record, list | tuple) else [] if record is None else [record]
    sizes = [(f"motion {each.name}", "motion", each.acceleration) for each in motions]
    found, silent = [], []
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
    found += check_sensors(screen(measurements))
    for each in (part for motion in motions for part in getattr(motion, "records", (motion,))):
        found += check_sensors(screen_motion(each))
    if silent:
        text, action = f"All samples of {', '.join(silent)} are equal.", "Leave it out, or read another column."
        found.append(Finding("A sensor was silent", CARE, text, action))
    return by_severity(about("input", found))


class Screened(NamedTuple):
    """Faults of one channel, its display unit (empty if it is not known), and the times of its samples."""

    name: str
    unit: str
    step: float  # [s]
    start: float  # of the first sample [s]
    faults: tuple[SensorFault, ...]  # levels in the unit
    is_motion: bool = False

    def time(self, sample: float) -> str:
        """Time of a sample, to a tenth of a step."""
        return f"{self.start + sample * self.step:.{max(0, 1 - math.floor(math.log10(self.step)))}f}"

    def missing(self) -> list[list[str]]:
        """First and last times of the samples that are to be left out."""
        left_out = [each for each in self.faults if each.kind in ("clipped", "stuck", "spikes", "straight")]
        return [[self.time(sample) for sample in span] for each in left_out for span in sorted(each.spans)]

    def baseline(self) -> list[str]:
        """Points of a line through the offset or drift: time, and value with unit."""
        level = next((each.level for each in self.faults if each.level), ())
        last = next((each.spans[0][1] for each in self.faults if each.level), 0)
        places = np.linspace(0.0, last, len(level)) if len(level) > 1 else [0.0] * len(level)
        return [f'[{self.time(k)}, "{v:.4g} {self.unit or "?"}"]' for k, v in zip(places, level, strict=True)]


def screen(measurements: Measurements) -> list[Screened]:
    """Faults of every channel of measurements that has any; none of data without time, such as modes."""
    found = list[Screened]()
    if not measurements.is_history:
        return found
    rows = zip(measurements.channels, measurements.steps, measurements.starts, measurements.values, strict=True)
    for channel, step, start, values in rows:
        shown = from_si(values, channel.unit)
        faults = find_sensor_faults(shown, channel.dimension)
        found += [Screened(channel.name, channel.unit, step, start, faults)] if faults else []
    return found


def screen_motion(motion: Record) -> list[Screened]:
    """Faults of a motion; zeros after it, and white noise, are usual."""
    found = []
    for fault in find_sensor_faults(motion.acceleration, "acceleration"):
        padding = fault.kind == "stuck" and all(last == motion.n_steps - 1 for _, last in fault.spans)
        found += [] if padding or fault.kind == "noise" else [fault]
    if lines := straight_parts(motion.acceleration):
        found.append(SensorFault("straight", lines, sum(last - first + 1 for first, last in lines) / motion.n_steps))
    return [Screened(motion.name, "m/s²", motion.dt, 0.0, tuple(found), is_motion=True)]


def repair_lines(channels: Sequence[Screened], marks: Sequence[str | float] = ()) -> list[str]:
    """Lines of ``[measurements]`` that deal with all faults, and with texts or numbers that stand for no sample."""
    missing = [json.dumps(each, ensure_ascii=False) for each in marks]
    missing += [f"[{json.dumps(c.name)}, {first}, {last}]" for c in channels for first, last in c.missing()]
    points = [f"{_key(c.name)} = [{', '.join(c.baseline())}]" for c in channels if c.baseline()]
    noisy = [c.name for c in channels if any(each.kind == "noise" for each in c.faults)]
    return [
        *([f"missing = [{', '.join(missing)}]"] if missing else []),
        *([f"baseline = {{{', '.join(points)}}}"] if points else []),
        *([f"# leave out of columns, or of channels: {', '.join(noisy)}"] if noisy else []),
    ]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else json.dumps(name, ensure_ascii=False)


FAULTS = {
    "clipped": ("A sensor is clipped", "has its largest or smallest value for several samples in a row, {when}."),
    "stuck": ("A sensor was stuck", "stands still {when}, while it moves before and after."),
    "straight": ("A motion has a gap", "is a straight line {when}, as over missing samples."),
    "spikes": ("A channel has spikes", "has spikes of one to three samples {when}."),
    "offset": ("A channel has an offset", "has the same mean in all its parts, about {level}."),
    "drift": ("A channel drifts", "has a mean that changes steadily, from {level}."),
    "noise": ("A channel is mostly noise", "has samples that hardly depend on each other (correlation {size:.2f})."),
}


def check_sensors(channels: Sequence[Screened]) -> list[Finding]:
    """Findings about faults of sensors, one for each channel and kind, with times and the line that deals with it."""
    found = []
    for channel, fault in ((each, fault) for each in channels for fault in each.faults):
        only = channel._replace(faults=(fault,))
        places = [first if first == last else f"{first} to {last}" for first, last in only.missing()]
        more = f" and at {len(places) - MOST_PLACES} more" if len(places) > MOST_PLACES else ""
        level = " to ".join(f"{value:.3g}" for value in fault.level[:: max(len(fault.level) - 1, 1)])
        words = {"when": f"at {', '.join(places[:MOST_PLACES])} s{more}", "level": f"{level} {channel.unit}".rstrip()}
        kind, text = FAULTS[fault.kind]
        text = text.format(size=fault.size, **words)
        action = "Check the file, or take another record of the motion: a motion needs all samples."
        if not channel.is_motion:
            do = "Subtract it, unless the structure did move so" if fault.level else "Leave these samples out"
            line = repair_lines([only])[0].removeprefix("# ")
            action = f"{do}; in [measurements] of a TOML file: {line}."
            action = f"{line[0].upper()}{line[1:]}." if fault.kind == "noise" else action
        name = f"The motion {channel.name}" if channel.is_motion else channel.name
        severity = NOTE if fault.kind == "noise" else CARE
        found.append(Finding(kind, severity, f"{name} {text}", action, {channel.name: float(fault.size)}))
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
