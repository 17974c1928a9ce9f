"""Times of the rows of a table: the uniform step, and the time of the first row."""

import contextlib
import datetime
import re

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit, to_si
from .clock_times import parse_clock
from .tables import Table, column_names, stated_unit
from .text_files import agree_on_unit
from .uneven_times import uniform_times

__all__ = ["row_times", "table_start", "table_step", "time_column"]

_TIME = re.compile(r"(elapsed |relative )?(t|(time|zeit|temps|tempo|tiempo)\d*)(\b|_)", re.IGNORECASE)
_STAMP = re.compile(r"(timestamp|unix|epoch)(\b|_)", re.IGNORECASE)  # times if no other column has them
_DAY_1970 = datetime.date(1970, 1, 1).toordinal()
_UNIX = re.compile(r"unix|epoch", re.IGNORECASE)
_UNIX_SECONDS = (1e9, 4.2e9)  # seconds since 1970 of the years 2001 to 2103


def table_step(table: Table, dt: float | None = None) -> float:
    """Return the time step [s] of a table: from its times, the comment ``dt = ... s`` and the argument, which must
    agree.

    Printed times are rounded, so each may differ from a uniform grid by one unit of its last digit: half a unit because
    it is rounded, half a unit because the two ends that define the grid are rounded. If this unit is more than half a
    step, the tolerance would hide a missing sample, and it is not applied. Times that may have been stored as float32
    may differ by 2e-7 times the largest time, if this is less than a quarter of a step. Other times must be uniform
    within 1e-4 of a step and round-off; ValueError otherwise. A whole number of samples per second is used where the
    mean step corresponds to it within the rounding and a relative 1e-4.
    """
    place = time_column(table)
    step, tolerance = (None, 0.0) if place is None else _uniform_step(table, place)
    known = [("the argument dt", dt)] if dt is not None else []
    known += [(repr(each.text), each.steps[0]) for each in table.stated.steps if len(each.steps) == 1]
    known += [("the time column", step)] if step is not None else []
    if not known:
        unclear = "".join(f", and states {each.text!r} without a unit" for each in table.stated.steps[:1])
        raise ValueError(
            f"{table.file} has no times (column time_s) and no comment 'dt = ... s'{unclear}: give dt= in seconds, or "
            "the column of times, time="
        )
    first, chosen = known[0]
    if step is not None and dt is None and not abs(step - chosen) <= tolerance + 1e-6 * step:
        first, chosen = known[-1]  # the times show a step that the text rounds
    for source, value in known[1:]:
        if source != "the time column" or abs(value - chosen) <= tolerance + 1e-6 * value:
            continue
        raise ValueError(f"{table.file}: the step is {chosen} s by {first} but {value} s by {source}; correct one")
    for each in table.stated.steps:
        if not each.fits(chosen, tolerance):
            raise ValueError(
                f"{table.file}: the step is {chosen} s by {first} but {each.steps[0]} s by {each.text!r}; correct one, "
                "or give skip= to leave out text that is about other samples"
            )
    return chosen


def table_start(table: Table, step: float, zero: float | str = 0.0) -> float:
    """Return the time of the first row after `zero` [s or clock time]; a file without times begins at time zero.

    With ``zero=0``, a start within the rounding of its printed digits from a whole number of steps is set to this
    number; for another `zero`, within round-off.
    """
    place = time_column(table)
    if isinstance(zero, str):
        zero = _clock_zero(table, place, zero)
    if place is None:
        return 0.0 - zero
    unit = _time_unit(table, place)
    first, digit = (float(to_si(each, unit)) for each in (table.values[0, place], 10.0 ** -table.decimals[place]))
    start = first - zero
    rounding = 0.5 * digit * (1 + 1e-6) if zero == 0.0 else 4 * float(np.spacing(max(abs(first), abs(zero))))
    nearest = round(start / step)
    return nearest * step if abs(start - nearest * step) <= rounding + 1e-9 * step else start


def _clock_zero(table: Table, place: int | None, text: str) -> float:
    """Return the clock time `zero` in the times of the table [s]; what it does not state is as in the first row."""
    zero, first = parse_clock(text, "zero"), table.clock
    if (
        place is not None
        and place not in table.clocks
        and _is_unix(to_si(table.values[0, place], _time_unit(table, place)))
    ):
        if zero.day is None or zero.zone is None:
            raise ValueError(
                f"{table.file}: the times are Unix times: give zero={text!r} with date and time zone, as in "
                "'2019-07-06T03:19:53Z'"
            )
        return 86400 * (zero.day - _DAY_1970) + zero.seconds - 60 * zero.zone
    if place not in table.clocks:
        raise ValueError(f"{table.file}: zero={text!r} needs a column of clock times; give zero in seconds")
    if zero.day is not None and first.day is None:
        raise ValueError(f"{table.file}: the times have no date; give zero={text!r} without one")
    if zero.zone is not None and first.zone is None:
        raise ValueError(f"{table.file}: the times have no time zone; give zero={text!r} without one, as in the file")
    days = 0 if zero.day is None else zero.day - first.day
    return 86400 * days + zero.seconds - (0 if zero.zone is None else 60 * (zero.zone - first.zone))


def time_column(table: Table) -> int | None:
    """Number of the column with the times: as given, by its name, else a clock, or the first one without names."""
    if table.time is not None:
        return table.time
    clock = min(table.clocks, default=None)
    if not table.names:
        return 0 if table.time_unit is not None and table.values.shape[1] > 1 else clock
    for form in (_TIME, _STAMP):
        for i, name in enumerate(table.names):
            if form.match(name) and i not in table.clocks | table.dates:
                return i
    return clock


