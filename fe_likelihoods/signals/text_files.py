"""Shared by the readers of files: bytes and text, numbers, units, and series of samples."""

import codecs
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, UNITS, find_unit, to_si

__all__ = [
    "LINE_END",
    "NUMBER",
    "Series",
    "agree_on_unit",
    "check_count",
    "decimals_of",
    "decode_text",
    "dimension_of",
    "is_number",
    "number_cells",
    "parse_count",
    "parse_number",
    "read_bytes",
    "read_text",
]

NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
"""Regular expression for a decimal number, without alternatives for the same digits: its time is linear."""

_LARGEST_FILE = 256 * 2**20  # bytes of a text file or an archive; long records have some MiB

LINE_END = re.compile(r"\r+\n|\r")
"""Regular expression for the end of a line with a carriage return, or two in a text that was transferred twice."""

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# What editors and transfers add after the last line: blank lines, ^Z (the end of a text in DOS), zero bytes as padding
_PADDING = " \t\n\f\0\x1a"
_CLOSING = re.compile(r"[^\d,;\t]{0,80}(?<![A-Za-z])(?:end|eof)[^\d,;\t]{0,80}", re.IGNORECASE)  # *** End data ***
_LAST_DECIMALS = re.compile(r"\.(\d+)([eEdD][-+]?\d+)?\s*$")
_FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)")  # the letter of double precision


class Series(NamedTuple):
    """Samples (n_steps,) as they are in a file, before any conversion; unit None if the file states none."""

    title: str
    dt: float  # [s], NaN with uneven times
    unit: str | None
    values: NDArray[np.float64]
    times: NDArray[np.float64] | None = None  # [s], if they are uneven


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file; raise ValueError if it cannot be read or is too large."""
    try:
        size = Path(path).stat().st_size
        if size > _LARGEST_FILE:
            raise ValueError(f"{path}: expected at most {_LARGEST_FILE} bytes, got {size}; cut the file")
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; check the path") from error


def decode_text(content: bytes) -> str:
    """Return the text of a file without padding and closing remarks after its last line.

    The text is UTF-8 or UTF-16 with a byte-order mark, UTF-8 where it is valid, else Latin-1. A line such as ``*** End
    data ***`` is a closing remark: it has no number, and no separator of cells. Zero bytes directly after a number are
    kept, so that this number is refused: a table that a crash has cut and padded may have lost its last digits.
    """
    try:
        text = content.decode("utf-8-sig") if not content.startswith(_UTF_16) else content.decode("utf-16", "replace")
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


def read_text(path: str | Path) -> str:
    """Return the text of a file in a format that states its number of samples; ValueError if it cannot be read."""
    return decode_text(read_bytes(path)).rstrip("\0\x1a")


def number_cells(line: str) -> list[str]:
    """Return the fields of a line of numbers, which blanks separate or which touch, as in some Fortran formats.

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


def dimension_of(unit: str) -> str | None:
    """Return the dimension of a unit, or None for other text."""
    try:
        return find_unit(unit).dimension
    except ValueError:
        return None


def agree_on_unit(stated: str | None, given: str | None, dimension: str, file: str | Path) -> str:
    """Return the canonical name of the unit that a file states or the caller gives.

    Raises ValueError if both are None, they disagree, or a unit is unknown or of another dimension.
    """
    names = [name for name in (stated, given) if name is not None]
    if not names:
        example = "g" if dimension == "acceleration" else DIMENSIONS[dimension]
        raise ValueError(f"{file} does not state the unit of its {dimension}: give units=, for instance {example!r}")
    try:
        units = [find_unit(name, dimension) for name in names]
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if any(unit.factor != units[0].factor for unit in units):
        raise ValueError(f"{file} states the unit {stated!r} but units = {given!r} was given; correct one of them")
    return units[0].name


def check_count(found: int, stated: int, where: str) -> None:
    """Raise ValueError if a file has another number of samples than it announces."""
    if found != stated:
        raise ValueError(f"{where} announces {stated} samples, the file has {found}; it is truncated or damaged")


def _as_float(field: str) -> float:
    """A number, also with an exponent of Fortran (1.0D-03); ValueError for digits grouped by underscores."""
    if "_" in field:
        raise ValueError
    try:
        return float(field)
    except ValueError:
        return float(_FORTRAN_EXPONENT.sub("e", field))


def is_number(field: str) -> bool:
    """Return whether a field of a file is a number."""
    try:
        _as_float(field)
    except ValueError:
        return False
    return True


def parse_number(field: str, where: str) -> float:
    """Return the finite number in a field of a file; raise ValueError for anything else."""
    try:
        value = _as_float(field)
    except ValueError:
        clock = ", or a clock time such as '03:19:53.010' or '2019-07-06T03:19:53.010'" if ":" in field else ""
        raise ValueError(f"{where}: expected a number{clock}, got {field[:100]!r}") from None
    if not math.isfinite(value):
        raise ValueError(f"{where}: expected a finite number, got {field[:100]!r}")
    return value


def parse_count(digits: str, where: str) -> int:
    """Return a number of samples, channels or columns; raise ValueError for more than 12 digits."""
    if len(digits) > 12:
        raise ValueError(f"{where}: expected a count, got a number with {len(digits)} digits")
    return int(digits)


