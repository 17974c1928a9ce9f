"""Gain, sign and clock of a sensor, from the part of the motion that no parameter changes.

Far below its lowest frequency a structure moves as its supports do, and these move alike. In this band the responses of
all draws of the prior agree, so that no fit can make up for a fault of the data, as it can near a resonance with
frequency and damping. There, measurement y and response r have the spectra Y and R, and gain and lag are ::

    c(lag) = sum_f Y conj(R) exp(2 pi i f lag),   lag = argmax |c|,   gain^2 = sum_f |Y|^2 / sum_f |R|^2,
    coherence = |c|^2 / (sum_f |Y|^2 sum_f |R|^2)

with the sign of c. The same holds for the motions of two supports in the lowest band in which they are coherent. Where
no band is found, or measurement and response are not coherent there, nothing is known.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from .data_faults import FACTOR, Fault
from .finding import SURE
from .sensor_faults import runs_of

__all__ = [
    "FEWEST_DRAWS",
    "SlowMotion",
    "compare_slow_motion",
    "find_slow_faults",
    "slow_motions",
    "support_gains",
    "supports_apart",
]

FEWEST_DRAWS = 5  # of the prior
AGREE = 0.1  # difference of a draw from the median, half of the draws: gains of 45 right fits are then 0.96 to 1.21
SMOOTH = 7  # lines of the spectrum over which powers are averaged, and fewest lines of a band
TAPER = 0.05  # share of the record at either end
FINE = 8  # lags per step
LONGEST_LAG = 0.2  # share of the record
# Coherence from which gain and lag are looked at: 0.985 or more in 45 right fits of nine real structures. Two supports
# have it in a band for 103 of 109 right pairs, with gains of 0.74 to 1.36 in its lowest 14 lines.
COHERENT = 0.9
LARGE_LAG = 0.025  # [s]; right fits have at most 0.02


class SlowMotion(NamedTuple):
    """Measurement by response in the band that no parameter changes."""

    gain: float  # negative for the opposite sign
    lag: float  # positive where the measurement is later [s]
    lag_error: float  # standard deviation [s]
    coherence: float
    before: float  # error without gain and lag (RRMSE)
    lowest: float  # ends of the band [Hz]
    highest: float
    step: float  # of the samples [s]

    @property
    def faults(self) -> dict[str, float]:
        """Sign, factor and lag by which the measurement differs."""
        found = {"sign": np.nan} if self.gain < 0.0 else {}
        if abs(np.log(abs(self.gain))) > np.log(FACTOR):
            found["factor"] = abs(self.gain)
        if abs(self.lag) > max(LARGE_LAG, 1.5 * self.step, SURE * self.lag_error):
            found["lag"] = self.lag
        return found


def _spectra(histories: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Spectra (..., n_lines) of histories (..., n) with tapered ends, zero where samples are missing."""
    n, ends = len(there), round(TAPER * len(there))
    window = np.minimum(1.0, (np.arange(n) + 0.5) / max(ends, 1))
    window = np.where(there, np.sin(0.5 * np.pi * np.minimum(window, window[::-1])) ** 2, 0.0)
    return np.fft.rfft(np.where(there, histories, 0.0) * window)


def _smooth(power: np.ndarray) -> np.ndarray:
    return np.convolve(power, np.ones(SMOOTH) / SMOOTH, "same")


def _lowest_band(good: np.ndarray, last: int) -> slice | None:
    """The lowest lines in a row that are good, and begin at the line `last` at most; None if there are too few."""
    good[:2] = False  # the mean, and what the taper makes of it
    runs = [run for run in runs_of(good) if run[1] - run[0] >= SMOOTH and run[0] <= last]
    return slice(*runs[0]) if runs else None


