"""Tables of numbers in text files and workbooks, as loggers and spreadsheets write them.

`read_table` finds separator, header line, line of units, decimal marks, clock times and the column of times.
Semicolons, tabs, commas or blanks separate cells, whichever splits most of the last lines into numbers. Decimal commas
are read if commas do not separate cells; separators of thousands go if a number shows them: ``1,234.5``, ``1.234,5``,
``1'234``. Text before the header line is left out, as are lines of numbers and words that a header line follows.

`table_step` and `table_start` return seconds, `table_values` the samples of columns with NaN for missing ones, and the
unit on which file and caller agree. The first part reads text, numbers and units, for other formats as well.
"""

import codecs
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

from ..units import DIMENSIONS, UNITS, find_unit
from .sampling import check_step

__all__ = [
    "LINE_END",
    "NUMBER",
    "WORKBOOKS",
    "Column",
    "Statements",
    "Table",
    "agree_on_unit",
    "check_count",
    "check_peaks",
    "clock_text",
    "column_unit",
    "column_values",
    "decimals_of",
    "decode_text",
    "dimension_of",
    "is_clock",
    "is_number",
    "number_cells",
    "parse_number",
    "read_bytes",
    "read_statements",
    "read_table",
    "row_times",
    "stated_unit",
    "table_start",
    "table_step",
    "table_values",
    "text_unit",
    "uniform_times",
    "unit_in_name",
    "value_columns",
]

# text and numbers -----------------------------------------------------------------------------------------------------

NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
"""Regular expression for a decimal number, without alternatives for the same digits: its time is linear."""

LINE_END = re.compile(r"\r+\n|\r")
"""Regular expression for the end of a line with a carriage return, or two in a text that was transferred twice."""

_LARGEST_FILE = 256 * 2**20  # bytes of a text file or an archive; long records have some MiB
# What editors and transfers add after the last line: blank lines, ^Z (the end of a text in DOS), zero bytes as padding
_PADDING = " \t\n\f\0\x1a"
_CLOSING = re.compile(r"[^\d,;\t]{0,80}(?<![A-Za-z])(?:end|eof)[^\d,;\t]{0,80}", re.IGNORECASE)  # *** End data ***
_LAST_DECIMALS = re.compile(r"\.(\d+)([eEdD][-+]?\d+)?\s*$")
_FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)")  # the letter of double precision


def read_bytes(path: str | Path) -> bytes:
    """The content of a file; ValueError if it cannot be read or is too large."""
    try:
        size = Path(path).stat().st_size
        if size > _LARGEST_FILE:
            raise ValueError(f"{path}: expected at most {_LARGEST_FILE} bytes, got {size}; cut the file")
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; check the path") from error


def decode_text(content: bytes) -> str:
    """The text of a file without padding and closing remarks after its last line.

    It is UTF-8 or UTF-16 with a byte-order mark, UTF-8 where it is valid, else Latin-1. Zero bytes directly after a
    number are kept, so that this number is refused: a table that a crash has cut may have lost its last digits.
    """
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16", "replace") if wide else content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    text = LINE_END.sub("\n", text)
    while True:
        last = len(text.rstrip(_PADDING))  # blanks at the end of this line may be empty cells
        text = text[:last] + re.split(r"[\n\f\x1a]", text[last:], maxsplit=1)[0]
        start = text.rfind("\n") + 1
        if not _CLOSING.fullmatch(text, start):
            return text
        text = text[:start]


def number_cells(line: str) -> list[str]:
    """The fields of a line of numbers, which blanks separate or which touch, as in some Fortran formats.

    Numbers that touch have equally many decimals, and begin with a sign (``-12.34567-0.12345``) or are equally wide
    (`` 12.34567100.12345``). Other text stays one field, which is no number.
    """
    cells, last = line.split(), _LAST_DECIMALS.search(line)
    if last is None or all(cell.count(".") < 2 for cell in cells):
        return cells
    exponent = r"[eEdD][-+]\d{2,3}" if last[2] else ""
    fields = re.findall(rf"\s*[-+]?\d*\.\d{{{len(last[1])}}}{exponent}", line)
    split = len({len(field) for field in fields}) == 1 or all(field[0] in " \t+-" for field in fields[1:])
    return [field.strip() for field in fields] if split and "".join(fields) == line.rstrip() else cells


def _as_float(field: str) -> float:
    """A number, also with an exponent of Fortran (1.0D-03); ValueError for digits grouped by underscores."""
    if "_" in field:
        raise ValueError
    try:
        return float(field)
    except ValueError:
        return float(_FORTRAN_EXPONENT.sub("e", field))


def is_number(field: str) -> bool:
    """Whether a field of a file is a number."""
    try:
        _as_float(field)
    except ValueError:
        return False
    return True


def parse_number(field: str, where: str) -> float:
    """The finite number in a field of a file; ValueError for anything else."""
    try:
        value = _as_float(field)
    except ValueError:
        clock = ", or a clock time such as '03:19:53.010' or '2019-07-06T03:19:53.010'" if ":" in field else ""
        raise ValueError(f"{where}: expected a number{clock}, got {field[:100]!r}") from None
    if not math.isfinite(value):
        raise ValueError(f"{where}: expected a finite number, got {field[:100]!r}")
    return value


def check_count(found: int, stated: str | float, where: str, advice: str = "") -> None:
    """ValueError if a file has another number of samples than it announces."""
    if found != float(stated):
        raise ValueError(
            f"{where} announces {stated!s:.20} samples, the file has {found}; it is truncated or damaged{advice}"
        )


def decimals_of(field: str) -> int:
    """How many digits after the decimal point the number in a field has, less than zero for 1e3."""
    digits = field.partition(".")[2]
    if digits.isdecimal():  # most fields
        return len(digits)
    mantissa, _, exponent = field.lower().replace("d", "e").partition("e")
    power = int(exponent or 0) if len(exponent) < 6 else 0  # a larger exponent belongs to zero
    return min(max(len(mantissa.partition(".")[2]) - power, -300), 300)


def dimension_of(unit: str) -> str | None:
    """The dimension of a unit, or None for other text."""
    try:
        return find_unit(unit).dimension
    except ValueError:
        return None


def agree_on_unit(stated: str | None, given: str | None, dimension: str, file: str | Path) -> str:
    """The canonical name of the unit that a file states or the caller gives.

    ValueError if both are None, they disagree, or a unit is unknown or of another dimension.
    """
    names = [name for name in (stated, given) if name is not None]
    if not names:
        example = "g" if dimension == "acceleration" else DIMENSIONS[dimension]
        raise ValueError(f"{file} does not state the unit of its {dimension}: give units=, for instance {example!r}")
    try:
        units = [find_unit(name, dimension) for name in names]
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if units[0].factor != units[-1].factor:
        raise ValueError(f"{file} states the unit {stated!r} but units = {given!r} was given; correct one of them")
    return units[0].name


# what the text above samples states -----------------------------------------------------------------------------------

