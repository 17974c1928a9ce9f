"""Columns of values of a table, with NaN for missing samples."""

import math
import warnings
from collections.abc import Sequence
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit
from .header_statements import Statements, check_peaks
from .table_times import row_times, table_step, time_column
from .tables import Table, column_names, listed_columns, named_places, stated_unit
from .text_files import Series, agree_on_unit

__all__ = ["column_values", "csv_series", "unit_of_column", "value_column", "warn_if_absent"]

_SENTINELS = (-9999.0, -999.25, 1e30, 9.97e36)  # numbers that loggers and formats write for missing samples
# also used for missing samples, but plausible as measured numbers: counts, or accelerations in gal
_PLAUSIBLE_SENTINELS = (-999.0, 99999.0, -99999.0, 32767.0, -32768.0)


def value_column(table: Table, column: int | str | None = None) -> int:
    """Return the index of the named column, or of the only column that is not the time."""
    candidates = _value_columns(table)
    if column is not None:
        places = named_places(table, column)
        candidates = [place for place in candidates if place in places]
    elif not table.names and len(candidates) > 1:
        raise ValueError(
            f"{table.file} has {table.values.shape[1]} columns and no header line; write one such as 'time_s,acc_g'"
            f", or {_proposal(table)}. Numbers with decimal commas need another separator between columns, such as ';'"
        )
    if len(candidates) != 1:
        raise ValueError(
            f"{table.file}: expected one column of values"
            + (f" named {column!r}" if column else "; choose it with column=")
            + f", {listed_columns(table)}"
        )
    return candidates[0]


def _value_columns(table: Table) -> list[int]:
    return [i for i in range(table.values.shape[1]) if i not in {time_column(table)} | table.clocks | table.dates]


def _proposal(table: Table) -> str:
    """Arguments that read a table without a header line."""
    width, plain = table.values.shape[1], "column=1 and the step dt= in seconds"
    if not table.clocks and not table.dates:
        plain += "; or column='rows' and dt= if the samples follow each other along the rows"
    try:
        table_step(table._replace(time=0, time_unit="s", stated=Statements()))
    except ValueError:
        return f"give the number of the column of values, from 1 to {width}, such as {plain}"
    choice = "column=2 and " if width > 2 else ""
    return f"give {choice}time_unit='s' if the first column has the times, in seconds; else {plain}"


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


def _text_unit(table: Table, place: int, dimension: str, others: bool) -> str | None:
    """Return the unit that comments or the text above a table state for a column of a dimension, or None.

    With other units known (`others`), text that is no unit is ignored, except for counts.
    """
    columns = _value_columns(table)
    for _, name in table.stated.units:
        known, alone = _dimension(name), len(columns) == 1
        if known == dimension or (alone and known != "time" and (known or not others or "count" in name.lower())):
            return name
    if dimension != "acceleration" or others or place not in columns:
        return None
    names, index = [column_names(table)[k] for k in columns], columns.index(place)
    return next((peak.unit for peak in table.stated.peaks if peak.unit and peak.printed_of(names, index)), None)


def _dimension(unit: str) -> str | None:
    try:
        return find_unit(unit).dimension
    except ValueError:
        return None


def unit_of_column(
    table: Table, place: int, values: NDArray[np.float64], given: str | None, dimension: str, where: str
) -> str:
    """Return the unit of a column, on which file and caller agree; a stated peak is compared with its `values`."""
    named = stated_unit(table, place, dimension)
    text = _text_unit(table, place, dimension, others=named is not None or given is not None)
    stated = agree_on_unit(named, text, dimension, f"{where} (column and text)") if named or text else None
    unit = agree_on_unit(stated, given, dimension, where)
    if dimension == "acceleration" and table.stated.peaks and not np.isnan(values).any():
        columns = _value_columns(table)
        names, advice = (
            [column_names(table)[k] for k in columns],
            ". If the text is about other samples, give skip= to leave it out",
        )
        index, decimals = columns.index(place), table.decimals[place]
        check_peaks(table.stated.peaks, names, index, values, decimals, unit, table.file, advice)
    return unit


def csv_series(
    table: Table,
    column: int | str | None = None,
    dt: float | None = None,
    units: str | None = None,
    missing: Sequence[float] | None = None,
    uneven: bool = False,
) -> Series:
    """Return one column of a table as a series, checked against what the file states (see `read_csv`)."""
    place = value_column(table, column)
    values = column_values(table, place, missing)
    unit = unit_of_column(table, place, values, units, "acceleration", table.file)
    warn_if_absent(table, [place], missing, stacklevel=4)
    absent = np.flatnonzero(np.isnan(values))
    if absent.size:
        raise ValueError(
            f"{table.file}, line {table.lines[absent[0]]}: expected a number, got an empty cell or NaN; an excitation "
            f"needs all samples, {absent.size} are missing: interpolate them, or cut the file"
        )
    title = table.comments.split("\n", 1)[0]
    if uneven:
        return Series(title, math.nan, unit, values, row_times(table, dt))
    return Series(title, table_step(table, dt), unit, values)
