"""From text files to numbers: the formats in which ground motions and measured responses are kept.

Each format has one function that returns plain numbers with the unit, step and title which the file itself states.
Nothing is converted here and nothing is guessed: what a file does not say stays None, and what it says wrongly is a
ValueError with the file and the line.

* PEER AT2: header lines with NPTS and DT, then free-format samples.
* CSMIP V2: per channel 25 text lines, integer header, real header (100 numbers in columns of 10), then blocks of
  acceleration, velocity, displacement, each opened by a line such as
  ``3000 POINTS OF ACCEL DATA EQUALLY SPACED AT  .020 SEC.  (UNITS: CM/SEC/SEC)`` and closed per channel by ``/&``.
* COSMOS V2 (format 1.20): headers that state their own length and Fortran format, then
  ``42000 acceleration pts, approx  210 secs, units=cm/sec2(04),Format=(1E15.6)``.
* CSV: comments ``#``, a header line, numbers.

Both V2 formats are Fortran columns without separators, so they are cut by width, never split at blanks.
"""

import csv
import io
import math
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import find_unit, to_si

__all__ = [
    "Series",
    "Table",
    "V2Channel",
    "agreed_unit",
    "column_unit",
    "csv_series",
    "find_v2_channels",
    "parse_at2",
    "parse_v2",
    "read_table",
    "read_text",
    "table_step",
    "value_column",
]

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_AT2_NEW = re.compile(rf"NPTS\s*=\s*(\d+)\b.*?DT\s*=\s*({_NUMBER})", re.IGNORECASE)
_AT2_OLD = re.compile(rf"^\s*(\d+)\s+({_NUMBER})\s*,?\s*NPTS\s*,\s*DT", re.IGNORECASE)
_UNITS_OF = re.compile(r"UNITS\s+OF\s+([^\s,;]+?)[.]?(?=[\s,;]|$)", re.IGNORECASE)
_CSMIP_DATA = re.compile(
    rf"^\s*(\d+)\s+points\s+of\s+accel\s+data\s+equally\s+spaced\s+at\s*({_NUMBER})", re.IGNORECASE
)
_CSMIP_UNITS = re.compile(r"units:\s*([^\s)]+)|\bin\s+([^\s.,]+)", re.IGNORECASE)
_CSMIP_END = re.compile(r"^\s*/&")
_COSMOS_DATA = re.compile(r"^\s*(\d+)\s+acceleration\s+pts\b.*?units\s*=\s*([^\s,(]+)", re.IGNORECASE)
_COSMOS_REALS = re.compile(r"^\s*(\d+)\s+real-header\s+values\s+follow\s+on\s+(\d+)\s+lines", re.IGNORECASE)
_COSMOS_END = re.compile(r"^\s*end-of-data", re.IGNORECASE)
_FORMAT = re.compile(r"\(\s*(\d*)\s*[a-z](\d+)\.\d+[^)]*\)\s*$", re.IGNORECASE)
_CSMIP_FORMAT = (8, 10)  # numbers on a line, columns of a number
_CSMIP_REALS, _CSMIP_DT = 100, 61  # length of the real header, place (from 1) of the step of the corrected data
_COSMOS_DT = 34
_LARGEST_MEMBER = 64 * 2**20  # bytes of a file in a zip; stations are some MiB


class Series(NamedTuple):
    """Samples as a file has them: `values` (n,) in `unit` (None: the file does not say), step `dt` [s], `title`."""

    title: str
    dt: float
    unit: str | None
    values: NDArray[np.float64]


class Table(NamedTuple):
    """Columns of numbers of a text file.

    `names` is empty if there is no header line; `values` has shape (n_rows, n_columns); `lines` are the line numbers
    of the rows; `decimals` is, for each column, the largest number of digits printed after the point; `comments` is
    the text of the comment lines.
    """

    file: str
    names: tuple[str, ...]
    values: NDArray[np.float64]
    lines: tuple[int, ...]
    decimals: tuple[int, ...]
    comments: str


class V2Channel(NamedTuple):
    """A channel found in a V2 file: its station channel number, a label, the file, and its lines from line `first`."""

    channel: int | None
    label: str
    file: str
    first: int
    lines: list[str]


def read_text(path: str | Path) -> str:
    """Text of a file; ValueError if there is none."""
    return _read_bytes(path).decode("latin-1")  # decodes every byte; the formats here are plain ASCII


