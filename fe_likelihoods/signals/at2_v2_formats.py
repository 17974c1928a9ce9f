"""File formats of ground motions: PEER AT2, and the formats V1 (uncorrected) and V2 of CSMIP and COSMOS.

Each format has one function that returns plain numbers with the unit, the step and the title that the file states. The
functions convert nothing. What a file does not state is None. A contradiction in a file raises ValueError with the file
and the line.

PEER AT2
    Header lines with NPTS and DT, then free-format samples.
CSMIP V2
    Per channel 25 lines of text, an integer header, a real header (100 numbers in columns of 10), and blocks of
    acceleration, velocity and displacement. Each block starts with a line such as
    ``3000 POINTS OF ACCEL DATA EQUALLY SPACED AT  .020 SEC.  (UNITS: CM/SEC/SEC)``, each channel ends with ``/&``.
CSMIP V1
    Per channel 13 lines of text, an integer header (100 numbers in columns of 5), and a real header (50 numbers in
    columns of 10; the third is the length [s], the seventh the peak [g]). Then follow ``13200 Accelerogram points at
    200 pts/sec in units of g.  Format: (8f9.6)`` and samples, or pairs of a time [s] and a sample in columns of 7, with
    the unit in the text.
COSMOS V1 and V2 (format 1.20)
    Headers that state their length and Fortran format, then
    ``42000 acceleration pts, approx  210 secs, units=cm/sec2(04),Format=(1E15.6)``.

These formats are Fortran columns without separators. They are split by width, never at blanks.
"""

import io
import lzma
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .header_statements import check_peaks, read_statements
from .text_files import (
    NUMBER,
    Series,
    check_count,
    check_peak,
    decimals_of,
    decode_text,
    is_number,
    number_cells,
    parse_count,
    parse_number,
    read_bytes,
)
from .uneven_times import without_repeated_times

__all__ = ["V2Channel", "find_v2_channels", "fixed_width_samples", "parse_at2", "parse_v2"]

# Expressions are searched from one place in a line, and their parts never match the same text: their time is linear.
_AT2_COUNT = re.compile(r"NPTS\s*=\s*(\d+)\b", re.IGNORECASE)
_AT2_STEP = re.compile(rf"\bDT\s*=\s*({NUMBER})\s*([a-z]*)", re.IGNORECASE)
_AT2_OLD = re.compile(rf"\s*(\d+)\s+({NUMBER})\s*(?:,\s*)?NPTS\s*,\s*DT", re.IGNORECASE)
_SECONDS = frozenset({"", "s", "sec", "secs", "second", "seconds"})
_UNITS_OF = re.compile(r"UNITS?\s*(?:OF|ARE|IS|:|=)\s*[(\[]?\s*([^\s,;()\[\]]+?)[)\]]?[.]?(?=[\s,;]|$)", re.IGNORECASE)
_CSMIP_DATA = re.compile(rf"^\s*(\d+)\s+points\s+of\s+accel\s+data\s+equally\s+spaced\s+at\s*({NUMBER})", re.IGNORECASE)
_CSMIP_UNITS = re.compile(r"units:\s*([^\s)]+)|\bin\s+([^\s.,]+)", re.IGNORECASE)
_CSMIP_END = re.compile(r"^\s*/&")
_COSMOS_DATA = re.compile(r"^\s*(\d+)\s+acceleration\s+pts\b.*?units\s*=\s*([^\s,(]+)", re.IGNORECASE)
_COSMOS_REALS = re.compile(r"^\s*(\d+)\s+real-header\s+values\s+follow\s+on\s+(\d+)\s+lines", re.IGNORECASE)
_COSMOS_END = re.compile(r"^\s*end-of-data", re.IGNORECASE)
_FORMAT = re.compile(r"\(\s*(\d*)\s*[a-z](\d+)\.\d+[^)]*\)$", re.IGNORECASE)
_V1_FIRST = re.compile(r"\s*uncorrected accelerogram", re.IGNORECASE)
_V1_DATA = re.compile(
    rf"^\s*(\d+)\s+accelerogram\s+points\s+at\s*({NUMBER})\s*pts/sec\s+in\s+units\s+of\s+(\S+?)\s*\.", re.IGNORECASE
)
_V1_UNITS = re.compile(r"units\s+of\s+uncor\s+\w+\s+are\s+sec\s+and\s+(g/10|g)\b", re.IGNORECASE)
_V1_TEXT, _V1_INTEGERS, _V1_REALS = 13, (100, 16, 5), (50, 8, 10)  # lines; numbers, per line, columns
_V1_COUNT, _V1_LENGTH, _V1_PEAK, _V1_PAIRS = 28, 3, 7, (10, 7)  # positions in the headers, from 1
_V1_HEADER = _V1_TEXT + math.ceil(100 / 16) + math.ceil(50 / 8)
_V2_TEXT = 25
_CSMIP_FORMAT = (8, 10)  # numbers per line, columns per number
_CSMIP_REALS, _CSMIP_DT = (
    100,
    61,
)  # length of the real header; position in it, from 1, of the step of the corrected data
_COSMOS_DT = 34
_WIDEST = 1000
# Limits of a zip archive and its contents: bytes, files, nested archives. Stations have a few MiB.
_LARGEST_CONTENT, _MOST_FILES, _DEEPEST = 64 * 2**20, 2000, 3
_MOST_LINES = 4_000_000
_ZIP_DAMAGE = (
    zipfile.BadZipFile,
    RuntimeError,
    NotImplementedError,
    OSError,
    EOFError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    UnicodeError,
)


