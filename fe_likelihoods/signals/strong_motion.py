"""Files of strong-motion networks: which format a file has, and its samples as they are.

Each parser returns plain numbers with the unit, the step and the title that the file states, and converts nothing. The
stated number of samples and the stated peak are compared with the samples, so that a file with another layout is
refused instead of misread. Fortran columns have no separators: they are split by width, never at blanks.

* PEER AT2: header lines with NPTS and DT, then free-format samples.
* CSMIP V2: per channel 25 lines of text, integers, 100 reals in columns of 10, and blocks of acceleration, velocity and
  displacement, each after a line ``3000 POINTS OF ACCEL DATA EQUALLY SPACED AT  .020 SEC.  (UNITS: CM/SEC/SEC)``.
* CSMIP V1: per channel 13 lines of text, 100 integers in columns of 5, 50 reals in columns of 10 (the third is the
  length [s], the seventh the peak [g]), then ``13200 Accelerogram points at 200 pts/sec in units of g.  Format:
  (8f9.6)`` and samples, or pairs of a time [s] and a sample in columns of 7, with the unit in the text.
* COSMOS V1 and V2 (1.20): headers that state their length and Fortran format, then
  ``42000 acceleration pts, approx  210 secs, units=cm/sec2(04),Format=(1E15.6)``. All three end a channel with ``/&``.
* USGS SMC (U.S. Geological Survey, "SMC-format data files", ``smcfmt.html``): 11 lines of text, 48 integers in columns
  of 10, 50 reals in columns of 15, comments with ``|``, samples in columns of 10 [cm/s²]; times [s] alternate with
  samples where the number of samples per second is missing.
* GeoNet V1A, V2A (W. J. Cousins, 2008, "GNS accelerogram data files, standard format"): per component 16 lines of text,
  40 integers, 60 reals, accelerations [mm/s²], and in V2A velocities and displacements, all in columns of 8.
* K-NET, KiK-net (NIED, "About K-NET ASCII format"): 17 lines of names and values, then counts, which are multiplied by
  the stated factor. The mean is subtracted, as in the stated peak.
* ESM, ITACA (DYNA 1.x): lines ``NAME: value``, then one sample per line.
* miniSEED, SAC, GSE2: read by the package obspy.
"""

import codecs
import io
import itertools
import math
import re
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import to_si
from .sampling import expect
from .tables import is_clock
from .text_files import (
    LINE_END,
    NUMBER,
    WORKBOOKS,
    agree_on_unit,
    check_count,
    check_peaks,
    decimals_of,
    decode_text,
    is_number,
    number_cells,
    parse_number,
    read_bytes,
    read_statements,
)


class Series(NamedTuple):
    """Samples (n_steps,) as they are in a file, before any conversion; unit None if the file states none."""

    title: str
    dt: float  # [s], NaN with uneven times
    unit: str | None
    values: NDArray[np.float64]
    times: NDArray[np.float64] | None = None  # [s], if they are uneven
    name: str = ""  # of the record, if it is not the name of the file
    file: str = ""  # in an archive, with the archive
    source: str = ""  # if it is not the name of the file with the title


class Found(NamedTuple):
    """One acceleration in a file that may hold several."""

    channel: int | str | None  # number at the station, or direction; None for the only one
    label: str
    file: str  # with the archive
    parse: Callable[[], Series]


def read_series(
    path: str | Path, form: str, channel: int | str | None = None, inventory: str | Path | None = None
) -> Series:
    """The samples of the only channel with a number or name in a file of a format that `recognise` names.

    ValueError if there are several, which lists them. A text for V2 files is a number too, or the end of a file's name.
    """
    if form in OF_OBSPY:
        return _parse_obspy(path, form, channel, inventory)
    if form in _SINGLE:
        series = find_channels(path, form)[0].parse()
        return series._replace(name=Path(path).name) if form == "knet" else series  # the ending is the direction
    text, ending = "" if channel is None else str(channel).lower(), None
    if form == "v2" and isinstance(channel, str):
        text, ending = (str(int(channel)), None) if channel.isdecimal() else ("", channel)
    candidates = find_channels(path, form, ending)
    chosen = [each for each in candidates if text in ("", str(each.channel).lower())]
    if len(chosen) != 1:
        listing = "\n  ".join(f"channel {each.channel}: {each.label} [{each.file}]" for each in chosen or candidates)
        advice = "choose with column=, its number or the end of its file's name, among"
        expected = f"one channel with column={channel!r}, found {len(chosen)}"
        expect(False, path, expected, advice=f"{advice}\n  {listing}")
    file, series = chosen[0].file, chosen[0].parse()
    source = file.removeprefix(f"{Path(path).parent}/") if form == "v2" else ""
    return series._replace(name=series.title, file=file, source=source)


# which format ---------------------------------------------------------------------------------------------------------

_LOOK = 40  # lines in which a format is recognised
OF_OBSPY = ("MSEED", "SAC", "GSE2")
"""Formats that the package obspy reads, by its names."""


