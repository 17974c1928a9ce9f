"""Findings about predictions, populations of stored posteriors and compared stiffnesses, from numbers."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from .finding import CARE, Finding

__all__ = [
    "check_bandwidth",
    "check_common",
    "check_event",
    "check_final_values",
    "check_most",
    "check_normal",
    "check_peaks",
    "check_reweighting",
]

# of a predicted peak to the calibrated ones: named in 1 of 100 right runs, and in 96 of 100 at three times the strength
PEAK_RATIO = 2.0
NARROW = 0.2  # bandwidth of a motion by that of the calibration; earthquakes of one structure differ by 0.38 or more
UNSETTLED = 0.1  # half the range in the last two seconds by the final value, which is then known to 10 % at best
NO_MOTION = 0.01  # half the range there by the largest response: a motion that does not matter
# Limits with study `hierarchy_warnings` of docs/results.rst, where the exact result is known.
LARGEST_SHAPE = 0.8  # Pareto shape; up to here, right results have it as well
HARMLESS_ERROR = 0.15  # of the means [posterior sd], up to which uneven weights and mixtures do no harm
# Skewness and excess kurtosis of the logarithms in any direction, assumed: a uniform distribution has the excess
# kurtosis -1.2, a double exponential one 3, and an exponential one the skewness 2.
NORMAL = (-1.0, 1.0), (-1.2, 3.0)
# Standard deviations of the prior by which the median of a common factor may differ from its mean: named in 1 of 120
# right cases, and in 120 of 120 in which all stiffnesses, known to 2 %, have lost 14 or 20 %.
COMMON = 1.96


class _Reweighted(Protocol):
    pareto_shape: float
    shift: float


def check_peaks(
    predicted: Mapping[str, float], calibrated: Sequence[Mapping[str, float]], alone: bool
) -> list[Finding]:
    """Peaks [SI] beyond the calibrated events' by a factor of two; `alone`: the parameters belong to one likelihood."""
    numbers = {}
    for name, value in predicted.items():
        measured = [event[name] for event in calibrated if event.get(name, 0.0) > 0.0]
        nearest = min(max(value, min(measured)), max(measured)) if measured else value
        if nearest and not 1.0 / PEAK_RATIO <= value / nearest <= PEAK_RATIO:
            numbers[name] = value / nearest
    far = ", ".join(
        f"{name} ({each:.2g} times the {'largest' if each > 1.0 else 'smallest'} calibrated one)"
        for name, each in numbers.items()
    )
    text = f"The predicted peaks are outside of the calibrated ones by more than a factor of {PEAK_RATIO:g}: {far}."
    # several events show how parameters vary between them, but not at amplitudes that none of them had
    other = ", or let parameters vary between events (in Python, Hierarchy)" if alone and len(calibrated) == 1 else ""
    action = f"Calibrate with events of this amplitude, on which stiffness and damping depend{other}."
    return [Finding("Beyond the calibrated amplitude", CARE, text, action, numbers)] if numbers else []


def check_bandwidth(bandwidth: float | None, calibrated: float | None) -> list[Finding]:
    """Whether the power of a motion is in a much narrower band [Hz] than in the calibration."""
    if bandwidth is None or calibrated is None or not bandwidth < NARROW * calibrated:
        return []
    text = (
        f"This motion has its power in a band of {bandwidth:.2g} Hz, as a harmonic has ({calibrated:.2g} Hz in the "
        "calibration): near a resonance the spread of the posterior is too narrow."
    )
    action = "Calibrate with such a motion, or predict with the spread between events (in Python, predict_new_event)."
    return [Finding("A narrow-band motion", CARE, text, action, {"ratio": bandwidth / calibrated})]