class V2Channel(NamedTuple):
    """A channel found in a V2 file: its number at the station, its label, and its lines."""

    channel: int | None
    label: str
    file: str  # with the archive that contains it
    first: int  # number of its first line in the file
    lines: list[str]


def fixed_width_samples(
    lines: list[str], start: int, count: int, form: tuple[int, int], file: str, first: int = 1
) -> NDArray[np.float64]:
    """Return `count` samples in Fortran columns, which may touch, from line index `start` on; `form` is (numbers per
    line, columns per number), `first` the file's number of the first line.

    Raises ValueError if a line has too few or too many numbers.
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
    if len(line) % width and len(lines[start].rstrip()) % width == 0:  # the last line ends within a number
        raise ValueError(f"{where}: expected numbers of {width} columns, the last one is cut; the file is truncated")
    return np.array(values)


def parse_at2(text: str, file: str) -> Series:
    """Return the samples of a PEER AT2 file (see `fe_likelihoods.signals.read.read_at2`)."""
    lines = text.splitlines()
    index, stated = next(((i, found) for i, line in enumerate(lines) if (found := _at2_header(line))), (None, None))
    if index is None:
        raise ValueError(
            f"{file}: expected a header line 'NPTS=  4096, DT=  .0100 SEC' or '4096  .0100  NPTS, DT', found none in "
            f"{len(lines)} lines; read plain columns of numbers with read_csv"
        )
    units = _UNITS_OF.search("\n".join(lines[:index]))
    rows = [(number, row) for number, row in enumerate(lines[index + 1 :], index + 2) if row.strip()]
    while rows and re.search("[A-Za-z]{3}", rows[-1][1]) and not any(map(is_number, rows[-1][1].split())):
        rows.pop()  # a closing remark in any words: the number of samples is stated
    cells = number_cells([row for _, row in rows])
    fields = [(number, field) for (number, _), row in zip(rows, cells, strict=True) for field in row]
    values = np.array([parse_number(field, f"{file}, line {line}") for line, field in fields])
    where = f"{file}: NPTS in line {index + 1}"
    check_count(values.size, parse_count(stated[0], where), where)
    if stated[2].lower() not in _SECONDS:
        raise ValueError(
            f"{file}, line {index + 1}: expected DT in seconds, such as 'DT= .0100 SEC', got {stated[1]} {stated[2]}; "
            "write it in seconds"
        )
    title = lines[index - 2].strip() if index >= 2 else ""
    return Series(title, float(stated[1]), units[1] if units else None, values)


def _at2_header(line: str) -> tuple[str, str, str] | None:
    """Number of samples, step and unit of the step, as stated in a line of an AT2 header; None for other lines."""
    if (count := _AT2_COUNT.search(line)) and (step := _AT2_STEP.search(line)):
        return count[1], step[1], step[2]
    old = _AT2_OLD.match(line)
    return (old[1], old[2], "") if old else None


def find_v2_channels(path: str | Path, member: str | None = None) -> list[V2Channel]:
    """Return the channels with acceleration in a V1 or V2 file, or in the V2, else V1 files of an archive."""
    content = read_bytes(path)
    files = list(_unzip(content, str(path))) if zipfile.is_zipfile(io.BytesIO(content)) else [(str(path), content)]
    files = list(dict.fromkeys(files))  # an archive may hold the same file twice
    if member is not None:
        exact = [(name, data) for name, data in files if name == f"{path}/{member}"]
        files = exact or [(name, data) for name, data in files if name.lower().endswith(member.lower())]
    elif len(files) > 1:  # corrected acceleration, if there is any
        for ends in ((".v2", ".v2c"), (".v1", ".v1c")):
            found = [(name, data) for name, data in files if name.lower().endswith(ends)]
            if found:
                break
        files = found
    channels = [channel for name, data in files for channel in _split_v2(decode_text(data), name)]
    if not channels:
        raise ValueError(
            f"{path}: expected a CSMIP or COSMOS V1 or V2 file with a line 'N POINTS OF ACCEL DATA EQUALLY SPACED AT "
            f"...', 'N acceleration pts ...' or 'Uncorrected accelerogram', found none in {len(files)} file(s)"
            + (f" named {member!r}" if member else "")
        )
    return sorted(channels, key=lambda each: (each.channel is None, each.channel or 0))


def parse_v2(channel: V2Channel) -> Series:
    """Return the acceleration of one channel."""
    where, lines = channel.file, channel.lines
    if _is_v1(lines):
        return _parse_v1(channel)
    index = next(i for i, line in enumerate(lines) if _CSMIP_DATA.match(line) or _COSMOS_DATA.match(line))
    line = lines[index]
    if re.match(r"\s*raw", lines[0], re.IGNORECASE):
        raise ValueError(
            f"{where}: expected acceleration, got {lines[0].strip()!r}, counts of a recorder; take V1 or V2"
        )
    if _V1_FIRST.match(lines[0]):
        raise ValueError(f"{where}: expected corrected acceleration in this form, got {lines[0].strip()!r}")
    uncorrected = ", uncorrected" if re.match(r"\s*uncorrected", lines[0], re.IGNORECASE) else ""
    stated = _column_format(line, where)
    per_line, width = stated or _CSMIP_FORMAT
    if match := _CSMIP_DATA.match(line):
        units = _CSMIP_UNITS.search(line, match.end())
        unit = units and (units[1] or units[2])
        start = index - math.ceil(_CSMIP_REALS / _CSMIP_FORMAT[0])
        dt = _header_number(channel, start, _CSMIP_FORMAT, _CSMIP_DT)
        # The data line has the step with three decimals only, the real header may have more.
        if abs(dt - float(match[2])) > 0.51e-3:
            raise ValueError(
                f"{where}, line {channel.first + index}: the step is {match[2]} s here but {dt} s in the real header; "
                f"the file is damaged"
            )
    else:
        match = _COSMOS_DATA.match(line)
        unit = match[2]
        header = next((i for i in range(index) if _COSMOS_REALS.match(lines[i])), None)
        form = _column_format(lines[header], where) if header is not None else None
        if form is None:
            raise ValueError(f"{where}: expected a line 'N Real-header values follow on N lines, Format= (5F15.6)'")
        if stated is None:
            raise ValueError(f"{where}, line {channel.first + index}: expected a Format such as (8F10.5) in {line!r}")
        dt = _header_number(channel, header + 1, form, _COSMOS_DT)
    if unit is None:
        raise ValueError(
            f"{where}, line {channel.first + index}: expected the unit of acceleration in {line.strip()!r}"
        )
    count = parse_count(match[1], f"{where}, line {channel.first + index}")
    values = _fixed_width(channel, index + 1, count, (per_line, width))
    if _CSMIP_DATA.match(line):
        decimals = decimals_of(lines[index + 1][:width].strip())
        check_peaks(read_statements(lines[:_V2_TEXT]).peaks, ("",), 0, values, decimals, unit, where)
    return Series(channel.label + uncorrected, dt, unit, values)


def _is_v1(lines: list[str]) -> bool:
    """Whether the lines of a channel are in the CSMIP format V1."""
    first = bool(lines and _V1_FIRST.match(lines[0])) and len(lines) > _V1_HEADER
    return first and not any(map(_CSMIP_DATA.match, lines))


def _parse_v1(channel: V2Channel) -> Series:
    """Return the uncorrected acceleration of one channel: at a constant rate, or with times."""
    where, line = channel.file, channel.lines[_V1_HEADER]
    reals = _V1_TEXT + math.ceil(_V1_INTEGERS[0] / _V1_INTEGERS[1])
    length = _header_field(channel, reals, _V1_REALS[1:], _V1_LENGTH)
    peak = _header_field(channel, reals, _V1_REALS[1:], _V1_PEAK)
    times, dt = None, math.nan
    if match := _V1_DATA.match(line):
        dt, unit, form = 1.0 / float(match[2]), match[3], _column_format(line, where)
        if form is None or not 0.0 < dt < math.inf:
            raise ValueError(f"{where}, line {channel.first + _V1_HEADER}: expected a rate and a Format in {line!r}")
        count = parse_count(match[1], where)
        values = _fixed_width(channel, _V1_HEADER + 1, count, form)
        if abs(count * dt - float(length)) > 2.0 * dt:
            raise ValueError(
                f"{where}: {count} samples at {1 / dt:g} per second are not {length} s; the file is damaged"
            )
        first = channel.lines[_V1_HEADER + 1][: form[1]]
    else:
        found = _V1_UNITS.search("\n".join(channel.lines[:_V1_TEXT]))
        if found is None:
            raise ValueError(f"{where}: expected 'Units of uncor data are sec and g' or 'g/10' in {_V1_TEXT} lines")
        unit = found[1]
        count = parse_count(_header_field(channel, _V1_TEXT, _V1_INTEGERS[1:], _V1_COUNT), where)
        pairs = _fixed_width(channel, _V1_HEADER, 2 * count, _V1_PAIRS)
        times, values, first = pairs[::2], pairs[1::2], line[_V1_PAIRS[1] : 2 * _V1_PAIRS[1]]
        step, digit = float(times[-1] - times[0]) / (count - 1), 10.0 ** -decimals_of(line[: _V1_PAIRS[1]].strip())
        if step > 0.0 and np.all(np.abs(times - times[0] - step * np.arange(count)) <= digit):
            rate = round(1.0 / step)
            times, dt = None, 1.0 / rate if rate and abs(1.0 / rate - step) <= digit / (count - 1) else step
    scale = 0.1 if unit.lower() == "g/10" else 1.0
    rounding = 0.505 * (scale * 10.0 ** -decimals_of(first.strip()) + 10.0 ** -decimals_of(peak))
    largest = scale * float(np.abs(values).max())
    if unit.lower() in ("g", "g/10"):
        check_peak(largest, abs(float(peak)), rounding, where)
    note = ""
    if times is not None:
        times, values, note = without_repeated_times(times, values)
    return Series(
        f"{channel.label}, uncorrected{note}", dt, "g" if unit.lower() == "g/10" else unit, scale * values, times
    )


class _Allowance:
    """How much may still be read from an archive; one object for all nested archives."""

    def __init__(self, name: str):
        self._name, self._bytes, self._files = name, _LARGEST_CONTENT, _MOST_FILES

    def take(self, sizes: list[int]) -> None:
        """Raise ValueError if an archive with files of these sizes [bytes] exceeds the limits."""
        self._files -= len(sizes)
        self._bytes -= sum(sizes)
        if self._files < 0 or self._bytes < 0:
            raise ValueError(
                f"{self._name}: expected at most {_MOST_FILES} files with {_LARGEST_CONTENT} bytes in all, got more; "
                "unpack the archive and read the files"
            )


def _unzip(content: bytes, name: str, allowance: _Allowance | None = None, depth: int = 1) -> Iterator:
    """Yield the names and contents of the files in a zip archive, and in the archives that it contains."""
    allowance = allowance or _Allowance(name)
    if depth > _DEEPEST:
        raise ValueError(
            f"{name}: expected at most {_DEEPEST} archives within each other; unpack it and read the files"
        )
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            allowance.take([info.file_size for info in infos])
            for info in infos:
                inner = f"{name}/{info.filename}"
                if info.filename.lower().endswith(".zip"):
                    yield from _unzip(archive.read(info), inner, allowance, depth + 1)
                elif not info.is_dir():
                    yield inner, archive.read(info)
    except _ZIP_DAMAGE as error:
        raise ValueError(f"{name}: the zip archive cannot be read ({error}); download it again") from error


def _split_v2(text: str, file: str) -> list[V2Channel]:
    """Return the channels of a V2 file, without channels of velocity and displacement (in COSMOS files)."""
    channels = []
    if text.count("\n") > _MOST_LINES:
        raise ValueError(f"{file}: expected at most {_MOST_LINES} lines, got {text.count(chr(10))}")
    lines = text.splitlines()
    first = 0
    for index, line in enumerate(lines):
        end = _CSMIP_END.match(line) or _COSMOS_END.match(line)
        if not end and index < len(lines) - 1:
            continue
        block = lines[first : index + (not end)]
        if _is_v1(block) or any(_CSMIP_DATA.match(each) or _COSMOS_DATA.match(each) for each in block):
            head = "\n".join(block[:25])
            number = re.search(r"STA CHN:\s*(\d+)", head, re.IGNORECASE)
            label = re.search(r"^\s*(?:STA )?CHAN\s*(\d+|\?)\s*:[^\n]*", head, re.IGNORECASE | re.MULTILINE)
            if number is None and label is not None and label[1] != "?":
                number = label
            text = re.sub(r"\s+", " ", label[0]).strip() if label else Path(file).name
            channels.append(V2Channel(parse_count(number[1], file) if number else None, text, file, first + 1, block))
        first = index + 1
    return channels


def _column_format(line: str, where: str) -> tuple[int, int] | None:
    """Numbers per line and columns per number of the Fortran format at the end of a line; None without one."""
    stated = _FORMAT.search(line.rstrip()[-100:])
    if stated is None:
        return None
    per_line, width = parse_count(stated[1] or "1", where), parse_count(stated[2], where)
    if not (0 < per_line <= _WIDEST and 0 < width <= _WIDEST):
        raise ValueError(f"{where}: expected a format of 1 to {_WIDEST} numbers and columns, got {stated[0]!r}")
    return per_line, width


def _header_number(channel: V2Channel, start: int, form: tuple[int, int], place: int) -> float:
    """Return the time step at a position (from 1) of a fixed-width header that starts at a line of the channel."""
    value = float(_header_field(channel, start, form, place))
    if not value > 0:
        raise ValueError(
            f"{channel.file}, line {channel.first + start}: number {place} of the real header must be the time step "
            f"[s], got {value}"
        )
    return value


def _header_field(channel: V2Channel, start: int, form: tuple[int, int], place: int) -> str:
    """Return the text of the number at a position (from 1) of a fixed-width header."""
    row, column = divmod(place - 1, form[0])
    where = f"{channel.file}, line {channel.first + start + row}: number {place} of the header"
    line = channel.lines[start + row] if 0 <= start + row < len(channel.lines) else ""
    field = line[column * form[1] : (column + 1) * form[1]].strip()
    parse_number(field, where)
    return field


def _fixed_width(channel: V2Channel, start: int, count: int, form: tuple[int, int]) -> NDArray[np.float64]:
    """Return the samples in a block of Fortran columns, after which the file must have no further ones."""
    per_line, width = form
    values = fixed_width_samples(channel.lines, start, count, form, channel.file, channel.first)
    following = channel.lines[start - (-count // per_line) :][:1]
    if following and is_number(following[0][:width].strip()):
        raise ValueError(
            f"{channel.file}, line {channel.first + start}: the file announces {count} samples but has more after them"
        )
    return values
