"""Tables of numbers in text files and workbooks, as loggers and spreadsheets write them.

`read_table` finds separator, header line, line of units, decimal marks, clock times and the column of times.
Semicolons, tabs, commas or blanks separate cells, whichever splits most of the last lines into numbers. Decimal commas
are read if commas do not separate cells; separators of thousands go if a number shows them: ``1,234.5``, ``1.234,5``,
``1'234``. Text before the header line is left out, as are lines of numbers and words that a header line follows.

A `Table` has step, start and times of its rows [s], samples with NaN for missing ones, and the units on which file and
caller agree.
"""

import csv
import datetime
import itertools
import math
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from numbers import Real
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit
from .sampling import expect, uniform_times
from .text_files import (
    WORKBOOKS,
    Statements,
    agree_on_unit,
    check_count,
    check_peaks,
    decimals_of,
    decode_text,
    dimension_of,
    is_number,
    number_cells,
    parse_number,
    read_bytes,
    read_statements,
)

# clock times ----------------------------------------------------------------------------------------------------------
# 03:19:53.010, 2019-07-06T03:19:53.010Z or 06.07.2019 03:19 PM, and dates: the year is first, or last after points.
# Without a date, 03:19 may be minutes and seconds.

_DATE = r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<month>\d{1,2})(?P=mark)(?P<last>\d{1,4})"
_AFTER = r"(?:[ \u00a0\u202f]?(?:([AP])\.?M\.?|(Z|UTC|[-+]\d{2}:?\d{2})))?"
_TIME_OF_DAY = r"(\d{1,2}):([0-5]\d)(?::([0-5]\d)(?:[.,](\d+))?)?"
_CLOCK = re.compile(rf"(?:{_DATE}(?:T| +)|(?=\d+:\d+:)){_TIME_OF_DAY}{_AFTER}", re.IGNORECASE)
_DAY_ONLY = re.compile(_DATE)
# Letters of day, month, year, hour and second in English, German, French, Spanish and Italian, each part once or more
_DATE_FORMAT = re.compile(
    r"([DTJGMYAHS])\1+(?:(?:[-/.:, ]{1,2}|T(?=HH))([DTJGMYAHS])\2+)+(?:[.,](?:0+|F+))?(?: ?AM/PM)?", re.IGNORECASE
)
_HOUR, _DAY = 3600, 86400


class ClockTime(NamedTuple):
    """A clock time."""

    day: int | None  # number of the day, None without a date
    seconds: float  # since the midnight before [s]
    decimals: int  # of the seconds
    zone: int | None  # minutes by which the clock is before UTC, None without a time zone
    halves: bool = False  # hours from 1 to 12 with AM and PM

    @property
    def text(self) -> str:
        """The clock time as `zero` takes it."""
        text = str((datetime.datetime.min + datetime.timedelta(seconds=self.seconds)).time())
        return text if self.day is None else f"{datetime.date.fromordinal(self.day)} {text}"


def is_clock(cell: str) -> bool:
    """Whether a cell is a clock time, with a date or without."""
    return ":" in cell and _CLOCK.fullmatch(cell) is not None


def _parse_clock(cell: str, where: str) -> ClockTime:
    """The clock time in a cell; ValueError for anything else."""
    found, got = _CLOCK.fullmatch(cell), f"{cell[:100]!r}"
    expect(found, where, "a clock time such as '03:19:53.010' or '2019-07-06T03:19:53.010'", got)
    *_, hour, minute, second, fraction, half, zone = found.groups()
    known, expected = (range(1, 13), "1 to 12") if half else (range(25), "0 to 23")
    expect(int(hour) in known, where, f"hours from {expected}", got)
    hours = int(hour) % 12 + 12 * (half in ("P", "p")) if half else int(hour)
    if zone is not None:  # minutes of a time zone such as +02:00; Z and UTC are zero
        zone = 0 if zone.upper() in ("Z", "UTC") else int(f"{zone[0]}1") * (60 * int(zone[1:3]) + int(zone[-2:]))
    seconds = float(f"{_HOUR * hours + 60 * int(minute) + int(second or 0)}.{fraction or 0}")
    year, day, number = found["first"], found["last"], None
    if year is not None:
        certain = len(year) == 4 or (found["mark"] == "." and len(day) == 4)
        got += "" if certain else ", which may begin with the day or the month"
        expect(certain, where, "a date such as 2019-07-06 or 06.07.2019", got, "write the year first")
        year, day = (year, day) if len(year) == 4 else (day, year)
        try:
            number = datetime.date(int(year), int(found["month"]), int(day)).toordinal()
        except ValueError as error:
            raise ValueError(f"{where}: expected a date, got {got} ({error})") from None
    return ClockTime(number, seconds, len(fraction or ""), zone, bool(half))


def _seconds_of(times: list[ClockTime | None], file: str) -> list[float]:
    """Seconds since the midnight before the first time, NaN for None.

    Without dates, a time more than half a day before the previous one belongs to the next day; 1 after 12 is refused.
    """
    known = [time for time in times if time is not None]
    for kinds, expected in (
        ({time.day is None for time in known}, "a date in all clock times or in none"),
        ({time.zone for time in known}, "one time zone in all clock times"),
        ({time.halves for time in known}, "AM or PM in all clock times or in none"),
    ):
        expect(len(kinds) == 1, file, expected, f"{len(kinds)} kinds", "write them alike")
    day, last, found = 0, 0.0, [math.nan] * len(times)
    for place, time in ((place, time) for place, time in enumerate(times) if time is not None):
        back = not time.halves and 12 * _HOUR <= last < 13 * _HOUR and _HOUR <= time.seconds < 2 * _HOUR
        expect(not back, file, "hours from 0 to 23", "1 after 12 o'clock, as on a clock of 12 hours")
        day = time.day - known[0].day if time.day is not None else day + (time.seconds < last - _DAY / 2)
        last = time.seconds
        found[place] = day * _DAY + time.seconds
    return found


