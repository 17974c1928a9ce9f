"""Readers of ground motions: formats of strong-motion networks, CSV, and Excel workbooks.

`read_record` recognises the format; a reader given another format names it in its error. Every reader converts to SI
units. It takes the unit and the time step from the file or from its arguments, and raises ValueError if neither states
them or if they disagree. Measured responses have their readers in `fe_likelihoods.signals.measurement_readers`.
"""

import contextlib
import io
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ..units import to_si
from . import at2_v2_formats, obspy_formats, smc_geonet_knet_esm_formats
from .records import Record
from .table_columns import csv_series
from .tables import read_table
from .text_files import Series, agree_on_unit, read_bytes, read_text
from .uneven_times import uniform_times

__all__ = [
    "named_format",
    "read_at2",
    "read_csv",
    "read_esm",
    "read_geonet",
    "read_knet",
    "read_obspy",
    "read_record",
    "read_smc",
    "read_v2",
    "recognise_reader",
]


def read_at2(path: str | Path, units: str | None = None) -> Record:
    """Read a ground motion from a PEER AT2 file.

    Both forms of the header are understood, the new one (``NPTS=  4096, DT=  .0100 SEC``) and the old one
    (``4096 .0100 NPTS, DT``).

    Parameters
    ----------
    path : str or path
        The file.
    units : str, optional
        Unit of the samples, needed if the header has no ``UNITS OF ...``. If it has, the two must agree.

    Returns
    -------
    Record
        The ground motion, named after the file.

    Raises
    ------
    ValueError
        If the file does not exist, has no header or no unit, contains another quantity than acceleration, has another
        number of samples than NPTS, or has a sample that is not a finite number.
    """
    return _read("read_at2", path, units)


def read_smc(path: str | Path, resample: float | None = None) -> Record:
    """Read a ground motion from a USGS SMC file: uncorrected or corrected acceleration.

    Parameters
    ----------
    path : str or path
        The file.
    resample : float, optional
        Nominal step of a file with uneven times, as in `read_csv`.

    Returns
    -------
    Record
        The ground motion, named after the file.

    Raises
    ------
    ValueError
        If the file does not exist, is no SMC file of acceleration, or does not have the number of samples and the peaks
        that its header states.
    """
    return _read("read_smc", path, resample=resample)


def read_geonet(path: str | Path, component: str | None = None) -> Record:
    """Read one component from a GeoNet file of uncorrected (V1A) or corrected (V2A) accelerations.

    Parameters
    ----------
    path : str or path
        The file, which has three components as a rule.
    component : str, optional
        Direction as in the file, such as ``"S16W"`` or ``"Up"``. Needed if there is more than one component.

    Returns
    -------
    Record
        The ground motion, named after station and component.

    Raises
    ------
    ValueError
        If the file does not exist or is no GeoNet file, the component does not exist (the message lists them), or a
        component does not have the number of samples and the peak that its header states.
    """
    return _read("read_geonet", path, channel=component)


def read_knet(path: str | Path) -> Record:
    """Read a ground motion from a K-NET or KiK-net file. Its mean is subtracted.

    Parameters
    ----------
    path : str or path
        The file of one component (``.NS``, ``.EW``, ``.UD``, or ``.NS1`` to ``.UD2``).

    Returns
    -------
    Record
        The ground motion, named after the file.

    Raises
    ------
    ValueError
        If the file does not exist, is no K-NET file, or does not have the number of samples and the peak that its
        header states.
    """
    return _read("read_knet", path)


def read_esm(path: str | Path) -> Record:
    """Read a ground motion from an ASCII file of the databases ESM or ITACA (format DYNA 1.x).

    Parameters
    ----------
    path : str or path
        The file of one component (``...ACC.ASC``).

    Returns
    -------
    Record
        The ground motion, named after the file.

    Raises
    ------
    ValueError
        If the file does not exist, is no such file of acceleration, or does not have the number of samples and the peak
        that its header states.
    """
    return _read("read_esm", path)