_VALUE = rf"\s*(?:[\[(]\s*(?P<bracket>[^\])]{{1,20}}?)\s*[\])])?\s*[:=,;\t]*\s*(?P<number>{NUMBER})\s*"
_STEP = re.compile(
    r"\b(?:dt|delta[ _]?t|(?:sampl(?:ing|e)|time|scan)[ _-]?(?:interval|step|period|increment|spacing)|"
    r"equal(?:ly)?\s+spac(?:ing\s+of|ed\s+at)|intervals\s+of|abtast(?:intervall|periode|zeit)|zeitschritt|"
    r"pas de temps|paso de tiempo|passo temporale|interval(?:o de muestreo|lo di campionamento))"
    rf"(?:_(?P<ending>s|ms)\b)?{_VALUE}(?P<unit>[a-z]*)",
    re.IGNORECASE,
)
_RATE = re.compile(
    r"(?:\b(?:(?:sampl(?:ing|e)|scan)[ _-]?(?:rate|freq(?:uency|\.)?)|(?:samples|scans) per sec(?:ond)?\b|"
    r"abtast(?:rate|frequenz)|fr[eé]quence d.[eé]chantillonnage|frecuencia de muestreo|frequenza di campionamento)|"
    rf"^\W*(?:fs|rate)\b(?=\s*[\[(:=,;\t])){_VALUE}"
    r"(?P<unit>k?hz|sps|(?:samples|pts|points)\s*(?:per|/)\s*s(?:ec(?:ond)?)?)?",
    re.IGNORECASE,
)
_COUNT = re.compile(
    r"\b(?:npts|ndata|(?:number|no\.?|num)[ _]of[ _](?:data|samples|scans|rows|values)(?:[ _]points)?|"
    r"(?:number|no\.?|num)[ _]of[ _]points|(?:scans|samples) in (?:the )?file|"
    r"anzahl(?: der)? (?:abtastwerte|messwerte|werte|punkte)|nombre d(?:e points|.[eé]chantillons)|"
    r"n[uú]mero de (?:datos|muestras|puntos))\s*[:=,;\t]*\s*(\d+)(?![\d.])|"
    r"^\W*(?:samples|points|scans)\s*[:=,;\t]\s*(\d+)\W*$",
    re.IGNORECASE,
)
_UNIT_LINE = re.compile(r"\b(?:units?|einheit)(?:\s+of\s+[a-z]{1,20})?\s*[:=]\s*([^\s;,]+)", re.IGNORECASE)
_UNITS_ARE = re.compile(r"\bunits?\s+(?:of|are|is)\s+[(\[]?\s*([^\s,;()\[\]]+)", re.IGNORECASE)
_PEAK = re.compile(
    r"\b(?:pga|(?:peak|max\w*\.?)(?:\s+ground)?\s+acc\w*\.?|(?P<any>(?:peak|max\w*\.?)\s+value))(?:\s+values?)?\s*"
    r"(?:[\[(]\s*(?P<unit>[^\])]{1,20}?)\s*[\])])?\s*[:=,;\t]\s*(?P<numbers>.{0,200})",
    re.IGNORECASE,
)
_NAMED = re.compile(rf"\(([^)]{{1,40}})\)\s*({NUMBER})")
_PLAIN = re.compile(rf"({NUMBER})\s*(\S*)")
_LONGER = ("min", "minutes", "h", "hours")  # loggers of temperature
_LONGEST = 10_000  # letters of a line that are searched
_LARGEST_ROUNDING = 0.005  # relative, of a number with three digits; with fewer ones, such as 0.01, a step is exact


class StatedStep(NamedTuple):
    """A step of the samples, in the words of a file."""

    text: str
    steps: tuple[float, ...]  # [s]; several if the unit is not stated
    rounding: float  # largest relative error of the printed number


class StatedPeak(NamedTuple):
    """Peak accelerations, in the words of a file."""

    text: str
    unit: str | None
    printed: dict[str, str]  # by the name of the column, "" for a peak without name

    def of(self, names: Sequence[str], index: int) -> str | None:
        """The number for one of the columns of values: by its name, or where no name is there by its place."""
        if any(name in self.printed for name in names):
            return self.printed.get(names[index])
        return list(self.printed.values())[index] if len(self.printed) == len(names) else None


class Statements(NamedTuple):
    """What lines state: steps, and the words and values of sample counts, units and peaks."""

    steps: tuple[StatedStep, ...] = ()
    counts: tuple[tuple[str, str], ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    peaks: tuple[StatedPeak, ...] = ()


def read_statements(lines: Sequence[str], decimal_commas: bool = False) -> Statements:
    """What lines of text state."""
    steps, counts, units, peaks = [], [], [], []
    for line in lines:
        line = re.sub(r"(?<=\d),(?=\d)", ".", line[:_LONGEST]) if decimal_commas else line[:_LONGEST]
        steps += [_stated_step(found, form is _RATE) for form in (_STEP, _RATE) for found in form.finditer(line)]
        counts += [(found[0][:60], found[1] or found[2]) for found in _COUNT.finditer(line)]
        units += [(found[0], found[1]) for found in _UNIT_LINE.finditer(line)]
        units += [(each[0], each[1]) for each in _UNITS_ARE.finditer(line) if dimension_of(each[1]) == "acceleration"]
        peaks += [_stated_peak(found) for found in _PEAK.finditer(line)]
    return Statements(tuple(filter(None, steps)), tuple(counts), tuple(units), tuple(filter(None, peaks)))


def _stated_step(found: re.Match[str], is_rate: bool) -> StatedStep | None:
    """A step, or the step of a rate; None for zero, and for a number of something else."""
    number, unit, bracket = float(found["number"]), found["unit"] or "", found["bracket"]
    if not number > 0.0 or unit.lower() in _LONGER:
        return None
    if is_rate:
        stated = (unit or bracket or "").lower()
        steps = tuple(1.0 / (number * each) for each in ([1e3 if stated == "khz" else 1.0] if stated else [1.0, 1e3]))
    else:
        stated = [each for each in (found["ending"], bracket, unit) if each and dimension_of(each) == "time"]
        if bracket and not stated:  # brackets around something else
            return None
        steps = tuple(number * each for each in [find_unit(each).factor for each in stated[:1]] or [1.0, 1e-3, 1e-6])
    rounding = 0.5 * 10.0 ** -decimals_of(found["number"]) / number
    return StatedStep(found[0].strip(), steps, min(rounding, _LARGEST_ROUNDING))


def _stated_peak(found: re.Match[str]) -> StatedPeak | None:
    """Peaks by name, or one without; None for other text, and a value that may be no acceleration."""
    unit, printed = found["unit"], {name.strip(): number for name, number in _NAMED.findall(found["numbers"])}
    if not printed and (plain := _PLAIN.match(found["numbers"])):
        unit, printed = unit or plain[2].rstrip(",;"), {"": plain[1]}
    unit = unit if unit and dimension_of(unit) == "acceleration" else None
    return StatedPeak(found[0].strip(), unit, printed) if printed and (unit or not found["any"]) else None


def check_peaks(
    peaks: Sequence[StatedPeak],
    names: Sequence[str],
    index: int,
    values: NDArray[np.float64],
    decimals: int,
    unit: str,
    file: str,
    advice: str = "",
) -> None:
    """ValueError if a stated peak is not the peak of a column, with its mean or without it.

    The column is number `index` of `names`, with printed values (n_rows,) without missing ones; `advice` ends the
    message.
    """
    factor, digit = find_unit(unit).factor, 1.01 * 10.0**-decimals
    found = [float(np.abs(each).max()) for each in (values, values - values.mean())]
    for peak in peaks:
        printed = peak.of(names, index)
        known = [peak.unit] if peak.unit else [name for name in UNITS if UNITS[name].dimension == "acceleration"]
        ratios = [find_unit(each).factor / factor for each in known]
        if printed is not None and not any(
            abs(each - ratio * abs(float(printed))) <= digit + 0.505 * ratio * 10.0 ** -decimals_of(printed)
            for each in found
            for ratio in ratios
        ):
            raise ValueError(
                f"{file}: the file states {peak.text!r}, the samples have a peak of {found[0]:g} {unit}; the unit is "
                f"wrong, or the file is damaged{advice}"
            )


# clock times ----------------------------------------------------------------------------------------------------------
# 03:19:53.010, 2019-07-06T03:19:53.010Z or 06.07.2019 03:19:53 PM, and dates: the year is first, or last after points.

_DATE = r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<month>\d{1,2})(?P=mark)(?P<last>\d{1,4})"
_AFTER = r"(?:[ \u00a0\u202f]?(?:([AP])\.?M\.?|(Z|UTC|[-+]\d{2}:?\d{2})))?"
_CLOCK = re.compile(rf"(?:{_DATE}(?:T| +))?(\d{{1,2}}):([0-5]\d):([0-5]\d)(?:[.,](\d+))?{_AFTER}", re.IGNORECASE)
_DAY_ONLY = re.compile(_DATE)
# Letters of day, month, year, hour and second in English, German, French, Spanish and Italian, each part once or more
_DATE_FORMAT = re.compile(
    r"([DTJGMYAHS])\1+(?:(?:[-/.:, ]{1,2}|T(?=HH))([DTJGMYAHS])\2+)+(?:[.,](?:0+|F+))?(?: ?AM/PM)?", re.IGNORECASE
)
_HOUR, _DAY = 3600, 86400
_EPOCH = datetime.date(1970, 1, 1).toordinal()