# the table ------------------------------------------------------------------------------------------------------------

_SEPARATORS = (";", "\t", ",", " ")
_LAST_LINES = 50  # lines that determine the separator
_MISSING = frozenset({"", "nan", "#n/a", "n/a", "na", "null", "-", "--"})
_BLANKS = "'\u2019\u00a0\u202f "  # between groups of three digits
_SPELLINGS = {  # of numbers, by the decimal mark and the mark between groups of three digits
    (mark, group): re.compile(
        rf"[-+]?(?:(?:\d+|[1-9]\d{{0,2}}(?:[{group}]\d{{3}})+)(?:[{mark}]\d{least})?|[{mark}]\d+)"
        r"(?:[eEdD][-+]?\d+)?"
    )
    for mark, group, least in ((".", _BLANKS, "*"), (",", _BLANKS, "+"), (".", ",", "*"), (",", ".", "+"))
}
_MARKED = re.compile(rf"[,{_BLANKS}]|\..*\.")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")  # 1,000: a thousand, or one with three decimals
_POINTS = "Numbers with decimal commas need another separator between columns, such as ';'"
_SKIP = "If the text is about other samples, give skip= to leave it out"
_CUT = "cut off the line, and all lines below it, if it is no row of samples"
_TIME = re.compile(r"(elapsed |relative )?(t|(time|zeit|temps|tempo|tiempo)\d*)(\b|_)", re.IGNORECASE)
_STAMP = re.compile(r"(timestamp|unix|epoch)(\b|_)", re.IGNORECASE)  # times if no other column has them
_UNIX = (1e9, 4.2e9)  # times since 1970 of the years 2001 to 2103 [s]

_Line = tuple[int, list[str]]  # its number and cells


class Column(NamedTuple):
    """One column of a table."""

    name: str  # without a header line its number, from 1
    values: NDArray[np.float64]  # (n_rows,) as printed, NaN for missing; clock times [s since the first midnight]
    decimals: int  # most digits after the decimal point
    below: str  # unit below the header line, "" without
    kind: str  # "number", "clock", or "text", such as dates and a logger's state, which has no values
    cells: tuple[str, ...] = ()  # (n_rows,) as printed