def agreed_unit(stated: str | None, given: str | None, dimension: str, file: str | Path) -> str:
    """Name of the unit in which the file's own statement and the caller's agree; ValueError if neither speaks."""
    names = [name for name in (stated, given) if name is not None]
    if not names:
        raise ValueError(f"{file} does not state the unit of its {dimension}: give units=, for instance 'g'")
    try:
        units = [find_unit(name, dimension) for name in names]
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    if any(unit.factor != units[0].factor for unit in units):
        raise ValueError(f"{file} states the unit {stated!r} but units = {given!r} was given; correct one of them")
    return units[0].name


def parse_at2(text: str, file: str) -> Series:
    """Samples of a PEER AT2 file (see `fe_likelihoods.signals.records.read_at2`)."""
    lines = text.splitlines()
    matches = [_AT2_NEW.search(line) or _AT2_OLD.search(line) for line in lines]
    index = next((i for i, match in enumerate(matches) if match), None)
    if index is None:
        raise ValueError(
            f"{file}: expected a header line 'NPTS=  4096, DT=  .0100 SEC' or '4096  .0100  NPTS, DT', found none in "
            f"{len(lines)} lines; read plain columns of numbers with read_csv"
        )
    units = _UNITS_OF.search("\n".join(lines[:index]))
    fields = [(index + offset, field) for offset, row in enumerate(lines[index + 1 :], 2) for field in row.split()]
    values = np.array([_number(field, f"{file}, line {line}") for line, field in fields])
    _check_count(values.size, int(matches[index][1]), f"{file}: NPTS in line {index + 1}")
    title = lines[index - 2].strip() if index >= 2 else ""
    return Series(title, float(matches[index][2]), units[1] if units else None, values)


def find_v2_channels(path: str | Path, member: str | None = None) -> list[V2Channel]:
    """Channels with corrected acceleration in a V2 file, or in those members of a zip whose names end with `member`."""
    content = _read_bytes(path)
    files = list(_unzip(content, str(path))) if zipfile.is_zipfile(io.BytesIO(content)) else [(str(path), content)]
    if member is not None:
        files = [(name, data) for name, data in files if name.lower().endswith(member.lower())]
    elif len(files) > 1:
        files = [(name, data) for name, data in files if name.lower().endswith((".v2", ".v2c"))]
    channels = [channel for name, data in files for channel in _split_v2(data.decode("latin-1"), name)]
    if not channels:
        raise ValueError(
            f"{path}: expected a CSMIP or COSMOS V2 file with a line 'N POINTS OF ACCEL DATA EQUALLY SPACED AT ...' or "
            f"'N acceleration pts ...', found none in {len(files)} file(s)" + (f" named {member!r}" if member else "")
        )
    return sorted(channels, key=lambda each: (each.channel is None, each.channel or 0))


def parse_v2(channel: V2Channel) -> Series:
    """Corrected acceleration of one channel."""
    where, lines = channel.file, channel.lines
    index = next(i for i, line in enumerate(lines) if _CSMIP_DATA.match(line) or _COSMOS_DATA.match(line))
    line = lines[index]
    if re.match(r"\s*(raw|uncorrected)", lines[0], re.IGNORECASE):
        raise ValueError(f"{where}: expected corrected acceleration (V2), got {lines[0].strip()!r}")
    stated = _FORMAT.search(line)
    per_line, width = (int(stated[1] or 1), int(stated[2])) if stated else _CSMIP_FORMAT
    if match := _CSMIP_DATA.match(line):
        units = _CSMIP_UNITS.search(line, match.end())
        unit = units and (units[1] or units[2])
        start = index - math.ceil(_CSMIP_REALS / _CSMIP_FORMAT[0])
        dt = _header_number(channel, start, _CSMIP_FORMAT, _CSMIP_DT)
        # The data line shows the step with three decimals only, the real header may hold more.
        if abs(dt - float(match[2])) > 0.51e-3:
            raise ValueError(
                f"{where}, line {channel.first + index}: the step is {match[2]} s here but {dt} s in the real header; "
                f"the file is damaged"
            )
    else:
        match = _COSMOS_DATA.match(line)
        unit = match[2]
        header = next((i for i in range(index) if _COSMOS_REALS.match(lines[i])), None)
        form = _FORMAT.search(lines[header]) if header is not None else None
        if form is None:
            raise ValueError(f"{where}: expected a line 'N Real-header values follow on N lines, Format= (5F15.6)'")
        if stated is None:
            raise ValueError(f"{where}, line {channel.first + index}: expected a Format such as (8F10.5) in {line!r}")
        dt = _header_number(channel, header + 1, (int(form[1] or 1), int(form[2])), _COSMOS_DT)
    if unit is None:
        raise ValueError(
            f"{where}, line {channel.first + index}: expected the unit of acceleration in {line.strip()!r}"
        )
    count = int(match[1])
    values = _fixed_width(channel, index + 1, count, (per_line, width))
    return Series(channel.label, dt, unit, values)


