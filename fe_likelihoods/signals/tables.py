"""Tables of numbers in text files: CSV with comments, an optional header line, and times.

The functions return plain numbers, with the units and the step that the file states. They convert nothing but times.
"""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit, to_si
from .text_files import NUMBER, Series, agree_on_unit, check_count, is_number, parse_count, parse_number, read_text

__all__ = ["Table", "column_unit", "csv_series", "read_table", "table_step", "value_column"]

_LONGEST_UNIT = 100


class Table(NamedTuple):
    """Columns of numbers of a text file.

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
    """

    file: str
    names: tuple[str, ...]
    values: NDArray[np.float64]
    lines: tuple[int, ...]
    decimals: tuple[int, ...]
    comments: str


def read_table(path: str | Path) -> Table:
    """Read columns of numbers from a text file.

    Columns are separated by commas, or by blanks in lines without commas. A header line is optional. Lines that start
    with ``#`` are comments.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    Table
        The columns.

    Raises
    ------
    ValueError
        If the file cannot be read, has no rows, has rows of different length, or a cell is not a finite number.
    """
    file = str(path)
    rows: list[tuple[int, list[str]]] = []
    comments = []
    names: tuple[str, ...] = ()
    for number, line in enumerate(read_text(path).removeprefix("\xef\xbb\xbf").splitlines(), 1):
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip("# \t"))
        elif line.strip():
            try:
                cells = next(csv.reader([line], skipinitialspace=True)) if "," in line else line.split()
            except csv.Error as error:
                raise ValueError(f"{file}, line {number}: expected cells separated by commas ({error})") from None
            cells = [cell.strip() for cell in cells]
            if not rows and not names and not any(is_number(cell) for cell in cells):
                names = tuple(cells)
            else:
                rows.append((number, cells))
    if not rows:
        raise ValueError(f"{file}: expected rows of numbers, found none")
    first = names or rows[0][1]
    width = len(first)
    advice = "; separate cells by commas (the first line contains ';')" if ";" in "".join(first) else ""
    for number, cells in rows:
        if len(cells) != width:
            raise ValueError(
                f"{file}, line {number}: expected {width} cells as in the first line, got {len(cells)}{advice}"
            )
    try:
        values = np.array([[parse_number(cell, f"{file}, line {number}") for cell in cells] for number, cells in rows])
    except ValueError as error:
        raise ValueError(f"{error}{advice}") from None
    decimals = tuple(max(_decimals(cells[i]) for _, cells in rows) for i in range(width))
    return Table(file, names, values, tuple(number for number, _ in rows), decimals, "\n".join(comments))


def value_column(table: Table, column: str | None = None) -> int:
    """Return the index of the named column, or of the only column that is not the time."""
    if not table.names and table.values.shape[1] > 1:
        raise ValueError(
            f"{table.file} has {table.values.shape[1]} columns and no header line; write one such as 'time_s,acc_g'"
        )
    candidates = [i for i in range(table.values.shape[1]) if i != _time_column(table)]
    if column is not None:
        candidates = [i for i in candidates if table.names and table.names[i] == column]
    if len(candidates) != 1:
        raise ValueError(
            f"{table.file}: expected one column of values"
            + (f" named {column!r}" if column else "; choose it with column=")
            + f", the columns are {', '.join(table.names) or 'not named'}"
        )
    return candidates[0]


def column_unit(name: str) -> str | None:
    """Return the unit at the end of a column name (``acc_cm_s2``, ``force [kip]``, ``disp (in)``), or None."""
    name = name[-_LONGEST_UNIT:]
    bracket = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    parts = name.split("_")
    for text in [bracket[1]] if bracket else ["_".join(parts[i:]) for i in range(1, len(parts))]:
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
    Printed times are rounded, so each may differ from a uniform grid by one unit of its last digit: half a unit for
    its own rounding, half a unit for the rounding of the two ends that define the grid. If that unit is more than half
    a step, this tolerance would hide a missing sample, and the times must be exact to 2e-7 of the last one, the
    precision of float32. If, within the rounding and within 1e-4 of it, the mean step corresponds to a whole number of
    samples per second, that number is used.
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


def csv_series(table: Table, column: str | None = None, dt: float | None = None) -> Series:
    """Return one column of a table as a series, checked against the comments (see `fe_likelihoods.read_csv`)."""
    place = value_column(table, column)
    stated = re.search(r"\bnpts\s*=\s*(\d+)", table.comments)
    if stated:
        where = f"{table.file}: npts in the comments"
        check_count(len(table.values), parse_count(stated[1], where), where)
    comment = re.search(r"\bunits:\s*([^\s;,]+)", table.comments)
    unit = column_unit(table.names[place]) if table.names else None
    if comment and unit is not None:
        unit = agree_on_unit(unit, comment[1], find_unit(unit).dimension, f"{table.file} (column and comment)")
    title = table.comments.split("\n", 1)[0]
    return Series(title, table_step(table, dt), unit or (comment and comment[1]), table.values[:, place])


def _time_column(table: Table) -> int | None:
    return next((i for i, name in enumerate(table.names) if re.match(r"t(ime)?(\b|_)", name.lower())), None)


def _uniform_step(table: Table, place: int) -> tuple[float, float]:
    """Return the mean step of a column of times [s] and the largest error that their rounding can cause in it."""
    unit = column_unit(table.names[place])
    if unit is None:
        raise ValueError(f"{table.file}: the column {table.names[place]!r} has no unit; call it time_s or time_ms")
    times = to_si(table.values[:, place], unit, "time")
    if times.size < 2 or not times[-1] > times[0]:
        raise ValueError(f"{table.file}: expected times that increase over 2 rows or more, got {times.size} row(s)")
    increments = np.diff(times)
    step = float(times[-1] - times[0]) / increments.size
    rounding = float(to_si(10.0 ** -table.decimals[place], unit)) * (1 + 1e-6)
    tolerance = 2e-7 * float(np.abs(times).max()) + (rounding if rounding <= 0.501 * step else 0.0)
    usual = float(np.median(increments))
    bad = np.abs(increments - usual) > tolerance
    off_grid = np.abs(times - times[0] - step * np.arange(times.size))[1:] > tolerance
    if bad.any() or off_grid.any():
        index = int(np.argmax(bad) if bad.any() else np.argmax(off_grid))
        raise ValueError(
            f"{table.file}, line {table.lines[index + 1]}: expected a uniform time step of about {usual:g} s, got "
            f"{increments[index]:g} s from {times[index]:g} to {times[index + 1]:g} s; interpolate to a uniform step, "
            f"or print the times with more digits"
        )
    tolerance /= increments.size
    rate = round(1 / step) if 1 / step < 1e15 else 0
    if rate and abs(1 / rate - step) < min(tolerance, 1e-4 * step):
        step = 1 / rate
    return step, tolerance


def _decimals(field: str) -> int:
    mantissa, _, exponent = field.lower().partition("e")
    power = int(exponent or 0) if len(exponent) < 6 else 0  # a larger one is that of zero
    return min(max(len(mantissa.partition(".")[2]) - power, -300), 300)
