"""Tables of numbers in text files and workbooks: columns with names, units and times.

The functions return plain numbers, with the units and the step that the file states. Only times are converted.
"""

import math
import re
import warnings
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit, to_si
from .clock_times import ClockTime, is_clock, is_date, parse_clock, seconds_since_midnight
from .table_rows import read_rows
from .text_files import NUMBER, Series, agree_on_unit, check_count, parse_count, parse_number

__all__ = [
    "Table",
    "column_unit",
    "column_values",
    "csv_series",
    "read_table",
    "stated_unit",
    "table_start",
    "table_step",
    "value_column",
    "warn_if_absent",
]

_LONGEST_UNIT = 100
_SENTINELS = (-9999.0, -999.25, 1e30, 9.97e36)  # numbers that loggers and formats write for missing samples
# also used for missing samples, but plausible as measured numbers: counts, or accelerations in gal
_PLAUSIBLE_SENTINELS = (-999.0, 99999.0, -99999.0, 32767.0, -32768.0)
_TIME = re.compile(r"(elapsed |relative )?(t|(time|zeit|temps|tempo|tiempo)\d*)(\b|_)", re.IGNORECASE)


class Table(NamedTuple):
    """Columns of numbers in a text file.

    Attributes
    ----------
    file : str
        The file, for messages.
    names : tuple of str
        Names of the columns. Empty if there is no header line.
    values : ndarray, shape (n_rows, n_columns)
        The numbers.
    lines : tuple of int
        Line numbers of the rows.
    decimals : tuple of int
        Largest number of digits printed after the decimal point, per column.
    comments : str
        Text of the comment lines.
    units : tuple of str
        Units below the header line, an empty string per column if there are none.
    time_unit : str or None
        Unit of the times as given by the caller.
    clocks : frozenset of int
        Columns of clock times. Their values are the seconds since the midnight before the first clock time.
    dates : frozenset of int
        Columns of dates, which have no values.
    clock : ClockTime or None
        The first clock time.
    """

    file: str
    names: tuple[str, ...]
    values: NDArray[np.float64]
    lines: tuple[int, ...]
    decimals: tuple[int, ...]
    comments: str
    units: tuple[str, ...]
    time_unit: str | None = None
    clocks: frozenset[int] = frozenset()
    dates: frozenset[int] = frozenset()
    clock: ClockTime | None = None


def read_table(path: str | Path, skip: int | None = None, time_unit: str | None = None) -> Table:
    """Read columns of numbers from a text file or an Excel workbook.

    Columns are separated by commas, semicolons, tabs or blanks, with decimal points or decimal commas. Text above the
    table, a header line and a line of units are optional. Lines that start with ``#`` are comments.

    Parameters
    ----------
    path : str or path
        The file.
    skip : int, optional
        Number of lines above the table. By default they are found.
    time_unit : str, optional
        Unit of the times, if the file does not state it. Without a header line, the first column then has the times.

    Returns
    -------
    Table
        The columns, with NaN for missing cells: empty, ``NaN``, ``NA``, ``N/A``, ``#N/A``, ``NULL``, ``-`` or ``--``.

    Raises
    ------
    ValueError
        If the file cannot be read, has no rows, has rows of different length, or a cell is not a finite number.
    """
    file, rows = str(path), read_rows(path, skip)
    width = len(rows.cells[0][1])
    if time_unit is not None:
        find_unit(time_unit, "time")
    values = np.empty((len(rows.cells), width))
    decimals, clocks, dates, clock = [], set(), set(), None
    for column in range(width):
        cells = [(cells[column], f"{file}, line {number}") for number, cells in rows.cells]
        if any(is_clock(cell) for cell, _ in cells):
            clocks.add(column)
            times = [parse_clock(cell, where) if cell else None for cell, where in cells]
            values[:, column] = seconds_since_midnight(times, file)
            decimals.append(max(time.decimals for time in times if time is not None))
            clock = next(time for time in times if time is not None) if clock is None else clock
        elif any(is_date(cell) for cell, _ in cells) and all(is_date(cell) or not cell for cell, _ in cells):
            dates.add(column)
            values[:, column] = np.nan
            decimals.append(0)
        else:
            values[:, column] = [parse_number(cell, where) if cell else np.nan for cell, where in cells]
            decimals.append(max(_decimals(cell) for cell, _ in cells))
    lines = tuple(number for number, _ in rows.cells)
    units = rows.units or ("",) * width
    numbers = rows.names, values, lines, tuple(decimals), "\n".join(rows.comments), units, time_unit
    return Table(file, *numbers, frozenset(clocks), frozenset(dates), clock)