def recognise(path: str | Path) -> str | None:
    """The format of a file or zip archive, such as "v2" or "at2"; None for a table (CSV, Excel).

    ValueError if the file cannot be read, or has a known format that is not read.
    """
    content = read_bytes(path)
    if Path(path).suffix.lower() in WORKBOOKS:
        return None
    if zipfile.is_zipfile(io.BytesIO(content)):
        return "v2"
    marks = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
    encoding = next((each for mark, each in marks.items() if content.startswith(mark)), "latin-1")  # letters are bytes
    text = content[:8000].decode(encoding, errors="replace")
    lines = LINE_END.sub("\n", text).splitlines()
    name, form = ("", None) if _is_table(lines) else _form_of(lines[:_LOOK], text)
    if name and form is None:
        raise ValueError(f"{path}: this looks like a {name} file, which is not read; take a file of another format")
    return form


def _is_table(lines: list[str]) -> bool:
    """Whether two successive lines have numbers between commas, semicolons or tabs, which no format here has."""

    def has_numbers(line: str) -> bool:
        cells = [cell.strip() for cell in line.split(next((each for each in ";\t," if each in line), None))]
        separated = any(each in line for each in ";\t,")
        return separated and all(is_number(cell.replace(",", ".")) or is_clock(cell) for cell in cells)

    return any(map(all, itertools.pairwise(map(has_numbers, lines))))


def _form_of(lines: list[str], text: str) -> tuple[str, str | None]:
    """Name of a format, empty for another one, and its kind, None if it is not read."""
    first, head = next((line.strip() for line in lines), ""), "\n".join(lines)
    version = text[304:308].encode("latin-1", "replace")  # in the header of SAC, 632 bytes

    def begins(pattern: str) -> bool:
        return bool(re.match(pattern, first, re.IGNORECASE))

    rules = (
        ("K-NET or KiK-net", "knet", first.startswith("Origin Time") and "Scale Factor" in head),
        ("ESM or ITACA", "esm", first.startswith("EVENT_NAME:") and "SAMPLING_INTERVAL_S:" in head),
        ("USGS SMC", "smc", re.match(r"[0-9] +(UN)?CORRECTED ACCELEROGRAM", first)),
        ("USGS SMC without acceleration", None, re.match(r"[0-9] +(VELOCITY|DISPLACEMENT|RESPONSE|UNKNOWN)", first)),
        ("GeoNet", "geonet", begins("(un)?corrected accelerogram") and any(x.startswith("Site ") for x in lines[1:2])),
        ("COSMOS V0 (raw acceleration)", None, begins("raw acc") and "Format v0" in first),
        ("CSMIP or COSMOS V1", "v2", begins(r"uncorrected acceler(ation\b|ogram)")),
        ("CSMIP or COSMOS V2", "v2", begins("corrected acc")),
        ("CSMIP V3 (spectra)", None, begins("response and fourier")),
        ("BHRC V1", None, first.startswith("* VOL1DS FILE")),
        ("gzip", None, text.startswith("\x1f\x8b")),
        ("PDF", None, text.startswith("%PDF")),
        ("damaged zip", None, text.startswith("PK")),
        ("web page (HTML)", None, begins(r"<(!doctype )?html\b")),
        ("miniSEED", "MSEED", re.match(r"\d{6}[DRQM][ \0]|MS\x03", text)),
        ("GSE2", "GSE2", text.startswith("WID2 ")),
        ("SAC", "SAC", len(text) > 632 and b"\0\0\0" in (version[1:], version[:3]) and 6 in version[::3]),
        ("PEER AT2", "at2", re.search(r"NPTS\s*(=|,)", head) and "DT" in head and not first.startswith("#")),
        ("Taiwan CWB or SMART", None, first.startswith("#StationCode")),
        ("binary", None, "\0" in text.rstrip("\0\x1a\r\n ")),
    )
    return next(((name, form) for name, form, fits in rules if fits), ("", None))


# numbers in Fortran columns -------------------------------------------------------------------------------------------

_FORMAT = re.compile(r"\(\s*(\d*)\s*[a-z](\d+)\.\d+[^)]*\)$", re.IGNORECASE)
_WIDEST = 1000