def read_record(
    path: str | Path,
    channel: int | str | None = None,
    units: str | None = None,
    missing: Sequence[float] | None = None,
    member: str | None = None,
    resample: float | None = None,
    *,
    dt: float | None = None,
    column: int | str | None = None,
    time: int | str | None = None,
    time_unit: str | None = None,
    skip: int | None = None,
) -> Record:
    """Read a ground motion from a file in any supported format, which is recognised by the first lines.

    Parameters
    ----------
    path : str or path
        A file, or a zip archive of CSMIP and COSMOS V2 files.
    channel : int or str, optional
        Channel number or name of a file in the archive (V2), component (GeoNet), trace (miniSEED) or column (CSV), if
        the file has more than one.
    units : str, optional
        Unit of the acceleration, if an AT2, CSV, miniSEED or SAC file does not state it. If the file states it, the two
        must agree.
    missing : sequence of float, optional
        For a CSV file: numbers that stand for missing samples, as in `read_csv`.
    member : str, optional
        For a zip archive of V2 files: name of the file in the archive, if several have the channel.
    resample : float, optional
        For a CSV, SMC or V1 file with uneven times: their nominal step [s], as in `read_csv`.
    dt : float, optional
        Time step [s], for a table without times. If the file states it, the two must agree.
    column : int or str, optional
        Another name of `channel`: the column of a table, as in `read_csv`.
    time, time_unit, skip : optional
        For a table, as in `read_csv`.

    Returns
    -------
    Record
        The ground motion.

    Raises
    ------
    ValueError
        As the reader of the format; for a known format without a reader, the message has its name.
    """
    if channel is not None and column is not None:
        raise ValueError(f"{path}: give channel= or column=, not both; they name the same")
    channel = column if channel is None else channel
    reader = recognise_reader(path)
    if reader is not None:
        given = dict(time=time, time_unit=time_unit, skip=skip, missing=missing)
        if unused := [name for name, value in given.items() if value is not None]:
            raise ValueError(f"{path}: a file for {reader} states its times and samples; leave {', '.join(unused)} out")
        return _read(reader, path, units, dt, channel, member, resample)
    try:
        return _read_csv(path, units, dt, channel, time_unit, skip, missing, resample, time)
    except ValueError as error:
        if Path(path).suffix.lower() in _TABLES:
            raise
        raise ValueError(f"{error}. The file has no known format of ground motions and was read as a table") from error


_TABLES = ("", ".csv", ".txt", ".dat", ".tsv", ".lvm", ".out", ".xlsx", ".xlsm")


def recognise_reader(path: str | Path) -> str | None:
    """Return the name of the function that reads a file or zip archive; None for a table (CSV, Excel).

    Raises ValueError if the file cannot be read, or has a known format without a reader.
    """
    content = read_bytes(path)
    if zipfile.is_zipfile(io.BytesIO(content)):
        return None if Path(path).suffix.lower() in (".xlsx", ".xlsm") else "read_v2"
    name, reader = smc_geonet_knet_esm_formats.recognise(content)
    if name and reader is None:
        raise ValueError(f"{path}: {_looks_like(name, None)}")
    return reader


def read_v2(
    path: str | Path, channel: int | None = None, member: str | None = None, resample: float | None = None
) -> Record:
    """Read the acceleration of one channel from a CSMIP or COSMOS file V2 or V1, or from a zip archive of such files.

    Archives may contain archives, as downloads of whole stations do; V1 files in them are read if there are no V2
    files. The unit is taken from the file, which must state it. V1 files are uncorrected, as the name of the record
    says: their baseline may drift.

    Parameters
    ----------
    path : str or path
        A V2 file, with one channel or several, or a zip archive.
    channel : int, optional
        The channel number of the station (``STA CHN``), or of the recorder if the file has no other. Needed if there
        is more than one channel.
    member : str, optional
        End of the file name in the archive, such as ``"CHAN12.V2"`` or ``"Free Field.zip/CHAN012.V2"``. Needed if the
        archive contains a channel more than once.
    resample : float, optional
        Nominal step of a V1 file with uneven times, as in `read_csv`.

    Returns
    -------
    Record
        The ground motion, named after the label of the channel.

    Raises
    ------
    ValueError
        If the file or the channel does not exist, several channels match (the message lists them), or the file is
        damaged.
    """
    return _read("read_v2", path, channel=channel, member=member, resample=resample)


def read_obspy(path: str | Path, units: str | None = None, channel: str | None = None) -> Record:
    """Read a ground motion in miniSEED, SAC or GSE2 with the package obspy (``pip install obspy``).

    Parameters
    ----------
    path : str or path
        The file.
    units : str
        Unit of the samples, which these formats do not state reliably.
    channel : str, optional
        End of the identifier of the trace, such as ``"HNZ"`` or ``"NZ.WEL.20.HNZ"``. Needed if there is more than one.

    Returns
    -------
    Record
        The ground motion, named after the trace.

    Raises
    ------
    ValueError
        If obspy is missing or cannot read the file, several traces match (the message lists them), the trace has gaps,
        or its samples are counts of a recorder.
    """
    return _read("read_obspy", path, units, channel=channel)