class ClockTime(NamedTuple):
    """A clock time."""

    day: int | None  # number of the day, None without a date
    seconds: float  # since the midnight before [s]
    decimals: int  # of the seconds
    zone: int | None  # minutes by which the clock is before UTC, None without a time zone
    halves: bool = False  # hours from 1 to 12 with AM and PM


def is_clock(cell: str) -> bool:
    """Whether a cell is a clock time, with a date or without."""
    return ":" in cell and _CLOCK.fullmatch(cell) is not None


def clock_text(clock: ClockTime) -> str:
    """A clock time as `zero` takes it."""
    text = str((datetime.datetime.min + datetime.timedelta(seconds=clock.seconds)).time())
    return text if clock.day is None else f"{datetime.date.fromordinal(clock.day)} {text}"


def _parse_clock(cell: str, where: str) -> ClockTime:
    """The clock time in a cell; ValueError for anything else."""
    found, got = _CLOCK.fullmatch(cell), f"got {cell[:100]!r}"
    if found is None:
        raise ValueError(f"{where}: expected a clock time such as '03:19:53.010' or '2019-07-06T03:19:53.010', {got}")
    *_, hour, minute, second, fraction, half, zone = found.groups()
    if not (1 <= int(hour) <= 12 if half else int(hour) <= 24):
        hours = "with AM and PM have hours from 1 to 12" if half else "have hours from 0 to 23"
        raise ValueError(f"{where}: clock times {hours}; {got}")
    hours = int(hour) % 12 + 12 * (half in ("P", "p")) if half else int(hour)
    if zone is not None:  # minutes of a time zone such as +02:00; Z and UTC are zero
        zone = 0 if zone.upper() in ("Z", "UTC") else int(f"{zone[0]}1") * (60 * int(zone[1:3]) + int(zone[-2:]))
    seconds = float(f"{_HOUR * hours + 60 * int(minute) + int(second)}.{fraction or 0}")
    year, day, number = found["first"], found["last"], None
    if year is not None:
        if len(year) != 4 and (found["mark"] != "." or len(day) != 4):
            raise ValueError(
                f"{where}: expected a date such as 2019-07-06 or 06.07.2019, {got}, which may begin with the day or "
                "the month; write the year first"
            )
        year, day = (year, day) if len(year) == 4 else (day, year)
        try:
            number = datetime.date(int(year), int(found["month"]), int(day)).toordinal()
        except ValueError as error:
            raise ValueError(f"{where}: expected a date, {got} ({error})") from None
    return ClockTime(number, seconds, len(fraction or ""), zone, bool(half))


def _seconds_of(times: list[ClockTime | None], file: str) -> list[float]:
    """Seconds since the midnight before the first time, NaN for None.

    Without dates, a time that is more than half a day earlier than the previous time belongs to the next day. 1 o'clock
    after 12 o'clock is refused: it is on a 12-hour clock.
    """
    known = [time for time in times if time is not None]
    zones = {time.zone for time in known}
    for differ, expected in (
        (len({time.day is None for time in known}) > 1, "a date in all clock times or in none"),
        (len(zones) > 1, f"one time zone in all clock times, got {len(zones)}"),
        (len({time.halves for time in known}) > 1, "AM or PM in all clock times or in none"),
    ):
        if differ:
            raise ValueError(f"{file}: expected {expected}; write them alike")
    day, last, found = 0, 0.0, []
    for time in times:
        if time is None:
            found.append(math.nan)
            continue
        if not time.halves and 12 * _HOUR <= last < 13 * _HOUR and _HOUR <= time.seconds < 2 * _HOUR:
            raise ValueError(
                f"{file}: the clock times go back from 12 to 1 o'clock, as on a clock of 12 hours; write hours from 0 "
                "to 23"
            )
        day = time.day - known[0].day if time.day is not None else day + (time.seconds < last - _DAY / 2)
        last = time.seconds
        found.append(day * _DAY + time.seconds)
    return found


# the table ------------------------------------------------------------------------------------------------------------

WORKBOOKS = (".xlsx", ".xlsm")
"""Endings of the names of Excel workbooks."""

_SEPARATORS = (";", "\t", ",", " ")
_LAST_LINES = 50  # lines that determine the separator
_MISSING = frozenset({"", "nan", "#n/a", "n/a", "na", "null", "-", "--"})
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?$")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}$")  # 1,000: a thousand, or one with three decimals
# Separators of thousands that cannot be decimal marks: another mark or a second group follows
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}(?:(?:,\d{3})+\.\d*|(?:\.\d{3})+,\d*|(?:,\d{3}){2,}|(?:\.\d{3}){2,})$")
_SPACED = re.compile(r"[-+]?[1-9]\d{0,2}(?:['\u2019\u00a0\u202f ]\d{3})+(?:[.,]\d*)?$")
_SPACE = re.compile(r"\d['\u2019\u00a0\u202f ]\d{3}")
_SPACES = str.maketrans("", "", "'\u2019\u00a0\u202f ")
_HUNDREDS = re.compile(r"[-+]?[1-9]\d{2}$")
_NUMBERS = re.compile(r"[\s\d.+\-eEdD]*")
_BELOW_ONE = re.compile(r"0?\.\d+|\d(?:\.\d+)?[eEdD]-\d+")
_POINTS = "Numbers with decimal commas need another separator between columns, such as ';'"
_SKIP = "If the text is about other samples, give skip= to leave it out"

_Line = tuple[int, list[str]]  # its number and cells


