"""File formats of strong-motion networks: USGS SMC, GeoNet V1A and V2A, K-NET and KiK-net, ESM and ITACA.

The functions return plain numbers with the unit, the step and the title that a file states, as in
`fe_likelihoods.signals.at2_v2_formats`. The stated number of samples and the stated peak are compared with the samples,
so that a file with another layout is refused instead of misread.

USGS SMC
    11 lines of text, 48 integers in columns of 10, 50 reals in columns of 15, comment lines with ``|``, samples in
    columns of 10 [cm/s²]; times [s] alternate with samples where the number of samples per second is missing.
    Format description: U.S. Geological Survey, National Strong-Motion Program, "SMC-format data files",
    ``smcfmt.html``.
GeoNet V1A, V2A
    Per component 16 lines of text, 40 integers and 60 reals in columns of 8, then accelerations [mm/s²], and in V2A
    velocities and displacements, in columns of 8. Format description: W. J. Cousins (2008), "GNS accelerogram data
    files, standard format"; GeoNet, "Strong motion file formats".
K-NET, KiK-net
    17 lines of names and values, then counts, which are multiplied by the stated scale factor. The mean is subtracted,
    as in the stated peak. Format description: National Research Institute for Earth Science and Disaster Resilience,
    "About K-NET ASCII format".
ESM, ITACA (DYNA 1.x)
    Lines ``NAME: value``, then one sample per line. Format description: ITACA development team, "DYNA 1.0".
"""

import math
import re
from typing import NamedTuple

import numpy as np

from ..units import from_si, to_si
from .at2_v2_formats import fixed_width_samples
from .clock_times import is_clock
from .text_files import (
    LINE_END,
    NUMBER,
    Series,
    agree_on_unit,
    check_count,
    check_peak,
    decimals_of,
    is_number,
    opening_text,
    parse_count,
    parse_number,
)
from .uneven_times import without_repeated_times

__all__ = ["GeonetComponent", "parse_esm", "parse_geonet", "parse_knet", "parse_smc", "recognise"]

_SMC_NULL = 1.6e38  # larger reals stand for missing values
_SMC_TYPES = {"1": "UNCORRECTED ACCELEROGRAM", "2": "CORRECTED ACCELEROGRAM"}
_SMC_TEXT, _SMC_INTEGERS, _SMC_REALS, _SMC_DATA = 11, (48, 8, 10), (50, 5, 15), (8, 10)
_GEONET_TEXT, _GEONET_INTEGERS, _GEONET_REALS, _GEONET_DATA = 16, (40, 10, 8), (60, 10, 8), (10, 8)
_GEONET_PEAK = re.compile(rf"Acceleration:\s*peak\s*({NUMBER})\s*mm/s/s", re.IGNORECASE)
_GEONET_STEP = re.compile(rf"\bat\s+(?:intervals\s+of\s+)?({NUMBER})\s*s", re.IGNORECASE)
_GEONET_UNIT = re.compile(rf"in\s+units\s+of\s+({NUMBER})\s*mm/s/s", re.IGNORECASE)
_KNET_TEXT, _KNET_NAME = 17, 18
_KNET_SCALE = re.compile(rf"({NUMBER})?\s*\(gal\)\s*/\s*({NUMBER})$", re.IGNORECASE)
_ESM_TEXT, _ESM_NAME = 200, re.compile(r"[A-Z][A-Z0-9_/^]*:")  # most lines of the header; 55 to 64 in known versions
_MOST_COMPONENTS = 100
_LOOK = 40  # lines in which a format is recognised
_READERS = {
    "PEER AT2": "read_at2",
    "CSMIP or COSMOS V1": "read_v2",
    "CSMIP or COSMOS V2": "read_v2",
    "USGS SMC": "read_smc",
    "GeoNet": "read_geonet",
    "K-NET or KiK-net": "read_knet",
    "ESM or ITACA": "read_esm",
    "miniSEED": "read_obspy",
    "GSE2": "read_obspy",
    "SAC": "read_obspy",
}


class GeonetComponent(NamedTuple):
    """Direction of one component of a GeoNet file, such as ``"S16W"`` or ``"Up"``, and its acceleration."""

    component: str
    series: Series


def recognise(content: bytes) -> tuple[str, str | None]:
    """Return the name of a file's format (empty if unknown), and of the function that reads it (None if not read)."""
    text = opening_text(content)
    lines = LINE_END.sub("\n", text).splitlines()
    name = "" if _is_table(lines) else _name_of(lines[:_LOOK], text)
    return name, _READERS.get(name)


def _is_table(lines: list[str]) -> bool:
    """Whether two successive lines have numbers between commas, semicolons or tabs, which no format here has."""
    before = False
    for line in lines:
        separator = next((each for each in (";", "\t", ",") if each in line), None)
        cells = [] if separator is None else [cell.strip() for cell in line.split(separator)]
        numbers = len(cells) > 1 and all(is_number(cell.replace(",", ".")) or is_clock(cell) for cell in cells)
        if numbers and before:
            return True
        before = numbers
    return False