def read_table(path: str | Path) -> Table:
    """Columns of numbers, with an optional header line and comments ``#``; separated by commas, or else by blanks."""
    file = str(path)
    rows: list[tuple[int, list[str]]] = []
    comments = []
    names: tuple[str, ...] = ()
    for number, line in enumerate(read_text(path).removeprefix("\xef\xbb\xbf").splitlines(), 1):
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip("# \t"))
        elif line.strip():
            cells = next(csv.reader([line], skipinitialspace=True)) if "," in line else line.split()
            cells = [cell.strip() for cell in cells]
            if not rows and not names and not any(_is_number(cell) for cell in cells):
                names = tuple(cells)
            else:
                rows.append((number, cells))
    if not rows:
        raise ValueError(f"{file}: expected rows of numbers, found none")
    width = len(names) or len(rows[0][1])
    for number, cells in rows:
        if len(cells) != width:
            raise ValueError(f"{file}, line {number}: expected {width} cells as in the first line, got {len(cells)}")
    values = np.array([[_number(cell, f"{file}, line {number}") for cell in cells] for number, cells in rows])
    decimals = tuple(max(_decimals(cells[i]) for _, cells in rows) for i in range(width))
    return Table(file, names, values, tuple(number for number, _ in rows), decimals, "\n".join(comments))


def value_column(table: Table, column: str | None = None) -> int:
    """Place of the named column, or of the only one that is not the time."""
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
    """Unit at the end of a column's name (``acc_cm_s2``, ``force [kip]``, ``disp (in)``), None if there is none."""
    bracket = re.search(r"[\[(]([^\])]+)[\])]\s*$", name)
    parts = name.split("_")
    for text in [bracket[1]] if bracket else ["_".join(parts[i:]) for i in range(1, len(parts))]:
        try:
            unit = find_unit(text).name
        except ValueError:
            continue
        if unit != "1":  # a number at the end of a name counts, it does not measure
            return unit
    return bracket[1] if bracket else None


def table_step(table: Table, dt: float | None = None) -> float:
    """Time step [s] of a table: from its times, the comment ``dt = ... s`` and the argument, which must agree.

    Printed times are rounded, so each may be off a uniform grid by one unit of its last digit: half for its own
    rounding, half for that of the two ends that define the grid. Where that unit is more than half a step it would
    hide a missing sample, and the times must be exact to 2e-7 of the last one (float32). A mean step that the
    rounding cannot tell from a whole number of samples per second (and within 1e-4 of it) is taken as that number.
    """
    stated = re.search(rf"\bdt\s*=\s*({_NUMBER})\s*s\b", table.comments)
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
    """One column of a table as a series, checked against the comments (see `fe_likelihoods.signals.records.read_csv`)."""
    place = value_column(table, column)
    stated = re.search(r"\bnpts\s*=\s*(\d+)", table.comments)
    if stated:
        _check_count(len(table.values), int(stated[1]), f"{table.file}: npts in the comments")
    comment = re.search(r"\bunits:\s*([^\s;,]+)", table.comments)
    unit = column_unit(table.names[place]) if table.names else None
    if comment and unit is not None:
        unit = agreed_unit(unit, comment[1], find_unit(unit).dimension, f"{table.file} (column and comment)")
    title = table.comments.split("\n", 1)[0]
    return Series(title, table_step(table, dt), unit or (comment and comment[1]), table.values[:, place])


def _read_bytes(path: str | Path) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}; check the path") from error


