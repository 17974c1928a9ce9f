"""Findings about predictions, from numbers: what goes beyond the calibration, and what a result cannot show."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..signals.channels import Channel
from ..units import DIMENSIONS, to_si
from .finding import CARE, Finding

__all__ = [
    "check_bandwidth",
    "check_failed_samples",
    "check_final_values",
    "check_peaks",
    "check_unit_of_threshold",
]

# of a predicted peak to the calibrated ones: named in 1 of 100 right runs, and in 96 of 100 at three times the strength
PEAK_RATIO = 2.0
NARROW = 0.2  # bandwidth of a motion by that of the calibration; earthquakes of one structure differ by 0.38 or more
UNSETTLED = 0.1  # half the range in the last two seconds by the final value, which is then known to 10 % at best
NO_MOTION = 0.01  # half the range there by the largest response: a motion that does not matter


def check_peaks(
    predicted: Mapping[str, float], calibrated: Sequence[Mapping[str, float]], alone: bool
) -> list[Finding]:
    """Peaks [SI] beyond the calibrated events' by a factor of two; `alone`: the parameters belong to one likelihood."""
    far, numbers = [], {}
    for name, value in predicted.items():
        measured = [event[name] for event in calibrated if event.get(name, 0.0) > 0.0]
        nearest = min(max(value, min(measured)), max(measured)) if measured else value
        if nearest and not 1.0 / PEAK_RATIO <= value / nearest <= PEAK_RATIO:
            numbers[name] = value / nearest
            far.append(
                f"{name} ({numbers[name]:.2g} times the {'largest' if value > nearest else 'smallest'} calibrated one)"
            )
    if not far:
        return []
    text = (
        f"The predicted peaks are outside of the range of the calibration by more than a factor of {PEAK_RATIO:g}: "
        f"{', '.join(far)}. The parameters were calibrated at other amplitudes; where stiffness and damping depend on "
        "the amplitude, the prediction is beside the truth, and its spread does not show it."
    )
    # several events show how parameters vary between them, but not at amplitudes that none of them had
    other = ", or let parameters vary between events (in Python, Hierarchy)" if alone and len(calibrated) == 1 else ""
    action = f"Calibrate with events of this amplitude{other}."
    return [Finding("Beyond the calibrated amplitude", CARE, text, action, numbers)]


def check_bandwidth(bandwidth: float | None, calibrated: float | None) -> list[Finding]:
    """Whether the power of a motion is in a much narrower band [Hz] than in the calibration."""
    if bandwidth is None or calibrated is None or not bandwidth < NARROW * calibrated:
        return []
    text = (
        f"This motion has its power in a band of {bandwidth:.2g} Hz, as a harmonic has; {calibrated:.2g} Hz in the "
        "calibration. Near a resonance the response depends on frequency and damping far more than in the calibration, "
        "which hardly speaks for it: the spread of the posterior is too narrow."
    )
    action = (
        "Calibrate with a motion of this kind, or predict with the spread between several events (in Python, "
        "predict_new_event)."
    )
    return [Finding("A narrow-band motion", CARE, text, action, {"ratio": bandwidth / calibrated})]


def check_final_values(ends: Mapping[str, Sequence[float]]) -> list[Finding]:
    """Final values that still move: half the range in the last two seconds, value, and largest response, by name."""
    numbers = {
        name: half / value
        for name, (half, value, largest) in ends.items()
        if value > 0.0 and half > max(UNSETTLED * value, NO_MOTION * largest)
    }
    if not numbers:
        return []
    text = (
        "The structure still moves in the last 2 s, by a part of its final value: "
        f"{', '.join(f'{name} (+- {share:.0%})' for name, share in numbers.items())}. A residual value is what is left "
        "after free vibration."
    )
    action = (
        'Append rest to the record, record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0), or take the '
        "mean over whole periods, final_value(channel, samples=...) or damage_measures(settle=...)."
    )
    return [Finding("A final value still moves", CARE, text, action, numbers)]


def check_failed_samples(reasons: Mapping[str, int], nothing: str = "") -> list[Finding]:
    """Samples that failed and were left out, by reason; or why there is no prediction at all."""
    if nothing:
        return [Finding("No prediction", CARE, f"All simulations failed: {nothing}.")]
    known = "; ".join(f"{count}: {reason}" for reason, count in reasons.items())
    text = f"{sum(reasons.values())} samples failed and are left out ({known})."
    return [Finding("Samples failed", CARE, text)] if reasons else []


def check_unit_of_threshold(limits: np.ndarray, values: np.ndarray, channel: Channel) -> list[Finding]:
    """Thresholds that are beside all values [SI], and among them in the unit of the channel."""
    shown, values = np.asarray(to_si(limits, channel.unit, channel.dimension)), np.abs(values)
    inside = (shown >= values.min()) & (shown <= values.max())
    if not np.all(inside & ((limits < values.min()) | (limits > values.max()))):
        return []
    text = (
        f"The threshold {limits.flat[0]:g} is in SI units, {DIMENSIONS[channel.dimension]}, and beside all predicted "
        f"values (up to {values.max():.3g}): is it in {channel.unit}?"
    )
    return [Finding("A threshold may have another unit", CARE, text, f'Then pass unit="{channel.unit}".')]
