"""Findings about measurements and motions, before any simulation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..signals.channels import Measurements
from ..signals.records import Record
from ..units import from_si
from .finding import CARE, NOTE, Finding, by_severity

__all__ = ["check_data", "check_gaps", "check_noise_prior", "check_steps_of_mass"]

# No horizontal ground acceleration above 2.8 g was recorded (Tsukidate 2011); responses leave room for impacts.
LARGEST_PEAKS = {"motion": (3.0, "g"), "acceleration": (20.0, "g"), "displacement": (10.0, "m")}
SMALLEST_MOTION = 1e-6  # [g], the noise of an accelerometer
SHORT_STEP = 1e-3  # [s]: accelerations below the top are then right to about 4 %
LARGEST_GAP = 0.05  # share of the samples that may be missing within a motion whose level a noise follows


def check_data(measurements: Measurements, record: Record | Sequence[Record] | None = None) -> tuple[Finding, ...]:
    """Look for faults that measurements and motions show by themselves; nothing is simulated.

    Parameters
    ----------
    measurements : Measurements
    record : Record, Events, or a list of records, optional
        The base motions.

    Returns
    -------
    tuple of Finding
        The most severe first, empty if nothing was found: sizes that are not plausible in SI units, channels that never
        change, and synthetic data.

    Examples
    --------
    >>> for finding in check_data(measurements, record):
    ...     print(finding.severity, finding)
    """
    motions = record if isinstance(record, list | tuple) else [] if record is None else [record]
    peaks = [(f"motion {each.name}", "motion", float(np.abs(each.acceleration).max())) for each in motions]
    for channel, values in zip(measurements.channels, measurements.values, strict=True):
        if np.isfinite(values).any():
            peaks.append((f"channel {channel.name}", channel.dimension, float(np.nanmax(np.abs(values)))))
    found = [each for peak in peaks for each in _check_size(*peak)]
    found += _check_silence(measurements) + _note_synthetic(measurements.description)
    return by_severity(found)


def _check_size(name: str, kind: str, peak: float) -> list[Finding]:
    """A peak [SI] whose size is not plausible; `kind` is "motion" or the dimension of a channel."""
    largest, unit = LARGEST_PEAKS.get(kind, (np.inf, ""))
    shown = from_si(peak, unit).item() if unit else 0.0
    if shown <= largest and not (kind == "motion" and shown < SMALLEST_MOTION):
        return []
    text = f"The peak of {name} is {shown:.3g} {unit}."
    action = "Check the unit of its file. A number without a unit is in SI units (m, m/s²)."
    return [Finding("A size is not plausible", CARE, text, action, {"peak": peak})]


def _check_silence(measurements: Measurements) -> list[Finding]:
    """Channels whose samples are all equal."""
    silent = [
        channel.name
        for channel, values in zip(measurements.channels, measurements.values, strict=True)
        if np.isfinite(values).any() and np.nanmax(values) == np.nanmin(values)
    ]
    if not silent:
        return []
    text = f"All samples of {', '.join(silent)} are equal."
    return [Finding("A sensor was silent", CARE, text, "Leave the channel out, or read another column.")]


def _note_synthetic(description: str) -> list[Finding]:
    """Data that were computed, by their description."""
    if "synthetic" not in description.lower():
        return []
    text = "The measurements were computed with a model, not measured. The result shows how the method works."
    return [Finding("Synthetic data", NOTE, text, "Say so wherever you show the numbers.")]


def check_gaps(noise: Any) -> list[Finding]:
    """Gaps in the measurements of a noise whose shares refer to the level of the measured part of a motion."""
    shares = noise.gap_shares() if hasattr(noise, "gap_shares") else {}
    large = {name: share for name, share in shares.items() if share > LARGEST_GAP}
    if not large:
        return []
    text = (
        f"Samples are missing within the channels {', '.join(f'{name} ({share:.0%})' for name, share in large.items())}"
        f". The share of {noise.title} refers to the mean square of the other samples. If the strong part of the "
        "motion is missing, the share is too large and predictions of whole motions too wide."
    )
    return [Finding("Gaps in the data", CARE, text, "Use local=1, whose level is taken from samples near by.", large)]


def check_noise_prior(channel: str, unit: str, expected: float, largest: float) -> list[Finding]:
    """Whether the noise that a prior expects exceeds every measured value of a channel [SI]."""
    if not expected > largest:
        return []
    text = f"The prior expects a noise that is larger than every measured value of {channel}."
    action = f'A number without a unit is in SI units; give one, such as "half-normal(5 {unit})".'
    return [Finding("A prior of the noise is large", CARE, text, action, {"ratio": expected / largest})]


def check_steps_of_mass(names: Sequence[str], step: float) -> list[Finding]:
    """Accelerations below the top of a column, whose own mass vibrates above 20 Hz, by integration steps [s]."""
    if not names or step <= SHORT_STEP:
        return []
    text = (
        f"{', '.join(names)}: accelerations below the top contain vibrations above 20 Hz, which a step of {step:.2g} s "
        "does not resolve (with 1/256 s, they are wrong by 48 %)."
    )
    action = f"Give substeps= so that a step is {SHORT_STEP:.2g} s or shorter, and compare different n_elements."
    return [Finding("The steps are long for an acceleration", CARE, text, action, {"step": step})]
