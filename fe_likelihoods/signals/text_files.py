"""Shared by the readers of text files: reading, numbers, units and series of samples."""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, find_unit

__all__ = [
    "LARGEST_FILE",
    "NUMBER",
    "Series",
    "agree_on_unit",
    "check_count",
    "check_peak",
    "decimals_of",
    "fixed_width_samples",
    "is_number",
    "parse_count",
    "parse_number",
    "read_bytes",
    "read_text",
]

NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
"""Regular expression for a decimal number, without alternatives for the same digits: its time is linear."""

LARGEST_FILE = 256 * 2**20
"""Largest size of a text file or an archive [bytes]; long records have some MiB."""


_FORTRAN_EXPONENT = re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)")  # the letter of double precision


class Series(NamedTuple):
    """Samples as they are in a file, before any conversion.

    Attributes
    ----------
    title : str
        Title in the file, or an empty string.
    dt : float
        Time step [s].
    unit : str or None
        Unit of the values as the file states it, None if it does not.
    values : ndarray, shape (n_steps,)
        The samples, in `unit`.
    times : ndarray, shape (n_steps,), or None
        Times of the samples [s], if they are uneven; `dt` is then NaN.
    """

    title: str
    dt: float
    unit: str | None
    values: NDArray[np.float64]
    times: NDArray[np.float64] | None = None


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file; raise ValueError if it cannot be read or is too large."""
    try:
        size = Path(path).stat().st_size
        if size > LARGEST_FILE:
            raise ValueError(f"{path}: expected at most {LARGEST_FILE} bytes, got {size}; cut the file")
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; check the path") from error


def read_text(path: str | Path) -> str:
    """Return the text of a file; raise ValueError if it cannot be read."""
    return read_bytes(path).decode("latin-1")  # decodes every byte; the formats read here are plain ASCII


def agree_on_unit(stated: str | None, given: str | None, dimension: str, file: str | Path) -> str:
    """Return the canonical name of the unit that a file states, or that the caller gives.

    Parameters
    ----------
    stated : str or None
        Unit in the file.
    given : str or None
        Unit given by the caller.
    dimension : str
        Dimension of the quantity.
    file : str or path
        The file, for messages.

    Returns
    -------
    str
        The unit.

    Raises
    ------
    ValueError
        If both are None, the two disagree, or a unit is unknown or of another dimension.
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


def fixed_width_samples(
    lines: list[str], start: int, count: int, form: tuple[int, int], file: str, first: int = 1
) -> NDArray[np.float64]:
    """Return samples in Fortran columns, which may touch; raise ValueError if a line has too few or too many.

    Parameters
    ----------
    lines : list of str
        Lines of a file, or of a part of it.
    start : int
        Index of the line with the first sample.
    count : int
        Number of samples.
    form : (int, int)
        Numbers per line, and columns per number.
    file : str
        The file, for messages.
    first : int
        Number of the first of the lines in the file.

    Returns
    -------
    ndarray, shape (count,)
    """
    per_line, width = form
    values: list[float] = []
    for k in range(start, start - (-count // per_line)):
        line, where = (lines[k].rstrip() if k < len(lines) else ""), f"{file}, line {first + k}"
        wanted = min(per_line, count - len(values))
        if math.ceil(len(line) / width) != wanted:
            raise ValueError(
                f"{where}: expected {wanted} numbers of {width} columns after {len(values)} of {count} samples, got "
                f"{math.ceil(len(line) / width)}; the file is truncated or damaged"
            )
        values += [parse_number(line[i * width : (i + 1) * width].strip(), where) for i in range(wanted)]
    if len(values) < 2:
        raise ValueError(f"{file}: expected two samples or more, the file announces {count}")
    return np.array(values)


def decimals_of(field: str) -> int:
    """Return how many digits after the decimal point the number in a field has, less than zero for 1e3."""
    digits = field.partition(".")[2]
    if digits.isdecimal():  # most fields
        return len(digits)
    mantissa, _, exponent = field.lower().replace("d", "e").partition("e")
    power = int(exponent or 0) if len(exponent) < 6 else 0  # a larger exponent belongs to zero
    return min(max(len(mantissa.partition(".")[2]) - power, -300), 300)


def is_number(field: str) -> bool:
    """Return whether a field of a file is a number."""
    try:
        _as_float(field)
    except ValueError:
        return False
    return True


def parse_count(digits: str, where: str) -> int:
    """Return a number of samples, channels or columns; raise ValueError for more than 12 digits."""
    if len(digits) > 12:
        raise ValueError(f"{where}: expected a count, got a number with {len(digits)} digits")
    return int(digits)


def _as_float(field: str) -> float:
    """A number, also with an exponent of Fortran (1.0D-03); ValueError for digits grouped by underscores."""
    if "_" in field:
        raise ValueError
    try:
        return float(field)
    except ValueError:
        return float(_FORTRAN_EXPONENT.sub("e", field))
