"""Columns of values of a table, with NaN for missing samples."""

import math
import re
import warnings
from collections.abc import Sequence
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from .table_times import row_times, table_step, time_column
from .tables import Table, stated_unit
from .text_files import Series, agree_on_unit, check_count, parse_count

__all__ = ["column_values", "csv_series", "value_column", "warn_if_absent"]

_SENTINELS = (-9999.0, -999.25, 1e30, 9.97e36)  # numbers that loggers and formats write for missing samples
# also used for missing samples, but plausible as measured numbers: counts, or accelerations in gal
_PLAUSIBLE_SENTINELS = (-999.0, 99999.0, -99999.0, 32767.0, -32768.0)


def value_column(table: Table, column: str | None = None) -> int:
    """Return the index of the named column, or of the only column that is not the time."""
    n_other = len({time_column(table)} - {None} | table.clocks | table.dates)
    if not table.names and table.values.shape[1] - n_other > 1:
        raise ValueError(
            f"{table.file} has {table.values.shape[1]} columns and no header line; write one such as 'time_s,acc_g'"
            ", or give time_unit= if there are two columns, times and values. Numbers with decimal commas need another "
            "separator between columns, such as ';'"
        )
    candidates = [i for i in range(table.values.shape[1]) if i not in {time_column(table)} | table.clocks | table.dates]
    if column is not None:
        candidates = [i for i in candidates if table.names and table.names[i] == column]
    if len(candidates) != 1:
        raise ValueError(
            f"{table.file}: expected one column of values"
            + (f" named {column!r}" if column else "; choose it with column=")
            + f", the columns are {', '.join(table.names) or 'not named'}"
        )
    return candidates[0]


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
    table: Table,
    column: str | None = None,
    dt: float | None = None,
    missing: Sequence[float] | None = None,
    uneven: bool = False,
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
    unit = unit or (comment and comment[1])
    if uneven:
        return Series(title, math.nan, unit, values, row_times(table, dt))
    return Series(title, table_step(table, dt), unit, values)