class Table(NamedTuple):
    """A table in a text file or workbook."""

    file: str  # for messages
    named: bool  # whether it has a header line
    columns: tuple[Column, ...]
    lines: tuple[int, ...]  # line numbers of the rows
    title: str  # the first comment
    stated: Statements  # what comments and the text above state
    missing: tuple[float | str, ...] | None  # what stands for missing samples, if the caller says it
    clock: ClockTime | None = None  # the first clock time
    time: int | None = None  # column of times
    time_unit: str | None = None  # as given by the caller
    chosen: bool = False  # whether the caller has chosen the column of times

    @property
    def value_columns(self) -> list[int]:
        """The places of the columns with values."""
        return [k for k, column in enumerate(self.columns) if column.kind == "number" and k != self.time]

    @property
    def listing(self) -> str:
        """The columns, for messages."""
        names = ", ".join(column.name for column in self.columns)
        return f"the columns are {names}" + ("" if self.named else f", without a header line. {_POINTS}")

    def place_of(self, name: int | str | None) -> int:
        """The place of the named column of values, or of the only one."""
        places = [k for k in self.value_columns if name is None or self.columns[k].name == str(name)]
        if name is None and not self.named and len(places) > 1:
            raise ValueError(
                f"{self.file} has {len(self.columns)} columns and no header line; write one such as 'time_s,acc_g', or "
                "give column=2 and time_unit='s' if the first column has the times, in seconds; else column=1 and the "
                f"step dt=; or column='rows' and dt= if the samples follow each other along the rows. {_POINTS}"
            )
        which = f" named {name!r}" if name else "; choose it with column="
        expect(len(places) == 1, self.file, f"one column of values{which}, {self.listing}")
        return places[0]

    # units and samples

    def stated_unit(self, place: int, dimension: str | None = None) -> str | None:
        """The unit of a column of a `dimension`, if known, as its name or the line below it states it, or None."""
        column = self.columns[place]
        end, below = column.name[-2:], column.below or None
        # N at the end of a name such as acc_N is the direction north, and S the direction south
        direction = dimension and ((end == "_N" and dimension != "force") or (end == "_S" and dimension != "time"))
        named = unit_in_name(column.name) if self.named and not direction else None
        if named is None or below is None:
            return named or below
        both = f"{self.file} (name and line of units)"
        return agree_on_unit(named, below, dimension_of(below) or dimension_of(named), both)

    def text_unit(self, place: int, dimension: str, others: bool = False) -> str | None:
        """The unit that text above states for a column, or None; with `others` known, only a unit or counts."""
        for unit in self.stated.units:
            known = dimension_of(unit)
            alone = len(self.value_columns) == 1 and known != "time"
            if known == dimension or (alone and (known or not others or "count" in unit.lower())):
                return unit
        peaks = self.peaks(place) if dimension == "acceleration" and not others and place in self.value_columns else ()
        return next((unit for _, unit, _ in peaks if unit), None)

    def peaks(self, place: int) -> list[tuple[str, str | None, str]]:
        """Words, unit and number of the stated peaks of a column of values."""
        places = self.value_columns
        return self.stated.peaks_of([self.columns[k].name for k in places], places.index(place))

    def measured(self, place: int) -> NDArray[np.float64]:
        """Values of a column, NaN where one is missing; ValueError for a number that usually stands for a missing one.

        It may be measured if the column has other numbers within 1 % of it, or the plausible ones if others have half
        its size, like the samples next to a peak.
        """
        given, column = self.missing or (), self.columns[place]
        values = np.where(np.isin(column.values, [x for x in given if not isinstance(x, str)]), np.nan, column.values)
        for sentinel in (*_SENTINELS, *_PLAUSIBLE_SENTINELS) if self.missing != () else ():
            there, size = np.flatnonzero(values == sentinel), abs(sentinel)
            close = sentinel in _SENTINELS
            similar = np.abs(values - sentinel) <= 0.01 * size if close else np.abs(values) >= 0.5 * size
            if there.size and np.count_nonzero(similar) == there.size:
                marks = [repr(each) if isinstance(each, str) else f"{each:g}" for each in (*given, sentinel)]
                got = f"{sentinel:g} in {there.size} rows, which usually stands for a missing sample"
                advice = "empty these cells, or in a record or measurements "
                advice += f"give missing=[{', '.join(marks)}] to read it as NaN, or missing=[] if it was measured"
                expect(False, f"{self.file}, line {self.lines[there[0]]}", "a measured number", got, advice)
        return values

    def samples(
        self, columns: Sequence[tuple[str | int | None, str, str | None, str]], stacklevel: int
    ) -> list[tuple[NDArray[np.float64], str, str]]:
        """Samples of columns (n_rows,), units and dimensions, of columns' names, dimensions, units, words for messages.

        Warns if a number for missing samples is in none of the columns: the file may write it in another way.
        """
        found, places = [], [self.place_of(name) for name, *_ in columns]
        for place, (_, dimension, unit, where) in zip(places, columns, strict=True):
            column, named, values = self.columns[place], self.stated_unit(place, dimension), self.measured(place)
            text = self.text_unit(place, dimension, others=named is not None or unit is not None)
            stated = agree_on_unit(named, text, dimension, f"{where} (column and text)") if named or text else None
            unit = agree_on_unit(stated, unit, dimension, where)
            if dimension == "acceleration" and not np.isnan(values).any():
                check_peaks(self.peaks(place), values, column.decimals, unit, self.file, f". {_SKIP}")
            found.append((values, unit, dimension))
        listed = [each for each in self.missing or () if not isinstance(each, str)]
        absent = [f"{each:g}" for each in listed if not any(each in self.columns[k].values for k in places)]
        if absent:
            warnings.warn(
                f"{self.file}: missing={', '.join(absent)} is in none of the columns that "
                "were read: check how the file writes missing samples, or leave it out",
                UserWarning,
                stacklevel=stacklevel + 1,
            )
        return found

    # times

    @property
    def unit_of_times(self) -> float:
        """The unit of the times [s]."""
        column = self.columns[self.time]
        if column.kind == "clock":
            return 1.0
        stated = self.stated_unit(self.time)
        if stated is None and self.time_unit is None:
            first = {unit: column.values[0] * find_unit(unit).factor for unit in ("s", "ms", "us")}
            unix = next((unit for unit, seconds in first.items() if _UNIX[0] <= seconds < _UNIX[1]), None)
            if unix is not None and re.search("unix|epoch", column.name, re.IGNORECASE):
                return find_unit(unix).factor
            hint = "" if unix is None else f" (for Unix times {unix!r} would fit the numbers)"
            advice = f"call it time_s or time_ms, or give time_unit={hint}"
            raise ValueError(f"{self.file}: the column {column.name!r} has no unit; {advice}")
        return find_unit(agree_on_unit(stated, self.time_unit, "time", f"{self.file} (times)")).factor

    def times(self, dt: float | None = None) -> NDArray[np.float64]:
        """Times of the rows [s]; ValueError without them or some of them, for a `dt`, or if columns differ."""
        if self.time is None or dt is not None:
            either = "resample is for uneven times in the file and dt for a file without times; give one of them"
            raise ValueError(f"{self.file}: {either}")
        unit, own = self.unit_of_times, self.columns[self.time]
        times = own.values * unit
        where = f"{self.file}, line {self.lines[int(np.argmax(np.isnan(times)))]}"
        expect(not np.isnan(times).any(), where, "a time", "an empty cell or NaN", f"write all times, or {_CUT}")
        for place, other in enumerate(() if self.chosen or not self.named else self.columns):
            if place == self.time or other.kind != own.kind:
                continue
            stated = self.stated_unit(place) if own.kind == "number" else None
            named = _TIME.match(other.name) or (stated and _STAMP.match(other.name))
            is_t = not stated and re.match(r"t(\b|_)", other.name, re.IGNORECASE)  # T may be a temperature
            if own.kind == "number" and (not named or is_t or (stated and dimension_of(stated) != "time")):
                continue
            others_unit = unit if stated is None else find_unit(stated, "time").factor
            ahead = other.values * others_unit - times
            ahead -= ahead[0] if _UNIX[0] <= abs(ahead[0]) < _UNIX[1] else 0.0  # a Unix time beside an elapsed one
            alike = np.all(np.abs(ahead) <= max(unit * 10.0**-own.decimals, others_unit * 10.0**-other.decimals))
            got = f"the columns {own.name!r} and {other.name!r} with different times"
            advice = "write one file for each of them with its columns of values, or name one, time="
            expect(alike, self.file, "one column of times", got, advice)
        return times

    def uniform_step(self) -> tuple[float, float]:
        """The mean step of the times [s], and the largest error in it that rounding can cause.

        Printed times may differ from a uniform grid by one unit of the last digit: half a unit each for the time and
        for the two ends of the grid. If it is more than half a step, it would hide a missing sample and is not applied.
        """
        times, column = self.times(), self.columns[self.time]
        advice = "print the times with more digits, or leave the column out and give dt="
        increasing = times.size > 1 and times[-1] > times[0]
        expect(increasing, self.file, "times that increase over 2 rows or more", f"{times.size} row(s)", advice)
        increments = np.diff(times)
        step, largest = float(times[-1] - times[0]) / increments.size, float(np.abs(times).max())
        digit = 10.0**-column.decimals
        rounding = digit * self.unit_of_times * (1 + 1e-6)
        with np.errstate(over="ignore"):  # whether each printed time is a float32, rounded to the printed digits
            apart = np.abs(column.values.astype(np.float32).astype(np.float64) - column.values)
        single = 2e-7 * largest if 2e-7 * largest <= 0.25 * step and np.all(apart <= 0.501 * digit) else 0.0
        # no term may reach a step, otherwise it hides lost samples if the times are large, such as Unix times
        tolerance = (rounding if rounding <= 0.501 * step else 0.0) + single
        tolerance += min(1e-4 * step + 4 * float(np.spacing(largest)), 0.1 * step)
        usual = float(np.median(increments))
        bad = np.abs(increments - usual) > tolerance
        bad = bad if bad.any() else np.abs(times - times[0] - step * np.arange(times.size))[1:] > tolerance
        if bad.any():
            index = int(np.argmax(bad))
            advice = "insert rows with empty cells where samples are missing, print the times with more digits"
            if increments[index] < 0.0:
                advice = "if the clock was set back, correct the later times, or leave the column out and give dt="
            with suppress(ValueError):
                even = uniform_times(times, None, self.file)
                advice += f", or give resample={even.step:.6g} to interpolate to a uniform step"
            got = f"{increments[index]:g} s from {times[index]:g} to {times[index + 1]:g} s"
            where = f"{self.file}, line {self.lines[index + 1]}"
            expect(False, where, f"a uniform time step of about {usual:g} s", got, advice)
        tolerance /= increments.size
        rate = round(1 / step) if 1 / step < 1e15 else 0  # a whole number of samples per second, within rounding
        return (1 / rate if rate and abs(1 / rate - step) < min(tolerance, 1e-4 * step) else step), tolerance

    def step(self, dt: float | None = None) -> float:
        """The time step [s]: from the times, the comment ``dt = ... s`` and the argument, which must agree."""
        step, tolerance = (None, 0.0) if self.time is None else self.uniform_step()
        known = [] if dt is None else [("the argument dt", dt)]
        known += [(repr(text), steps[0]) for text, steps, _ in self.stated.steps if len(steps) == 1]
        known += [] if step is None else [("the time column", step)]
        if not known:
            unclear = "".join(f", and states {text!r} without a unit" for text, *_ in self.stated.steps[:1])
            lacking = f"no times (column time_s) and no comment 'dt = ... s'{unclear}"
            raise ValueError(f"{self.file} has {lacking}: give dt= in seconds, or the column of times, time=")
        first, chosen = known[0]
        agrees = step is None or abs(step - chosen) <= tolerance + 1e-6 * step
        differs = f"{self.file}: the step is {chosen} s by {first} but"
        if not agrees and dt is not None:
            raise ValueError(f"{differs} {step} s by the time column; correct one")
        first, chosen = known[0 if agrees else -1]  # the times show a step that the text rounds
        for text, steps, error in self.stated.steps:
            if not any(abs(other - chosen) <= tolerance + (error + 1e-6) * chosen for other in steps):
                advice = "correct one, or give skip= to leave out text that is about other samples"
                stated = f"the step is {chosen} s by {first} but {steps[0]} s by {text!r}"
                raise ValueError(f"{self.file}: {stated}; {advice}")
        return chosen

    def start(self, step: float, zero: float | str = 0.0) -> float:
        """The time of the first row after `zero` [s or clock time]; a file without times begins at time zero.

        It is a whole number of steps if it is one within the rounding of printed digits; with a `zero`, round-off.
        """
        column = None if self.time is None else self.columns[self.time]
        unit = 1.0 if column is None else self.unit_of_times
        if isinstance(zero, str):  # what it does not state is as in the first row
            text, zero, first = zero, _parse_clock(zero, "zero"), self.clock
            if column is None or column.kind != "clock":
                raise ValueError(f"{self.file}: zero={text!r} needs a column of clock times; give zero in seconds")
            for what, given, known in (("date", zero.day, first.day), ("time zone", zero.zone, first.zone)):
                if given is not None and known is None:
                    advice = f"give zero={text!r} without one, as in the file"
                    raise ValueError(f"{self.file}: the times have no {what}; {advice}")
            days = 0 if zero.day is None else zero.day - first.day
            zero = _DAY * days + zero.seconds - (0 if zero.zone is None else 60 * (zero.zone - first.zone))
        if column is None:
            return 0.0 - zero
        first, digit = float(column.values[0]) * unit, unit * 10.0**-column.decimals
        start = first - zero
        rounding = 0.5 * digit * (1 + 1e-6) if zero == 0.0 else 4 * float(np.spacing(max(abs(first), abs(zero))))
        nearest = round(start / step)
        return nearest * step if abs(start - nearest * step) <= rounding + 1e-9 * step else start