def read_csv(
    path: str | Path,
    units: str | None = None,
    dt: float | None = None,
    column: int | str | None = None,
    *,
    time: int | str | None = None,
    time_unit: str | None = None,
    skip: int | None = None,
    missing: Sequence[float] | None = None,
    resample: float | None = None,
) -> Record:
    """Read a ground motion from a CSV file with a header line such as ``time_s,acc_g``, or from an Excel workbook.

    Cells are separated by commas, semicolons, tabs or blanks. Decimal commas are read where commas do not separate.
    The text is UTF-8, UTF-16 with a byte-order mark, or Latin-1. Text above the table is not data. Workbooks need the
    package openpyxl.

    The unit is the suffix of the column name (``acc_g``, ``acc_cm_s2``, ``acc [m/s²]``, ``acc, g``), a cell in a line
    of units below the header line, the comment ``# units: g``, or `units`. If several are given, they must agree. Times
    must be uniform within the rounding of the printed digits. The first sample of the record is at time zero, even if
    the times in the file begin later (see `read_columns`).

    What comments and the text above the table state is used, and must agree with the arguments and the samples: step or
    rate (``# dt = 0.02 s``, ``Sampling rate: 200 Hz``), number of samples (``npts = 1559``, ``NUMBER OF DATA: 1559``),
    unit and peak acceleration (``PGA (gal): 312.8``). A step without its unit is compared only. Blocks of samples below
    a line with their number and step, as of eqsig and RSPMatch, are read; such a file does not state the unit.

    Parameters
    ----------
    path : str or path
        The file. Without a header line, its columns are numbered from 1. Lines that start with ``#`` are comments.
    units : str, optional
        Unit of the samples.
    dt : float, optional
        Time step [s], needed for a file without times.
    column : str or int, optional
        Name of the column, or its number in a file without a header line; needed if there are several columns in
        addition to the time. ``"rows"`` takes the numbers of a file without a header line row after row, such as those
        of the Fortran format ``8F10.5``.
    time : str or int, optional
        Name or number of the column of times, if it is not found. Other columns that look like times are then ignored.
    time_unit : str, optional
        Unit of the times, if the column name does not end with it. Without a header line, the first column then has the
        times, unless `time` is another one.
    skip : int, optional
        Number of lines above the table, if they are not found. What they state is ignored.
    missing : sequence of float, optional
        Numbers that stand for missing samples; they are read as NaN, which an excitation must not have. A warning names
        the numbers that the column does not have. If not listed, -9999, -999.25, 1e30 and 9.97e36 are refused unless
        further numbers lie within 1 % of them; -999, 99999, -99999, 32767 and -32768 unless a further number has half
        their size. ``()`` takes all numbers as measured.
    resample : float, optional
        Nominal step of uneven times [s], to which the samples are interpolated linearly. The source of the record says
        what was done, and a warning names gaps, which are filled by straight lines.

    Returns
    -------
    Record
        The ground motion, named after the file.

    Raises
    ------
    ValueError
        If the file or the column does not exist, unit or step are missing or contradictory, a cell is not a finite
        number or is empty, or a time step is irregular (the message names the first one).
    """
    return _read_csv(path, units, dt, column, time_unit, skip, missing, resample, time)


def _read_csv(
    path: str | Path,
    units: str | None,
    dt: float | None,
    column: int | str | None,
    time_unit: str | None,
    skip: int | None,
    missing: Sequence[float] | None,
    resample: float | None,
    time: int | str | None,
) -> Record:
    """`read_csv`, at the call depth below a public reader that its warnings expect."""
    with named_format(path, "read_csv"):
        table = read_table(path, skip, time_unit, time, along_rows=column == "rows")
        column = None if column == "rows" and "rows" not in table.names else column
        series = csv_series(table, column, dt, units, missing, resample is not None)
        if smc_geonet_knet_esm_formats.recognise(read_bytes(path))[1] not in (None, "read_at2"):
            raise ValueError(f"{path}: expected a table")  # lines such as NPTS=3, DT=0.01 may stand above a table
    return _record(series, units, path, Path(path).stem, resample)


