"""Readers of measured responses in CSV files and Excel workbooks: histories, and tests with an imposed displacement.

They convert to SI units. Units and time step come from the file or the arguments; ValueError is raised if neither
states them or if they disagree (`fe_likelihoods.signals.table_times`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import to_si
from .channels import Channel, Measurements
from .readers import read_record, recognise_reader
from .records import DisplacementHistory
from .table_columns import column_values, unit_of_column, value_column, warn_if_absent
from .table_times import row_times, table_start, table_step
from .tables import Table, read_table
from .uneven_times import uniform_times

__all__ = ["ImposedTest", "read_columns", "read_imposed_test"]


class ImposedTest(NamedTuple):
    """A laboratory test with an imposed displacement.

    Attributes
    ----------
    history : DisplacementHistory
        The imposed displacement.
    measurements : Measurements
        The channels measured at its steps. ``measurements.dt`` is 1, one step.
    """

    history: DisplacementHistory
    measurements: Measurements


def read_columns(
    path: str | Path,
    channels: Sequence[Channel],
    columns: Sequence[str | int],
    units: str | Sequence[str] | None = None,
    dt: float | None = None,
    description: str = "",
    *,
    time: int | str | None = None,
    time_unit: str | None = None,
    skip: int | None = None,
    zero: float | str = 0.0,
    missing: Sequence[float] | None = None,
    resample: float | None = None,
) -> Measurements:
    """Read measured responses from the columns of a CSV file or workbook with a header line (see `read_csv`).

    Accelerations are also read from the files of strong-motion networks that `read_record` reads, with the numbers or
    names of their channels as `columns`, such as those of a structure in a zip archive of V2 files.

    An empty cell, ``NaN``, ``NA``, ``N/A``, ``#N/A``, ``NULL``, ``-`` or ``--`` is a missing sample.

    Parameters
    ----------
    path : str or path
        The file.
    channels : sequence of Channel
        The measured channels.
    columns : sequence of str or int
        Names of the columns in the header line, or without one their numbers, from 1; one per channel. For other files
        as `channel` of `read_record`.
    units : str or sequence of str, optional
        Unit of the numbers, one for all columns or one per column. Not needed if the names of the columns end with the
        unit (``disp_in``). If both are given, they must agree.
    dt : float, optional
        Time step [s], needed for a file without times.
    description : str, optional
        Description of the measurements.
    time : str or int, optional
        Name or number of the column of times, if it is not found, as in `read_csv`.
    time_unit : str, optional
        Unit of the times, if the column name does not end with it.
    skip : int, optional
        Number of lines above the table, if they are not found.
    zero : float or str, optional
        Time in the file at which the excitation begins [s]. For clock times, which count from midnight, it may be a
        clock time, such as ``"03:19:53.37"`` or ``"2019-07-06T03:19:53.37"``, in the time zone of the file unless it
        states another one (``"03:19:53Z"``, ``"05:19:53+02:00"``).
    missing : sequence of float, optional
        Numbers that stand for missing samples; they are read as NaN. A warning names the numbers that no column has.
        If not listed, -9999, -999.25, 1e30 and 9.97e36 are refused unless further numbers lie within 1 % of them; -999,
        99999, -99999, 32767 and -32768 unless a further number has half their size. ``()`` takes all numbers as
        measured.
    resample : float, optional
        Nominal step of uneven times [s], to which the samples are interpolated linearly, with NaN in gaps.
        The description of the measurements says what was done.

    Returns
    -------
    Measurements
        The channels. They start at the first time of the file minus `zero`, so a file that begins at 0.37 s keeps this
        time; give ``zero=0.37`` if the excitation begins with it.

    Raises
    ------
    ValueError
        If a column is missing, a unit is missing or has another dimension than its channel, the times are not uniform,
        or a cell is not a finite number.
    """
    if (reader := recognise_reader(path)) is not None:
        if not all(option is None for option in (units, dt, time, time_unit, skip, missing)):
            raise ValueError(
                f"{path}: a file for {reader} states units and times; leave units, dt, time, time_unit, skip and "
                "missing out"
            )
        return _recorded(path, channels, columns, description, zero, resample)
    table = read_table(path, skip, time_unit, time)
    values = _channel_values(table, channels, columns, units, missing)
    warn_if_absent(table, [value_column(table, column) for column in columns], missing, stacklevel=2)
    if resample is None:
        step = table_step(table, dt)
    else:
        even, step = uniform_times(row_times(table, dt), resample, table.file), resample
        values = np.array([even.interpolate(row) for row in values])
        description = ", ".join(filter(None, (description, even.note)))
    return Measurements(tuple(channels), step, values, description, table_start(table, step, zero))


def _recorded(
    path: str | Path,
    channels: Sequence[Channel],
    columns: Sequence[str | int],
    description: str,
    zero: float | str,
    resample: float | None,
) -> Measurements:
    """Measured accelerations in a file of a strong-motion network or a zip archive of such files."""
    if isinstance(columns, str) or len(channels) != len(columns):
        raise ValueError(f"expected one channel of {path} for each of {len(channels)} channels, got {columns!r}")
    if isinstance(zero, str):
        raise ValueError(f"{path} has no clock times; give zero in seconds after its first sample, got {zero!r}")
    records = []
    for channel, column in zip(channels, columns, strict=True):
        if channel.dimension != "acceleration":
            raise ValueError(
                f"{path}: accelerations are read from files of this format, and the channel {channel.name!r} is a "
                f"{channel.dimension}; leave it out, or write its samples to a CSV file"
            )
        records.append(read_record(path, column, resample=resample))
    labels = [f"{channel.name} is {record.name}" for channel, record in zip(channels, records, strict=True)]
    text = ", ".join(filter(None, (description, *labels)))
    steps, rows = [record.dt for record in records], [record.acceleration for record in records]
    return Measurements(tuple(channels), steps, rows, text, 0.0 - zero)


def read_imposed_test(
    path: str | Path,
    displacement: str,
    channels: Sequence[Channel],
    columns: Sequence[str],
    units: str | Sequence[str] | None = None,
    displacement_unit: str | None = None,
    description: str = "",
    *,
    skip: int | None = None,
    missing: Sequence[float] | None = None,
) -> ImposedTest:
    """Read a quasi-static laboratory test from a CSV file: the imposed displacement, and channels at its steps.

    Parameters
    ----------
    path : str or path
        The file.
    displacement : str
        Name of the column with the imposed displacement.
    channels : sequence of Channel
        The measured channels, as in `read_columns`.
    columns : sequence of str
        Names of the columns in the header line, one per channel.
    units : str or sequence of str, optional
        Unit of the numbers, as in `read_columns`.
    displacement_unit : str, optional
        Unit of the displacement, if the column name does not end with it.
    description : str, optional
        Description of the measurements.
    skip : int, optional
        Number of lines above the table, if they are not found.
    missing : sequence of float, optional
        As in `read_columns`.

    Returns
    -------
    ImposedTest
        The history, named after the file, and the measurements.

    Raises
    ------
    ValueError
        As `read_columns`, except for times, which the test does not have.
    """
    table = read_table(path, skip)
    imposed = Channel(displacement, "displacement", displacement_unit or "m")
    (history,) = _channel_values(table, (imposed,), (displacement,), displacement_unit, missing)
    values = _channel_values(table, channels, columns, units, missing)
    places = [value_column(table, column) for column in (displacement, *columns)]
    warn_if_absent(table, places, missing, stacklevel=2)
    measurements = Measurements(tuple(channels), 1.0, values, description)
    return ImposedTest(DisplacementHistory(Path(path).stem, history, Path(path).name), measurements)


def _channel_values(
    table: Table,
    channels: Sequence[Channel],
    columns: Sequence[str],
    units: str | Sequence[str] | None,
    missing: Sequence[float] | None,
) -> NDArray[np.float64]:
    """Return columns of a table in SI units, shape (n_channels, n_rows)."""
    given = [units] * len(columns) if units is None or isinstance(units, str) else list(units)
    if isinstance(columns, str) or not len(channels) == len(columns) == len(given):
        raise ValueError(
            f"expected one column and one unit for each of {len(channels)} channels, got columns {columns!r}, "
            f"units {units!r}; the unit of the times is given by time_unit="
        )
    rows = []
    for channel, column, unit in zip(channels, columns, given, strict=True):
        place = value_column(table, column)
        where = f"{table.file}, column {column!r}"
        values = column_values(table, place, missing)
        rows.append(to_si(values, unit_of_column(table, place, values, unit, channel.dimension, where)))
    return np.array(rows)