def read_table(
    path: str | Path,
    skip: int | None = None,
    time_unit: str | None = None,
    time: int | str | None = None,
    along_rows: bool = False,
    missing: Sequence[float | str] | None = None,
    labels: str | None = None,
) -> Table:
    """Read columns of numbers from a text file, or from the first sheet of an Excel workbook (needs openpyxl).

    Arguments are as in `read_record`; with `along_rows` the numbers are one column, row after row, and the column
    `labels` ("": the first one) is text if not all its cells are numbers.
    """
    if skip is not None and (isinstance(skip, bool) or not isinstance(skip, int) or skip < 0):
        raise ValueError(f"skip must be a number of lines, zero or more, got {skip!r}")
    file, is_book = str(path), Path(path).suffix.lower() in WORKBOOKS
    text = _workbook(path) if is_book else decode_text(read_bytes(path)).splitlines()
    lines = [(number, line) for number, line in enumerate(text, 1) if number > (skip or 0) and line.strip()]
    comments = [line.lstrip("# \t") for _, line in lines if line.lstrip().startswith("#")]
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    separator = "\t" if is_book else _separator([line for _, line in lines[-_LAST_LINES:]])
    rows = [(number, _split(line, separator, f"{file}, line {number}")) for number, line in lines]
    rows, stated = _logger_table(rows, file)
    missing = _checked_missing(missing)
    marks = [each for each in missing or () if isinstance(each, str)]
    for _, cells in rows if marks else ():  # but names of columns
        if any(map(_known, cells)) or all(cell in marks or _is_missing(cell) for cell in cells):
            cells[:] = ["nan" if cell in marks else cell for cell in cells]
    along_rows = along_rows and not any("rows" in row for _, row in rows[:_LAST_LINES])
    rows, stated = (None if along_rows or stated else _announced(rows, file)) or (rows, stated)
    names, below, rows = _header(rows, separator, along_rows, file, labels)
    expect(rows, file, "rows of numbers, found none")
    rows, commas = _with_points(rows, separator, file)
    columns, clock = _columns(names, below, rows, file, marks, labels)
    above = [line for number, line in lines if number < rows[0][0]]
    statements = read_statements([*comments, *stated, *above], commas)
    title, numbers = "".join([*comments, *stated][:1]), tuple(number for number, _ in rows)
    table = Table(file, bool(names), columns, numbers, title, statements, missing, clock, None, time_unit)
    for words, count in statements.counts:
        check_count(len(rows), count, f"{file}: {words!r}", f". {_SKIP}")
    if time is None:  # by the name of the column, else a clock; without names the first one, if its unit is given
        first = [0] if not names and time_unit is not None and len(columns) > 1 else []
        numbers = [k for k, column in enumerate(columns) if column.kind == "number" and names]
        named = [k for form in (_TIME, _STAMP) for k in numbers if form.match(columns[k].name)]
        clocks = [k for k, column in enumerate(columns) if column.kind == "clock"]
        return table._replace(time=next(iter(first + named + clocks), None))
    places = [k for k, column in enumerate(columns) if column.name == str(time) and column.kind != "text"]
    expected = f"one column of times with time={time!r}, found {len(places)}"
    expect(len(places) == 1, file, expected, advice=table.listing)
    return table._replace(time=places[0], chosen=True)