class Missing(NamedTuple):
    """What stands for missing samples, as the caller says."""

    numbers: NDArray[np.float64]
    texts: list[str]
    stated: bool  # whether the caller says it; it may be nothing


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
    missing: Missing
    found: frozenset[str]  # texts of missing samples that rows have
    clock: ClockTime | None = None  # the first clock time
    time: int | None = None  # column of times
    time_unit: str | None = None  # as given by the caller
    chosen: bool = False  # whether the caller has chosen the column of times


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

    Arguments are those of `read_record`; with `along_rows` the numbers are one column, row after row, and the column
    `labels` ("": the first one) is text if not all its cells are numbers. ValueError if the file cannot be read, has no
    rows, rows of different length, a cell that is no finite number, or states another number of samples.
    """
    if skip is not None and (isinstance(skip, bool) or not isinstance(skip, int) or skip < 0):
        raise ValueError(f"skip must be a number of lines, zero or more, got {skip!r}")
    if time_unit is not None:
        find_unit(time_unit, "time")
    file, is_book = str(path), Path(path).suffix.lower() in WORKBOOKS
    text = _workbook(path) if is_book else decode_text(read_bytes(path)).splitlines()
    lines = [(number, line) for number, line in enumerate(text, 1) if number > (skip or 0) and line.strip()]
    comments = [line.lstrip("# \t") for _, line in lines if line.lstrip().startswith("#")]
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    separator = "\t" if is_book else _separator([line for _, line in lines[-_LAST_LINES:]])
    rows = [(number, _split(line, separator, f"{file}, line {number}")) for number, line in lines]
    rows, stated = _logger_table(rows, file)
    absent = _listed(missing)
    there = _blank(rows, absent.texts)
    along_rows = along_rows and not any("rows" in row for _, row in rows[:_LAST_LINES])
    announced = None if along_rows or stated else _announced(rows, file)
    if announced:
        rows, stated = announced
    elif rows:
        _check_names(rows, separator, along_rows, file)
        rows = _along_rows(rows, file) if along_rows else rows
    names, below, rows = _header(rows, file)
    rows, commas = _with_points(rows, separator, file)
    columns, clock = _columns(names, below, rows, file, absent.texts, labels)
    above = [line for number, line in lines if number < rows[0][0]]
    found = read_statements([*comments, *stated, *above], commas)
    title, numbers = "".join([*comments, *stated][:1]), tuple(number for number, _ in rows)
    table = Table(file, bool(names), columns, numbers, title, found, absent, there, clock, None, time_unit)
    for words, count in found.counts:
        check_count(len(rows), count, f"{file}: {words!r}", f". {_SKIP}")
    if time is None:
        return table._replace(time=_time_column(table))
    places = [k for k, column in enumerate(columns) if column.name == str(time) and column.kind != "text"]
    if len(places) != 1:
        raise ValueError(
            f"{file}: expected one column of times with time={time!r}, found {len(places)}; {_listed_columns(table)}"
        )
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
        rows = [list(map(_cell_text, row)) for row in sheet.iter_rows(values_only=True)]
    except Exception as error:  # a damaged workbook may raise anything
        raise ValueError(f"{path}: not a readable Excel workbook ({error}); save it as CSV") from error
    width = max(map(len, rows), default=0)
    return ["\t".join(row + [""] * (width - len(row))) for row in rows]


def _cell_text(value: object) -> str:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return repr(float(value)) if number else " ".join(str("" if value is None else value).split())


# rows of cells --------------------------------------------------------------------------------------------------------


def _split(line: str, separator: str, where: str) -> list[str]:
    if separator == " ":
        return number_cells(line) if _NUMBERS.fullmatch(line) else line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != "\t"))
    except csv.Error as error:
        raise ValueError(f"{where}: expected cells separated by {separator!r} ({error})") from None
    cells = [cell.strip() for cell in cells]
    if not _SPACE.search(line):
        return cells
    return [cell.translate(_SPACES) if _SPACED.match(cell) else cell for cell in cells]


def _separator(lines: Sequence[str]) -> str:
    """The separator that splits most lines into several numbers, or into one number if no separator does."""
    best, most = " ", (0, 0)
    for separator in _SEPARATORS:
        widths: Counter[int] = Counter()
        for line in lines:
            with suppress(ValueError):
                cells = _split(line, separator, "")
                widths[len(cells)] += _is_data(cells)
        width, count = max(widths.items(), key=lambda item: item[1], default=(0, 0))
        if (count * (width > 1), count) > most:
            best, most = separator, (count * (width > 1), count)
    if most == (0, 0):  # no line of numbers: the separator that is there, for the message
        best = next((each for each in _SEPARATORS if any(each in line for line in lines)), " ")
    return best


def _blank(rows: Sequence[_Line], marks: Sequence[str]) -> frozenset[str]:
    """Write NaN for the marks of missing samples in rows, which have a number or nothing else; the marks found."""
    found = set()
    for _, cells in rows if marks else ():
        if any(map(_known, cells)) or all(cell in marks or _is_missing(cell) for cell in cells):
            found |= {*cells} & {*marks}
            cells[:] = ["nan" if cell in marks else cell for cell in cells]
    return frozenset(found)


def _is_missing(cell: str) -> bool:
    return cell.lower() in _MISSING


def _is_date(cell: str) -> bool:
    """Whether a cell is a date without a time, in any order of day, month and year."""
    return _DAY_ONLY.fullmatch(cell) is not None


def _known(cell: str) -> bool:
    """Whether a cell is a number in any spelling, a clock time or a date."""
    if _is_missing(cell):
        return False
    return bool(
        is_number(cell) or _DECIMAL_COMMA.match(cell) or _GROUPED.match(cell) or is_clock(cell) or _is_date(cell)
    )


def _is_data(cells: Sequence[str]) -> bool:
    return any(map(_known, cells)) and all(_known(cell) or _is_missing(cell) for cell in cells)


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
        if wrong := [cell for cell in cells if not _known(cell)]:
            raise ValueError(f"{file}, line {number}: expected numbers below lines of text, got {wrong[0][:100]!r}")
        if len(cells) > width or (len(cells) < width and number != rows[-1][0]):
            raise ValueError(f"{file}, line {number}: expected {width} numbers as in the first row, got {len(cells)}")
    return [(number, [cell]) for number, cells in rows for cell in cells]


def _announced(lines: list[_Line], file: str) -> tuple[list[_Line], list[str]] | None:
    """One row per number below a line with their number and step, and title and step as comments; None without it.

    eqsig writes this line above one sample per line, RSPMatch above several ones, with at most another integer. In a
    table, the line would have as many cells as the rows.
    """
    heads = [" ".join(cells).split() for _, cells in lines[: _LAST_LINES + 1]]
    place = next((k for k, head in enumerate(heads[:-1]) if head and all(map(is_number, head))), None)
    if place is None or not 2 <= len(head := heads[place]) <= 3 or len(heads[place + 1]) == len(head):
        return None
    if not all(map(str.isdecimal, (head[0], *head[2:]))) or not _BELOW_ONE.fullmatch(head[1]):
        return None
    if not all(_known(cell) for _, cells in lines[place + 1 :] for cell in cells):
        return None
    numbers = _along_rows(lines[place + 1 :], file)
    check_count(len(numbers), head[0], f"{file}, line {lines[place][0]}")
    return numbers, [*(" ".join(cells) for _, cells in lines[: min(place, 1)]), f"dt = {head[1]} s"]


def _logger_table(lines: list[_Line], file: str) -> tuple[list[_Line], list[str]]:
    """Header line, line of units and rows of a logger program's format, and what comments would state (a step).

    Campbell Scientific TOA5 has four header lines: environment, names, units, processing (LoggerNet manual). A LabVIEW
    file (.lvm) has tags and values up to ``***End_of_Header***``, twice, a line of names that begins with ``X_Value``,
    and rows; with X_Columns "No" the cells of this column are empty, with "Multi" each channel has its own, and they
    must agree (National Instruments, "Specification for the LabVIEW Measurement File"). Other lines stay.
    """
    first = lines[0][1][0] if lines and lines[0][1] else ""
    if first == "TOA5" and len(lines) > 3:
        units = [f"[{unit}]" if unit not in ("", "TS", "RN") else "" for unit in lines[2][1]]
        return [lines[1], (lines[2][0], units), *lines[4:]], []
    if not first.startswith("LabVIEW Measurement"):
        return lines, []
    ends = [place for place, (_, cells) in enumerate(lines) if cells[0] == "***End_of_Header***"]
    if len(ends) != 2:
        raise ValueError(
            f"{file}: expected a LabVIEW file with one segment, found {max(len(ends) - 1, 0)}; write a file for each "
            "segment (option 'Overwrite file' or 'One header only')"
        )
    tags = {cells[0]: cells[1:] for _, cells in lines[: ends[1]]}
    (number, header), rows = lines[ends[1] + 1] if lines[ends[1] + 1 :] else (0, [""]), lines[ends[1] + 2 :]
    columns, axis = (next(iter(tags.get(tag, ())), "") for tag in ("X_Columns", "X_Dimension"))
    if header[0] != "X_Value" or (axis or "Time") != "Time":
        raise ValueError(
            f"{file}: expected a LabVIEW file whose first column X_Value has times, got {header[0]!r} and X_Dimension "
            f"{axis!r}; write it with times"
        )
    width = len(header) - (header[-1] == "Comment")
    labels = ["", *tags.get("Y_Unit_Label", []), *[""] * width]
    names = ["time [s]" if name == "X_Value" else name for name in header[:width]]
    units = ["s" if name == "X_Value" else label for name, label in zip(header[:width], labels, strict=False)]
    for k, (line, cells) in enumerate(rows):
        # the text in the column of comments goes; numbers in it show that a row is damaged
        if len(cells) == width + 1 and not any(map(str.isdigit, cells[-1])):
            rows[k] = line, cells[:width]
    table = [(number, names), (number, [f"[{unit}]" if unit else "" for unit in units]), *rows]
    if columns != "No":
        return table, []
    steps = sorted({cell for cell in tags.get("Delta_X", []) if cell})
    if len(steps) != 1:
        raise ValueError(f"{file}: expected one step Delta_X, got {', '.join(steps) or 'none'}; write it with times")
    return [(number, cells[1:]) for number, cells in table], [f"dt = {steps[0].replace(',', '.')} s"]


# header line and decimal marks ----------------------------------------------------------------------------------------


def _first_row(lines: Sequence[_Line]) -> tuple[int, int]:
    """Place and width of the first row that is as wide as most first rows: a number above the table is no row."""
    places = [*itertools.islice((k for k, (_, cells) in enumerate(lines) if _is_data(cells)), _LAST_LINES)]
    if not places:
        return len(lines), max((len(cells) for _, cells in lines), default=0)
    width = Counter(len(lines[k][1]) for k in places).most_common(1)[0][0]
    return next(k for k in places if len(lines[k][1]) == width), width


def _header(lines: list[_Line], file: str) -> tuple[list[str], list[str], list[_Line]]:
    """Names, units below them, and rows of equal width, without columns that have neither a name nor a number."""
    first, width = _first_row(lines)
    spare = not any(cells[-1] for _, cells in lines[first:] if len(cells) == width)
    names, below, after = _names(lines[:first], width, spare)
    if not names:
        # a damaged first row is an error and no text above the table, and a row of missing samples is a row
        after = next((k for k in range(first) if len(lines[k][1]) == width and _is_row(lines[k][1])), first)
    rows = lines[after:]
    if not rows:
        raise ValueError(f"{file}: expected rows of numbers, found none")
    for number, cells in rows:
        if len(cells) != width:
            last = not names and len(cells) < width and number == rows[-1][0] and all(map(_known, cells))
            advice = "; if the samples follow each other along the rows, give column='rows' and dt=" if last else ""
            raise ValueError(
                f"{file}, line {number}: expected {width} cells as in the first line, got {len(cells)}{advice}"
            )
    kept = [k for k in range(width) if (names and names[k]) or not all(_is_missing(cells[k]) for _, cells in rows)]
    kept = kept or [*range(width)]  # the others are empty after a separator at the end of each line
    names, below = ([each[k] for k in kept] if each else [] for each in (names, below))
    return names, below, [(number, [cells[k] for k in kept]) for number, cells in rows]


def _is_row(cells: Sequence[str]) -> bool:
    """Whether some cells are numbers, or all are missing and not all empty."""
    return any(map(_known, cells)) or (any(cells) and all(map(_is_missing, cells)))


def _names(lines: Sequence[_Line], width: int, spare: bool) -> tuple[list[str], list[str], int]:
    """Names, units and the place after them: the last line of words as wide as the rows, and a line of units below.

    Separators at the ends of the rows may be missing at the end of the header line, and the other way round. Only then,
    if the last cells of all rows are empty (`spare`), the header line may have one cell less.
    """
    found: list[tuple[int, list[str]]] = []
    for place, (_, cells) in enumerate(lines):
        words = list(cells)
        while len(words) > width and not words[-1]:
            words.pop()
        if spare and len(words) == width - 1 and width > 2:
            words.append("")
        states = width == 1 and any(read_statements(words))  # a line such as "Time step: 10 ms" names no column
        if len(words) == width and _is_text(words) and not states:
            found.append((place, words))
    if not found:
        return [], [], len(lines)
    place, last = found[-1]
    if len(found) > 1 and found[-2][0] == place - 1 and _are_units(last):
        return found[-2][1], ["" if _states_nothing(cell) else cell.strip("[]() ") for cell in last], place + 1
    return last, [], place + 1


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a line below a header line has units: all cells are units, one is a unit of time, or all are in brackets.

    Cells that are no known unit are refused when their column is read. A capital S may be the direction south.
    """
    given = [cell for cell in cells if cell]
    units = [cell.strip("[]() ") for cell in given if not _states_nothing(cell)]
    dimensions = [None if unit == "S" else dimension_of(unit) for unit in units]
    known = bool(units) and all(map(dimension_of, units))
    return "time" in dimensions or known or all(cell[0] + cell[-1] in ("()", "[]") for cell in given)


