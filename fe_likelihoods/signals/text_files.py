"""Shared by the readers of files: bytes and text, numbers, units, and series of samples."""

import codecs
import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, find_unit

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