def check_final_values(ends: Mapping[str, Sequence[float]]) -> list[Finding]:
    """Final values that still move: half the range in the last two seconds, value, and largest response, by name."""
    numbers = {
        name: half / value
        for name, (half, value, largest) in ends.items()
        if value > 0.0 and half > max(UNSETTLED * value, NO_MOTION * largest)
    }
    shares = ", ".join(f"{name} (+- {share:.0%})" for name, share in numbers.items())
    text = f"The structure still moves in the last 2 s, by a part of its final value: {shares}."
    action = (
        'Append rest to the record, record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0), or take the '
        "mean over whole periods, final_value(channel, samples=...) or damage_measures(settle=...)."
    )
    return [Finding("A final value still moves", CARE, text, action, numbers)] if numbers else []


def check_event(reason: str) -> list[Finding]:
    """An event that cannot be predicted, with the `reason` of the failures."""
    text, action = (
        f"It could not be predicted: {reason}.",
        "Mend the model for this motion; the samples stay as they are.",
    )
    return [Finding("An event is not predicted", CARE, text, action)]


def check_reweighting(tests: Mapping[str, _Reweighted], error: float, parameters: Sequence[str]) -> list[Finding]:
    """Whether the stored samples of each test suffice; `error` is the largest error of a mean [posterior sd]."""
    found = []
    for name, each in tests.items():
        if each.pareto_shape > LARGEST_SHAPE:
            text = (
                f"test {name!r}: the population reaches values that the prior of this test leaves out (Pareto shape "
                f"{each.pareto_shape:.2f}, above {LARGEST_SHAPE:g}): the spread between tests is not reliable."
            )
            action = f"Sample this test again with a wider prior of {', '.join(parameters)}."
            numbers = {"shape": each.pareto_shape, "error": error}
            found.append(Finding("The prior of a test is too narrow", CARE, text, action, numbers))
    if not found and error > HARMLESS_ERROR:
        worst = max(tests, key=lambda name: tests[name].shift)
        text = f"test {worst!r}: the means have errors of up to {error:.1f} posterior sd, from too few samples."
        action = "Give more samples of this test, or draw fresh samples with the population as its prior."
        found.append(Finding("Too few samples of a test", CARE, text, action, {"error": error}))
    return found


def check_normal(skewness: np.ndarray, kurtosis: np.ndarray) -> list[Finding]:
    """Whether the logarithms of the stiffnesses are normal, by skewness and excess kurtosis (n,) in n directions."""
    numbers = zip((skewness, kurtosis), NORMAL, strict=True)
    if all(low < np.min(each) and np.max(each) < high for each, (low, high) in numbers):
        return []
    shown = f"skewness {np.max(np.abs(skewness)):.1f}, excess kurtosis {np.min(kurtosis):.1f} to {np.max(kurtosis):.1f}"
    text = f"The logarithms of the stiffnesses are not normal ({shown}): ridges and several modes are not represented."
    return [Finding("A calibration is not normal", CARE, text, "Use narrower priors, or fix what is not identified.")]


def check_common(factors: np.ndarray, expected: float, sd: float) -> list[Finding]:
    """Whether a common factor, by draws (n,), is the `expected` one of a prior with the log standard deviation `sd`."""
    factor = float(np.median(factors))
    if abs(np.log(factor / expected)) <= COMMON * sd:
        return []
    text = (
        f"The factor that all share is {factor:.3g}, where {expected:.3g} is expected, with a standard deviation of "
        f"{sd:.1%}: the losses leave it out, and it may be a damage of all."
    )
    action = "State what else has changed, such as temperature or mass (slopes=, common=), or take it as a loss of all."
    return [Finding("All stiffnesses have changed", CARE, text, action, {"factor": factor})]


def check_most(counts: np.ndarray, most: int, stiffnesses: int) -> list[Finding]:
    """Whether more stiffnesses may be damaged than are allowed: draws (n,) of their number that grow up to `most`."""
    as_many, fewer = (float(np.mean(counts == count)) for count in (most, most - 1))
    text = f"The probability of {most} damaged stiffnesses is {as_many:.2f}: there may be more."
    found = [Finding("More stiffnesses may be damaged", CARE, text, "Increase most.", {"share": as_many})]
    return found if most < stiffnesses and as_many > fewer else []