def _states_nothing(cell: str) -> bool:
    """Whether a cell in a line of units is empty, a dash or the format of a time, such as DD.MM.YYYY hh:mm:ss."""
    return not cell.strip("-\u2013") or _DATE_FORMAT.fullmatch(cell.strip("[]() ")) is not None


def _check_names(lines: Sequence[_Line], separator: str, along_rows: bool, file: str) -> None:
    """ValueError if the line above the rows has half as many names as they have cells, or one name too few.

    Commas then separate cells and decimals, or the rows have names.
    """
    first, width = _first_row(lines)
    (number, names), rows = lines[first - 1], [cells for _, cells in lines[first : first + _LAST_LINES]]
    half = separator == "," and 2 * len(names) == width and not any("." in cell for cells in rows for cell in cells)
    short = len(names) == width - 1 > 1 and any(cells[-1] for cells in rows) and not along_rows
    if first and rows and (half or short) and _is_text(names) and all(names):
        raise ValueError(
            f"{file}, line {number}: expected a name for each of the {width} cells in a row, got {len(names)}; write "
            f"decimal points, or leave out the names of rows, in R with row.names = FALSE. {_POINTS}"
        )


def _with_points(lines: list[_Line], separator: str, file: str) -> tuple[list[_Line], bool]:
    """Rows with decimal points and without separators of thousands, "" for missing cells; whether commas were decimal.

    Separators of thousands go if a number such as ``1,234.5`` or ``1.234.567`` shows which mark it is. Cells such as
    ``1,000`` have three decimals unless commas separate the cells and the file has no other decimal comma, or the
    column has no other decimal comma and integers of three digits: then they are refused.
    """
    rows = [(number, ["" if _is_missing(cell) else cell for cell in cells]) for number, cells in lines]
    alike = "write all numbers alike, without separators of thousands"

    def first(fits):
        return next(((number, cell) for number, row in rows for cell in row if fits(cell)), None)

    if shown := first(lambda cell: ("," in cell or cell.count(".") > 1) and _GROUPED.match(cell)):
        mark = next(letter for letter in shown[1] if letter in ",.")
        grouped = re.compile(rf"[-+]?[1-9]\d{{0,2}}(?:\{mark}\d{{3}})+(?:\{'.' if mark == ',' else ','}\d*)?$")
        for number, row in rows:
            for k, cell in enumerate(row):
                if mark in cell and grouped.match(cell):
                    row[k] = cell.replace(mark, "")
                elif mark in cell and _known(cell) and not (is_clock(cell) or _is_date(cell)):
                    raise ValueError(
                        f"{file}: {mark!r} separates thousands in {shown[1]!r}, line {shown[0]}, but not in {cell!r}, "
                        f"line {number}; {alike}"
                    )
    comma = first(_DECIMAL_COMMA.match)
    if comma is None:
        return rows, False
    columns = [[(number, row[k]) for number, row in rows] for k in range(len(rows[0][1]))]
    decimals = [any(_DECIMAL_COMMA.match(c) and not _THOUSANDS.match(c) for _, c in column) for column in columns]
    for column, own in zip(columns, decimals, strict=True):
        found = next((each for each in column if _THOUSANDS.match(each[1])), None)
        hundreds = not own and any(_HUNDREDS.match(cell) for _, cell in column)
        if found and (hundreds or (separator == "," and not any(decimals))):
            raise ValueError(
                f"{file}, line {found[0]}: expected a number, got {found[1]!r}, which may have a separator of "
                "thousands or a decimal comma; write it without separators of thousands and with a decimal point"
            )
    if point := first(lambda cell: "." in cell and is_number(cell)):
        raise ValueError(
            f"{file}: expected decimal points or decimal commas, got {comma[1]!r} in line {comma[0]} and {point[1]!r} "
            f"in line {point[0]}; {alike}"
        )
    return [(n, [cell.replace(",", ".") if _known(cell) else cell for cell in row]) for n, row in rows], True


