"""Findings about predictions, populations of stored posteriors and compared stiffnesses, from numbers."""

from collections.abc import Mapping, Sequence

import numpy as np

from .finding import CARE, Finding

# of a predicted peak to the calibrated ones: named in 1 of 100 right runs, and in 96 of 100 at three times the strength
PEAK_RATIO = 2.0
NARROW = 0.2  # bandwidth of a motion by that of the calibration; earthquakes of one structure differ by 0.38 or more
# half the range in the last two seconds by the final value, which is then known to 10 % at best; a smaller one than a
# tenth of the largest response counts as a tenth
UNSETTLED = 0.1
LARGEST_SHAPE = 0.8  # Pareto shape of weights; up to here, right results have it as well (study `hierarchy_warnings`)
HARMLESS_ERROR = 0.15  # of the means [posterior sd], up to which uneven weights and mixtures do no harm
# Standard deviations of the prior by which the median of a common factor may differ from its mean: named in 1 of 120
# right cases, and in 120 of 120 in which all stiffnesses, known to 2 %, have lost 14 or 20 %.
COMMON = 1.96


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
        f"Its power is in a band of {bandwidth:.2g} Hz, as a harmonic has; of the calibration's, {calibrated:.2g} Hz."
    )
    action = "Calibrate with such a motion, or predict with the spread between events (in Python, predict_new_event)."
    return [Finding("A narrow-band motion", CARE, text, action, {"ratio": bandwidth / calibrated})]


def check_final_values(ends: Mapping[str, Sequence[float]]) -> list[Finding]:
    """Final values that still move: half the range in the last two seconds, value, and largest response, by name."""
    numbers = {
        name: half / value
        for name, (half, value, largest) in ends.items()
        if value > 0.0 and half > UNSETTLED * max(value, UNSETTLED * largest)
    }
    shares = ", ".join(f"{name} (+- {share:.0%})" for name, share in numbers.items())
    text = f"The structure still moves in the last 2 s, by a part of its final value: {shares}."
    action = "Append rest to the record (record.followed_by), or take a mean, final_value(channel, samples=...)."
    return [Finding("A final value still moves", CARE, text, action, numbers)] if numbers else []


def check_reweighting(shapes: Mapping[str, float], error: float, parameters: Sequence[str]) -> list[Finding]:
    """Whether the stored samples of each test suffice, by the Pareto shapes of weights and the largest error [sd]."""
    wide = {name: shape for name, shape in shapes.items() if shape > LARGEST_SHAPE}
    names, shown = ", ".join(map(repr, wide)), ", ".join(f"{each:.2f}" for each in wide.values())
    text = f"test {names}: the population reaches values that the prior leaves out (Pareto shape {shown})."
    action = f"Sample this test again with a wider prior of {', '.join(parameters)}."
    if wide:
        return [Finding("The prior of a test is too narrow", CARE, text, action, wide)]
    text = f"Tests have too few samples: the means have errors of up to {error:.1f} posterior sd."
    action = "Give more samples of the tests, or draw fresh ones with the population as their prior."
    return (
        [Finding("Too few samples of a test", CARE, text, action, {"error": error})] if error > HARMLESS_ERROR else []
    )


def check_common(factors: np.ndarray, expected: float, sd: float) -> list[Finding]:
    """Whether a common factor, by draws (n,), is the `expected` one of a prior with the log standard deviation `sd`."""
    factor = float(np.median(factors))
    if abs(np.log(factor / expected)) <= COMMON * sd:
        return []
    text = f"The factor that all share, which is no loss, is {factor:.3g}; {expected:.3g} is expected, +- {sd:.1%}."
    action = "State what else has changed, such as temperature or mass (slopes=, common=), or take it as a loss of all."
    return [Finding("All stiffnesses have changed", CARE, text, action, {"factor": factor})]


def check_most(counts: np.ndarray, most: int, stiffnesses: int) -> list[Finding]:
    """Whether more stiffnesses may be damaged than are allowed: draws (n,) of their number that grow up to `most`."""
    as_many, fewer = (float(np.mean(counts == count)) for count in (most, most - 1))
    text = f"The probability of {most} damaged stiffnesses is {as_many:.2f}: there may be more."
    found = [Finding("More stiffnesses may be damaged", CARE, text, "Increase most.", {"share": as_many})]
    return found if most < stiffnesses and as_many > fewer else []