def _is_sac(text: str) -> bool:
    """Whether a file has the header of a binary SAC file: 632 bytes, with the version in the 77th word."""
    version = text[304:308].encode("latin-1")
    return (
        len(text) > 632 and (version[1:] == b"\0\0\0" or version[:3] == b"\0\0\0") and 6 in version[:1] + version[-1:]
    )


def _name_of(lines: list[str], text: str) -> str:
    first = next((line.strip() for line in lines), "")
    head = "\n".join(lines)
    rules = (
        ("HDF5", text.startswith("\x89HDF")),
        ("K-NET or KiK-net", first.startswith("Origin Time") and "Scale Factor" in head),
        ("ESM or ITACA", first.startswith("EVENT_NAME:") and "SAMPLING_INTERVAL_S:" in head),
        ("USGS SMC", bool(re.match(r"[0-9] +(UN)?CORRECTED ACCELEROGRAM", first))),
        ("USGS SMC without acceleration", bool(re.match(r"[0-9] +(VELOCITY|DISPLACEMENT|RESPONSE|UNKNOWN)", first))),
        (
            "GeoNet",
            bool(re.match(r"(un)?corrected accelerogram", first, re.IGNORECASE))
            and any(line.startswith("Site ") for line in lines[1:2]),
        ),
        ("COSMOS V0 (raw acceleration)", bool(re.match(r"raw acc", first, re.IGNORECASE)) and "Format v0" in first),
        ("CSMIP or COSMOS V1", bool(re.match(r"uncorrected acceler(ation\b|ogram)", first, re.IGNORECASE))),
        ("CSMIP or COSMOS V2", bool(re.match(r"corrected acc", first, re.IGNORECASE))),
        ("CSMIP V3 (spectra)", bool(re.match(r"response and fourier", first, re.IGNORECASE))),
        ("BHRC V1", first.startswith("* VOL1DS FILE")),
        ("LabVIEW TDMS", text.startswith("TDSm")),
        ("MATLAB", text.startswith("MATLAB 5.0 MAT-file")),
        ("gzip", text.startswith("\x1f\x8b")),
        ("PDF", text.startswith("%PDF")),
        ("web page (HTML)", bool(re.match(r"<(!doctype )?html\b", first, re.IGNORECASE))),
        ("miniSEED", bool(re.match(r"\d{6}[DRQM][ \0]|MS\x03", text))),
        ("GSE2", text.startswith("WID2 ")),
        ("SAC", _is_sac(text)),
        ("PEER AT2", bool(re.search(r"NPTS\s*(=|,)", head)) and "DT" in head and not first.startswith("#")),
        ("Taiwan CWB or SMART", first.startswith("#StationCode")),
        ("binary", "\0" in text.rstrip("\0\x1a\r\n ") and not text.startswith("PK")),  # no workbook
    )
    return next((name for name, fits in rules if fits), "")