def _workbook(path: str | Path) -> list[str]:
    """Lines of the first sheet, with tabs between cells; formulas have their stored values."""
    try:
        from openpyxl import load_workbook
    except ImportError as error:
        raise ValueError(
            f"reading {path} needs the package openpyxl: install it with pip install openpyxl, or save the sheet as CSV"
        ) from error
    read_bytes(path)  # the checks of existence and size
    try:
        sheet = load_workbook(path, read_only=True, data_only=True).worksheets[0]
        rows = [
            [repr(float(each)) if type(each) in (int, float) else " ".join(str(each or "").split()) for each in row]
            for row in sheet.iter_rows(values_only=True)
        ]
    except Exception as error:  # a damaged workbook may raise anything
        raise ValueError(f"{path}: not a readable Excel workbook ({error}); save it as CSV") from error
    width = max(map(len, rows), default=0)
    return ["\t".join(row + [""] * (width - len(row))) for row in rows]


# rows of cells --------------------------------------------------------------------------------------------------------


def _split(line: str, separator: str, where: str = "") -> list[str]:
    if separator == " ":
        return number_cells(line) if re.fullmatch(r"[\s\d.+\-eEdD]*", line) else line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != "\t"))
    except csv.Error as error:
        raise ValueError(f"{where}: expected cells separated by {separator!r} ({error})") from None
    return [cell.strip() for cell in cells]


def _separator(lines: Sequence[str]) -> str:
    """The separator that splits most lines into several numbers, or into one number if no separator does."""

    def score(separator: str) -> tuple[int, ...]:
        widths: Counter[int] = Counter()
        for line in lines:
            with suppress(ValueError):
                cells = _split(line, separator)
                widths[len(cells)] += _is_data(cells)
        width, count = max(widths.items(), key=lambda item: item[1], default=(0, 0))
        return count * (width > 1), count, not count and any(separator in line for line in lines)

    return max(_SEPARATORS, key=score)