def value_column(table: Table, column: str | None = None) -> int:
    """Return the index of the named column, or of the only column that is not the time."""
    n_other = len({_time_column(table)} - {None} | table.clocks | table.dates)
    if not table.names and table.values.shape[1] - n_other > 1:
        raise ValueError(
            f"{table.file} has {table.values.shape[1]} columns and no header line; write one such as 'time_s,acc_g'"
            ", or give time_unit= if there are two columns, times and values. Numbers with decimal commas need another "
            "separator between columns, such as ';'"
        )
    candidates = [
        i for i in range(table.values.shape[1]) if i not in {_time_column(table)} | table.clocks | table.dates
    ]
    if column is not None:
        candidates = [i for i in candidates if table.names and table.names[i] == column]
    if len(candidates) != 1:
        raise ValueError(
            f"{table.file}: expected one column of values"
            + (f" named {column!r}" if column else "; choose it with column=")
            + f", the columns are {', '.join(table.names) or 'not named'}"
        )
    return candidates[0]


def stated_unit(table: Table, place: int, dimension: str | None = None) -> str | None:
    """Return the unit of a column as the file states it, in its name or below the header line, or None.

    With a `dimension` other than force, the N at the end of a name such as ``acc_N`` is the direction north.
    """
    named = column_unit(table.names[place]) if table.names else None
    if dimension is not None and _direction(table, place, dimension):
        named = None
    below = table.units[place] or None
    if named is None or below is None:
        return named or below
    where = f"{table.file} (name and line of units)"
    try:
        stated = find_unit(below).dimension
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    return agree_on_unit(named, below, stated, where)


def _direction(table: Table, place: int, dimension: str) -> bool:
    """Whether the name of a column ends with the direction north or south, which look like newton and second."""
    end = table.names[place][-2:] if table.names else ""
    return (end == "_N" and dimension != "force") or (end == "_S" and dimension != "time")


def column_unit(name: str) -> str | None:
    """Return the unit at the end of a column name (``acc_cm_s2``, ``force [kip]``, ``acc, g``), or None."""
    name = name[-_LONGEST_UNIT:]
    bracket = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    parts = name.split("_")
    texts = ["_".join(parts[i:]) for i in range(1, len(parts))] + name.split(", ")[1:][-1:]
    for text in [bracket[1]] if bracket else texts:
        try:
            unit = find_unit(text).name
        except ValueError:
            continue
        if unit != "1":  # a number at the end of a name is a counter, not the unit of a strain
            return unit
    return bracket[1] if bracket else None


def table_step(table: Table, dt: float | None = None) -> float:
    """Return the time step of a table: from its times, the comment ``dt = ... s`` and the argument, which must agree.

    Parameters
    ----------
    table : Table
        The table.
    dt : float, optional
        Time step [s] given by the caller.

    Returns
    -------
    float
        The time step [s].

    Raises
    ------
    ValueError
        If no step is given, the given steps differ, or the times are not uniform.

    Notes
    -----
    Printed times are rounded, so each may differ from a uniform grid by one unit of its last digit: half a unit because
    it is rounded, half a unit because the two ends that define the grid are rounded. If this unit is more than half a
    step, the tolerance would hide a missing sample, and it is not applied. Times that may have been stored in single
    precision (float32) may differ by 2e-7 times the largest time, if this is less than a quarter of a step. Other
    times, such as Unix times, must be uniform within 1e-4 of a step and the round-off of double precision. If the mean
    step corresponds to a whole number of samples per second, within the rounding and within a relative 1e-4, this
    number is used.
    """
    stated = re.search(rf"\bdt\s*=\s*({NUMBER})\s*s\b", table.comments)
    place = _time_column(table)
    step, tolerance = (None, 0.0) if place is None else _uniform_step(table, place)
    sources = {"the argument dt": dt, "the comments": float(stated[1]) if stated else None, "the time column": step}
    known = [(source, value) for source, value in sources.items() if value is not None]
    if not known:
        raise ValueError(f"{table.file} has no times (column time_s) and no comment 'dt = ... s': give dt= in seconds")
    first, chosen = known[0]
    for source, value in known[1:]:
        if not abs(value - chosen) <= tolerance + 1e-6 * value:
            raise ValueError(f"{table.file}: the step is {chosen} s by {first} but {value} s by {source}; correct one")
    return chosen