# columns and units ----------------------------------------------------------------------------------------------------

_LONGEST_UNIT = 100
_SENTINELS = (-9999.0, -999.25, 1e30, 9.97e36)  # numbers that loggers and formats write for missing samples
# also used for missing samples, but plausible as measured numbers: counts, or accelerations in gal
_PLAUSIBLE_SENTINELS = (-999.0, 99999.0, -99999.0, 32767.0, -32768.0)


def _columns(
    names: list[str], below: list[str], rows: list[_Line], file: str, marks: Sequence[str], labels: str | None = None
) -> tuple[tuple[Column, ...], ClockTime | None]:
    """Columns of numbers, clock times and text, and the first clock time; `marks` are for the message."""
    columns, first, lines = [], None, [f"{file}, line {number}" for number, _ in rows]
    for k, cells in enumerate(zip(*(row for _, row in rows), strict=True)):
        filled = [cell for cell in cells if cell]
        kind, decimals, values = "number", 0, [math.nan] * len(cells)
        is_label = names and labels in (names[k], "" if k == 0 else names[k])
        if is_label and not all(map(is_number, filled)):
            kind = "text"
        elif any(map(is_clock, filled)):
            kind = "clock"
            times = [_parse_clock(cell, where) if cell else None for cell, where in zip(cells, lines, strict=True)]
            values, known = _seconds_of(times, file), [time for time in times if time is not None]
            first, decimals = first or known[0], max(time.decimals for time in known)
        elif filled and all(_is_date(cell) or _is_word(cell) for cell in filled):
            kind = "text"
        else:
            for place, (cell, where) in enumerate(zip(cells, lines, strict=True)):
                try:
                    values[place] = parse_number(cell, where) if cell else math.nan
                except ValueError as error:
                    raise ValueError(f"{error}{_advice(cell, rows[place][1], names, marks)}") from None
            decimals = max(map(decimals_of, filled), default=0)
        name, unit = names[k] if names else str(k + 1), below[k] if below else ""
        columns.append(Column(name, np.array(values), decimals, unit, kind, cells))
    return tuple(columns), first


def _advice(cell: str, row: Sequence[str], names: Sequence[str], marks: Sequence[str]) -> str:
    """How text in a row is read as a missing sample; nothing for a damaged number, and for a second header line."""
    word = _is_word(cell) or not any(map(str.isdigit, cell))
    alone = len(row) == 1 and cell not in names
    if not word or not (alone or any(map(_known, row))):
        return ""
    return f"; if it stands for a missing sample, give missing={[*marks, cell[:100]]}"


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


def stated_unit(table: Table, place: int, dimension: str | None = None) -> str | None:
    """The unit of a column as the file states it, in its name or below the header line, or None.

    With a `dimension` other than force, the N at the end of a name such as ``acc_N`` is the direction north, and an S
    is the direction south unless it is a time.
    """
    column = table.columns[place]
    end, below = column.name[-2:], column.below or None
    direction = dimension and ((end == "_N" and dimension != "force") or (end == "_S" and dimension != "time"))
    named = unit_in_name(column.name) if table.named and not direction else None
    if named is None or below is None:
        return named or below
    return agree_on_unit(
        named, below, dimension_of(below) or dimension_of(named), f"{table.file} (name and line of units)"
    )


def text_unit(table: Table, place: int, dimension: str, others: bool = False) -> str | None:
    """The unit that comments or the text above a table state for a column of a dimension, or None.

    With other units known (`others`), text that is no unit is ignored, except for counts.
    """
    places = value_columns(table)
    for _, unit in table.stated.units:
        known = dimension_of(unit)
        alone = len(places) == 1 and known != "time" and (known or not others or "count" in unit.lower())
        if alone or known == dimension:
            return unit
    if dimension != "acceleration" or others or place not in places:
        return None
    names = [table.columns[k].name for k in places]
    return next((peak.unit for peak in table.stated.peaks if peak.unit and peak.of(names, places.index(place))), None)


def column_unit(
    table: Table, place: int, values: NDArray[np.float64], given: str | None, dimension: str, where: str
) -> str:
    """The unit of a column, on which file and caller agree; a stated peak is compared with its `values`."""
    named = stated_unit(table, place, dimension)
    text = text_unit(table, place, dimension, others=named is not None or given is not None)
    stated = agree_on_unit(named, text, dimension, f"{where} (column and text)") if named or text else None
    unit = agree_on_unit(stated, given, dimension, where)
    if dimension == "acceleration" and not np.isnan(values).any():
        places, decimals = value_columns(table), table.columns[place].decimals
        names = [table.columns[k].name for k in places]
        check_peaks(table.stated.peaks, names, places.index(place), values, decimals, unit, table.file, f". {_SKIP}")
    return unit


def value_columns(table: Table) -> list[int]:
    """The places of the columns with values."""
    return [k for k, column in enumerate(table.columns) if column.kind == "number" and k != table.time]


def _listed_columns(table: Table) -> str:
    if table.named:
        return f"the columns are {', '.join(column.name for column in table.columns)}"
    return f"the columns have no names: give a number from 1 to {len(table.columns)}. {_POINTS}"


def _value_column(table: Table, column: int | str | None = None) -> int:
    """The place of the named column, or of the only column that is not the time."""
    places = value_columns(table)
    if column is not None:
        places = [place for place in places if table.columns[place].name == str(column)]
    elif not table.named and len(places) > 1:
        raise ValueError(
            f"{table.file} has {len(table.columns)} columns and no header line; write one such as 'time_s,acc_g', or "
            "give column=2 and time_unit='s' if the first column has the times, in seconds; else column=1 and the step "
            f"dt=; or column='rows' and dt= if the samples follow each other along the rows. {_POINTS}"
        )
    if len(places) != 1:
        which = f" named {column!r}" if column else "; choose it with column="
        raise ValueError(f"{table.file}: expected one column of values{which}, {_listed_columns(table)}")
    return places[0]


def column_values(table: Table, place: int) -> NDArray[np.float64]:
    """The numbers of a column, with NaN for numbers that stand for missing samples.

    ValueError for another number that usually does, unless the caller says that none does, or the number may have been
    measured: the column has other numbers within 1 % of it, or, for -999 and the limits of integers, other numbers of
    half its size, like the samples next to a measured peak.
    """
    listed, marks, stated = table.missing
    values = np.where(np.isin(table.columns[place].values, listed), np.nan, table.columns[place].values)
    for sentinel in (*_SENTINELS, *_PLAUSIBLE_SENTINELS) if listed.size or marks or not stated else ():
        found, size = np.flatnonzero(values == sentinel), abs(sentinel)
        close = sentinel in _SENTINELS
        similar = np.abs(values - sentinel) <= 0.01 * size if close else np.abs(values) >= 0.5 * size
        if found.size and np.count_nonzero(similar) == found.size:
            numbers = ", ".join([*map(repr, marks), *(f"{number:g}" for number in (*listed, sentinel))])
            raise ValueError(
                f"{table.file}, line {table.lines[found[0]]}: expected a measured number, got {sentinel:g} in "
                f"{found.size} rows, which usually stands for a missing sample; give missing=[{numbers}] to read it "
                "as NaN, or missing=[] if it was measured"
            )
    return values


def _listed(missing: Sequence[float | str] | None) -> Missing:
    """Numbers and texts that stand for missing samples; ValueError for other values, and for numbers in quotes."""
    given = [] if missing is None else [missing] if np.ndim(missing) == 0 else list(missing)
    marks = [each.strip() for each in given if isinstance(each, str)]
    numbers = [each for each in given if not isinstance(each, str)]
    quoted = any(not mark or (_known(mark) and any(map(str.isdigit, mark))) for mark in marks)
    if quoted or not all(isinstance(number, Real) and math.isfinite(number) for number in numbers):
        raise ValueError(
            f"missing must be finite numbers and texts, such as (-9999, 'OL'), or () for none; got {missing!r}"
        )
    return Missing(np.array(numbers, dtype=float), marks, missing is not None)


