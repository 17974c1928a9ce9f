"""Text of files that people and programs write: its lines, its numbers and units, and what it states in words.

Readers of tables and of strong-motion formats share it. `read_statements` finds step or rate, number of samples, unit
and peak in the words of loggers and networks, which must agree with the samples.
"""

import codecs
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, UNITS, find_unit
from .sampling import expect

WORKBOOKS = (".xlsx", ".xlsm")
"""Endings of the names of Excel workbooks."""

NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
"""Regular expression for a decimal number, without alternatives for the same digits: its time is linear."""

LINE_END = re.compile(r"\r+\n|\r")
"""Regular expression for the end of a line with a carriage return, or two in a text that was transferred twice."""

_LARGEST_FILE = 256 * 2**20  # bytes of a text file or an archive; long records have some MiB
# What editors and transfers add after the last line: blank lines, ^Z (the end of a text in DOS), zero bytes as padding
_PADDING = " \t\n\f\0\x1a"
_CLOSING = re.compile(r"[^\d,;\t]{0,80}(?<![A-Za-z])(?:end|eof)[^\d,;\t]{0,80}", re.IGNORECASE)  # *** End data ***
_LAST_DECIMALS = re.compile(r"\.(\d+)([eEdD][-+]?\d+)?\s*$")


def read_bytes(path: str | Path) -> bytes:
    """The content of a file; ValueError if it cannot be read or is too large."""
    try:
        size = Path(path).stat().st_size
        expect(size <= _LARGEST_FILE, path, f"at most {_LARGEST_FILE} bytes", size, "cut the file")
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; check the path") from error