def _in_band(measured: np.ndarray, reference: np.ndarray, band: slice, n: int, step: float) -> SlowMotion:
    """Compare two spectra (n_lines,) in a band."""
    product = np.zeros(FINE * (n // 2) + 1, dtype=complex)
    product[band] = (measured * reference.conj())[band]
    size = 2 * (len(product) - 1)
    longest = int(LONGEST_LAG * size)
    correlation = np.roll(0.5 * size * np.fft.irfft(product, size), longest)[: 2 * longest + 1]
    place = int(np.argmax(np.abs(correlation)))
    power, own = np.square(np.abs(reference[band])), float(np.square(np.abs(measured[band])).sum())
    frequency = np.fft.rfftfreq(n, step)[band]
    squared = float(np.sqrt((power * frequency**2).sum() / power.sum()))
    coherence = float(correlation[place] ** 2 / (power.sum() * own)) if own > 0.0 else 0.0
    lines = power.sum() ** 2 / np.square(power).sum()  # that have power
    error = float(np.sqrt(max(1.0 - coherence, 0.0) / (2.0 * lines * max(coherence, 1e-12))))
    return SlowMotion(
        gain=float(np.sign(correlation[place]) * np.sqrt(own / power.sum())),
        lag=(place - longest) * step * n / size,
        lag_error=error / (2.0 * np.pi * squared),
        coherence=coherence,
        before=float(np.sqrt(np.square(np.abs(measured - reference)[band]).sum() / own)) if own > 0.0 else np.nan,
        lowest=float(frequency[0]),
        highest=float(frequency[-1]),
        step=step,
    )


def compare_slow_motion(measured: np.ndarray, draws: np.ndarray, step: float) -> SlowMotion | None:
    """Compare a channel (n,), NaN where samples are missing, with draws of the prior (n_draws, n) where these agree.

    None where they agree in too few lines of the spectrum, or above its largest line only.
    """
    there = np.isfinite(measured)
    draws = draws[np.isfinite(draws[:, there]).all(axis=1)]
    if len(draws) < FEWEST_DRAWS:
        return None
    spectra = _spectra(draws, there)
    centre = np.median(spectra.real, axis=0) + 1j * np.median(spectra.imag, axis=0)
    power = _smooth(np.abs(centre) ** 2)
    agree = _smooth(np.median(np.abs(spectra - centre), axis=0) ** 2) < AGREE**2 * power
    band = _lowest_band(agree, int(np.argmax(power)))  # below it, filtered motions are noise
    return None if band is None else _in_band(_spectra(measured, there), centre, band, len(measured), step)


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
    for name, slow in known.items():
        after = float(np.sqrt(max(1.0 - slow.coherence, 0.0)))
        for kind, value in slow.faults.items():
            found.append((Fault(kind, (name,), value, slow.before, after), (slow.lowest, slow.highest)))
    return found


def support_gains(
    motions: Sequence[np.ndarray], step: float, coherent: float = COHERENT, lines: int = 2 * SMOOTH
) -> dict[tuple[int, int], float]:
    """Gains of supports (k, other), in the lowest band in which their motions (n,) are coherent, where there is one."""
    n, gains = len(motions[0]), {}
    spectra = {k: _spectra(motion, np.ones(n, dtype=bool)) for k, motion in enumerate(motions) if np.any(motion)}
    for k, other in permutations(spectra, 2):
        own, reference = (_smooth(np.abs(spectra[i]) ** 2) for i in (k, other))
        cross = np.abs(_smooth(spectra[k] * spectra[other].conj())) ** 2
        band = _lowest_band(cross > coherent * own * reference, int(np.argmax(reference)))
        if band is not None:
            band = slice(band.start, min(band.stop, band.start + lines))
            gains[k, other] = _in_band(spectra[k], spectra[other], band, n, step).gain
    return gains


def supports_apart(gains: Mapping[tuple[int, int], float], limit: float = FACTOR) -> dict[int, float]:
    """Gains of supports, by number, whose slow motion has another sign or size than that of all others known."""
    found = {}
    for k in sorted({k for k, _ in gains}):
        own = [gain for (one, _), gain in gains.items() if one == k]
        if all(gain < 0.0 or abs(np.log(gain)) > np.log(limit) for gain in own):
            found[k] = float(np.median(own))
    return found