def _unix_unit(table: Table, place: int) -> str | None:
    """Unit in which the times of a column are Unix times of this century, None if they are none in any."""
    first = table.values[0, place]
    return next((unit for unit, n in (("s", 1), ("ms", 1e3), ("us", 1e6)) if _is_unix(first / n)), None)


def _is_unix(seconds: float) -> bool:
    return _UNIX_SECONDS[0] <= seconds < _UNIX_SECONDS[1]


def _time_unit(table: Table, place: int) -> str:
    if place in table.clocks:
        return "s"
    stated, unix = stated_unit(table, place), _unix_unit(table, place)
    if stated is None and table.time_unit is None:
        name = column_names(table)[place]
        if unix is not None and _UNIX.search(name):
            return unix
        hint = "" if unix is None else f" (for Unix times {unix!r} would fit the numbers)"
        raise ValueError(
            f"{table.file}: the column {name!r} has no unit; call it time_s or time_ms, or give time_unit={hint}"
        )
    return agree_on_unit(stated, table.time_unit, "time", f"{table.file} (times)")


def _uniform_step(table: Table, place: int) -> tuple[float, float]:
    """Return the mean step of the times in a column [s], and the largest error in it that rounding can cause."""
    times, unit = _times(table, place), _time_unit(table, place)
    if times.size < 2 or not times[-1] > times[0]:
        raise ValueError(
            f"{table.file}: expected times that increase over 2 rows or more, got {times.size} row(s); print the times "
            "with more digits, or leave the column out and give dt="
        )
    increments = np.diff(times)
    step = float(times[-1] - times[0]) / increments.size
    rounding = float(to_si(10.0 ** -table.decimals[place], unit)) * (1 + 1e-6)
    largest = float(np.abs(times).max())
    # no term may reach a step, otherwise it hides lost samples if the times are large, such as Unix times
    single = 2e-7 * largest if 2e-7 * largest <= 0.25 * step and _fits_single_precision(table, place) else 0.0
    tolerance = (rounding if rounding <= 0.501 * step else 0.0) + single
    tolerance += min(1e-4 * step + 4 * float(np.spacing(largest)), 0.1 * step)
    usual = float(np.median(increments))
    bad = np.abs(increments - usual) > tolerance
    off_grid = np.abs(times - times[0] - step * np.arange(times.size))[1:] > tolerance
    if bad.any() or off_grid.any():
        index = int(np.argmax(bad) if bad.any() else np.argmax(off_grid))
        advice = "insert rows with empty cells where the logger has missed samples, print the times with more digits"
        with contextlib.suppress(ValueError):
            even = uniform_times(times, None, table.file)
            advice += f", or give resample={even.step:.6g} to interpolate to a uniform step"
        raise ValueError(
            f"{table.file}, line {table.lines[index + 1]}: expected a uniform time step of about {usual:g} s, got "
            f"{increments[index]:g} s from {times[index]:g} to {times[index + 1]:g} s; {advice}"
        )
    tolerance /= increments.size
    rate = round(1 / step) if 1 / step < 1e15 else 0
    if rate and abs(1 / rate - step) < min(tolerance, 1e-4 * step):
        step = 1 / rate
    return step, tolerance


def row_times(table: Table, dt: float | None = None) -> NDArray[np.float64]:
    """Return the times of the rows [s]; raise ValueError if the table has none, some are missing, or `dt` is given."""
    place = time_column(table)
    if place is None or dt is not None:
        raise ValueError(
            f"{table.file}: resample is for uneven times in the file and dt for a file without times; give one of them"
        )
    return _times(table, place)


def _times(table: Table, place: int) -> NDArray[np.float64]:
    times = to_si(table.values[:, place], _time_unit(table, place), "time")
    if np.isnan(times).any():
        line = table.lines[int(np.argmax(np.isnan(times)))]
        raise ValueError(f"{table.file}, line {line}: expected a time, got an empty cell or NaN; write all times")
    _check_single_clock(table, place)
    return times


def _fits_single_precision(table: Table, place: int) -> bool:
    """Return whether each printed time is a float32, rounded to the printed digits."""
    printed = table.values[:, place]
    with np.errstate(over="ignore"):
        single = printed.astype(np.float32).astype(np.float64)
    return bool(np.all(np.abs(single - printed) <= 0.501 * 10.0 ** -table.decimals[place]))


def _check_single_clock(table: Table, place: int) -> None:
    """Raise ValueError if another column has different times, so that the times of the values are ambiguous."""
    if table.time is not None:
        return
    own_unit = _time_unit(table, place)
    times = to_si(table.values[:, place], own_unit, "time")
    for other, name in enumerate(table.names):
        if place in table.clocks or other in table.clocks | table.dates:
            continue
        like_time = other != place and (_TIME.match(name) or _STAMP.match(name))
        unit = stated_unit(table, other) if like_time else None
        try:
            is_time = unit is not None and find_unit(unit).dimension == "time"
        except ValueError:  # another quantity, such as a temperature T [°C]
            is_time = False
        is_time |= unit is None and other != place and bool(_TIME.match(name)) and not re.match(r"t(\b|_)", name, re.I)
        if not is_time:
            continue
        unit = unit or own_unit
        digit = max(
            float(to_si(10.0 ** -table.decimals[column], each)) for column, each in ((place, own_unit), (other, unit))
        )
        ahead = to_si(table.values[:, other], unit, "time") - times
        if _is_unix(abs(ahead[0])):  # a Unix time beside an elapsed one
            ahead = ahead - ahead[0]
        if not np.all(np.abs(ahead) <= digit):
            raise ValueError(
                f"{table.file}: expected one column of times, the columns {table.names[place]!r} and {name!r} have "
                "different times; write one file for each of them with its columns of values, or name one, time="
            )