def column_values(table: Table, place: int, missing: Sequence[float] | None = None) -> NDArray[np.float64]:
    """Return the numbers of a column, with NaN for numbers that are in `missing`.

    ValueError is raised for a number that usually stands for missing samples and is not in `missing`, unless `missing`
    is empty or the number may have been measured: the column has other numbers within 1 % of it, or, for -999 and the
    limits of integers, other numbers of half its size, like the samples next to a measured peak.
    """
    values = table.values[:, place]
    listed = _listed(missing)
    if missing is not None:
        values = np.where(np.isin(values, listed), np.nan, values)
        if not listed.size:
            return values
    for sentinel in (*_SENTINELS, *_PLAUSIBLE_SENTINELS):
        found = np.flatnonzero(values == sentinel)
        if sentinel in _SENTINELS:
            similar = np.abs(values - sentinel) <= 0.01 * abs(sentinel)
        else:
            similar = np.abs(values) >= 0.5 * abs(sentinel)
        if found.size and np.count_nonzero(similar) == found.size:
            numbers = ", ".join(f"{number:g}" for number in (*listed, sentinel))
            raise ValueError(
                f"{table.file}, line {table.lines[found[0]]}: expected a measured number, got {sentinel:g} in "
                f"{found.size} rows, which usually stands for a missing sample; give missing=[{numbers}] to read it "
                "as NaN, or missing=[] if it was measured"
            )
    return values


def warn_if_absent(table: Table, places: Sequence[int], missing: Sequence[float] | None, stacklevel: int) -> None:
    """Warn if a number in `missing` is in none of the columns: the file may write it in another way."""
    listed = _listed(missing)
    absent = listed[~np.isin(listed, table.values[:, list(places)])]
    if absent.size:
        warnings.warn(
            f"{table.file}: missing={', '.join(f'{number:g}' for number in absent)} is in none of the columns that "
            "were read: check how the file writes missing samples, or leave it out",
            UserWarning,
            stacklevel=stacklevel + 1,
        )


def _listed(missing: Sequence[float] | None) -> NDArray[np.float64]:
    """Numbers that stand for missing samples; ValueError if they are not finite numbers."""
    given = [] if missing is None else [missing] if np.ndim(missing) == 0 else list(missing)
    if not all(isinstance(number, Real) and math.isfinite(number) for number in given):
        raise ValueError(f"missing must be finite numbers, such as (-9999,), or () for none; got {missing!r}")
    return np.array(given, dtype=float)


def csv_series(
    table: Table, column: str | None = None, dt: float | None = None, missing: Sequence[float] | None = None
) -> Series:
    """Return one column of a table as a series, checked against the comments (see `read_csv`)."""
    place = value_column(table, column)
    stated = re.search(r"\bnpts\s*=\s*(\d+)", table.comments)
    if stated:
        where = f"{table.file}: npts in the comments"
        check_count(len(table.values), parse_count(stated[1], where), where)
    comment = re.search(r"\bunits:\s*([^\s;,]+)", table.comments)
    unit = stated_unit(table, place, "acceleration")
    if comment and unit is not None:
        unit = agree_on_unit(unit, comment[1], "acceleration", f"{table.file} (column and comment)")
    values = column_values(table, place, missing)
    warn_if_absent(table, [place], missing, stacklevel=4)
    absent = np.flatnonzero(np.isnan(values))
    if absent.size:
        raise ValueError(
            f"{table.file}, line {table.lines[absent[0]]}: expected a number, got an empty cell or NaN; an excitation "
            f"needs all samples, {absent.size} are missing: interpolate them, or cut the file"
        )
    title = table.comments.split("\n", 1)[0]
    return Series(title, table_step(table, dt), unit or (comment and comment[1]), values)