def parse_smc(text: str, file: str) -> Series:
    """Return the samples of a USGS SMC file (see `fe_likelihoods.signals.read.read_smc`)."""
    lines = text.splitlines()
    title = lines[0].strip() if lines else ""
    number, _, kind = title.partition(" ")
    if _SMC_TYPES.get(number) != kind.strip():
        raise ValueError(
            f"{file}: expected the first line '1 UNCORRECTED ACCELEROGRAM' or '2 CORRECTED ACCELEROGRAM' of an SMC "
            f"file, got {title[:80]!r}"
        )
    integers = _numbers(lines, _SMC_TEXT, *_SMC_INTEGERS, file)
    first_real = _SMC_TEXT + _SMC_INTEGERS[0] // _SMC_INTEGERS[1]
    reals = _numbers(lines, first_real, *_SMC_REALS, file)
    comments, count = (_whole(integers[place], file, what) for place, what in ((15, "comment lines"), (16, "samples")))
    rate, highest, lowest = reals[1], reals[29], reals[31]
    uneven = rate >= _SMC_NULL  # pairs of time and acceleration
    if not rate > 0.0 or (uneven and count % 2):
        raise ValueError(
            f"{file}: expected a positive number of samples per second as the second real, or none for an even number "
            f"of times and accelerations, got {rate:g} and {count} numbers"
        )
    start = first_real + _SMC_REALS[0] // _SMC_REALS[1] + comments
    if not all(line.startswith("|") for line in lines[start - comments : start]):
        raise ValueError(f"{file}: expected {comments} comment lines that start with '|'; the file is damaged")
    values, times = fixed_width_samples(lines, start, count, _SMC_DATA, file), None
    further = next((line for line in lines[start - (-count // _SMC_DATA[0]) :] if line.strip()), "")
    if is_number(further[: _SMC_DATA[1]].strip()):
        raise ValueError(f"{file}: the header announces {count} numbers, the file has more; it is damaged")
    if uneven:
        times, values = values[::2], values[1::2]
    for stated, found in ((highest, values.max()), (lowest, values.min())):
        if abs(stated) < _SMC_NULL:
            check_peak(found, stated, 2e-4 * float(np.abs(values).max()), file)
    note = ""
    if times is not None:
        times, values, note = without_repeated_times(times, values)
    station = next((line.strip() for line in lines[2:_SMC_TEXT] if line.startswith("station")), title)
    return Series(re.sub(r"\s+", " ", station) + note, math.nan if uneven else 1.0 / rate, "cm/s2", values, times)


def parse_geonet(text: str, file: str) -> list[GeonetComponent]:
    """Return the components of a GeoNet V1A or V2A file (see `fe_likelihoods.signals.read.read_geonet`)."""
    lines, place, found = text.splitlines(), 0, []
    while place < len(lines) and any(line.strip() for line in lines[place : place + 3]):
        if len(found) >= _MOST_COMPONENTS:
            raise ValueError(f"{file}: expected at most {_MOST_COMPONENTS} components")
        component, place = _geonet_component(lines, place, file)
        found.append(component)
    if not found:
        raise ValueError(f"{file}: expected a GeoNet V1A or V2A file, got an empty one")
    return found


def _geonet_component(lines: list[str], place: int, file: str) -> tuple[GeonetComponent, int]:
    """One component, and the line after it."""
    head = "\n".join(lines[place : place + _GEONET_TEXT])
    where = f"{file}, line {place + 1}"
    if not re.match(r"\s*(un)?corrected accelerogram", head, re.IGNORECASE):
        raise ValueError(
            f"{where}: expected 'Corrected accelerogram' or 'Uncorrected accelerogram', the first line of a component "
            f"of a GeoNet file, got {lines[place][:80]!r}"
        )
    peak, component = _GEONET_PEAK.search(head), re.search(r"^Component\s+(\S+)", head, re.MULTILINE)
    step = next((match for line in head.splitlines()[10:12] if (match := _GEONET_STEP.search(line))), None)
    if peak is None or component is None or step is None:
        raise ValueError(f"{where}: expected the component, the step and the peak acceleration in {_GEONET_TEXT} lines")
    first = place + _GEONET_TEXT
    integers = _numbers(lines, first, *_GEONET_INTEGERS, file)
    first += _GEONET_INTEGERS[0] // _GEONET_INTEGERS[1]
    reals = _numbers(lines, first, *_GEONET_REALS, file)
    first += _GEONET_REALS[0] // _GEONET_REALS[1]
    counts = [_whole(integers[k], file, "samples") for k in (33, 34, 35)]
    dt = reals[25]
    if not dt > 0.0 or abs(dt - float(step[1])) > 0.51e-3:
        raise ValueError(
            f"{where}: the step is {step[1]} s in the text but {dt:g} s in the header; the file is damaged"
        )
    unit = _GEONET_UNIT.search(head)
    scale = float(unit[1]) if unit else 1.0
    values = scale * fixed_width_samples(lines, first, counts[0], _GEONET_DATA, file)
    # the peak is rounded to the digits that are printed; the samples are rounded or cut
    row, column = divmod(int(np.argmax(np.abs(values))), _GEONET_DATA[0])
    printed = lines[first + row][column * _GEONET_DATA[1] :][: _GEONET_DATA[1]].strip()
    resolution = 1.01 * scale * 10.0 ** -decimals_of(printed) + 0.505 * 10.0 ** -decimals_of(peak[1])
    check_peak(float(np.abs(values).max()), abs(float(peak[1])), resolution, where)
    end = first + sum(math.ceil(count / _GEONET_DATA[0]) for count in counts)
    if end > len(lines):
        raise ValueError(f"{where}: expected {sum(counts)} numbers up to line {end}; the file is truncated")
    site = re.search(r"^Site\s+(\S+)", head, re.MULTILINE)
    title = f"{site[1] if site else 'GeoNet'}, component {component[1]}"
    return GeonetComponent(component[1], Series(title, dt, "mm/s2", values)), end


def parse_knet(text: str, file: str) -> Series:
    """Return the samples of a K-NET or KiK-net file (see `fe_likelihoods.signals.read.read_knet`)."""
    lines = text.splitlines()
    header = {line[:_KNET_NAME].strip().rstrip("."): line[_KNET_NAME:].strip() for line in lines[:_KNET_TEXT]}
    names = ("Station Code", "Sampling Freq(Hz)", "Duration Time(s)", "Dir", "Scale Factor")
    missing = [name for name in names if name not in header]
    if missing:
        raise ValueError(
            f"{file}: expected the {_KNET_TEXT} header lines of a K-NET file, {', '.join(missing)} are missing"
        )
    rate = parse_number(
        re.sub(r"\s*hz$", "", header["Sampling Freq(Hz)"], flags=re.IGNORECASE), f"{file}, Sampling Freq"
    )
    duration = parse_number(header["Duration Time(s)"], f"{file}, Duration Time")
    scale = _KNET_SCALE.match(header["Scale Factor"])
    if scale is None or not float(scale[2]) > 0.0 or not rate > 0.0:
        raise ValueError(
            f"{file}: expected a positive sampling frequency and a scale factor such as '3920(gal)/6182761', got "
            f"{rate:g} and {header['Scale Factor']!r}"
        )
    fields = [(k, field) for k, line in enumerate(lines[_KNET_TEXT:], _KNET_TEXT + 1) for field in line.split()]
    counts = np.array([parse_number(field, f"{file}, line {line}") for line, field in fields])
    check_count(counts.size, _whole(rate * duration, file, "samples"), f"{file}: frequency times duration")
    # "(gal)/1048.2" means 1 gal; the stated peak is compared below
    values = (counts - counts.mean()) * (float(scale[1] or 1.0) / float(scale[2]))
    stated = header.get("Max. Acc. (gal)", header.get("Max Acc. (gal)", header.get("Max. Acc (gal)")))
    if stated is None:
        raise ValueError(f"{file}: expected a header line 'Max. Acc. (gal)'")
    peak = parse_number(stated, f"{file}, Max. Acc.")
    check_peak(float(np.abs(values).max()), peak, 2e-3 * abs(peak) + 2e-3, file)
    title = f"{header['Station Code']}, channel {header['Dir']}, mean subtracted"
    return Series(title, 1.0 / rate, "gal", values)


def parse_esm(text: str, file: str) -> Series:
    """Return the samples of an ESM or ITACA file (see `fe_likelihoods.signals.read.read_esm`)."""
    lines = text.splitlines()
    header: dict[str, str] = {}
    for line in lines[:_ESM_TEXT]:
        if not _ESM_NAME.match(line):
            break
        name, _, value = line.partition(":")
        header[name] = value.strip()
    text_lines = len(header)
    names = ("SAMPLING_INTERVAL_S", "NDATA", "UNITS", "DATA_TYPE", "STATION_CODE", "STREAM")
    missing = [name for name in names if not header.get(name)]
    if missing:
        raise ValueError(f"{file}: expected the header of an ESM or ITACA file, {', '.join(missing)} are missing")
    if header["DATA_TYPE"].upper() != "ACCELERATION":
        raise ValueError(f"{file}: expected acceleration, got DATA_TYPE {header['DATA_TYPE']!r}; take the ACC file")
    dt = parse_number(header["SAMPLING_INTERVAL_S"], f"{file}, SAMPLING_INTERVAL_S")
    if not dt > 0.0:
        raise ValueError(f"{file}: expected a positive SAMPLING_INTERVAL_S, got {dt:g}")
    rows = [(k, line.strip()) for k, line in enumerate(lines[text_lines:], text_lines + 1) if line.strip()]
    values = np.array([parse_number(row, f"{file}, line {k}") for k, row in rows])
    where = f"{file}: NDATA"
    check_count(values.size, _whole(parse_number(header["NDATA"], where), file, "samples"), where)
    stated = header.get("PGA_CM/S^2", "")
    if stated and values.size:
        peak = abs(parse_number(stated, f"{file}, PGA_CM/S^2"))
        unit = agree_on_unit(header["UNITS"], None, "acceleration", file)
        scale = float(from_si(to_si(1.0, unit), "cm/s2"))
        found = scale * float(np.abs(values).max())
        check_peak(found, peak, 1e-4 * peak + 2e-6 * scale, file)
    title = f"{header.get('NETWORK', '')}.{header['STATION_CODE']} {header['STREAM']}"
    return Series(title, dt, header["UNITS"], values)


def _numbers(lines: list[str], start: int, count: int, per_line: int, width: int, file: str) -> list[float]:
    """Numbers in a header with Fortran columns, from the line with index `start`."""
    numbers = []
    for k in range(count):
        row, column = divmod(k, per_line)
        line = lines[start + row] if start + row < len(lines) else ""
        numbers.append(
            parse_number(line[column * width : (column + 1) * width].strip(), f"{file}, line {start + row + 1}")
        )
    return numbers


def _whole(number: float, file: str, what: str) -> int:
    """A number of lines or samples."""
    if not 0.0 <= number < 1e9 or abs(number - round(number)) > 1e-6:
        raise ValueError(f"{file}: expected a number of {what}, got {number:g}")
    return parse_count(str(round(number)), file)
