"""Faults that samples of a sensor show by themselves, before a simulation: clipped, stuck, spikes, gaps, offset, drift.

All sizes are relative to the channel: its peak, its usual step from sample to sample, its neighbouring samples. So
units, sampling rates and kinds of structures do not matter. The limits were set on the channels of five structures,
without and with faults (``python -m benchmarks screening``); beside each limit is what right channels reach.
"""

import json
import math
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from ..signals.records import Record
from ..units import from_si
from .finding import CARE, HALF, Finding, Findings

FEWEST = 50  # samples that are judged, and for each spike
MATTERS = 0.25  # of the peak, or of the standard deviation: smaller parts hardly change a sum of squares
DIGITS = 3.0  # the steps beside, in smallest steps; without it, 10 of 181 right channels are named for 4
STILL = 3  # equal samples at an extremum, half of those elsewhere; right channels: 2, or between small steps
LONG, VANISHED = 1.5, 10.0  # for so many periods a signal is never so much smaller than beside; right: 5.8
SPIKE = 18.0  # ratio to the errors of interpolation around it; right channels: 15.9
LEVEL = 0.02  # smallest mean of a tenth of a channel, or change of such means, in peaks; right channels: 0.012
# Share of a power that one cause explains: of these means a polynomial (right channels: 0.8), of a history another one.
ONE_CAUSE = 0.9
STRAIGHT = 15  # equal steps of a motion in a row; right motions: 11; found in 786 of 787 gaps of 0.2 to 1 s
WIDEST, AROUND = 3, 10  # samples of a spike, and samples around it that are looked at
LEAVE_OUT, SUBTRACT = "Leave these samples out", "Subtract it, unless the structure did move so"
FAULTS = {  # kind, text and action
    "clipped": ("A sensor is clipped", "has its largest or smallest value for several samples in a row, {}", LEAVE_OUT),
    "stuck": ("A sensor was stuck", "stands still {}, while it moves before and after", LEAVE_OUT),
    "straight": ("A channel has gaps", "is a straight line {}, as over missing samples", LEAVE_OUT),
    "spikes": ("A channel has spikes", "has spikes of one to three samples {}", LEAVE_OUT),
    "offset": ("A channel has an offset", "has the same mean in all its parts, about {}", SUBTRACT),
    "drift": ("A channel drifts", "has a mean that changes steadily, from {}", SUBTRACT),
}


class SensorFault(NamedTuple):
    """A fault of one channel; `screen` adds name, unit and times of the channel."""

    kind: str  # a key of `FAULTS`
    spans: tuple[tuple[int, int], ...]  # first and last samples, both included
    level: tuple[float, ...] = ()  # offset, or drift at evenly spaced samples, the first and the last included
    name: str = ""
    unit: str = ""  # empty if it is not known
    step: float = 1.0  # [s]
    start: float = 0.0  # [s]
    is_motion: bool = False

    def time(self, sample: float) -> str:
        """Time of a sample [s], to a tenth of a step."""
        return f"{self.start + sample * self.step:.{max(0, 1 - math.floor(math.log10(self.step)))}f}"

    @property
    def line(self) -> str:
        """The value in TOML that deals with it."""
        name = json.dumps(self.name, ensure_ascii=False)
        if not self.level:
            return ", ".join(f"[{name}, {self.time(first)}, {self.time(last)}]" for first, last in self.spans)
        key = self.name if re.fullmatch("[A-Za-z0-9_-]+", self.name) else name
        places = np.linspace(0.0, self.spans[0][1], max(len(self.level), 2))
        points = zip(map(self.time, places), self.level, strict=False)
        return f"{key} = [" + ", ".join(f'[{at}, "{value:.4g} {self.unit or "?"}"]' for at, value in points) + "]"


