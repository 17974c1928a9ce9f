"""Gain, sign and clock of a sensor, from the part of the motion that no parameter changes.

Far below its lowest frequency a structure moves as its supports do. In this band the responses of all draws of the
prior agree, so that no fit can make up for a fault of the data, as it can near a resonance with frequency and damping.
There, measurement y and response r have the spectra Y and R, and the gain g and the lag of y(t) = g r(t - lag) are ::

    c(lag) = sum_f Y conj(R) exp(2 pi i f lag),   lag = argmax |c|,   g = c / sum_f |R|^2,
    coherence = |c|^2 / (sum_f |Y|^2 sum_f |R|^2)

Where the draws agree nowhere, or measurement and response are not coherent there, nothing is known.
"""

from collections.abc import Mapping
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from .data_faults import FACTOR, Fault
from .finding import SMALL_PROBABILITY
from .sensor_faults import runs_of

__all__ = ["FEWEST_DRAWS", "SlowMotion", "compare_slow_motion", "find_slow_faults", "slow_motions"]

FEWEST_DRAWS = 5  # of the prior
AGREE = 0.1  # difference of a draw from the median, half of the draws: gains of 45 right fits are then 0.96 to 1.21
SMOOTH = 7  # lines of the spectrum over which powers are averaged, and fewest lines of a band
TAPER = 0.05  # share of the record at either end
FINE = 8  # lags per step
LONGEST_LAG = 0.2  # share of the record
COHERENT = 0.95  # from which gain and lag are looked at; 0.985 or more in 45 right fits of nine real structures
LARGE_LAG = 0.025  # [s]; right fits have at most 0.02


class SlowMotion(NamedTuple):
    """Measurement by response in the band that no parameter changes."""

    gain: float  # negative for the opposite sign
    lag: float  # positive where the measurement is later [s]
    coherence: float
    before: float  # error without gain and lag (RRMSE)
    error: float  # standard deviation of the logarithm of the gain
    lag_error: float  # [s]
    lowest: float  # ends of the band [Hz]
    highest: float
    step: float  # of the samples [s]


def compare_slow_motion(measured: np.ndarray, draws: np.ndarray, step: float) -> SlowMotion | None:
    """Compare a channel (n,), NaN where samples are missing, with draws of the prior (n_draws, n) where these agree.

    None where they agree in too few lines of the spectrum, or above its largest line only.
    """
    there = np.isfinite(measured)
    n, ends = len(measured), round(TAPER * len(measured))
    window = np.minimum(1.0, (np.arange(n) + 0.5) / max(ends, 1))
    window = np.where(there, np.sin(0.5 * np.pi * np.minimum(window, window[::-1])) ** 2, 0.0)
    draws = draws[np.isfinite(draws[:, there]).all(axis=1)]
    if len(draws) < FEWEST_DRAWS:
        return None
    spectra = np.fft.rfft(np.where(there, draws, 0.0) * window, axis=1)
    centre = np.median(spectra.real, axis=0) + 1j * np.median(spectra.imag, axis=0)
    smooth = np.ones(SMOOTH) / SMOOTH
    power = np.convolve(np.abs(centre) ** 2, smooth, "same")
    disagree = np.convolve(np.median(np.abs(spectra - centre), axis=0) ** 2, smooth, "same") >= AGREE**2 * power
    disagree[:2] = True  # the mean, and what the taper makes of it
    runs = [run for run in runs_of(~disagree) if run[1] - run[0] >= SMOOTH and run[0] <= np.argmax(power)]
    if not runs:
        return None
    band = slice(*runs[0])  # below it, filtered motions are noise
    spectrum = np.fft.rfft(np.where(there, measured, 0.0) * window)
    product = np.zeros(FINE * (n // 2) + 1, dtype=complex)
    product[band] = (spectrum * centre.conj())[band]
    size = 2 * (len(product) - 1)
    correlation = 0.5 * size * np.fft.irfft(product, size)
    longest = int(LONGEST_LAG * size)
    correlation = np.concatenate([correlation[-longest:], correlation[: longest + 1]])
    place = int(np.argmax(np.abs(correlation)))
    power, own = np.square(np.abs(centre[band])), np.square(np.abs(spectrum[band])).sum()
    frequency = np.fft.rfftfreq(n, step)[band]
    squared = float(np.sqrt((power * frequency**2).sum() / power.sum()))
    coherence = float(correlation[place] ** 2 / (power.sum() * own)) if own > 0.0 else 0.0
    lines = power.sum() ** 2 / np.square(power).sum()  # that have power
    error = float(np.sqrt(max(1.0 - coherence, 0.0) / (2.0 * lines * max(coherence, 1e-12))))
    return SlowMotion(
        gain=float(correlation[place] / power.sum()),
        lag=(place - longest) * step * n / size,
        coherence=coherence,
        before=float(np.sqrt(np.square(np.abs(spectrum - centre)[band]).sum() / own)) if own > 0.0 else np.nan,
        error=error,
        lag_error=error / (2.0 * np.pi * squared),
        lowest=float(frequency[0]),
        highest=float(frequency[-1]),
        step=step,
    )


def slow_motions(measured: Measurements, draws: np.ndarray) -> dict[str, SlowMotion]:
    """Channels whose measurement follows draws of the prior (n, n_channels, n_samples) in such a band, by name."""
    found = {}
    for row, (channel, values, step) in enumerate(zip(measured.channels, measured.values, measured.steps, strict=True)):
        slow = compare_slow_motion(values, draws[:, row], step)
        found |= {channel.name: slow} if slow is not None and slow.coherence > COHERENT else {}
    return found


def find_slow_faults(known: Mapping[str, SlowMotion]) -> list[tuple[Fault, tuple[float, float]]]:
    """Factors, signs and lags of channels in the band [Hz] that no parameter changes, and this band."""
    found: list[tuple[Fault, tuple[float, float]]] = []
    sure = NormalDist().inv_cdf(1.0 - 0.5 * SMALL_PROBABILITY)  # standard deviations
    for name, slow in known.items():
        faults = {"sign": np.nan} if slow.gain < 0.0 else {}
        if abs(np.log(abs(slow.gain))) > max(np.log(FACTOR), sure * slow.error):
            faults["factor"] = abs(slow.gain)
        if abs(slow.lag) > max(LARGE_LAG, 1.5 * slow.step, sure * slow.lag_error):
            faults["lag"] = slow.lag
        after = float(np.sqrt(max(1.0 - slow.coherence, 0.0)))
        for kind, value in faults.items():
            found.append((Fault(kind, (name,), value, slow.before, after), (slow.lowest, slow.highest)))
    return found