def _is_missing(cell: str) -> bool:
    return cell.lower() in _MISSING


def _is_value(cell: str) -> bool:
    """Whether a cell is a number in any spelling, and not missing."""
    return not _is_missing(cell) and (is_number(cell) or any(form.fullmatch(cell) for form in _SPELLINGS.values()))


def _known(cell: str) -> bool:
    """Whether a cell is a number, a clock time, or a date in any order of day, month and year."""
    return _is_value(cell) or is_clock(cell) or _DAY_ONLY.fullmatch(cell) is not None


def _is_data(cells: Sequence[str]) -> bool:
    return any(map(_known, cells)) and all(_is_missing(cell) or _known(cell) for cell in cells)


def _is_text(cells: Sequence[str]) -> bool:
    words = any(any(map(str.isalpha, cell)) and not _is_missing(cell) for cell in cells)
    return words and not any(map(_known, cells))


def _along_rows(lines: list[_Line], file: str) -> list[_Line]:
    """One row per number, below lines of text, which have no more numbers than other cells."""

    def is_text(line: _Line) -> bool:
        return any(re.search("[A-Za-z]{2}", cell) for cell in line[1]) and 2 * sum(map(_known, line[1])) <= len(line[1])

    rows = [*itertools.dropwhile(is_text, lines)]
    for number, cells in rows:
        width = len(rows[0][1])
        where, wrong = f"{file}, line {number}", next((cell for cell in cells if not _known(cell)), None)
        expect(wrong is None, where, "numbers below lines of text", repr(str(wrong)[:100]))
        fits = len(cells) == width or (len(cells) < width and number == rows[-1][0])
        expect(fits, where, f"{width} numbers as in the first row", len(cells))
    return [(number, [cell]) for number, cells in rows for cell in cells]


def _announced(lines: list[_Line], file: str) -> tuple[list[_Line], list[str]] | None:
    """One row per number below a line with their number and step, and title and step as comments; None without it.

    eqsig and RSPMatch write it, with at most another integer; in a table it would have as many cells as the rows.
    """
    heads = [" ".join(cells).split() for _, cells in lines[: _LAST_LINES + 1]]
    place = next((k for k, head in enumerate(heads[:-1]) if head and all(map(is_number, head))), 0)
    head, below = heads[place] if heads[1:] else [], lines[place + 1 :]
    stated = re.fullmatch(r"(\d+) (0?\.\d+|\d(?:\.\d+)?[eEdD]-\d+)(?: \d+)?", " ".join(head))
    if not stated or len(head) == len(heads[place + 1]) or not all(_known(cell) for _, row in below for cell in row):
        return None
    rows = _along_rows(below, file)
    check_count(len(rows), stated[1], f"{file}, line {lines[place][0]}")
    return rows, [*(" ".join(cells) for _, cells in lines[: min(place, 1)]), f"dt = {stated[2]} s"]


def _logger_table(lines: list[_Line], file: str) -> tuple[list[_Line], list[str]]:
    """Header line, line of units and rows of a logger program's format, and what comments would state (a step).

    Campbell Scientific TOA5 has four header lines: environment, names, units, processing (LoggerNet manual). LabVIEW
    has tags up to ``***End_of_Header***``, twice, and names that begin with ``X_Value``, whose cells are empty with
    X_Columns "No"; "Multi" has one per channel ("Specification for the LabVIEW Measurement File"). Other lines stay.
    """
    first = lines[0][1][0] if lines and lines[0][1] else ""
    if first == "TOA5" and len(lines) > 3:
        units = [f"[{unit}]" if unit not in ("", "TS", "RN") else "" for unit in lines[2][1]]
        return [lines[1], (lines[2][0], units), *lines[4:]], []
    if not first.startswith("LabVIEW Measurement"):
        return lines, []
    ends = [place for place, (_, cells) in enumerate(lines) if cells[0] == "***End_of_Header***"]
    advice = "write a file for each segment (option 'Overwrite file' or 'One header only')"
    expect(len(ends) == 2, file, "a LabVIEW file with one segment", max(len(ends) - 1, 0), advice)
    tags = {cells[0]: cells[1:] for _, cells in lines[: ends[1]]}
    (number, header), rows = lines[ends[1] + 1] if lines[ends[1] + 1 :] else (0, [""]), lines[ends[1] + 2 :]
    columns, axis = (next(iter(tags.get(tag, ())), "") for tag in ("X_Columns", "X_Dimension"))
    there = header[0] == "X_Value" and (axis or "Time") == "Time"
    expect(there, file, "times in the first column X_Value", f"{header[0]!r} and X_Dimension {axis!r}", "write them")
    width = len(header) - (header[-1] == "Comment")
    labels = ["", *tags.get("Y_Unit_Label", []), *[""] * width]
    names = ["time [s]" if name == "X_Value" else name for name in header[:width]]
    units = ["s" if name == "X_Value" else label for name, label in zip(header[:width], labels, strict=False)]
    for _, cells in rows:
        # the text in the column of comments goes; numbers in it show that a row is damaged
        del cells[width : width + (len(cells) == width + 1 and not any(map(str.isdigit, cells[-1])))]
    table = [(number, names), (number, [f"[{unit}]" if unit else "" for unit in units]), *rows]
    if columns != "No":
        return table, []
    steps = sorted({cell for cell in tags.get("Delta_X", []) if cell})
    expect(len(steps) == 1, file, "one step Delta_X", ", ".join(steps) or "none", "write it with times")
    return [(number, cells[1:]) for number, cells in table], [f"dt = {steps[0].replace(',', '.')} s"]