def table_values(
    table: Table, columns: Sequence[tuple[str | int | None, str, str | None, str]], stacklevel: int
) -> list[tuple[NDArray[np.float64], str, str]]:
    """Samples of columns (n_rows,), units and dimensions, of columns' names, dimensions, units and words for messages.

    Warns if a number for missing samples is in none of the columns, or a text in no row: the file may write it in
    another way.
    """
    found, places = [], [_value_column(table, name) for name, *_ in columns]
    for place, (_, dimension, unit, where) in zip(places, columns, strict=True):
        values = column_values(table, place)
        found.append((values, column_unit(table, place, values, unit, dimension, where), dimension))
    listed, marks, _ = table.missing
    absent = [f"{each:g}" for each in listed[~np.isin(listed, [table.columns[place].values for place in places])]]
    absent += [repr(mark) for mark in marks if mark not in table.found]
    if absent:
        warnings.warn(
            f"{table.file}: missing={', '.join(absent)} is in none of the columns that "
            "were read: check how the file writes missing samples, or leave it out",
            UserWarning,
            stacklevel=stacklevel + 1,
        )
    return found


# times ----------------------------------------------------------------------------------------------------------------

_TIME = re.compile(r"(elapsed |relative )?(t|(time|zeit|temps|tempo|tiempo)\d*)(\b|_)", re.IGNORECASE)
_STAMP = re.compile(r"(timestamp|unix|epoch)(\b|_)", re.IGNORECASE)  # times if no other column has them
_UNIX = re.compile(r"unix|epoch", re.IGNORECASE)


def _time_column(table: Table) -> int | None:
    """Place of the times: by the name of the column, else a clock, or the first column of a table without names."""
    kinds = [column.kind for column in table.columns]
    if not table.named and table.time_unit is not None and len(kinds) > 1:
        return 0
    numbers = [k for k, kind in enumerate(kinds) if kind == "number" and table.named]
    named = (k for form in (_TIME, _STAMP) for k in numbers if form.match(table.columns[k].name))
    return next(named, kinds.index("clock") if "clock" in kinds else None)


def _is_unix(seconds: float) -> bool:
    return 1e9 <= seconds < 4.2e9  # since 1970, of the years 2001 to 2103


def _time_unit(table: Table) -> float:
    """Unit of the times [s]."""
    column = table.columns[table.time]
    if column.kind == "clock":
        return 1.0
    stated = stated_unit(table, table.time)
    if stated is None and table.time_unit is None:
        # the unit in which the times are Unix times of this century
        unix = next((unit for unit in ("s", "ms", "us") if _is_unix(column.values[0] * find_unit(unit).factor)), None)
        if unix is not None and _UNIX.search(column.name):
            return find_unit(unix).factor
        hint = "" if unix is None else f" (for Unix times {unix!r} would fit the numbers)"
        raise ValueError(
            f"{table.file}: the column {column.name!r} has no unit; call it time_s or time_ms, or give time_unit={hint}"
        )
    return find_unit(agree_on_unit(stated, table.time_unit, "time", f"{table.file} (times)")).factor


def _times(table: Table) -> NDArray[np.float64]:
    """Times of the rows [s]; ValueError if some are missing, or another column has different times."""
    unit, own = _time_unit(table), table.columns[table.time]
    times = own.values * unit
    if np.isnan(times).any():
        line = table.lines[int(np.argmax(np.isnan(times)))]
        raise ValueError(f"{table.file}, line {line}: expected a time, got an empty cell or NaN; write all times")
    for place, other in enumerate(() if table.chosen or not table.named else table.columns):
        if place == table.time or other.kind != own.kind:
            continue
        by_name, stated = _TIME.match(other.name), None
        if own.kind == "number":
            stated = stated_unit(table, place)  # T may be a temperature
            if not (by_name or _STAMP.match(other.name)) or (
                (not by_name or re.match(r"t(\b|_)", other.name, re.IGNORECASE))
                if stated is None
                else dimension_of(stated) != "time"
            ):
                continue
        others_unit = unit if stated is None else find_unit(stated, "time").factor
        ahead = other.values * others_unit - times
        ahead = ahead - ahead[0] if _is_unix(abs(ahead[0])) else ahead  # a Unix time beside an elapsed one
        if not np.all(np.abs(ahead) <= max(unit * 10.0**-own.decimals, others_unit * 10.0**-other.decimals)):
            raise ValueError(
                f"{table.file}: expected one column of times, the columns {own.name!r} and {other.name!r} have "
                "different times; write one file for each of them with its columns of values, or name one, time="
            )
    return times


def row_times(table: Table, dt: float | None = None) -> NDArray[np.float64]:
    """The times of the rows [s]; ValueError if the table has none, some are missing, or `dt` is given."""
    if table.time is None or dt is not None:
        raise ValueError(
            f"{table.file}: resample is for uneven times in the file and dt for a file without times; give one of them"
        )
    return _times(table)


def _uniform_step(table: Table) -> tuple[float, float]:
    """The mean step of the times [s], and the largest error in it that rounding can cause.

    Printed times are rounded, so each may differ from a uniform grid by one unit of its last digit: half a unit because
    it is rounded, half a unit because the two ends that define the grid are rounded. If this unit is more than half a
    step, the tolerance would hide a missing sample, and it is not applied. Times that may have been stored as float32
    may differ by 2e-7 times the largest time, if this is less than a quarter of a step. Other times must be uniform
    within 1e-4 of a step and round-off.
    """
    times, column = _times(table), table.columns[table.time]
    if times.size < 2 or not times[-1] > times[0]:
        raise ValueError(
            f"{table.file}: expected times that increase over 2 rows or more, got {times.size} row(s); print the times "
            "with more digits, or leave the column out and give dt="
        )
    increments = np.diff(times)
    step, largest = float(times[-1] - times[0]) / increments.size, float(np.abs(times).max())
    digit = 10.0**-column.decimals
    rounding = digit * _time_unit(table) * (1 + 1e-6)
    with np.errstate(over="ignore"):  # whether each printed time is a float32, rounded to the printed digits
        apart = np.abs(column.values.astype(np.float32).astype(np.float64) - column.values)
    single = 2e-7 * largest if 2e-7 * largest <= 0.25 * step and np.all(apart <= 0.501 * digit) else 0.0
    # no term may reach a step, otherwise it hides lost samples if the times are large, such as Unix times
    tolerance = (rounding if rounding <= 0.501 * step else 0.0) + single
    tolerance += min(1e-4 * step + 4 * float(np.spacing(largest)), 0.1 * step)
    usual = float(np.median(increments))
    bad = np.abs(increments - usual) > tolerance
    off_grid = np.abs(times - times[0] - step * np.arange(times.size))[1:] > tolerance
    if bad.any() or off_grid.any():
        index = int(np.argmax(bad) if bad.any() else np.argmax(off_grid))
        advice = "insert rows with empty cells where the logger has missed samples, print the times with more digits"
        if increments[index] < 0.0:
            advice = "if the clock was set back, correct the later times, or leave the column of times out and give dt="
        with suppress(ValueError):
            even = uniform_times(times, None, table.file)
            advice += f", or give resample={even.step:.6g} to interpolate to a uniform step"
        raise ValueError(
            f"{table.file}, line {table.lines[index + 1]}: expected a uniform time step of about {usual:g} s, got "
            f"{increments[index]:g} s from {times[index]:g} to {times[index + 1]:g} s; {advice}"
        )
    tolerance /= increments.size
    rate = round(1 / step) if 1 / step < 1e15 else 0
    return (1 / rate if rate and abs(1 / rate - step) < min(tolerance, 1e-4 * step) else step), tolerance


