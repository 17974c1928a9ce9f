"""Readers of ground motions and measured responses: files of strong-motion networks, CSV files, Excel workbooks.

`read_record` and `read_columns` recognise the format. Everything is converted to SI units. Unit and time step come from
the file or the arguments; ValueError is raised if neither states them or if they disagree.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..units import to_si
from .channels import Channel, Measurements
from .records import Record
from .sampling import expect, uniform_times
from .strong_motion import OF_OBSPY, Series, read_series, recognise
from .tables import read_table
from .text_files import WORKBOOKS, agree_on_unit

_TABLES = ("", ".csv", ".txt", ".dat", ".tsv", ".lvm", ".out", *WORKBOOKS)


def read_record(
    path: str | Path,
    column: int | str | None = None,
    units: str | None = None,
    missing: Sequence[float | str] | None = None,
    resample: float | None = None,
    *,
    dt: float | None = None,
    time: int | str | None = None,
    time_unit: str | None = None,
    skip: int | None = None,
    inventory: str | Path | None = None,
) -> Record:
    """Read a ground motion from a file in any supported format, which is recognised by the first lines.

    The formats are PEER AT2, CSMIP and COSMOS V1 and V2, USGS SMC, GeoNet, K-NET and KiK-net, ESM and ITACA; miniSEED,
    SAC and GSE2 by the package obspy; CSV files with a header line such as ``time_s,acc_g``, and Excel workbooks.

    In tables, commas, semicolons, tabs or blanks separate cells. Decimal commas are read where commas do not separate.
    The unit is the suffix of the column name (``acc_g``, ``acc_cm_s2``, ``acc [m/s²]``, ``acc, g``), a cell in a line
    of units below the header line, the comment ``# units: g``, or `units`; if several are given, they must agree. Times
    must be uniform within the rounding of the printed digits. The first sample of the record is at time zero.

    What comments and the text above a table state is used, and must agree with the arguments and the samples: step or
    rate (``# dt = 0.02 s``, ``Sampling rate: 200 Hz``), number of samples (``npts = 1559``), unit and peak acceleration
    (``PGA (gal): 312.8``). Samples below a line with their number and step, as of eqsig and RSPMatch, are read.

    Parameters
    ----------
    path : str or path
        A file, or a zip archive of CSMIP and COSMOS V2 files. Archives may contain archives; V1 files in them, which
        are uncorrected, are read if there are no V2 files. Lines of a table that start with ``#`` are comments.
    column : int or str, optional
        Where there are several: name of the column in a table, or its number from 1 without a header line, and
        ``"rows"`` for numbers without a header line row after row, as those of the Fortran format ``8F10.5``. Number of
        a channel at the station, or end of the name of a file in the archive, ``"Free Field.zip/CHAN012.V2"`` (V2);
        component such as ``"S16W"`` (GeoNet); end of the name of a trace such as ``"HNZ"`` (miniSEED).
    units : str, optional
        Unit of the acceleration, if an AT2, CSV, miniSEED or SAC file does not state it.
    missing : sequence of float or str, optional
        Numbers and texts, such as ``"OL"``, in a table that stand for missing samples; they are read as NaN, which an
        excitation must not have. A warning names those that are not there. If not listed, -9999, -999.25, 1e30 and
        9.97e36 are refused unless further numbers lie within 1 % of them; -999, 9999, ±99999, 32767 and -32768 unless
        a further number has half their size. ``()`` takes all numbers as measured.
    resample : float, optional
        Nominal step of uneven times [s], to which the samples are interpolated linearly. The source of the record says
        what was done, and a warning names gaps, which are filled by straight lines.
    dt : float, optional
        Time step [s], needed for a file without times.
    time : str or int, optional
        Name or number of the column of times, if it is not found. Other columns that look like times are then ignored.
    time_unit : str, optional
        Unit of the times, if the column name does not end with it. Without a header line, the first column then has the
        times, unless `time` is another one.
    skip : int, optional
        Number of lines above the table, if they are not found. What they state is ignored.
    inventory : str or path, optional
        StationXML file of the recorder, with which counts in a miniSEED file become m/s2 (obspy's
        ``remove_response``). The lowest frequencies of a seismometer for velocities are not restored.

    Returns
    -------
    Record
        The ground motion, named after the file, the trace or the channel. Samples of K-NET are without their mean.

    Raises
    ------
    ValueError
        If the file, column or channel does not exist or several match (the message lists them), unit or step are
        missing or contradictory, a cell is no finite number or is empty, a time step is irregular (the message names
        the first one), the samples are not as many or do not have the peak that the file states, or the format is
        known and not read.

    Examples
    --------
    >>> table = [[0.00, 0.00], [0.01, 0.05], [0.02, -0.02]]
    >>> np.savetxt("motion.csv", table, delimiter=",", header="time_s,acceleration_g", comments="")
    >>> read_record("motion.csv").acceleration.round(3)  # m/s²
    array([ 0.   ,  0.49 , -0.196])
    """
    form, file = recognise(path), str(path)
    if inventory is not None and form not in OF_OBSPY:
        raise ValueError(f"{path}: inventory= is for miniSEED, SAC and GSE2 files; leave it out")
    options = {"time": time, "time_unit": time_unit, "skip": skip, "missing": missing}
    if form is None:
        try:
            table = read_table(path, along_rows=column == "rows", **options)
            rows = column == "rows" and "rows" not in [each.name for each in table.columns]
            wanted = (None if rows else column, "acceleration", units, table.file)
            ((values, unit, _),) = table.samples([wanted], stacklevel=2)
            absent = np.flatnonzero(np.isnan(values))
            where = f"{table.file}, line {table.lines[absent[0]]}" if absent.size else table.file
            advice = f"an excitation needs all samples, {absent.size} are missing: interpolate them, or cut the file"
            expect(not absent.size, where, "a number", "an empty cell or NaN", advice)
            step, times = (table.step(dt), None) if resample is None else (np.nan, table.times(dt))
            series = Series(table.title, step, unit, values, times)
        except ValueError as error:
            if Path(path).suffix.lower() in _TABLES:
                raise
            raise ValueError(f"{error}. It has no known format of ground motions and was read as a table") from error
        dt = units = None  # the table has them
    elif unused := ", ".join(name for name, option in options.items() if option is not None):
        raise ValueError(f"{path}: a file of format {form} states its times and samples; leave {unused} out")
    else:
        series = read_series(path, form, column, inventory)
    unit = agree_on_unit(series.unit, units, "acceleration", series.file or file)
    # The source has the file name without its folder, because it is written into data sets that are shared.
    source = series.source or Path(file).name + (f": {series.title}" if series.title else "")
    step, values, file = series.dt, series.values, series.file or file
    if series.times is not None:
        even = uniform_times(series.times, resample, file)
        if resample is None:
            advice = f"give their nominal step, resample={even.step:.6g}"
            raise ValueError(f"{file}: the samples are at uneven times; {advice}")
        if even.gaps.size:
            warnings.warn(
                f"{file}: {even.note}; an excitation needs all samples, so the gaps are straight lines: compare with "
                "another record of the motion if a gap is in its strong part",
                UserWarning,
                stacklevel=2,
            )
        source, step = f"{source}; {even.note}", resample
        values = np.interp(even.uniform, even.times, values[even.kept])
    elif resample is not None:
        raise ValueError(f"{file}: the samples have a uniform step; leave resample out")
    if dt is not None and not abs(dt - step) <= 1e-6 * step:
        advice = "leave dt out, or correct the file"
        raise ValueError(f"{file} states a step of {step:g} s but dt = {dt!r} was given; {advice}")
    return Record(series.name or Path(path).stem, step, to_si(values, unit, "acceleration"), source)


# measured responses ---------------------------------------------------------------------------------------------------


def read_columns(
    path: str | Path,
    channels: Sequence[Channel],
    columns: Sequence[str | int],
    units: str | Sequence[str] | Mapping[str, str] | None = None,
    dt: float | None = None,
    description: str = "",
    *,
    time: int | str | None = None,
    time_unit: str | None = None,
    skip: int | None = None,
    zero: float | str = 0.0,
    missing: Sequence[float | str] | None = None,
    resample: float | None = None,
) -> Measurements:
    """Read measured responses from the columns of a table, a CSV file or workbook as `read_record` reads it.

    Accelerations are also read from the files of strong-motion networks, with the numbers or names of their channels as
    `columns`, such as those of a structure in a zip archive of V2 files. An empty cell, ``NaN``, ``NA``, ``N/A``,
    ``#N/A``, ``NULL``, ``-`` or ``--`` is a missing sample.

    Parameters
    ----------
    path : str or path
        The file.
    channels : sequence of Channel
        The measured channels.
    columns : sequence of str or int
        Names of the columns in the header line, or without one their numbers, from 1; one per channel.
    units : str, sequence of str, or mapping of channel names to str, optional
        Unit of the numbers, one for all columns or one per column. Not needed if the names of the columns end with the
        unit (``disp_in``). If both are given, they must agree.
    description : str, optional
        Description of the measurements.
    zero : float or str, optional
        Time in the file at which the excitation begins [s]. For clock times, which count from midnight, it may be a
        clock time, such as ``"03:19:53.37"`` or ``"2019-07-06T03:19:53.37"``, in the time zone of the file unless it
        states another one (``"03:19:53Z"``, ``"05:19:53+02:00"``).
    dt, time, time_unit, skip, missing, resample : optional
        As in `read_record`. Missing samples, and those in gaps of uneven times, are NaN.

    Returns
    -------
    Measurements
        The channels. They start at the first time of the file minus `zero`, so a file that begins at 0.37 s keeps this
        time; give ``zero=0.37`` if the excitation begins with it.

    Raises
    ------
    ValueError
        As `read_record`, or if a unit has another dimension than its channel.

    Examples
    --------
    >>> table = [[0.00, 0.0], [0.01, 1.5], [0.02, 2.0]]
    >>> np.savetxt("measured.csv", table, delimiter=",", header="time_s,top_mm", comments="")
    >>> measured = read_columns("measured.csv", [Channel("top", "relative displacement", "mm")], ["top_mm"])
    >>> measured.values  # m
    array([[0.    , 0.0015, 0.002 ]])
    """
    given = units_of(channels, units)
    if isinstance(columns, str) or len(channels) != len(columns):
        raise ValueError(f"expected one column for each of {len(channels)} channels; got {columns!r}")
    wanted = [
        (column, channel.dimension, unit, f"{path}, column {column!r}")
        for channel, column, unit in zip(channels, columns, given, strict=True)
    ]
    if recognise(path) is not None:
        if isinstance(zero, str):
            raise ValueError(f"{path} has no clock times; give zero in seconds after its first sample, got {zero!r}")
        for other in (channel for channel in channels if channel.dimension != "acceleration"):
            got, advice = f"{other.dimension} {other.name!r}", "leave it out, or write its samples to a CSV file"
            expect(False, path, "accelerations, as files of this format have", got, advice)
        options = {"dt": dt, "time": time, "time_unit": time_unit, "skip": skip, "missing": missing}
        records = [read_record(path, column, unit, resample=resample, **options) for column, _, unit, _ in wanted]
        labels = [f"{channel.name} is {record.name}" for channel, record in zip(channels, records, strict=True)]
        description = ", ".join(filter(None, (description, *labels)))
        steps, rows = [record.dt for record in records], [record.acceleration for record in records]
        return Measurements(tuple(channels), steps, rows, description, 0.0 - zero)
    table = read_table(path, skip, time_unit, time, missing=missing)
    values = np.array([to_si(*each) for each in table.samples(wanted, stacklevel=2)])
    if resample is None:
        step = table.step(dt)
    else:
        even, step = uniform_times(table.times(dt), resample, table.file), resample
        values = np.array([even.interpolate(row) for row in values])
        description = ", ".join(filter(None, (description, even.note)))
    return Measurements(tuple(channels), step, values, description, table.start(step, zero))


def units_of(channels: Sequence[Channel], units: str | Sequence[str] | Mapping[str, str] | None) -> list[str | None]:
    """The given unit of each channel, None where the file states it; ValueError for other names or another number."""
    names = [channel.name for channel in channels]
    if units is None or isinstance(units, str):
        return [units] * len(names)
    given = [units.get(name) for name in names] if isinstance(units, Mapping) else list(units)
    known = len(given) == len(names) and not set(units) - set(names if isinstance(units, Mapping) else units)
    expect(known, "units", f"a unit for each of {', '.join(names)}, one for all, or units by name", repr(units))
    return given