def table_start(table: Table, step: float, zero: float | str = 0.0) -> float:
    """Return the time of the first row after `zero` [s]; a file without times begins at time zero.

    For a file with clock times, `zero` may be a clock time.

    A printed time is rounded by at most half a unit of its last digit. With ``zero=0``, a start within this rounding of
    a whole number of steps is set to this number. For another `zero`, the same holds within round-off.
    """
    place = _time_column(table)
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
    if place not in table.clocks:
        raise ValueError(f"{table.file}: zero={text!r} needs a column of clock times; give zero in seconds")
    zero = parse_clock(text, "zero")
    first = table.clock
    if zero.day is not None and first.day is None:
        raise ValueError(f"{table.file}: the times have no date; give zero={text!r} without one")
    if zero.zone is not None and first.zone is None:
        raise ValueError(f"{table.file}: the times have no time zone; give zero={text!r} without one, as in the file")
    days = 0 if zero.day is None else zero.day - first.day
    return 86400 * days + zero.seconds - (0 if zero.zone is None else 60 * (zero.zone - first.zone))


def _time_column(table: Table) -> int | None:
    clock = min(table.clocks, default=None)
    if not table.names:
        return 0 if table.time_unit is not None and table.values.shape[1] > 1 else clock
    named = (i for i, name in enumerate(table.names) if _TIME.match(name) and i not in table.clocks | table.dates)
    return next(named, clock)


def _time_unit(table: Table, place: int) -> str:
    if place in table.clocks:
        return "s"
    stated = stated_unit(table, place)
    if stated is None and table.time_unit is None:
        raise ValueError(
            f"{table.file}: the column {table.names[place]!r} has no unit; call it time_s or time_ms, or give "
            "time_unit="
        )
    return agree_on_unit(stated, table.time_unit, "time", f"{table.file} (times)")


def _uniform_step(table: Table, place: int) -> tuple[float, float]:
    """Return the mean step of the times in a column [s], and the largest error in it that rounding can cause."""
    unit = _time_unit(table, place)
    times = to_si(table.values[:, place], unit, "time")
    if np.isnan(times).any():
        line = table.lines[int(np.argmax(np.isnan(times)))]
        raise ValueError(f"{table.file}, line {line}: expected a time, got an empty cell or NaN; write all times")
    if times.size < 2 or not times[-1] > times[0]:
        raise ValueError(f"{table.file}: expected times that increase over 2 rows or more, got {times.size} row(s)")
    _check_single_clock(table, place)
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
        raise ValueError(
            f"{table.file}, line {table.lines[index + 1]}: expected a uniform time step of about {usual:g} s, got "
            f"{increments[index]:g} s from {times[index]:g} to {times[index + 1]:g} s; insert rows with "
            "empty cells where the logger has missed samples, interpolate to a uniform step, or print the times with "
            "more digits"
        )
    tolerance /= increments.size
    rate = round(1 / step) if 1 / step < 1e15 else 0
    if rate and abs(1 / rate - step) < min(tolerance, 1e-4 * step):
        step = 1 / rate
    return step, tolerance


def _fits_single_precision(table: Table, place: int) -> bool:
    """Return whether each printed time is a float32, rounded to the printed digits."""
    printed = table.values[:, place]
    with np.errstate(over="ignore"):
        single = printed.astype(np.float32).astype(np.float64)
    return bool(np.all(np.abs(single - printed) <= 0.501 * 10.0 ** -table.decimals[place]))


def _check_single_clock(table: Table, place: int) -> None:
    """Raise ValueError if another column has different times, so that the times of the values are ambiguous."""
    own_unit = _time_unit(table, place)
    times = to_si(table.values[:, place], own_unit, "time")
    for other, name in enumerate(table.names):
        if place in table.clocks or other in table.clocks | table.dates:
            continue
        unit = stated_unit(table, other) if other != place and _TIME.match(name) else None
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
        if not np.all(np.abs(to_si(table.values[:, other], unit, "time") - times) <= digit):
            raise ValueError(
                f"{table.file}: expected one column of times, the columns {table.names[place]!r} and {name!r} have "
                "different times; write one file for each of them with its columns of values"
            )


def _decimals(field: str) -> int:
    mantissa, _, exponent = field.lower().partition("e")
    power = int(exponent or 0) if len(exponent) < 6 else 0  # a larger exponent belongs to zero
    return min(max(len(mantissa.partition(".")[2]) - power, -300), 300)