class Block(NamedTuple):
    """Lines of a file, or of one channel in it. The form of a block of columns is (numbers per line, width)."""

    file: str  # with the archive that contains it
    lines: list[str]
    first: int = 1  # number of the first line in the file
    channel: int | str | None = None  # number at the station, or direction of a component
    label: str = ""

    def where(self, place: int) -> str:
        """File and line for a message."""
        return f"{self.file}, line {self.first + place}"

    def field(self, start: int, form: tuple[int, int], place: int) -> str:
        """Text of the number at a position, from 0, of a header in columns from the line with index `start`."""
        row, column = divmod(place, form[0])
        line = self.lines[start + row] if 0 <= start + row < len(self.lines) else ""
        field = line[column * form[1] : (column + 1) * form[1]].strip()
        parse_number(field, self.where(start + row))
        return field

    def header(self, start: int, count: int, form: tuple[int, int]) -> tuple[list[float], int]:
        """Numbers of a header, and the index of the line after them."""
        return [float(self.field(start, form, place)) for place in range(count)], start - (-count // form[0])

    def samples(self, start: int, count: int, form: tuple[int, int], last: bool = True) -> NDArray[np.float64]:
        """Samples in columns, which may touch. `last`: no further numbers may follow."""
        (per_line, width), values, line = form, [], ""
        end = start - (-count // per_line)
        for k in range(start, end):
            line = self.lines[k].rstrip() if k < len(self.lines) else ""
            wanted, found = min(per_line, count - len(values)), math.ceil(len(line) / width)
            expected = f"{wanted} numbers of {width} columns after {len(values)} of {count} samples"
            expect(found == wanted, self.where(k), expected, found, "the file is truncated or damaged")
            values += [parse_number(line[i * width :][:width].strip(), self.where(k)) for i in range(wanted)]
        expect(len(values) > 1, self.file, "two samples or more", len(values))
        cut = len(line) % width and len(self.lines[start].rstrip()) % width == 0  # the last line ends within a number
        expected = f"numbers of {width} columns, the last one is cut"
        expect(not cut, self.where(end - 1), expected, advice="it is truncated")
        following = next((line for line in self.lines[end:] if line.strip()), "")
        more = last and is_number(following[:width].strip())
        expect(not more, self.where(start), f"{count} samples as the file announces, but it has more after them")
        return np.array(values)

    def form_at_the_end_of(self, place: int) -> tuple[int, int]:
        """The Fortran format at the end of a line; ValueError without one."""
        line = self.lines[place].rstrip()
        stated = _FORMAT.search(line[-100:])
        form = (int(stated[1][:9] or 1), int(stated[2][:9])) if stated else (0, 0)
        known, expected = all(0 < each <= _WIDEST for each in form), f"of 1 to {_WIDEST} numbers and columns"
        expect(known, self.where(place), f"a Format such as (8F10.5) {expected}", repr(line))
        return form


def _check_peak(found: float, stated: float, tolerance: float, where: str) -> None:
    """ValueError if the stated peak is not the peak of the samples."""
    expected, advice = f"the peak of {stated:g} that the header states", "the file is damaged, or of another form"
    expect(abs(found - stated) <= tolerance, where, expected, f"{found:g}", advice)


def _check_step(dt: float, where: str, stated: str | None = None) -> float:
    """The step [s] in a header; ValueError if it is not positive, or the text `stated` another one."""
    expect(dt > 0.0, where, "the time step [s] in the header", f"{dt:g}")
    if stated is not None and abs(dt - float(stated)) > 0.51e-3:  # texts have three decimals
        raise ValueError(f"{where}: the step is {stated} s in the text but {dt:g} s in the header; the file is damaged")
    return dt


def _whole(number: float, file: str, what: str) -> int:
    """A number of lines or samples."""
    expect(0.0 <= number < 1e9 and abs(number - round(number)) <= 1e-6, file, f"a number of {what}", f"{number:g}")
    return round(number)


def _uneven(title: str, unit: str, times: NDArray[np.float64], values: NDArray[np.float64]) -> Series:
    """A digitised record with the mean of the samples of equal times.

    Such samples are closer to each other than the printed digits of their times show. Times that decrease stay.
    """
    first = np.concatenate([[True], np.diff(times) != 0.0])
    number = np.cumsum(first) - 1
    title += "" if first.all() else f", mean of samples of equal times ({int((~first).sum())})"
    return Series(title, math.nan, unit, np.bincount(number, weights=values) / np.bincount(number), times[first])


# PEER -----------------------------------------------------------------------------------------------------------------

# Expressions are searched from one place in a line, and their parts never match the same text: their time is linear.
_AT2_COUNT = re.compile(r"NPTS\s*=\s*(\d+)\b", re.IGNORECASE)
_AT2_STEP = re.compile(rf"\bDT\s*=\s*({NUMBER})\s*([a-z]*)", re.IGNORECASE)
_AT2_OLD = re.compile(rf"\s*(\d+)\s+({NUMBER})\s*(?:,\s*)?NPTS\s*,\s*DT", re.IGNORECASE)
_UNITS_OF = re.compile(r"UNITS?\s*(?:OF|ARE|IS|:|=)\s*[(\[]?\s*([^\s,;()\[\]]+?)[)\]]?[.]?(?=[\s,;]|$)", re.IGNORECASE)


def _parse_at2(text: str, file: str) -> Series:
    """The samples of a PEER AT2 file, in the new or old form of its header."""
    lines = text.splitlines()
    index, stated = next(((i, found) for i, line in enumerate(lines) if (found := _at2_header(line))), (None, None))
    expected = "a header line 'NPTS=  4096, DT=  .0100 SEC' or '4096  .0100  NPTS, DT'"
    expect(stated, file, f"{expected}, found none in {len(lines)} lines", advice="is it a table of plain columns?")
    units = _UNITS_OF.search("\n".join(lines[:index]))
    rows = [(number, row) for number, row in enumerate(lines[index + 1 :], index + 2) if row.strip()]
    while rows and re.search("[A-Za-z]{3}", rows[-1][1]) and not any(map(is_number, rows[-1][1].split())):
        rows.pop()  # a closing remark in any words: the number of samples is stated
    values = [parse_number(cell, f"{file}, line {number}") for number, row in rows for cell in number_cells(row)]
    check_count(len(values), stated[0], f"{file}: NPTS in line {index + 1}")
    step, where = f"{stated[1]} {stated[2]}", f"{file}, line {index + 1}"
    seconds = stated[2].lower() in ("", "s", "sec", "secs", "second", "seconds")
    expect(seconds, where, "DT in seconds, such as 'DT= .0100 SEC'", step, "write it in seconds")
    title = lines[index - 2].strip() if index >= 2 else ""
    return Series(title, float(stated[1]), units[1] if units else None, np.array(values))


def _at2_header(line: str) -> tuple[str, str, str] | None:
    """Number of samples, step and unit of the step, as stated in a line of an AT2 header; None for other lines."""
    if (count := _AT2_COUNT.search(line)) and (step := _AT2_STEP.search(line)):
        return count[1], step[1], step[2]
    old = _AT2_OLD.match(line)
    return (old[1], old[2], "") if old else None


# CSMIP and COSMOS -----------------------------------------------------------------------------------------------------

_COUNT = r"^\s*(\d{1,12})\s+"
_CSMIP_DATA = re.compile(rf"{_COUNT}points\s+of\s+accel\s+data\s+equally\s+spaced\s+at\s*({NUMBER})", re.IGNORECASE)
_CSMIP_UNITS = re.compile(r"units:\s*([^\s)]+)|\bin\s+([^\s.,]+)", re.IGNORECASE)
_COSMOS_DATA = re.compile(rf"{_COUNT}acceleration\s+pts\b.*?units\s*=\s*([^\s,(]+)", re.IGNORECASE)
_COSMOS_REALS = re.compile(rf"{_COUNT}real-header\s+values\s+follow\s+on\s+(\d+)\s+lines", re.IGNORECASE)
_END = re.compile(r"^\s*(/&|end-of-data)", re.IGNORECASE)
_V1_FIRST = re.compile(r"\s*uncorrected accelerogram", re.IGNORECASE)
_V1_DATA = re.compile(
    rf"{_COUNT}accelerogram\s+points\s+at\s*({NUMBER})\s*pts/sec\s+in\s+units\s+of\s+(\S+?)\s*\.", re.IGNORECASE
)
_V1_UNITS = re.compile(r"units\s+of\s+uncor\s+\w+\s+are\s+sec\s+and\s+(g/10|g)\b", re.IGNORECASE)
_V1_TEXT, _V1_INTEGERS, _V1_REALS, _V1_PAIRS = 13, (16, 5), (8, 10), (10, 7)  # lines; forms of blocks
_V1_REAL_START = _V1_TEXT + math.ceil(100 / 16)  # lines before the 50 reals
_V1_HEADER = _V1_REAL_START + math.ceil(50 / 8)
_V2_TEXT, _CSMIP_FORM, _CSMIP_REALS = 25, (8, 10), 100
# positions in headers, from 0: step of V2 files; number, length and peak of V1 files
_CSMIP_DT, _COSMOS_DT, _V1_COUNT, _V1_LENGTH, _V1_PEAK = 60, 33, 27, 2, 6
# Limits of a zip archive and all within it: bytes and files. Stations have a few MiB.
_LARGEST_CONTENT, _MOST_FILES = 64 * 2**20, 2000


def find_channels(path: str | Path, form: str, member: str | None = None) -> list[Found]:
    """The accelerations in a file, or in the V2, else V1 files of an archive, or in its files with an end of a name."""
    content, file = read_bytes(path), str(path)
    if form in OF_OBSPY:
        return [Found(None, Path(path).name, file, partial(_parse_obspy, path, form))]
    if form != "v2":
        text = decode_text(content).rstrip("\0\x1a")
        if form == "geonet":
            return _parse_geonet(text, file)
        return [Found(None, Path(path).name, file, partial(_SINGLE[form], text, file))]
    files = [(file, content)]
    if zipfile.is_zipfile(io.BytesIO(content)):
        files = list(dict.fromkeys(_unzip(content, file, file, [_MOST_FILES, _LARGEST_CONTENT])))

    def ending(*ends: str) -> list[tuple[str, bytes]]:
        return [(name, data) for name, data in files if name.lower().endswith(ends)]

    if member is not None:
        files = [each for each in files if each[0] == f"{path}/{member}"] or ending(member.lower())
    elif len(files) > 1:  # corrected acceleration, if there is any
        files = ending(".v2", ".v2c") or ending(".v1", ".v1c")
    channels = [channel for name, data in files for channel in _split_v2(decode_text(data), name)]
    expected = "'N POINTS OF ACCEL DATA EQUALLY SPACED AT ...', 'N acceleration pts ...' or 'Uncorrected accelerogram'"
    none = f"found none in {len(files)} file(s)" + (f" named {member!r}" if member else "")
    expect(channels, path, f"a CSMIP or COSMOS V1 or V2 file with a line {expected}, {none}")
    found = [Found(each.channel, each.label, each.file, partial(_parse_v2, each)) for each in channels]
    return sorted(found, key=lambda each: (each.channel is None, each.channel or 0))


def _unzip(content: bytes, name: str, archive: str, left: list[int]) -> Iterator[tuple[str, bytes]]:
    """Yield the names and contents of the files in a zip archive, and in the archives that it contains.

    `left` is how many files and bytes may still be read, for all nested archives together.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as opened:
            infos = opened.infolist()
            left[:] = left[0] - len(infos), left[1] - sum(info.file_size for info in infos)
            fits = min(left) >= 0
            members = [(each.filename, opened.read(each)) for each in infos if fits and not each.is_dir()]
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"{name}: the zip archive cannot be read ({error}); download it again") from error
    expected = f"at most {_MOST_FILES} files with {_LARGEST_CONTENT} bytes in all"
    expect(fits, archive, expected, "more", "unpack the archive and read the files")
    for member, data in members:
        inner = f"{name}/{member}"
        yield from _unzip(data, inner, archive, left) if member.lower().endswith(".zip") else [(inner, data)]


def _split_v2(text: str, file: str) -> list[Block]:
    """The channels of a V2 file, without channels of velocity and displacement (in COSMOS files)."""
    channels, lines, first = [], text.splitlines(), 0
    for index, line in enumerate(lines):
        end = _END.match(line)
        if not end and index < len(lines) - 1:
            continue
        block = lines[first : index + (not end)]
        if _is_v1(block) or any(_CSMIP_DATA.match(each) or _COSMOS_DATA.match(each) for each in block):
            head = "\n".join(block[:25])
            label = re.search(r"^\s*(?:STA )?CHAN\s*(\d{1,12}|\?)\s*:[^\n]*", head, re.IGNORECASE | re.MULTILINE)
            number = re.search(r"STA CHN:\s*(\d{1,12})", head, re.IGNORECASE) or label
            known = int(number[1]) if number and number[1] != "?" else None
            title = " ".join(label[0].split()) if label else Path(file).name
            channels.append(Block(file, block, first + 1, known, title))
        first = index + 1
    return channels


def _is_v1(lines: list[str]) -> bool:
    """Whether the lines of a channel are in the CSMIP format V1."""
    first = bool(lines and _V1_FIRST.match(lines[0])) and len(lines) > _V1_HEADER
    return first and not any(map(_CSMIP_DATA.match, lines))


def _parse_v2(block: Block) -> Series:
    """The acceleration of one channel."""
    lines = block.lines
    if _is_v1(lines):
        return _parse_v1(block)
    index = next(i for i, line in enumerate(lines) if _CSMIP_DATA.match(line) or _COSMOS_DATA.match(line))
    line, where = lines[index], block.where(index)
    if csmip := _CSMIP_DATA.match(line):
        units = _CSMIP_UNITS.search(line, csmip.end())
        expect(units, where, f"the unit of acceleration in {line.strip()!r}")
        unit = units[1] or units[2]
        form = block.form_at_the_end_of(index) if _FORMAT.search(line.rstrip()) else _CSMIP_FORM
        start = index - math.ceil(_CSMIP_REALS / _CSMIP_FORM[0])
        # the data line has the step with three decimals only, the real header may have more
        dt = _check_step(float(block.field(start, _CSMIP_FORM, _CSMIP_DT)), where, csmip[2])
    else:
        unit, form = _COSMOS_DATA.match(line)[2], block.form_at_the_end_of(index)
        header = next((i for i in range(index) if _COSMOS_REALS.match(lines[i])), None)
        expect(header is not None, where, "a line 'N Real-header values follow on N lines, Format= (5F15.6)'")
        dt = _check_step(float(block.field(header + 1, block.form_at_the_end_of(header), _COSMOS_DT)), where)
    values = block.samples(index + 1, int((csmip or _COSMOS_DATA.match(line))[1]), form)
    if csmip:
        decimals = decimals_of(lines[index + 1][: form[1]].strip())
        check_peaks(read_statements(lines[:_V2_TEXT]).peaks_of([""], 0), values, decimals, unit, block.file)
    uncorrected = ", uncorrected" if re.match(r"\s*uncorrected", lines[0], re.IGNORECASE) else ""
    return Series(block.label + uncorrected, dt, unit, values)


def _parse_v1(block: Block) -> Series:
    """The uncorrected acceleration of one channel: at a constant rate, or with times."""
    where, line, times = block.file, block.lines[_V1_HEADER], None
    length, peak = (block.field(_V1_REAL_START, _V1_REALS, place) for place in (_V1_LENGTH, _V1_PEAK))
    if match := _V1_DATA.match(line):
        unit, rate, count = match[3], float(match[2]), int(match[1])
        dt = _check_step(1.0 / rate if rate else 0.0, block.where(_V1_HEADER))
        form = block.form_at_the_end_of(_V1_HEADER)
        values = block.samples(_V1_HEADER + 1, count, form)
        fits, got = abs(count * dt - float(length)) <= 2.0 * dt, f"{count} samples at {1 / dt:g} per second"
        expect(fits, where, f"{length} s", got, "the file is damaged")
        printed = block.lines[_V1_HEADER + 1][: form[1]]
    else:
        found = _V1_UNITS.search("\n".join(block.lines[:_V1_TEXT]))
        expect(found, where, f"'Units of uncor data are sec and g' or 'g/10' in {_V1_TEXT} lines")
        unit, width = found[1], _V1_PAIRS[1]
        count = _whole(float(block.field(_V1_TEXT, _V1_INTEGERS, _V1_COUNT)), where, "samples")
        pairs = block.samples(_V1_HEADER, 2 * count, _V1_PAIRS)
        times, values, printed = pairs[::2], pairs[1::2], line[width : 2 * width]
        dt, digit = float(times[-1] - times[0]) / max(count - 1, 1), 10.0 ** -decimals_of(line[:width].strip())
        if dt > 0.0 and np.all(np.abs(times - times[0] - dt * np.arange(count)) <= digit):
            rate, times = round(1.0 / dt), None
            dt = 1.0 / rate if rate and abs(1.0 / rate - dt) <= digit / (count - 1) else dt
    scale = 0.1 if unit.lower() == "g/10" else 1.0
    if unit.lower() in ("g", "g/10"):
        unit = "g" if scale == 0.1 else unit
        rounding = 0.505 * (scale * 10.0 ** -decimals_of(printed.strip()) + 10.0 ** -decimals_of(peak))
        _check_peak(scale * np.abs(values).max(), abs(float(peak)), rounding, where)
    title = f"{block.label}, uncorrected"
    return Series(title, dt, unit, scale * values) if times is None else _uneven(title, unit, times, scale * values)


# USGS and GeoNet ------------------------------------------------------------------------------------------------------

_SMC_NULL = 1.6e38  # larger reals stand for missing values
_SMC_TYPES = ("1 UNCORRECTED ACCELEROGRAM", "2 CORRECTED ACCELEROGRAM")
_SMC_TEXT, _SMC_INTEGERS, _SMC_REALS, _SMC_DATA = 11, (8, 10), (5, 15), (8, 10)
_GEONET_TEXT, _GEONET_FORM = 16, (10, 8)
_GEONET_PEAK = re.compile(rf"Acceleration:\s*peak\s*({NUMBER})\s*mm/s/s", re.IGNORECASE)
_GEONET_STEP = re.compile(rf"\bat\s+(?:intervals\s+of\s+)?({NUMBER})\s*s", re.IGNORECASE)
_GEONET_UNIT = re.compile(rf"in\s+units\s+of\s+({NUMBER})\s*mm/s/s", re.IGNORECASE)


def _parse_smc(text: str, file: str) -> Series:
    """The samples of a USGS SMC file, uncorrected or corrected."""
    block = Block(file, text.splitlines())
    title = " ".join(block.lines[0].split(maxsplit=1)).strip() if block.lines else ""
    expect(title in _SMC_TYPES, file, f"the first line of an SMC file, {' or '.join(_SMC_TYPES)}", repr(title[:80]))
    integers, start = block.header(_SMC_TEXT, 48, _SMC_INTEGERS)
    reals, start = block.header(start, 50, _SMC_REALS)
    comments, count = (_whole(integers[place], file, what) for place, what in ((15, "comment lines"), (16, "samples")))
    rate, highest, lowest = reals[1], reals[29], reals[31]
    uneven = rate >= _SMC_NULL  # pairs of time and acceleration
    expected = "a positive number of samples per second as second real, or none and an even number of times and values"
    expect(rate > 0.0 and not (uneven and count % 2), file, expected, f"{rate:g} and {count} numbers")
    marked = all(line.startswith("|") for line in block.lines[start : start + comments])
    expect(marked, file, f"{comments} comment lines that start with '|'", advice="the file is damaged")
    numbers = block.samples(start + comments, count, _SMC_DATA)
    values = numbers[1::2] if uneven else numbers
    for stated, found in ((highest, values.max()), (lowest, values.min())):
        if abs(stated) < _SMC_NULL:
            _check_peak(found, stated, 2e-4 * np.abs(values).max(), file)
    station = next((" ".join(line.split()) for line in block.lines[2:_SMC_TEXT] if line.startswith("station")), title)
    return _uneven(station, "cm/s2", numbers[::2], values) if uneven else Series(station, 1.0 / rate, "cm/s2", values)


def _parse_geonet(text: str, file: str) -> list[Found]:
    """The components of a GeoNet V1A or V2A file, with directions such as ``"S16W"`` or ``"Up"``."""
    block, place, found = Block(file, text.splitlines()), 0, []
    while any(line.strip() for line in block.lines[place : place + 3]):
        component, series, place = _geonet_component(block, place)
        found.append(Found(component, series.title, file, lambda series=series: series))
    return found


def _geonet_component(block: Block, place: int) -> tuple[str, Series, int]:
    """Direction and samples of one component, and the line after it."""
    lines, where = block.lines, block.where(place)
    head = "\n".join(lines[place : place + _GEONET_TEXT])
    first = re.match(r"\s*(un)?corrected accelerogram", head, re.IGNORECASE)
    peak, component = _GEONET_PEAK.search(head), re.search(r"^Component\s+(\S+)", head, re.MULTILINE)
    step = next((match for line in head.splitlines()[10:12] if (match := _GEONET_STEP.search(line))), None)
    expected = "'Corrected accelerogram' or 'Uncorrected accelerogram', the first line of a component of a GeoNet file"
    expected += f", and component, step and peak acceleration in {_GEONET_TEXT} lines"
    expect(first and peak and component and step, where, expected, repr(lines[place][:80]))
    integers, start = block.header(place + _GEONET_TEXT, 40, _GEONET_FORM)
    reals, start = block.header(start, 60, _GEONET_FORM)
    counts, dt = [_whole(number, block.file, "samples") for number in integers[33:36]], reals[25]
    _check_step(dt, where, step[1])
    unit = _GEONET_UNIT.search(head)
    scale = float(unit[1]) if unit else 1.0
    values = scale * block.samples(start, counts[0], _GEONET_FORM, last=False)
    # the peak is rounded to the digits that are printed; the samples are rounded or cut
    printed = block.field(start, _GEONET_FORM, int(np.argmax(np.abs(values))))
    resolution = 1.01 * scale * 10.0 ** -decimals_of(printed) + 0.505 * 10.0 ** -decimals_of(peak[1])
    _check_peak(np.abs(values).max(), abs(float(peak[1])), resolution, where)
    end = start + sum(math.ceil(count / _GEONET_FORM[0]) for count in counts)
    expect(end <= len(lines), where, f"{sum(counts)} numbers up to line {end}", advice="the file is truncated")
    site = re.search(r"^Site\s+(\S+)", head, re.MULTILINE)
    title = f"{site[1] if site else 'GeoNet'}, component {component[1]}"
    return component[1], Series(title, dt, "mm/s2", values), end


# K-NET and ESM --------------------------------------------------------------------------------------------------------

_KNET_TEXT, _KNET_NAME = 17, 18
_KNET_SCALE = re.compile(rf"({NUMBER})?\s*\(gal\)\s*/\s*({NUMBER})$", re.IGNORECASE)
_ESM_TEXT, _ESM_NAME = 200, re.compile(r"[A-Z][A-Z0-9_/^]*:")  # most lines of the header; 55 to 64 in known versions


def _stated(header: dict[str, str], names: tuple[str, ...], file: str, form: str) -> list[str]:
    """The values of names in a header; ValueError if one is missing."""
    missing = ", ".join(name for name in names if name not in header)
    expect(not missing, file, f"the header of {form} file, {missing} are missing")
    return [header[name] for name in names]


def _samples_below(lines: list[str], start: int, file: str) -> NDArray[np.float64]:
    """Numbers that blanks separate, from the line with index `start`."""
    fields = ((k, field) for k, line in enumerate(lines[start:], start + 1) for field in line.split())
    return np.array([parse_number(field, f"{file}, line {k}") for k, field in fields])


def _parse_knet(text: str, file: str) -> Series:
    """The samples of a K-NET or KiK-net file, without their mean."""
    lines = text.splitlines()
    header = {line[:_KNET_NAME].replace(".", "").strip(): line[_KNET_NAME:].strip() for line in lines[:_KNET_TEXT]}
    names = ("Station Code", "Sampling Freq(Hz)", "Duration Time(s)", "Dir", "Scale Factor", "Max Acc (gal)")
    station, frequency, duration, direction, factor, peak = _stated(header, names, file, "a K-NET")
    rate = parse_number(re.sub(r"\s*hz$", "", frequency, flags=re.IGNORECASE), f"{file}, Sampling Freq")
    scale, known = _KNET_SCALE.match(factor), "a positive frequency and a scale factor such as '3920(gal)/6182761'"
    expect(scale and float(scale[2]) > 0.0 and rate > 0.0, file, known, f"{rate:g} and {factor!r}")
    counts = _samples_below(lines, _KNET_TEXT, file)
    count = _whole(rate * parse_number(duration, f"{file}, Duration Time"), file, "samples")
    check_count(counts.size, count, f"{file}: frequency times duration")
    # "(gal)/1048.2" means 1 gal; the stated peak is compared below
    values = (counts - counts.mean()) * (float(scale[1] or 1.0) / float(scale[2]))
    stated = parse_number(peak, f"{file}, Max. Acc.")
    _check_peak(np.abs(values).max(), stated, 2e-3 * abs(stated) + 2e-3, file)
    return Series(f"{station}, channel {direction}, mean subtracted", 1.0 / rate, "gal", values)


def _parse_esm(text: str, file: str) -> Series:
    """The samples of an ESM or ITACA file."""
    lines = text.splitlines()
    stated = (line.partition(":") for line in itertools.takewhile(_ESM_NAME.match, lines[:_ESM_TEXT]))
    header = {name: value.strip() for name, _, value in stated}
    names = ("SAMPLING_INTERVAL_S", "NDATA", "UNITS", "DATA_TYPE", "STATION_CODE", "STREAM")
    interval, count, unit, kind, station, stream = _stated(header, names, file, "an ESM or ITACA")
    expect(kind.upper() == "ACCELERATION", file, "acceleration", f"DATA_TYPE {kind!r}", "take the ACC file")
    dt = _check_step(parse_number(interval, f"{file}, SAMPLING_INTERVAL_S"), f"{file}, SAMPLING_INTERVAL_S")
    values, where = _samples_below(lines, len(header), file), f"{file}: NDATA"
    check_count(values.size, _whole(parse_number(count, where), file, "samples"), where)
    if (stated := header.get("PGA_CM/S^2")) and values.size:
        peak = abs(parse_number(stated, f"{file}, PGA_CM/S^2"))
        scale = float(to_si(1.0, agree_on_unit(unit, None, "acceleration", file)) / to_si(1.0, "cm/s2"))
        _check_peak(scale * np.abs(values).max(), peak, 1e-4 * peak + 2e-6 * scale, file)
    return Series(f"{header.get('NETWORK', '')}.{station} {stream}", dt, unit, values)


_SINGLE = {"at2": _parse_at2, "smc": _parse_smc, "knet": _parse_knet, "esm": _parse_esm}
"""Parsers of formats with one acceleration."""

# seismology -----------------------------------------------------------------------------------------------------------


def _parse_obspy(
    path: str | Path, form: str, channel: str | None = None, inventory: str | Path | None = None
) -> Series:
    """The samples of one trace in a miniSEED, SAC or GSE2 file, in m/s2 with the `inventory` of its recorder."""
    try:
        import obspy
    except ImportError as error:
        raise ValueError(
            f"reading {path} needs the package obspy: install it with pip install obspy, or write the record as CSV"
        ) from error
    try:
        # by name: obspy would also find formats such as pickle, which runs code of the file
        stream = obspy.read(io.BytesIO(read_bytes(path)), format=form).merge()
        traces = [trace for trace in stream if channel is None or trace.id.endswith(channel)]
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path}: obspy cannot read the file ({error}); download it again") from error
    advice = f"the traces are {', '.join(trace.id for trace in stream)}"
    expect(len(traces) == 1, path, f"one trace with column={channel!r}, found {len(traces)}", advice=advice)
    trace, lacking = traces[0], np.ma.count_masked(traces[0].data)
    advice = "an excitation needs all samples: cut the record, or fill the gaps in obspy"
    expect(not lacking, path, "all samples", f"{trace.id} without {lacking} samples", advice)
    if inventory is not None:
        try:
            # neither taper nor mean are removed: the record of an event may begin and end with motion
            stations = obspy.read_inventory(io.BytesIO(read_bytes(inventory)), format="STATIONXML")
            trace.remove_response(stations, output="ACC", water_level=60.0, zero_mean=False, taper=False)
        except Exception as error:  # no response of this channel at this time, or anything else
            raise ValueError(
                f"{path}: obspy cannot apply the inventory {inventory} to {trace.id} ({error}); give the StationXML "
                "file with the response of this channel at the time of the record"
            ) from error
    got, advice = f"whole numbers, counts of the recorder {trace.id}", "give its StationXML file, inventory="
    expect(np.issubdtype(trace.data.dtype, np.floating), path, "accelerations", got, advice)
    quantity = {6: "displacement", 7: "velocity"}.get(trace.stats.get("sac", {}).get("idep"))
    expect(not quantity, path, "acceleration", f"{quantity} by the SAC header of {trace.id}", "differentiate it")
    rate = round(1.0 / trace.stats.delta)  # SAC has the step in single precision
    dt = 1.0 / rate if rate and abs(rate * trace.stats.delta - 1.0) < 1e-6 else trace.stats.delta
    unit = None if inventory is None else "m/s2"
    return Series(trace.id, float(dt), unit, np.asarray(trace.data, dtype=np.float64), name=trace.id)