def table_step(table: Table, dt: float | None = None) -> float:
    """The time step [s] of a table: from its times, the comment ``dt = ... s`` and the argument, which must agree.

    A whole number of samples per second is used where the mean step corresponds to it within the rounding of printed
    times and a relative 1e-4.
    """
    step, tolerance = (None, 0.0) if table.time is None else _uniform_step(table)
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
    if step is not None and not abs(step - chosen) <= tolerance + 1e-6 * step:
        if dt is not None:
            raise ValueError(
                f"{table.file}: the step is {chosen} s by {first} but {step} s by the time column; correct one"
            )
        first, chosen = known[-1]  # the times show a step that the text rounds
    for each in table.stated.steps:
        allowed = tolerance + (each.rounding + 1e-6) * chosen
        if not any(abs(other - chosen) <= allowed for other in each.steps):
            raise ValueError(
                f"{table.file}: the step is {chosen} s by {first} but {each.steps[0]} s by {each.text!r}; correct one, "
                "or give skip= to leave out text that is about other samples"
            )
    return chosen


def table_start(table: Table, step: float, zero: float | str = 0.0) -> float:
    """The time of the first row after `zero` [s or clock time]; a file without times begins at time zero.

    With ``zero=0``, a start within the rounding of its printed digits from a whole number of steps is set to this
    number; for another `zero`, within round-off.
    """
    if isinstance(zero, str):
        zero = _clock_zero(table, zero)
    if table.time is None:
        return 0.0 - zero
    unit, column = _time_unit(table), table.columns[table.time]
    first, digit = float(column.values[0]) * unit, unit * 10.0**-column.decimals
    start = first - zero
    rounding = 0.5 * digit * (1 + 1e-6) if zero == 0.0 else 4 * float(np.spacing(max(abs(first), abs(zero))))
    nearest = round(start / step)
    return nearest * step if abs(start - nearest * step) <= rounding + 1e-9 * step else start


def _clock_zero(table: Table, text: str) -> float:
    """The clock time `zero` in the times of the table [s]; what it does not state is as in the first row."""
    zero, first, file = _parse_clock(text, "zero"), table.clock, table.file
    column = None if table.time is None else table.columns[table.time]
    if column is None or column.kind != "clock":
        if column is None or not _is_unix(column.values[0] * _time_unit(table)):
            raise ValueError(f"{file}: zero={text!r} needs a column of clock times; give zero in seconds")
        if zero.day is None or zero.zone is None:
            raise ValueError(
                f"{file}: the times are Unix times: give zero={text!r} with date and time zone, as in "
                "'2019-07-06T03:19:53Z'"
            )
        return _DAY * (zero.day - _EPOCH) + zero.seconds - 60 * zero.zone
    if zero.day is not None and first.day is None:
        raise ValueError(f"{file}: the times have no date; give zero={text!r} without one")
    if zero.zone is not None and first.zone is None:
        raise ValueError(f"{file}: the times have no time zone; give zero={text!r} without one, as in the file")
    days = 0 if zero.day is None else zero.day - first.day
    return _DAY * days + zero.seconds - (0 if zero.zone is None else 60 * (zero.zone - first.zone))


# uneven times, from a clock with jitter or a logger that loses packets ------------------------------------------------

_GAP = 1.5  # usual steps between two samples, from which on samples are missing
_NEAR = 0.1  # usual steps from a sample, within which a time beside a gap has its value
_MOST_REPEATED = 0.05  # share of rows that repeat a time; more are the times of packets
_LARGEST_DIFFERENCE = 0.05  # relative, of the new step from the usual one


class UniformTimes(NamedTuple):
    """Times with a uniform step instead of uneven ones."""

    times: NDArray[np.float64]  # (n_samples,) uneven [s]
    step: float  # [s]
    uniform: NDArray[np.float64]  # (n_steps,) from the first uneven time on [s]
    usual: float  # mean step without gaps [s]
    gaps: NDArray[np.float64]  # (n_gaps,) lengths [s]
    note: str  # what is done, for the description of the data
    kept: NDArray[np.bool_]  # (n_rows,) samples that are used: of those with equal times the first

    def interpolate(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_steps,) at the uniform times, linear between known samples, NaN in gaps and beyond the last."""
        values = values[self.kept]
        known = np.flatnonzero(~np.isnan(values))
        if known.size == 0:
            return np.full(self.uniform.size, np.nan)
        times = self.times[known]
        after = np.searchsorted(times, self.uniform).clip(0, times.size - 1)
        before = (after - 1).clip(0)
        ahead, behind = times[after] - self.uniform, self.uniform - times[before]
        nearest = np.where(np.abs(ahead) < np.abs(behind), after, before)
        found = np.interp(self.uniform, times, values[known])
        apart = (ahead + behind > _GAP * self.usual) | (ahead < 0.0) | (behind < 0.0)
        near = np.minimum(np.abs(ahead), np.abs(behind)) <= _NEAR * self.usual
        return np.where(apart, np.where(near, values[known][nearest], np.nan), found)

    def straight(self, values: NDArray[np.float64], where: str, stacklevel: int) -> NDArray[np.float64]:
        """Values (n_steps,) at the uniform times, with straight lines over gaps and a warning about them."""
        if self.gaps.size:
            warnings.warn(
                f"{where}: {self.note}; an excitation needs all samples, so the gaps are straight lines: compare with "
                "another record of the motion if a gap is in its strong part",
                UserWarning,
                stacklevel=stacklevel + 1,
            )
        return np.interp(self.uniform, self.times, values[self.kept])


def uniform_times(times: NDArray[np.float64], step: float | None, where: str) -> UniformTimes:
    """Return times with the uniform `step` [s] from the first to the last of the given times (n_samples,) [s].

    The default step is a whole number of samples per second within 5 % of the usual step, else the usual step. Raises
    ValueError if times decrease or many repeat, more than half of the samples are missing, or the step differs from the
    usual one by more than 5 %: that would need a filter (`Record.resample`, `Measurements.decimate`). Of samples with
    equal times the first one is used.
    """
    step = None if step is None else check_step(step, f"resample of {where}")
    kept = np.concatenate([[True], np.diff(times) != 0.0])
    if 0 < (repeated := np.count_nonzero(~kept)) <= _MOST_REPEATED * times.size:
        first_repeated, times = float(times[~kept][0]), times[kept]
    else:
        repeated, kept = 0, np.ones(times.size, dtype=bool)
    increments = np.diff(times)
    if times.size < 2 or not np.all(increments > 0.0):
        place = int(np.argmax(~(increments > 0.0))) if times.size > 1 else 0
        raise ValueError(
            f"{where}: expected times that increase, got {times[min(place + 1, times.size - 1)]:.15g} s after "
            f"{times[place]:.15g} s; if the times are those of packets, leave the column of times out and give dt=; "
            "if the clock was set back, correct the later times"
        )
    usual = float(increments[increments <= _GAP * np.median(increments)].mean())
    if step is None:
        whole = 1.0 / max(round(1.0 / usual), 1) if usual > 1e-9 else usual
        step = whole if abs(whole - usual) < 0.999 * _LARGEST_DIFFERENCE * usual else usual
    if abs(step - usual) > _LARGEST_DIFFERENCE * usual:
        raise ValueError(
            f"{where}: expected the nominal step of the samples, about {usual:.4g} s, got resample={step:g}; resample "
            "the record or decimate the measurements afterwards"
        )
    gaps, others = (increments[chosen] for chosen in (increments > _GAP * usual, increments <= _GAP * usual))
    note = f"interpolated linearly to a step of {step:g} s from steps of {others.min():.4g} to {others.max():.4g} s"
    note += f", with {gaps.size} gap(s) of up to {gaps.max():.4g} s" if gaps.size else ""
    note += f", without {repeated} row(s) of a repeated time, the first at {first_repeated:g} s" if repeated else ""
    duration = times[-1] - times[0]
    if duration > 2 * times.size * step:
        raise ValueError(
            f"{where}: expected samples at most times, got {times.size} in {duration:.4g} s with a gap of "
            f"{gaps.max():.4g} s; cut the file at its long gaps"
        )
    uniform = times[0] + step * np.arange(int(duration / step + 1e-6) + 1)
    return UniformTimes(times, step, uniform, usual, gaps, note, kept)