def decimals_of(field: str) -> int:
    """Return how many digits after the decimal point the number in a field has, less than zero for 1e3."""
    digits = field.partition(".")[2]
    if digits.isdecimal():  # most fields
        return len(digits)
    mantissa, _, exponent = field.lower().replace("d", "e").partition("e")
    power = int(exponent or 0) if len(exponent) < 6 else 0  # a larger exponent belongs to zero
    return min(max(len(mantissa.partition(".")[2]) - power, -300), 300)


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

    def fits(self, step: float, tolerance: float = 0.0) -> bool:
        """Whether a step [s] is the stated one within the printed digits, and a tolerance [s]."""
        return any(abs(each - step) <= tolerance + (self.rounding + 1e-6) * step for each in self.steps)


class StatedPeak(NamedTuple):
    """Peak accelerations, in the words of a file."""

    text: str
    unit: str | None
    printed: dict[str, str]  # by the name of the column, "" for a peak without name

    def printed_of(self, names: Sequence[str], index: int) -> str | None:
        """The number for one of the columns of values: by its name, or where no name is there by its place."""
        if any(name in self.printed for name in names):
            return self.printed.get(names[index])
        return list(self.printed.values())[index] if len(self.printed) == len(names) else None


class Statements(NamedTuple):
    """What lines state: steps, and the words and values of sample counts, units and peaks."""

    steps: tuple[StatedStep, ...] = ()
    counts: tuple[tuple[str, int], ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    peaks: tuple[StatedPeak, ...] = ()


def read_statements(lines: Sequence[str], decimal_commas: bool = False) -> Statements:
    """Return what lines of text state."""
    steps, counts, units, peaks = [], [], [], []
    for line in lines:
        line = re.sub(r"(?<=\d),(?=\d)", ".", line[:_LONGEST]) if decimal_commas else line[:_LONGEST]
        steps += [
            _stated_step(match, rate) for form, rate in ((_STEP, False), (_RATE, True)) for match in form.finditer(line)
        ]
        counts += [(match[0], parse_count(match[1] or match[2], match[0][:60])) for match in _COUNT.finditer(line)]
        units += [(match[0], match[1]) for match in _UNIT_LINE.finditer(line)]
        units += [
            (match[0], match[1]) for match in _UNITS_ARE.finditer(line) if dimension_of(match[1]) == "acceleration"
        ]
        peaks += [_stated_peak(match) for match in _PEAK.finditer(line)]
    return Statements(tuple(filter(None, steps)), tuple(counts), tuple(units), tuple(filter(None, peaks)))


def _stated_step(match: re.Match[str], rate: bool) -> StatedStep | None:
    """A step, or the step of a rate; None for zero, and for a number of something else."""
    number, unit, bracket = float(match["number"]), match["unit"] or "", match["bracket"]
    if not number > 0.0 or unit.lower() in _LONGER:
        return None
    if rate:
        stated = (unit or bracket or "").lower()
        factors = [1e3 if stated == "khz" else 1.0] if stated else [1.0, 1e3]
        steps = tuple(1.0 / (number * factor) for factor in factors)
    else:
        stated = [each for each in (match["ending"], bracket, unit) if each and dimension_of(each) == "time"]
        if bracket and not stated:  # brackets around something else
            return None
        factors = [find_unit(each).factor for each in stated[:1]] or [1.0, 1e-3, 1e-6]
        steps = tuple(number * factor for factor in factors)
    rounding = 0.5 * 10.0 ** -decimals_of(match["number"]) / number
    return StatedStep(match[0].strip(), steps, min(rounding, _LARGEST_ROUNDING))


def _stated_peak(match: re.Match[str]) -> StatedPeak | None:
    """Peaks by name, or one without; None for other text, and a value that may be no acceleration."""
    unit, printed = match["unit"], {name.strip(): number for name, number in _NAMED.findall(match["numbers"])}
    if not printed and (plain := _PLAIN.match(match["numbers"])):
        unit, printed = unit or plain[2].rstrip(",;"), {"": plain[1]}
    unit = unit if unit and dimension_of(unit) == "acceleration" else None
    return StatedPeak(match[0].strip(), unit, printed) if printed and (unit or not match["any"]) else None


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
    """Raise ValueError if a stated peak is not the peak of a column, with its mean or without it.

    The column is number `index` of `names`, with printed values (n_rows,) without missing ones; `advice` ends the
    message.
    """
    factor, digit = float(to_si(1.0, unit)), 1.01 * 10.0**-decimals
    found = [float(np.abs(each).max()) for each in (values, values - values.mean())]
    for peak in peaks:
        printed = peak.printed_of(names, index)
        known = [peak.unit] if peak.unit else [name for name in UNITS if UNITS[name].dimension == "acceleration"]
        ratios = [float(to_si(1.0, each)) / factor for each in known]
        if printed is not None and not any(
            abs(each - ratio * abs(float(printed))) <= digit + 0.505 * ratio * 10.0 ** -decimals_of(printed)
            for each in found
            for ratio in ratios
        ):
            raise ValueError(
                f"{file}: the file states {peak.text!r}, the samples have a peak of {found[0]:g} {unit}; the unit is "
                f"wrong, or the file is damaged{advice}"
            )