def decode_text(content: bytes) -> str:
    """The text of a file in UTF-8, UTF-16 or Latin-1, without padding and closing remarks after its last line.

    Zero bytes directly after a number are kept, so that it is refused: a crash may have cut its last digits.
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
    """The fields of a line of numbers, which blanks separate or which touch; other text stays one field.

    Numbers that touch have equally many decimals, and signs (``-1.34567-0.12345``) or one width (``12.3456100.1234``).
    """
    cells, last = line.split(), _LAST_DECIMALS.search(line)
    if last is None or all(cell.count(".") < 2 for cell in cells):
        return cells
    exponent = r"[eEdD][-+]\d{2,3}" if last[2] else ""
    fields = re.findall(rf"\s*[-+]?\d*\.\d{{{len(last[1])}}}{exponent}", line)
    split = len({len(field) for field in fields}) == 1 or all(field[0] in " \t+-" for field in fields[1:])
    return [field.strip() for field in fields] if split and "".join(fields) == line.rstrip() else cells


def _number(field: str) -> float | None:
    """The number in a field, also with an exponent of Fortran (1.0D-03), or None; digits are not grouped by "_"."""
    with suppress(ValueError):
        return None if "_" in field else float(field.lower().replace("d", "e"))
    return None


def is_number(field: str) -> bool:
    """Whether a field of a file is a number."""
    return _number(field) is not None


def parse_number(field: str, where: str) -> float:
    """The finite number in a field of a file; ValueError for anything else."""
    value = _number(field)
    if value is None or not math.isfinite(value):
        what = "a number" if value is None else "a finite number"
        clock = ", or a clock time such as '03:19:53.010' or '2019-07-06T03:19:53.010'" if ":" in field else ""
        raise ValueError(f"{where}: expected {what}{clock}, got {field[:100]!r}")
    return value


def check_count(found: int, stated: str | float, where: str, advice: str = "") -> None:
    """ValueError if a file has another number of samples than it announces."""
    if found != float(stated):
        got = f"announces {stated!s:.20} samples, the file has {found}"
        raise ValueError(f"{where} {got}; it is truncated or damaged{advice}")


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


def agree_on_unit(
    stated: str | None, given: str | None, dimension: str, file: str | Path, argument: str = "units"
) -> str:
    """The canonical name of the unit that a file states or the caller gives, by an `argument` that a message names."""
    names = [name for name in (stated, given) if name is not None]
    if not names:
        advice = f"give {argument}=, for instance {'g' if dimension == 'acceleration' else DIMENSIONS[dimension]!r}"
        raise ValueError(f"{file} does not state the unit of its {dimension}: {advice}")
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


class Statements(NamedTuple):
    """What lines of text state, in their words."""

    # words, steps [s], several if their unit is not stated, and the largest relative error of the printed number
    steps: tuple[tuple[str, tuple[float, ...], float], ...] = ()
    counts: tuple[tuple[str, str], ...] = ()  # words and number of samples
    units: tuple[str, ...] = ()
    # words, unit, and peak accelerations by the names of columns, "" for one without a name
    peaks: tuple[tuple[str, str | None, dict[str, str]], ...] = ()

    def peaks_of(self, names: Sequence[str], index: int) -> list[tuple[str, str | None, str]]:
        """Words, unit and number of peaks of one column of values: by its name, or where no name is there its place."""
        found = []
        for text, unit, printed in self.peaks:
            if any(name in printed for name in names):
                number = printed.get(names[index])
            else:
                number = [*printed.values()][index] if len(printed) == len(names) else None
            found += [] if number is None else [(text, unit, number)]
        return found


def read_statements(lines: Sequence[str], decimal_commas: bool = False) -> Statements:
    """What lines of text state; nothing for a step of zero, and for numbers of something else."""
    steps, counts, units, peaks = [], [], [], []
    for line in lines:
        line = re.sub(r"(?<=\d),(?=\d)", ".", line[:_LONGEST]) if decimal_commas else line[:_LONGEST]
        for found in (*_STEP.finditer(line), *_RATE.finditer(line)):
            number, unit, bracket = float(found["number"]), found["unit"] or "", found["bracket"]
            if is_rate := found.re is _RATE:
                stated = (unit or bracket or "").lower()
                factors = [1e3 if stated == "khz" else 1.0] if stated else [1.0, 1e3]
            else:
                stated = [each for each in (found["ending"], bracket, unit) if each and dimension_of(each) == "time"]
                factors = [find_unit(each).factor for each in stated[:1]] or [1.0, 1e-3, 1e-6] * (not bracket)
            if number > 0.0 and unit.lower() not in _LONGER and factors:
                found_steps = tuple(1.0 / (number * each) if is_rate else number * each for each in factors)
                rounding = min(0.5 * 10.0 ** -decimals_of(found["number"]) / number, _LARGEST_ROUNDING)
                steps.append((found[0].strip(), found_steps, rounding))
        counts += [(found[0][:60], found[1] or found[2]) for found in _COUNT.finditer(line)]
        units += [found[1] for found in _UNIT_LINE.finditer(line)]
        units += [each[1] for each in _UNITS_ARE.finditer(line) if dimension_of(each[1]) == "acceleration"]
        for found in _PEAK.finditer(line):
            unit, printed = found["unit"], {name.strip(): number for name, number in _NAMED.findall(found["numbers"])}
            if not printed and (plain := _PLAIN.match(found["numbers"])):
                unit, printed = unit or plain[2].rstrip(",;"), {"": plain[1]}
            unit = unit if unit and dimension_of(unit) == "acceleration" else None
            if printed and (unit or not found["any"]):  # a peak value may be no acceleration
                peaks.append((found[0].strip(), unit, printed))
    return Statements(tuple(steps), tuple(counts), tuple(units), tuple(peaks))


def check_peaks(
    peaks: Sequence[tuple[str, str | None, str]],
    values: NDArray[np.float64],
    decimals: int,
    unit: str,
    file: str,
    advice: str = "",
) -> None:
    """ValueError if a stated peak is not the peak of printed values (n_rows,), with their mean or without it."""
    factor, digit = find_unit(unit).factor, 1.01 * 10.0**-decimals
    found = [float(np.abs(each).max()) for each in (values, values - values.mean())]
    for text, stated, printed in peaks:
        known = [stated] if stated else [name for name in UNITS if UNITS[name].dimension == "acceleration"]
        ratios = np.array([find_unit(each).factor / factor for each in known])
        rounding = digit + 0.505 * ratios * 10.0 ** -decimals_of(printed)
        if not any((np.abs(each - ratios * abs(float(printed))) <= rounding).any() for each in found):
            got = f"the file states {text!r}, the samples have a peak of {found[0]:g} {unit}"
            raise ValueError(f"{file}: {got}; the unit is wrong, or the file is damaged{advice}")
