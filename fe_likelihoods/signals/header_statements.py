"""What the text above samples states about them: step, number, unit and peak.

Loggers and networks print such lines in their own words (``SAMPLING INTERVAL (sec) : 0.01``, ``Sampling rate,200 Hz``,
``NPTS=40, DT=0.01``, ``RAW PGA VALUES (gal) : (N-S) 97.4``). They are compared with the arguments of a reader and with
the samples, and used where a reader has no argument. A number without its unit is compared only.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import UNITS, find_unit, to_si
from .text_files import NUMBER, decimals_of, parse_count

__all__ = ["StatedPeak", "StatedStep", "Statements", "check_peaks", "read_statements"]

_IS = r"\s*[:=,;\t]*\s*"
_UNIT = r"(?:[\[(]\s*([^\])]{1,20}?)\s*[\])])?"
_STEP = re.compile(
    r"\b(?:dt|delta[ _]?t|(?:sampl(?:ing|e)|time|scan)[ _-]?(?:interval|step|period|increment)|"
    r"equal(?:ly)?\s+spac(?:ing\s+of|ed\s+at)|intervals\s+of)"
    rf"(?:_(s|ms)\b)?\s*{_UNIT}{_IS}({NUMBER})\s*([a-z]*)",
    re.IGNORECASE,
)
_RATE = re.compile(
    r"(?:\b(?:(?:sampl(?:ing|e)|scan)[ _-]?(?:rate|freq(?:uency|\.)?)|samples per sec(?:ond)?\b)|"
    r"^\W*(?:fs|rate)\b(?=\s*[\[(:=,;\t]))"
    rf"\s*{_UNIT}{_IS}({NUMBER})\s*"
    r"(k?hz|sps|(?:samples|pts|points)\s*(?:per|/)\s*s(?:ec(?:ond)?)?)?",
    re.IGNORECASE,
)
_COUNT = re.compile(
    r"\b(?:npts|ndata|(?:number|no\.?|num)[ _]of[ _](?:data|samples|scans|rows|values)(?:[ _]points)?|"
    rf"(?:number|no\.?|num)[ _]of[ _]points){_IS}(\d+)(?![\d.])|"
    r"^\W*(?:samples|points|scans)\s*[:=,;\t]\s*(\d+)\W*$",
    re.IGNORECASE,
)
_UNIT_LINE = re.compile(r"\bunits?(?:\s+of\s+[a-z]{1,20})?\s*[:=]\s*([^\s;,]+)", re.IGNORECASE)
_UNITS_ARE = re.compile(r"\bunits?\s+(?:of|are|is)\s+[(\[]?\s*([^\s,;()\[\]]+)", re.IGNORECASE)
_PEAK = re.compile(
    rf"\b(?:pga|(?:peak|max\w*\.?)(?:\s+ground)?\s+acc\w*\.?)(?:\s+values?)?\s*{_UNIT}\s*[:=,;\t]\s*(.{{0,200}})",
    re.IGNORECASE,
)
_NAMED = re.compile(rf"\(([^)]{{1,40}})\)\s*({NUMBER})")
_PLAIN = re.compile(rf"({NUMBER})\s*(\S*)")
_LONGER = ("min", "minutes", "h", "hours")  # loggers of temperature
_LONGEST = 10_000  # letters of a line that are searched
_HERTZ = {"khz": 1e3}
_LARGEST_ROUNDING = 0.005  # relative, of a number with three digits; with fewer ones, such as 0.01, a step is exact


class StatedStep(NamedTuple):
    """A step of the samples, in the words of a file."""

    text: str
    steps: tuple[float, ...]  # [s]; several if the unit is not stated
    rounding: float  # largest relative error of the printed number

    def fits(self, step: float, tolerance: float = 0.0) -> bool:
        """Whether a step [s] is the stated one within the printed digits, and a tolerance [s]."""
        return any(abs(each - step) <= tolerance + (self.rounding + 1e-6) * step for each in self.steps)


class StatedPeak(NamedTuple):
    """Peak accelerations, in the words of a file."""

    text: str
    unit: str | None
    printed: dict[str, str]  # by the name of the column, "" for a peak without name

    def printed_of(self, names: Sequence[str], index: int) -> str | None:
        """The number for one of the columns of values: by its name, or where no name is there by its place."""
        if any(name in self.printed for name in names):
            return self.printed.get(names[index])
        return list(self.printed.values())[index] if len(self.printed) == len(names) else None


class Statements(NamedTuple):
    """What lines state: steps, and the words and values of sample counts, units and peaks."""

    steps: tuple[StatedStep, ...] = ()
    counts: tuple[tuple[str, int], ...] = ()
    units: tuple[tuple[str, str], ...] = ()
    peaks: tuple[StatedPeak, ...] = ()


def read_statements(lines: Sequence[str]) -> Statements:
    """Return what lines of text state."""
    steps, counts, units, peaks = [], [], [], []
    for line in (each[:_LONGEST] for each in lines):
        steps += [found for match in _STEP.finditer(line) if (found := _stated_step(match))]
        steps += [found for match in _RATE.finditer(line) if (found := _stated_rate(match))]
        counts += [(match[0], parse_count(match[1] or match[2], match[0][:60])) for match in _COUNT.finditer(line)]
        units += [(match[0], match[1]) for match in _UNIT_LINE.finditer(line)]
        units += [(match[0], match[1]) for match in _UNITS_ARE.finditer(line) if _is_acceleration(match[1])]
        peaks += [found for match in _PEAK.finditer(line) if (found := _stated_peak(match)).printed]
    return Statements(tuple(steps), tuple(counts), tuple(units), tuple(peaks))


def _stated_step(match: re.Match[str]) -> StatedStep | None:
    ending, bracket, printed, unit = match.groups()
    number, stated = float(printed), [_time_unit(each) for each in (ending, bracket, unit) if each]
    known = [each for each in stated if each is not None]
    if not number > 0.0 or (bracket and not known) or unit.lower() in _LONGER:  # brackets around something else
        return None
    factors = known[:1] or [1.0, 1e-3, 1e-6]
    return StatedStep(match[0].strip(), tuple(number * factor for factor in factors), _rounding(printed))


def _stated_rate(match: re.Match[str]) -> StatedStep | None:
    bracket, printed, unit = match.groups()
    number, stated = float(printed), unit or bracket
    if not number > 0.0:
        return None
    factors = [_HERTZ.get(stated.lower(), 1.0)] if stated else [1.0, 1e3]
    return StatedStep(match[0].strip(), tuple(1.0 / (number * factor) for factor in factors), _rounding(printed))


def _rounding(printed: str) -> float:
    return min(0.5 * 10.0 ** -decimals_of(printed) / float(printed), _LARGEST_ROUNDING)


def _time_unit(name: str) -> float | None:
    try:
        return find_unit(name, "time").factor
    except ValueError:
        return None


def _stated_peak(match: re.Match[str]) -> StatedPeak:
    unit, text = match.groups()
    named = {name.strip(): printed for name, printed in _NAMED.findall(text)}
    if not named and (plain := _PLAIN.match(text)):
        named = {"": plain[1]}
        unit = unit or plain[2].rstrip(",;") or None
    return StatedPeak(match[0].strip(), unit if unit and _is_acceleration(unit) else None, named)


def _is_acceleration(unit: str) -> bool:
    try:
        return find_unit(unit).dimension == "acceleration"
    except ValueError:
        return False


def check_peaks(
    peaks: Sequence[StatedPeak],
    names: Sequence[str],
    index: int,
    values: NDArray[np.float64],
    decimals: int,
    unit: str,
    file: str,
    advice: str = "",
) -> None:
    """Raise ValueError if a stated peak is not the peak of a column, with its mean or without it.

    The column is number `index` of `names`, with printed values (n_rows,) without missing ones; `advice` ends the
    message.
    """
    factor = float(to_si(1.0, unit))
    found = [float(np.abs(each).max()) for each in (values, values - values.mean())]
    for peak in peaks:
        printed = peak.printed_of(names, index)
        if printed is None:
            continue
        known = (
            (peak.unit,) if peak.unit else (each.name for each in UNITS.values() if each.dimension == "acceleration")
        )
        ratios = [float(to_si(1.0, each)) / factor for each in known]
        stated = abs(float(printed))
        if not any(
            abs(each - ratio * stated) <= 1.01 * 10.0**-decimals + 0.505 * ratio * 10.0 ** -decimals_of(printed)
            for each in found
            for ratio in ratios
        ):
            raise ValueError(
                f"{file}: the file states {peak.text!r}, the samples have a peak of {found[0]:g} {unit}; the unit is "
                f"wrong, or the file is damaged{advice}"
            )
