"""What the text above samples states about them: step, number, unit and peak.

Loggers and networks print such lines in their own words (``SAMPLING INTERVAL (sec) : 0.01``, ``Abtastrate: 200 Hz``,
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
from .text_files import NUMBER, decimals_of, dimension_of, parse_count

__all__ = ["StatedPeak", "StatedStep", "Statements", "check_peaks", "read_statements"]

_VALUE = rf"\s*(?:[\[(]\s*(?P<bracket>[^\])]{{1,20}}?)\s*[\])])?\s*[:=,;\t]*\s*(?P<number>{NUMBER})\s*"
_STEP = re.compile(
    r"\b(?:dt|delta[ _]?t|(?:sampl(?:ing|e)|time|scan)[ _-]?(?:interval|step|period|increment|spacing)|"
    r"equal(?:ly)?\s+spac(?:ing\s+of|ed\s+at)|intervals\s+of|abtast(?:intervall|periode|zeit)|zeitschritt|"
    r"pas de temps|paso de tiempo|passo temporale|interval(?:o de muestreo|lo di campionamento))"
    rf"(?:_(?P<ending>s|ms)\b)?{_VALUE}(?P<unit>[a-z]*)",
    re.IGNORECASE,
)
_RATE = re.compile(
    r"(?:\b(?:(?:sampl(?:ing|e)|scan)[ _-]?(?:rate|freq(?:uency|\.)?)|(?:samples|scans) per sec(?:ond)?\b|"
    r"abtast(?:rate|frequenz)|fr[eé]quence d.[eé]chantillonnage|frecuencia de muestreo|frequenza di campionamento)|"
    rf"^\W*(?:fs|rate)\b(?=\s*[\[(:=,;\t])){_VALUE}"
    r"(?P<unit>k?hz|sps|(?:samples|pts|points)\s*(?:per|/)\s*s(?:ec(?:ond)?)?)?",
    re.IGNORECASE,
)
_COUNT = re.compile(
    r"\b(?:npts|ndata|(?:number|no\.?|num)[ _]of[ _](?:data|samples|scans|rows|values)(?:[ _]points)?|"
    r"(?:number|no\.?|num)[ _]of[ _]points|(?:scans|samples) in (?:the )?file|"
    r"anzahl(?: der)? (?:abtastwerte|messwerte|werte|punkte)|nombre d(?:e points|.[eé]chantillons)|"
    r"n[uú]mero de (?:datos|muestras|puntos))\s*[:=,;\t]*\s*(\d+)(?![\d.])|"
    r"^\W*(?:samples|points|scans)\s*[:=,;\t]\s*(\d+)\W*$",
    re.IGNORECASE,
)
_UNIT_LINE = re.compile(r"\b(?:units?|einheit)(?:\s+of\s+[a-z]{1,20})?\s*[:=]\s*([^\s;,]+)", re.IGNORECASE)
_UNITS_ARE = re.compile(r"\bunits?\s+(?:of|are|is)\s+[(\[]?\s*([^\s,;()\[\]]+)", re.IGNORECASE)
_PEAK = re.compile(
    r"\b(?:pga|(?:peak|max\w*\.?)(?:\s+ground)?\s+acc\w*\.?|(?P<any>(?:peak|max\w*\.?)\s+value))(?:\s+values?)?\s*"
    r"(?:[\[(]\s*(?P<unit>[^\])]{1,20}?)\s*[\])])?\s*[:=,;\t]\s*(?P<numbers>.{0,200})",
    re.IGNORECASE,
)
_NAMED = re.compile(rf"\(([^)]{{1,40}})\)\s*({NUMBER})")
_PLAIN = re.compile(rf"({NUMBER})\s*(\S*)")
_LONGER = ("min", "minutes", "h", "hours")  # loggers of temperature
_LONGEST = 10_000  # letters of a line that are searched
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


def read_statements(lines: Sequence[str], decimal_commas: bool = False) -> Statements:
    """Return what lines of text state."""
    steps, counts, units, peaks = [], [], [], []
    for line in lines:
        line = re.sub(r"(?<=\d),(?=\d)", ".", line[:_LONGEST]) if decimal_commas else line[:_LONGEST]
        steps += [
            _stated_step(match, rate) for form, rate in ((_STEP, False), (_RATE, True)) for match in form.finditer(line)
        ]
        counts += [(match[0], parse_count(match[1] or match[2], match[0][:60])) for match in _COUNT.finditer(line)]
        units += [(match[0], match[1]) for match in _UNIT_LINE.finditer(line)]
        units += [
            (match[0], match[1]) for match in _UNITS_ARE.finditer(line) if dimension_of(match[1]) == "acceleration"
        ]
        peaks += [_stated_peak(match) for match in _PEAK.finditer(line)]
    return Statements(tuple(filter(None, steps)), tuple(counts), tuple(units), tuple(filter(None, peaks)))


def _stated_step(match: re.Match[str], rate: bool) -> StatedStep | None:
    """A step, or the step of a rate; None for zero, and for a number of something else."""
    number, unit, bracket = float(match["number"]), match["unit"] or "", match["bracket"]
    if not number > 0.0 or unit.lower() in _LONGER:
        return None
    if rate:
        stated = (unit or bracket or "").lower()
        factors = [1e3 if stated == "khz" else 1.0] if stated else [1.0, 1e3]
        steps = tuple(1.0 / (number * factor) for factor in factors)
    else:
        stated = [each for each in (match["ending"], bracket, unit) if each and dimension_of(each) == "time"]
        if bracket and not stated:  # brackets around something else
            return None
        factors = [find_unit(each).factor for each in stated[:1]] or [1.0, 1e-3, 1e-6]
        steps = tuple(number * factor for factor in factors)
    rounding = 0.5 * 10.0 ** -decimals_of(match["number"]) / number
    return StatedStep(match[0].strip(), steps, min(rounding, _LARGEST_ROUNDING))


def _stated_peak(match: re.Match[str]) -> StatedPeak | None:
    """Peaks by name, or one without; None for other text, and a value that may be no acceleration."""
    unit, printed = match["unit"], {name.strip(): number for name, number in _NAMED.findall(match["numbers"])}
    if not printed and (plain := _PLAIN.match(match["numbers"])):
        unit, printed = unit or plain[2].rstrip(",;"), {"": plain[1]}
    unit = unit if unit and dimension_of(unit) == "acceleration" else None
    return StatedPeak(match[0].strip(), unit, printed) if printed and (unit or not match["any"]) else None


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
    factor, digit = float(to_si(1.0, unit)), 1.01 * 10.0**-decimals
    found = [float(np.abs(each).max()) for each in (values, values - values.mean())]
    for peak in peaks:
        printed = peak.printed_of(names, index)
        known = [peak.unit] if peak.unit else [name for name in UNITS if UNITS[name].dimension == "acceleration"]
        ratios = [float(to_si(1.0, each)) / factor for each in known]
        if printed is not None and not any(
            abs(each - ratio * abs(float(printed))) <= digit + 0.505 * ratio * 10.0 ** -decimals_of(printed)
            for each in found
            for ratio in ratios
        ):
            raise ValueError(
                f"{file}: the file states {peak.text!r}, the samples have a peak of {found[0]:g} {unit}; the unit is "
                f"wrong, or the file is damaged{advice}"
            )
