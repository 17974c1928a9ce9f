"""Faults of data in words: what was found, which units it may be of, and what to do."""

import math
from collections.abc import Sequence
from itertools import combinations

from ..signals.channels import Channel
from ..text_tables import listed
from ..units import DIMENSIONS, UNITS
from .faults import Fault
from .finding import WRONG, Finding, percent

__all__ = ["describe_unit", "finding_of"]

SAME_UNITS = 1.25  # ratio of a factor to one between units, up to which it is named after them
OF_MODES = {  # ratios of frequencies; of stiffness or mass, the square roots
    2.0 * math.pi: "rad/s instead of Hz",
    60.0: "1/min instead of Hz",
    1000.0: "kHz instead of Hz",
    1000.0**0.5: "a stiffness in kN instead of N, or a mass in t instead of kg",
    9.81**0.5: "a weight instead of a mass",
}
FAULTS = {
    "factor": (
        "A {what} may be wrong",
        "{where}: {those} are {value} times {others}{units}{better}.",
        "Look up unit and gain of the channel and of the base motion, loads or stiffnesses, and correct the wrong one; "
        "a model of your own must return SI units.",
    ),
    "sign": (
        "A sign may be wrong",
        "{where}: {those} have the opposite sign of {others}{better}.",
        "Where the sensor counts the other way, change its sign in the file, or by `reversed` in [measurements].",
    ),
    "swap": (
        "Channels may be swapped",
        "{where}: each measurement resembles the computed response of the other{better}.",
        "Look up which cable, or column of the file, belongs to which; if they were exchanged, exchange the columns.",
    ),
    "lag": (
        "Clocks may differ",
        "{where}: {those} are {value} s {late} than {others}{better}.",
        "Check the clocks of sensors and motions, and when the motion begins (`zero` in [measurements], or "
        "measurements.shift); a lag that stays unknown can be a parameter (`Sensor`).",
    ),
    "value": (
        "A value may be wrong",
        "{where} is {value} times what the other values let expect{better}.",
        "Check this number in the file; if it is right, look at the model.",
    ),
    "exchange": (
        "Values may be exchanged",
        "{where} may be exchanged{better}.",
        "Check the order of lines and columns in the file, and the places of loads and sensors in the model.",
    ),
}
"""Kind, text and action of each fault of data."""
OF_SUPPORTS = (
    "Check unit, sign and clock of its file. Slow motions of one site are alike, except of supports that did move so, "
    "or that waves reach one by one."
)


def finding_of(
    fault: Fault, title: str, channels: Sequence[Channel] = (), severity: str = WRONG, loads: bool = False
) -> Finding:
    """A fault of a data set with a title; its channels, and whether they are all channels of a load test."""
    of_modes = fault.names == ("frequencies",)
    kinds = [("frequency", "", False)] if of_modes else [(each.dimension, each.unit, loads) for each in channels]
    near = [describe_unit(fault.value, *each) for each in kinds] if fault.kind == "factor" else []
    units = " or ".join(filter(None, dict.fromkeys(near)))
    better = f"; corrected, the error (RRMSE) is {percent(fault.after)} instead of {percent(fault.before)}{fault.where}"
    if not channels:
        better = f"; corrected, values differ from draws of the prior by {fault.after:.2g} of their spread instead of "
        better += f"{fault.before:.2g}"
    of_supports = math.isnan(fault.before)
    value = abs(fault.value) if fault.kind == "lag" else fault.value
    names = " of ".join(fault.names) if fault.kind == "value" else listed(fault.names)
    words = {
        "where": f"{names}{f' ({title})' if title else ''}",
        "better": "" if of_supports else better,
        "those": "slow motions" if of_supports else "measured values",
        "others": "those of the other supports" if of_supports else "the computed ones",
        "value": f"{value:.0f}" if abs(value) >= 1e3 else f"{value:.3g}",
        "late": "later" if fault.value > 0.0 else "earlier",
        "what": "unit" if units or of_modes else "gain",
        "units": f", {'as with' if of_modes else 'about the ratio of'} {units}" if units else "",
    }
    kind, text, action = (each.format(**words) for each in FAULTS[fault.kind])
    numbers = {"before": fault.before, "after": fault.after, fault.kind: fault.value}
    numbers = {name: number for name, number in numbers.items() if not math.isnan(number)}
    return Finding(kind, severity, text, OF_SUPPORTS if of_supports else action, numbers, "data")


def describe_unit(factor: float, dimension: str, unit: str = "", loads: bool = False) -> str:
    """Units whose ratio is about a factor or its inverse, in words; empty if there are none.

    One of the two is the SI unit or the `unit` of the channel, or they are m/s2 and g of the base motion; with `loads`,
    all channels of a static test have this factor.
    """
    bases, size = (unit, DIMENSIONS[dimension]), abs(math.log(factor))
    units = sorted((each for each in UNITS.values() if each.dimension == dimension), key=lambda u: u.name not in bases)
    ratios = {} if dimension == "acceleration" else {9.80665: "m/s2 and g of the base motion"}
    if dimension == "frequency":
        ratios, units = OF_MODES, []
    for one, other in combinations(units, 2):
        if one.name in bases:  # of two names of a unit, the first
            ratios.setdefault(one.factor / other.factor, f"{one.name} and {other.name}")
    near = [words for ratio, words in ratios.items() if abs(abs(math.log(ratio)) - size) < math.log(SAME_UNITS)]
    # stiffnesses are not known to a factor of 2: 86 of 88 load tests are named
    near += ["kN and N of the loads"] if loads and abs(size - math.log(1000.0)) < math.log(2.0) else []
    return " or ".join(near)