def _read(
    reader: str,
    path: str | Path,
    units: str | None = None,
    dt: float | None = None,
    channel: int | str | None = None,
    member: str | None = None,
    resample: float | None = None,
) -> Record:
    """The record in a file of a format, at the call depth below a public reader that its warnings expect."""
    file, name = str(path), Path(path).name if reader == "read_knet" else Path(path).stem
    with named_format(path, reader):
        if reader == "read_v2":
            found = _v2_channel(path, channel, member)
            series, file = at2_v2_formats.parse_v2(found), found.file
        elif reader == "read_geonet":
            series = _geonet_component(path, channel)
        elif reader == "read_obspy":
            series = obspy_formats.parse_obspy(path, channel)
        else:
            series = _PARSERS[reader](read_text(path), file)
    if reader in ("read_v2", "read_geonet", "read_obspy"):
        name = series.title
    record = _record(series, units, file, name, resample, dt)
    return replace(record, source=file.removeprefix(f"{Path(path).parent}/")) if reader == "read_v2" else record


_PARSERS: dict[str, Callable[[str, str], Series]] = {
    "read_at2": at2_v2_formats.parse_at2,
    "read_smc": smc_geonet_knet_esm_formats.parse_smc,
    "read_knet": smc_geonet_knet_esm_formats.parse_knet,
    "read_esm": smc_geonet_knet_esm_formats.parse_esm,
}


def _v2_channel(path: str | Path, channel: int | str | None, member: str | None) -> at2_v2_formats.V2Channel:
    """The channel with a number; a text is a number too, or the name of a file in the archive."""
    if isinstance(channel, str):
        channel, member = (int(channel), member) if channel.isdecimal() else (None, channel)
    candidates = at2_v2_formats.find_v2_channels(path, member)
    chosen = [each for each in candidates if channel is None or each.channel == channel]
    if len(chosen) != 1:
        listing = "\n  ".join(f"channel {each.channel}: {each.label} [{each.file}]" for each in chosen or candidates)
        raise ValueError(
            f"{path}: expected one channel with channel = {channel}, member = {member!r}, found {len(chosen)}; "
            "choose with channel= and member=, or in a TOML file with the end of a file name as column, among\n  "
            f"{listing}"
        )
    return chosen[0]


def _geonet_component(path: str | Path, component: int | str | None) -> Series:
    found = smc_geonet_knet_esm_formats.parse_geonet(read_text(path), str(path))
    chosen = [each for each in found if component is None or each.component.lower() == str(component).lower()]
    if len(chosen) != 1:
        raise ValueError(
            f"{path}: expected one component with component = {component!r}, found {len(chosen)}; the components are "
            f"{', '.join(each.component for each in found)}"
        )
    return chosen[0].series


@contextlib.contextmanager
def named_format(path: str | Path, reader: str) -> Iterator[None]:
    """Name the format of a file that a reader refuses, if it is another known format."""
    try:
        yield
    except ValueError as error:
        try:
            name, other = smc_geonet_knet_esm_formats.recognise(read_bytes(path))
        except ValueError:
            raise error from None
        if not name or other == reader:
            raise
        raise ValueError(f"{path}: {_looks_like(name, other)}") from error


def _looks_like(name: str, reader: str | None) -> str:
    article = "an" if name.startswith(("ESM", "HDF5")) else "a"
    advice = ", which is not read; take a file of another format" if reader is None else f": read it with {reader}"
    return f"this looks like {article} {name} file{advice}"


def _record(
    series: Series,
    units: str | None,
    file: str | Path,
    name: str,
    resample: float | None = None,
    dt: float | None = None,
) -> Record:
    unit = agree_on_unit(series.unit, units, "acceleration", file)
    # The source has the file name without its folder, because it is written into data sets that are shared.
    source, step, values = Path(file).name + (f": {series.title}" if series.title else ""), series.dt, series.values
    if series.times is not None:
        if resample is None:
            even = uniform_times(series.times, None, str(file))
            raise ValueError(
                f"{file}: the samples are at uneven times; give their nominal step, resample={even.step:.6g}"
            )
        even = uniform_times(series.times, resample, str(file))
        source, step, values = f"{source}; {even.note}", resample, even.straight(values, str(file), stacklevel=4)
    elif resample is not None:
        raise ValueError(f"{file}: the samples have a uniform step; leave resample out")
    if dt is not None and not abs(dt - step) <= 1e-6 * step:
        raise ValueError(
            f"{file} states a step of {step:g} s but dt = {dt!r} was given; leave dt out, or correct the file"
        )
    return Record(name, step, to_si(values, unit, "acceleration"), source)