# header line and decimal marks ----------------------------------------------------------------------------------------


def _header(
    lines: list[_Line], separator: str, along_rows: bool, file: str, labels: str | None = None
) -> tuple[list[str], list[str], list[_Line]]:
    """Names, units below them, and rows of equal width, without columns that have neither a name nor a number.

    Names are the last line of words above the rows that is as wide, but for a separator at the ends of rows or names.
    """
    data = [*itertools.islice((k for k, (_, cells) in enumerate(lines) if _is_data(cells)), _LAST_LINES)]
    widths = [len(lines[k][1]) for k in data] or [max((len(cells) for _, cells in lines), default=0)]
    width = Counter(widths).most_common(1)[0][0]
    first = next((k for k in data if len(lines[k][1]) == width), len(lines))
    if first:  # half as many names as cells: commas separate cells and decimals; one too few: the rows have names
        (number, above), rows = lines[first - 1], [cells for _, cells in lines[first : first + _LAST_LINES]]
        half = separator == "," and 2 * len(above) == width and not any("." in cell for cells in rows for cell in cells)
        short = len(above) == width - 1 > 1 and any(cells[-1] for cells in rows) and not along_rows
        wrong = rows and (half or short) and _is_text(above) and all(above)
        advice = "write decimal points, or leave out the names of rows, in R with row.names = FALSE"
        expected = f"a name for each of the {width} cells in a row"
        expect(not wrong, f"{file}, line {number}", expected, len(above), f"{advice}. {_POINTS}")
    if along_rows:
        return [], [], _along_rows(lines, file)
    spare = width > 2 and not any(cells[-1] for _, cells in lines[first:] if len(cells) == width)
    found: list[tuple[int, list[str]]] = []
    for place, (_, cells) in enumerate(lines[:first]):
        words = cells if any(cells[width:]) else [*cells, *[""] * spare][:width]
        states = width == 1 and any(read_statements(words))  # a line such as "Time step: 10 ms" names no column
        filled = [k for k, cell in enumerate(words) if not _is_missing(cell)]
        label = found[-1][1].index(labels) if found and labels and labels in found[-1][1] else 0
        alone = found and labels is not None and filled == [label] and not _are_units(words)  # a row without a number
        if len(words) == width and _is_text(words) and not states and not alone:
            found.append((place, words))
    after, names = found[-1] if found else (first, [])
    below: list[str] = []
    if len(found) > 1 and found[-2][0] == after - 1 and _are_units(names):
        below = ["" if _states_nothing(cell) else cell.strip("[]() ") for cell in names]
        names = found[-2][1]
    if not names:
        # a damaged first row is an error and no text above the table, and a row of missing samples is a row
        whole = (k for k, (_, cells) in enumerate(lines[:first]) if len(cells) == width and any(cells))
        after = next((k for k in whole if any(map(_known, lines[k][1])) or all(map(_is_missing, lines[k][1]))), first)
    rows = lines[after + bool(names) :]
    for number, cells in rows:
        if len(cells) != width:
            last = not names and len(cells) < width and number == rows[-1][0] and all(map(_known, cells))
            advice = "if the samples follow each other along the rows, give column='rows' and dt=" if last else ""
            advice = _CUT if number == rows[-1][0] and not all(map(_known, filter(None, cells))) else advice
            expect(False, f"{file}, line {number}", f"{width} cells as in the first line", len(cells), advice)
    kept = [k for k in range(width) if (names and names[k]) or not all(_is_missing(cells[k]) for _, cells in rows)]
    kept = kept or [*range(width)]  # the others are empty after a separator at the end of each line
    names, below = ([each[k] for k in kept] if each else [] for each in (names, below))
    return names, below, [(number, [cells[k] for k in kept]) for number, cells in rows]


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a line below the names has units: all cells are units, one is a unit of time, or all have brackets."""
    given = [cell for cell in cells if cell]
    units = [cell.strip("[]() ") for cell in given if not _states_nothing(cell)]
    of_time = any(dimension_of(unit) == "time" for unit in units if unit != "S")  # which may be the direction south
    known = bool(units) and all(map(dimension_of, units))
    return of_time or known or all(cell[0] + cell[-1] in ("()", "[]") for cell in given)


def _states_nothing(cell: str) -> bool:
    """Whether a cell in a line of units is empty, a dash or the format of a time, such as DD.MM.YYYY hh:mm:ss."""
    return not cell.strip("-\u2013") or _DATE_FORMAT.fullmatch(cell.strip("[]() ")) is not None


def _with_points(lines: list[_Line], separator: str, file: str) -> tuple[list[_Line], bool]:
    """Rows with decimal points and without separators of thousands, "" for missing cells; whether commas were decimal.

    All numbers have one spelling, and separators of thousands need a number that shows them, such as ``1,234.5``. Cells
    such as ``1,000`` have three decimals unless commas separate the cells and no number shows that they are decimal, or
    the column has no other decimal comma and integers of three digits.
    """
    rows = [(number, ["" if _is_missing(cell) else cell for cell in cells]) for number, cells in lines]
    if not any(_MARKED.search(cell) for _, cells in rows for cell in cells):
        return rows, False
    left, shown, seen = set(_SPELLINGS), set[tuple[str, str]](), list[tuple[str, int]]()
    for number, cells in rows:
        for cell in cells:
            fit = {each for each, form in _SPELLINGS.items() if form.fullmatch(cell)}
            shown |= fit if len(fit) == 1 else set()
            if fit and not left <= fit:
                left, seen = left & fit, [*seen[:1], (cell, number)]
    spellings = [each for each in _SPELLINGS if each in left and (each[1] == _BLANKS or each in shown)]
    pairs = " and ".join(f"{cell!r} in line {number}" for cell, number in seen[:1] + seen[-1:])
    expect(spellings, file, "one decimal mark", pairs, "write all numbers alike, without separators of thousands")
    mark, group = spellings[0]
    for column in zip(*(cells for _, cells in rows), strict=True) if (mark, group) == (",", _BLANKS) else ():
        doubtful = [k for k, cell in enumerate(column) if _THOUSANDS.fullmatch(cell)]
        own = any("," in cell and _is_value(cell) and not _THOUSANDS.fullmatch(cell) for cell in column)
        alone = separator == "," and (".", ",") in left
        wrong = not own and (alone or any(re.fullmatch(r"[-+]?[1-9]\d{2}", cell) for cell in column))
        for k in doubtful[:wrong]:
            got = f"{column[k]!r}, which may have a separator of thousands or a decimal comma"
            advice = "write it without separators of thousands and with a decimal point"
            expect(False, f"{file}, line {rows[k][0]}", "a number", got, advice)
    form, plain = _SPELLINGS[mark, group], str.maketrans({**dict.fromkeys(group), mark: "."})
    for _, cells in rows:
        cells[:] = [cell.translate(plain) if form.fullmatch(cell) else cell for cell in cells]
    return rows, mark == ","


# columns ----------------------------------------------------------------------------------------------------

_LONGEST_UNIT = 100
_SENTINELS = (-9999.0, -999.25, 1e30, 9.97e36)  # numbers that loggers and formats write for missing samples
# also used for missing samples, but plausible as measured numbers: counts, or accelerations in gal
_PLAUSIBLE_SENTINELS = (-999.0, 9999.0, 99999.0, -99999.0, 32767.0, -32768.0)


def _columns(
    names: list[str], below: list[str], rows: list[_Line], file: str, marks: Sequence[str], labels: str | None = None
) -> tuple[tuple[Column, ...], ClockTime | None]:
    """Columns of numbers, clock times and text, and the first clock time; `marks` are for the message."""
    columns, first, lines = [], None, [f"{file}, line {number}" for number, _ in rows]
    for k, cells in enumerate(zip(*(row for _, row in rows), strict=True)):
        filled = [cell for cell in cells if cell]
        kind, decimals, values = "number", 0, [math.nan] * len(cells)
        is_label = names and labels in (names[k], "" if k == 0 else names[k]) and not all(map(is_number, filled))
        if is_label or (filled and all(_DAY_ONLY.fullmatch(cell) or _is_word(cell) for cell in filled)):
            kind = "text"
        elif any(map(is_clock, filled)):
            kind = "clock"
            times = [_parse_clock(cell, where) if cell else None for cell, where in zip(cells, lines, strict=True)]
            values, known = _seconds_of(times, file), [time for time in times if time is not None]
            first, decimals = first or known[0], max(time.decimals for time in known)
        else:
            for place, cell in enumerate(cells):
                try:
                    values[place] = parse_number(cell, lines[place]) if cell else math.nan
                except ValueError as error:
                    # text may be a missing sample, unless it is a damaged number or in a second header line, or among
                    # the times: then a line below the samples may state a largest value, a mean, or a date
                    alone = len(rows[place][1]) == 1 and cell not in names
                    word = _is_word(cell) or not any(map(str.isdigit, cell))
                    mark = word and (alone or any(map(_known, rows[place][1])))
                    advice = f"; if it stands for a missing sample, give missing={[*marks, cell[:100]]}" if mark else ""
                    of_time = names and _TIME.match(names[k]) and _is_word(cell)
                    raise ValueError(f"{error}{f'; {_CUT}' if of_time else advice}") from None
            decimals = max(map(decimals_of, filled), default=0)
        name, unit = names[k] if names else str(k + 1), below[k] if below else ""
        columns.append(Column(name, np.array(values), decimals, unit, kind, cells))
    return tuple(columns), first


def _is_word(cell: str) -> bool:
    """Whether a cell is text that is no number: also inf is one."""
    return cell[0] not in "+-.,0123456789" and not is_number(cell)


def unit_in_name(name: str) -> str | None:
    """The unit at the end of a column name (``acc_cm_s2``, ``force [kip]``, ``acc, g``), or None."""
    name = name[-_LONGEST_UNIT:]
    bracket = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    parts = name.split("_")
    texts = ["_".join(parts[i:]) for i in range(1, len(parts))] + name.split(", ")[1:][-1:]
    for text in [bracket[1]] if bracket else texts:
        # a number at the end of a name is a counter, not the unit of a strain
        if dimension_of(text) and (unit := find_unit(text).name) != "1":
            return unit
    return bracket[1] if bracket else None


def _checked_missing(missing: Sequence[float | str] | None) -> tuple[float | str, ...] | None:
    """Numbers and texts that stand for missing samples; ValueError for other values, and for numbers in quotes."""
    if missing is None:
        return None
    given = [each.strip() if isinstance(each, str) else each for each in np.atleast_1d(np.array(missing, dtype=object))]
    for each in given:
        text = isinstance(each, str) and each and not (_known(each) and any(map(str.isdigit, each)))
        expected = "finite numbers and texts, such as (-9999, 'OL'), or () for none"
        expect(text or (isinstance(each, Real) and math.isfinite(each)), "missing", expected, repr(missing))
    return tuple(given)
