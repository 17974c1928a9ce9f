"""Findings about measurements and motions, before any simulation."""

import json
from collections.abc import Iterable, Sequence

import numpy as np

from ..signals.channels import Measurements
from ..signals.records import Record
from ..units import from_si
from .finding import CARE, Finding
from .sensor_faults import SensorFault, find_sensor_faults

LEAVE_OUT, SUBTRACT = "Leave these samples out", "Subtract it, unless the structure did move so"
FAULTS = {  # kind, text and action
    "clipped": ("A sensor is clipped", "has its largest or smallest value for several samples in a row, {}", LEAVE_OUT),
    "stuck": ("A sensor was stuck", "stands still {}, while it moves before and after", LEAVE_OUT),
    "straight": ("A channel has gaps", "is a straight line {}, as over missing samples", LEAVE_OUT),
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
        Faults of sensors, and channels that never change; empty if nothing was found.

    Examples
    --------
    >>> dead = np.where(measurements.time < 5.0, measurements.values, 0.0)
    >>> for finding in check_data(Measurements(measurements.channels, record.dt, dead), record):
    ...     print(finding.severity, finding)
    care A sensor was stuck: ...
    """
    given = record if isinstance(record, list | tuple) else [] if record is None else [record]
    motions = [part for each in given for part in getattr(each, "records", (each,))]
    found, silent = check_sensors(screen(measurements, motions)), list[str]()
    for channel, values in zip(measurements.channels, measurements.values, strict=True):
        known = values[np.isfinite(values)]
        equal = len(known) > 1 and np.ptp(known) == 0.0  # of data without time, zeros alone are no sign of life
        silent += [channel.name] if equal and (measurements.is_history or known[0] == 0.0) else []
    if silent:
        text, action = f"All samples of {', '.join(silent)} are equal.", "Leave it out, or read another column."
        found.append(Finding("A sensor was silent", CARE, text, action, about="input"))
    return tuple(found)


def screen(measurements: Measurements, motions: Iterable[Record] = ()) -> list[SensorFault]:
    """Faults of every channel that has any, and of motions; none of data without time, such as modes."""
    found, of = list[SensorFault](), measurements
    for channel, *times, values in zip(of.channels, of.steps, of.starts, of.values, strict=True):
        faults = find_sensor_faults(from_si(values, channel.unit), channel.dimension) if of.is_history else ()
        found += [SensorFault(*each[:3], channel.name, channel.unit, *times) for each in faults]
    for motion in motions:
        for each in find_sensor_faults(motion.acceleration, "acceleration"):
            if each.kind != "stuck" or each.spans[0][1] < motion.n_steps - 1:  # zeros after a motion are usual
                found.append(SensorFault(*each[:3], motion.name, "m/s²", motion.dt, is_motion=True))
    return found


def repair_lines(found: Sequence[SensorFault], marks: Sequence[str | float] = ()) -> list[str]:
    """Lines of ``[measurements]`` that deal with all faults, and with texts or numbers that stand for no sample."""
    missing = [json.dumps(each, ensure_ascii=False) for each in marks]
    missing += [each.line for each in found if not each.level]
    lines = [f"missing = [{', '.join(missing)}]"] if missing else []
    points = ", ".join(each.line for each in found if each.level)
    return [*lines, f"baseline = {{{points}}}"] if points else lines


def check_sensors(screened: Iterable[SensorFault]) -> list[Finding]:
    """Findings about faults of sensors, one for each channel and kind, with times and the line that deals with it."""
    found = []
    for each in screened:
        kind, text, do = FAULTS[each.kind]
        ends = " to ".join(dict.fromkeys(f"{each.level[k]:.3g}" for k in (0, -1))) if each.level else ""
        places = [" to ".join(dict.fromkeys(map(each.time, span))) for span in each.spans[:3]]
        more = f" and at {len(each.spans) - 3} more" if each.spans[3:] else ""  # the line for the TOML file has all
        where = f"{ends} {each.unit}".rstrip() if ends else f"at {', '.join(places)} s{more}"
        action = f"{do}; in [measurements] of a TOML file: {repair_lines([each])[0]}."
        if each.is_motion:
            action = "Check the file, or take another record of the motion: a motion needs all samples."
        name = f"The motion {each.name}" if each.is_motion else each.name
        found.append(Finding(kind, CARE, f"{name} {text.format(where)}.", action, about="input"))
    return found
