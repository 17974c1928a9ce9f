"""Tables of numbers in text files and workbooks: columns with names and units.

Times of the rows are read by `fe_likelihoods.signals.table_times`, columns of values by
`fe_likelihoods.signals.table_columns`. Only times are converted to SI units.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit
from .clock_times import ClockTime, is_clock, is_date, parse_clock, seconds_since_midnight
from .header_statements import Statements, read_statements
from .table_rows import read_rows
from .text_files import agree_on_unit, decimals_of, is_number, parse_number

__all__ = ["Table", "column_names", "column_unit", "listed_columns", "named_places", "read_table", "stated_unit"]

_LONGEST_UNIT = 100


class Table(NamedTuple):
    """Columns of numbers in a text file."""

    file: str  # for messages
    names: tuple[str, ...]  # empty without a header line
    values: NDArray[np.float64]  # (n_rows, n_columns)
    lines: tuple[int, ...]  # line numbers of the rows
    decimals: tuple[int, ...]  # most digits printed after the decimal point, per column
    comments: str
    units: tuple[str, ...]  # below the header line, "" per column without them
    time_unit: str | None = None  # as given by the caller
    clocks: frozenset[int] = frozenset()  # columns of clock times [s since the midnight before the first]
    dates: frozenset[int] = frozenset()  # columns of dates or text, such as a logger's state, without values
    clock: ClockTime | None = None  # the first clock time
    time: int | None = None  # column of times, as given by the caller
    stated: Statements = Statements()  # what comments and the text above state


def read_table(
    path: str | Path,
    skip: int | None = None,
    time_unit: str | None = None,
    time: int | str | None = None,
    along_rows: bool = False,
) -> Table:
    """Read columns of numbers from a text file or an Excel workbook, with NaN for missing cells.

    Separators are commas, semicolons, tabs or blanks; text above the table (`skip` lines, None finds them), a header
    line and a line of units are optional; lines with ``#`` are comments. `time` is the name or number of the column of
    times, by default found; with `time_unit`, the first column of a file without a header line has them. Raises
    ValueError if the file cannot be read, has no rows or rows of different length, has a cell that is no finite number,
    or states another number of samples.
    """
    file, rows = str(path), read_rows(path, skip, along_rows)
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
        elif any(cell for cell, _ in cells) and all(not cell or is_date(cell) or _is_word(cell) for cell, _ in cells):
            dates.add(column)
            values[:, column] = np.nan
            decimals.append(0)
        else:
            values[:, column] = [parse_number(cell, where) if cell else np.nan for cell, where in cells]
            decimals.append(max(decimals_of(cell) for cell, _ in cells))
    lines = tuple(number for number, _ in rows.cells)
    units = rows.units or ("",) * width
    numbers = rows.names, values, lines, tuple(decimals), "\n".join(rows.comments), units, time_unit
    stated = read_statements([*rows.comments, *rows.above])
    for text, count in stated.counts:
        if len(values) != count:
            raise ValueError(
                f"{file}: {text!r} announces {count} samples, the file has {len(values)}; it is truncated or damaged. "
                "If the text is about other samples, give skip= to leave it out"
            )
    table = Table(file, *numbers, frozenset(clocks), frozenset(dates), clock, None, stated)
    return table if time is None else table._replace(time=_time_place(table, time))


def _time_place(table: Table, time: int | str) -> int:
    places = [place for place in named_places(table, time) if place not in table.dates]
    if len(places) != 1:
        raise ValueError(
            f"{table.file}: expected one column of times with time={time!r}, found {len(places)}; "
            f"{listed_columns(table)}"
        )
    return places[0]


def column_names(table: Table) -> tuple[str, ...]:
    """Names of the columns, without a header line their numbers, from 1."""
    return table.names or tuple(str(k + 1) for k in range(table.values.shape[1]))


def named_places(table: Table, column: int | str) -> list[int]:
    """Columns with a name, or without a header line with a number, from 1."""
    return [place for place, name in enumerate(column_names(table)) if name == str(column)]


def listed_columns(table: Table) -> str:
    """The names of the columns, for messages."""
    if table.names:
        return f"the columns are {', '.join(table.names)}"
    return (
        f"the columns have no names: give a number from 1 to {table.values.shape[1]}. Numbers with decimal commas need "
        "another separator between columns, such as ';'"
    )


def _is_word(cell: str) -> bool:
    """Whether a cell is text that is no number: also inf is one."""
    return cell[0] not in "+-.,0123456789" and not is_number(cell)


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
