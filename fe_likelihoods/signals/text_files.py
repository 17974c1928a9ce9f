"""Shared by the readers of files: bytes and text, numbers, units, and series of samples."""

import codecs
import itertools
import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, find_unit

__all__ = [
    "LARGEST_FILE",
    "LINE_END",
    "NUMBER",
    "Series",
    "agree_on_unit",
    "check_count",
    "check_peak",
    "decimals_of",
    "decode_text",
    "dimension_of",
    "is_number",
    "number_cells",
    "opening_text",
    "parse_count",
    "parse_number",
    "read_bytes",
    "read_text",
]

NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
"""Regular expression for a decimal number, without alternatives for the same digits: its time is linear."""

LARGEST_FILE = 256 * 2**20
"""Largest size of a text file or an archive [bytes]; long records have some MiB."""

LINE_END = re.compile(r"\r+\n|\r")
"""Regular expression for the end of a line with a carriage return, or two in a text that was transferred twice."""

_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# What editors and transfers add after the last line: blank lines, ^Z (the end of a text in DOS), zero bytes as padding
_PADDING = " \t\n\f\0\x1a"
_CLOSING = re.compile(r"[^\d,;\t]{0,80}(?<![A-Za-z])(?:end|eof)[^\d,;\t]{0,80}", re.IGNORECASE)  # *** End data ***
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
        if size > LARGEST_FILE:
            raise ValueError(f"{path}: expected at most {LARGEST_FILE} bytes, got {size}; cut the file")
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


def opening_text(content: bytes) -> str:
    """Return the first letters of a file in which its format is recognised; of binary files, one letter per byte."""
    start = content[:8000]
    for mark, encoding in ((codecs.BOM_UTF8, "utf-8-sig"), *((each, "utf-16") for each in _UTF_16)):
        if start.startswith(mark):
            return start.decode(encoding, errors="replace")
    return start.decode("latin-1")


def read_text(path: str | Path) -> str:
    """Return the text of a file in a format that states its number of samples; ValueError if it cannot be read."""
    return decode_text(read_bytes(path)).rstrip("\0\x1a")


def number_cells(lines: list[str]) -> list[list[str]]:
    """Return the fields of lines of numbers, which blanks separate or which touch, as in some Fortran formats.

    Numbers that touch have a decimal point each, and begin with a sign (``-12.34567-0.12345``) or end in the same
    columns of all lines (``12.34567100.12345``). Other text is one field, which is no number.
    """
    rows = [[part for field in line.split() for part in _apart(field)] for line in lines]
    if any(cell.count(".") > 1 for row in rows for cell in row):
        first = sum(cell.count(".") for cell in rows[0]) == 1  # a line that announces number and step of the others
        fields = _aligned([line.rstrip() for line in lines[first:]])
        return rows if fields is None else rows[:first] + fields
    return rows


def _apart(field: str) -> list[str]:
    """The numbers in a field that begin with a sign; the field if a part of it is no number with a decimal point."""
    parts = [field] if field.count(".") < 2 else re.split(r"(?<=[\d.])(?=[-+])", field)
    return parts if all(part.count(".") == 1 for part in parts) else [field]


def _aligned(lines: list[str]) -> list[list[str]] | None:
    """The fields of a Fortran format with three numbers or more, whose points are at equal distances; else None."""
    points = [[match.start() for match in re.finditer(r"\.", line)] for line in lines]
    most = max(points, key=len, default=[])
    if len(most) < 3 or any(found != most[: len(found)] or not found for found in points):
        return None
    width, after = most[1] - most[0], len(lines[0]) - points[0][-1]  # columns of a field, and from its point to its end
    starts = [point + after - width for point in most]
    if starts[0] < 0 or any(b - a != width for a, b in itertools.pairwise(most)):
        return None
    rows = []
    for line, found in zip(lines, points, strict=True):
        rows.append([line[start : start + width].strip() for start in starts[: len(found)]])
        if (
            len(line) != starts[len(found) - 1] + width
            or line[: starts[0]].strip()
            or not all(map(is_number, rows[-1]))
        ):
            return None
    return rows


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


def check_peak(found: float, stated: float, tolerance: float, where: str) -> None:
    """Raise ValueError if the stated peak is not the peak of the samples."""
    if not abs(found - stated) <= tolerance:
        raise ValueError(
            f"{where}: the header states a peak of {stated:g}, the samples have {found:g}; the file is damaged, or of "
            "another form than the one that is read here"
        )


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