def find_sensor_faults(values: np.ndarray, dimension: str = "") -> tuple[SensorFault, ...]:
    """Faults of the samples (n,) of a channel, NaN where missing; each without the samples of faults found before it.

    An acceleration returns to zero and is never straight; forces and strains of dead loads, and displacements after
    yielding, do not return to zero.
    """
    x, found = np.array(values, dtype=float), list[SensorFault]()
    looks = {"spikes": _spikes, "clipped": _clipped, "stuck": _stuck}
    looks |= {"straight": _straight} if dimension == "acceleration" else {}
    looks |= {"baseline": _baseline} if dimension in ("acceleration", "velocity") else {}
    for kind, look in looks.items():
        # enough neighbouring samples, and not all equal
        if np.isfinite(np.diff(x)).sum() < FEWEST or not np.nanmax(x) > np.nanmin(x):
            break
        if (seen := look(x)) and kind == "baseline":
            found.append(SensorFault("offset" if len(seen) == 1 else "drift", ((0, len(x) - 1),), seen))
        elif seen:
            found.append(SensorFault(kind, tuple(sorted(seen))))
            for first, last in seen:
                x[first : last + 1] = np.nan
    return tuple(found)


def _peak(x: np.ndarray) -> float:
    return float(np.nanmax(np.abs(x - np.nanmedian(x))))


def _round_off(x: np.ndarray) -> float:
    return 8.0 * float(np.spacing(np.nanmax(np.abs(x))))


def runs_of(true: np.ndarray) -> list[tuple[int, int]]:
    """First index and index after the last of each run of true values."""
    edges = np.diff(np.concatenate([[0], true.astype(int), [0]]))
    return list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))


def _flat_parts(x: np.ndarray, equal: float) -> list[tuple[int, int]]:
    """First and last samples of parts of equal samples between steep steps, which the top of a wave has not."""
    steps = np.abs(np.diff(x))
    moving = steps[steps > equal]
    found = []
    for first, last in runs_of(steps <= equal) if len(moving) >= FEWEST else ():  # else it consists of steps
        sides = (steps[max(first - 2 * STILL, 0) : first], steps[last : last + 2 * STILL])
        beside = [np.square(side[np.isfinite(side)]).mean() for side in sides if np.isfinite(side).any()]
        if beside and min(beside) >= (DIGITS * moving.min()) ** 2:
            found.append((first, last))
    return found