def _unzip(content: bytes, name: str) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the files in a zip, and in the zips that it holds."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for info in archive.infolist():
                inner = f"{name}/{info.filename}"
                if info.file_size > _LARGEST_MEMBER:
                    raise ValueError(f"{inner}: expected at most {_LARGEST_MEMBER} bytes, got {info.file_size}")
                if info.filename.lower().endswith(".zip"):
                    yield from _unzip(archive.read(info), inner)
                elif not info.is_dir():
                    yield inner, archive.read(info)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError) as error:
        raise ValueError(f"{name}: the zip cannot be read ({error}); fetch it again") from error


def _split_v2(text: str, file: str) -> list[V2Channel]:
    """Channels of a V2 file; COSMOS files may hold velocity and displacement as channels of their own, left out."""
    channels = []
    lines = text.splitlines()
    first = 0
    for index, line in enumerate(lines):
        end = _CSMIP_END.match(line) or _COSMOS_END.match(line)
        if not end and index < len(lines) - 1:
            continue
        block = lines[first : index + (not end)]
        if any(_CSMIP_DATA.match(each) or _COSMOS_DATA.match(each) for each in block):
            head = "\n".join(block[:25])
            number = re.search(r"STA CHN:\s*(\d+)", head, re.IGNORECASE)
            label = re.search(r"^\s*(?:STA )?CHAN\s*(\d+|\?)\s*:[^\n]*", head, re.IGNORECASE | re.MULTILINE)
            if number is None and label is not None and label[1] != "?":
                number = label
            text = re.sub(r"\s+", " ", label[0]).strip() if label else Path(file).name
            channels.append(V2Channel(int(number[1]) if number else None, text, file, first + 1, block))
        first = index + 1
    return channels


def _header_number(channel: V2Channel, start: int, form: tuple[int, int], place: int) -> float:
    """Number at a place (from 1) of a fixed-width header that starts at line `start` of the channel."""
    row, column = divmod(place - 1, form[0])
    where = f"{channel.file}, line {channel.first + start + row}: number {place} of the real header"
    line = channel.lines[start + row] if 0 <= start + row < len(channel.lines) else ""
    value = _number(line[column * form[1] : (column + 1) * form[1]].strip(), where)
    if not value > 0:
        raise ValueError(f"{where} must be the time step [s], got {value}")
    return value


def _fixed_width(channel: V2Channel, start: int, count: int, form: tuple[int, int]) -> NDArray[np.float64]:
    """The `count` numbers of a block of Fortran columns."""
    per_line, width = form
    values: list[float] = []
    for offset in range(start, start + math.ceil(count / per_line)):
        line = channel.lines[offset].rstrip() if offset < len(channel.lines) else ""
        where = f"{channel.file}, line {channel.first + offset}"
        wanted = min(per_line, count - len(values))
        found = math.ceil(len(line) / width)
        if found != wanted:
            raise ValueError(
                f"{where}: expected {wanted} numbers of {width} columns, got {found}, after {len(values)} of the "
                f"{count} samples that the file announces; the file is cut or damaged"
            )
        values += [_number(line[i * width : (i + 1) * width].strip(), where) for i in range(wanted)]
    following = channel.lines[start + math.ceil(count / per_line) :][:1]
    if following and _is_number(following[0][:width].strip()):
        raise ValueError(
            f"{channel.file}, line {channel.first + start}: the file announces {count} samples but has more after them"
        )
    return np.array(values)


def _time_column(table: Table) -> int | None:
    return next((i for i, name in enumerate(table.names) if re.match(r"t(ime)?(\b|_)", name.lower())), None)


def _uniform_step(table: Table, place: int) -> tuple[float, float]:
    """Mean step of a column of times [s] and the largest error that their rounding can give it."""
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
    rate = round(1 / step)
    if rate and abs(1 / rate - step) < min(tolerance, 1e-4 * step):
        step = 1 / rate
    return step, tolerance


def _check_count(found: int, stated: int, where: str) -> None:
    if found != stated:
        raise ValueError(f"{where} announces {stated} samples, the file has {found}; it is cut or damaged")


def _number(field: str, where: str) -> float:
    try:
        value = float(field)
    except ValueError:
        raise ValueError(f"{where}: expected a number, got {field!r}") from None
    if not math.isfinite(value):
        raise ValueError(f"{where}: expected a finite number, got {field!r}")
    return value


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _decimals(field: str) -> int:
    mantissa, _, exponent = field.lower().partition("e")
    return len(mantissa.partition(".")[2]) - int(exponent or 0)