def _clipped(x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Samples at the largest or smallest value, if several in a row have it between steep parts."""
    found, flat = list[tuple[int, int]](), _flat_parts(x, _round_off(x))
    for top in (np.nanmax(x), np.nanmin(x)):
        at = np.abs(x - top) <= _round_off(x)
        if sum(last - first + 1 for first, last in flat if at[first]) >= STILL:
            found += [(first, stop - 1) for first, stop in runs_of(at)]
    return tuple(sorted(found))


def _stuck(x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Samples at which the sensor stood still, or hardly moved for longer than a period of the motion."""
    still, level = np.zeros(len(x), dtype=bool), float(np.nanstd(x))
    for first, last in _flat_parts(x, _round_off(x)):
        still[first : last + 1] |= last - first >= 2 * STILL
    period = 2.0 * np.pi * level / np.sqrt(np.nanmean(np.square(np.diff(x))))
    length, beside = max(int(LONG * period), 2 * STILL), max(int(0.5 * period), 3)
    if len(x) > 2 * (length + beside):
        quiet, sides = _moving_deviation(x, length), _moving_deviation(x, beside)
        for least in MATTERS * level * 2.0 ** np.arange(4):
            for first, stop in runs_of(quiet <= least / VANISHED):
                after = stop - 1 + length
                if first >= beside and after + beside <= len(x) and not still[first:stop].any():
                    still[first:after] |= bool(least <= min(sides[first - beside], sides[after]) < np.inf)
    # a quiet start, as of a shake table, is no fault
    return tuple((first, stop - 1) for first, stop in runs_of(still) if first > 0 or stop == len(x))


def _straight(x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Straight lines between parts that move, as readers and loggers fill gaps."""
    equal, moves = 4.0 * _round_off(x), np.abs(np.diff(x)) > 4.0 * _round_off(x)
    lines = [(first, last + 1) for first, last in _flat_parts(np.diff(x), equal) if last - first >= STRAIGHT]
    found = [(first, last) for first, last in lines if moves[first]]
    # a motion with a larger step that was interpolated is straight wherever it moves
    return tuple(found) if sum(last - first for first, last in found) < HALF * np.count_nonzero(moves) else ()


def _moving_deviation(x: np.ndarray, length: int) -> np.ndarray:
    """Standard deviations (n - length + 1,) of the parts of this length, inf where a sample is missing."""
    y, window = np.where(np.isfinite(x), x - np.nanmean(x), 0.0), np.ones(length) / length
    mean, square, there = (np.convolve(each, window, "valid") for each in (y, np.square(y), np.isfinite(x)))
    return np.where(there > 1.0 - 0.5 / length, np.sqrt(np.maximum(square - np.square(mean), 0.0)), np.inf)


def _spikes(x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Up to three neighbouring samples that are off by the same amount, far more than the samples around them.

    A spike has a known pattern of errors of cubic interpolation; what is left without it, the signal itself does there.
    """
    cubic = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0  # a sample less the cubic through its four neighbours
    x, found = x.copy(), list[tuple[int, int]]()
    for _ in range(len(x) // FEWEST):
        peak, best = _peak(x), (SPIKE, 0, 0)
        errors = np.convolve(x, cubic, "same")
        errors[:2] = errors[-2:] = np.nan
        there, errors = np.isfinite(errors), np.nan_to_num(errors)
        for width in range(1, WIDEST + 1):
            pattern = np.pad(np.convolve(np.ones(width), cubic), AROUND - 2)
            power, window = pattern @ pattern, np.ones(len(pattern))
            size = np.correlate(errors, pattern, "same") / power
            left = np.convolve(np.square(errors), window, "same") - np.square(size) * power
            count = np.convolve(there, window, "same")
            noise = np.sqrt(np.maximum(left, 0.0) / np.maximum(count - 1.0, 1.0)) + 1e-4 * peak
            ratio = np.where((np.abs(size) > MATTERS * peak) & (count > AROUND), np.abs(size) / noise, 0.0)
            best = max(best, (float(ratio.max()), int(np.argmax(ratio)) - width // 2, width))
        _, first, width = best
        if not width:
            break
        found.append((max(first, 0), min(first + width, len(x)) - 1))
        x[found[-1][0] : found[-1][1] + 1] = np.nan
        if np.nanmax(x) == np.nanmin(x):  # a pulse is all there is
            return ()
    return tuple(sorted(found))


def _baseline(x: np.ndarray) -> tuple[float, ...]:
    """Offset, or values at the ends (and in the middle) of a drift; empty if there is neither."""
    parts = np.array([np.nan if np.isnan(part).all() else np.nanmean(part) for part in np.array_split(x, 10)])
    places, parts = np.linspace(-0.9, 0.9, 10)[np.isfinite(parts)], parts[np.isfinite(parts)]
    least, spread = LEVEL * _peak(x), np.square(parts - parts.mean()).sum()
    for degree in (1, 2) if len(parts) > 4 else ():
        line = np.polynomial.Polynomial.fit(places, parts, degree, domain=[-1, 1])
        smooth = np.square(parts - line(places)).sum() < (1.0 - ONE_CAUSE) * spread
        if smooth and np.ptp(line(places)) > least:
            return tuple(line(np.linspace(-1.0, 1.0, degree + 1)).tolist())
    large = np.abs(parts).min() > least and (np.sign(parts) == np.sign(parts[0])).all()
    return (float(np.median(parts)),) if large else ()


def check_data(measurements: Measurements, record: Record | Sequence[Record] | None = None) -> Findings:
    """Look for faults that measurements and motions show by themselves; nothing is simulated.

    A channel is clipped, was stuck, or has spikes, gaps, an offset or a drift: each finding says when, and has the line
    of ``[measurements]`` in a TOML file that deals with it. In Python, set these samples to NaN, or subtract the
    offset. Sizes are relative to the channel itself.

    Parameters
    ----------
    measurements : Measurements
    record : Record, Events, or a list of records, optional
        The base motions.

    Returns
    -------
    Findings
        A tuple: faults of sensors, and channels that never change; empty if nothing was found.

    Examples
    --------
    >>> dead = np.where(measurements.time < 5.0, measurements.values, 0.0)
    >>> check_data(Measurements(measurements.channels, record.dt, dead), record)
    CAUTION: A sensor was stuck: ...
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
    return Findings(found)


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
