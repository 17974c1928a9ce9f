"""Faults of measured histories that responses show: wrong units or signs, swapped channels, clocks that differ.

A sampler finds parameters that make up for a part of a fault. Each fault is therefore a hypothesis about draws of the
prior, before a run and after it: with a factor, the other sign, a shift in time or another order of the channels, is
one of them much closer to the measurements than the best one is without it?

Far below its lowest frequency a structure moves as its supports do, whatever its parameters. There, draws agree, and
gain and lag of a measurement y with the spectrum Y follow from those of their median R (`slow_motion`)::

    c(lag) = sum_f Y conj(R) exp(2 pi i f lag),   lag = argmax |c|,   gain^2 = sum_f |Y|^2 / sum_f |R|^2

with the sign of c. The motions of two supports are compared in the same way, in the lowest lines of the spectrum in
which they are coherent. Counts of what is named are in docs/results.rst.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from ..signals.error_measures import relative_errors
from ..units import find_unit
from .sensor_faults import runs_of

__all__ = ["FACTOR", "FEWEST_DRAWS", "Fault", "find_faults", "slow_motion", "slow_motions", "supports_apart"]

BETTER = 0.6  # error (RRMSE) with a fault taken into account, as a share of the error without: study `fit_gate`
EXPLAINED = 0.85  # error above which a response explains nothing: a correlation of a half
FLOOR = 0.02  # error below which smaller ones count as equal
FACTOR = 1.5  # from which a factor may be one between units
LONGEST_LAG, LONGEST_SHARE = 5.0, 0.2  # [s], and as a share of the record
MOST_FAULTS = 4  # that are found one after the other
FEWEST_DRAWS = 5  # of the prior
AGREE = 0.1  # difference of a draw from the median, half of the draws: gains of 45 right fits are then 0.96 to 1.21
SMOOTH = 7  # lines of the spectrum over which powers are averaged, and fewest lines of a band
TAPER = 0.05  # share of the record at either end
FINE = 8  # lags per step
# Coherence from which gain and lag are looked at: 0.985 or more in 45 right fits of nine real structures. Two supports
# have it in a band for 103 of 109 right pairs, with gains of 0.74 to 1.36 in its lowest 14 lines.
COHERENT = 0.9
LARGE_LAG = 0.025  # [s]; right fits have at most 0.02
PASSED = 0.06  # [s] between supports; waves make 0.048 at most in 37 right events, 93 of 111 late by 0.1 s have more


class Fault(NamedTuple):
    """A fault of channels that explains the measurements better."""

    kind: str  # "factor", "sign", "lag" or "swap"; of data without time also "value" or "exchange"
    names: tuple[str, ...]
    value: float  # measurements / responses [-], or time by which they are late [s]; NaN for a sign and a swap
    before: float = math.nan  # error of the channels for the best response (RRMSE, geometric mean); NaN of supports
    after: float = math.nan  # the same error with the fault
    where: str = ""  # that it was looked for, in words


def find_faults(measurements: Measurements, draws: np.ndarray) -> tuple[Fault, ...]:
    """Faults of histories, from responses (n, n_channels, n_samples) [SI] at draws of the prior.

    Gain and clock of a channel are judged where the draws agree, if there is such a band, else by the whole record,
    where each fault is found after the stronger ones are corrected.
    """
    found, known = list[Fault](), list[int]()
    for row, (channel, values, step) in enumerate(
        zip(measurements.channels, measurements.values, measurements.steps, strict=True)
    ):
        slow = slow_motion(values, draws[:, row], step)
        if slow is not None:
            known.append(row)
            found += _slow_faults(channel.name, slow, step)
    return (*found, *_of_whole_records(measurements, draws, known))


def _of_whole_records(measurements: Measurements, draws: np.ndarray, known: Sequence[int]) -> Iterator[Fault]:
    """Faults of whole records; of channels whose gain and clock are `known`, swaps alone."""
    there, usable = np.isfinite(measurements.values), np.flatnonzero(np.nan_to_num(measurements.values).any(axis=1))
    r = draws[np.isfinite(draws[:, there]).all(axis=1)]
    if not len(r) or not len(usable):
        return
    y, r = np.nan_to_num(measurements.values)[usable], np.where(there, r, 0.0)[:, usable]
    for _ in range(MOST_FAULTS):
        errors, most, chosen = _log_errors(y, r), 0.0, None
        best = int(np.argmin(errors.sum(axis=1)))
        for kind, group, value, corrected in _hypotheses(measurements, usable, known, y, r):
            with_fault = _log_errors(y[group], corrected)
            total = errors.sum(axis=1) + (with_fault - errors[:, group]).sum(axis=1)
            row = int(np.argmin(total))
            gain, before, after = errors[best].sum() - total[row], errors[best, group].mean(), with_fault[row].mean()
            step = max(measurements.steps[usable[k]] for k in group)  # one is a convention of files
            large = {"factor": _is_factor(value[row]), "lag": abs(value[row]) > 1.5 * step, "swap": True}[kind]
            least = -math.log(BETTER) * (1 if kind == "swap" else len(group))  # a swap has no number to fit
            clear = gain > least and before - after > least / len(group) and after < math.log(EXPLAINED)
            if large and clear and gain > most:
                most, chosen = gain, (kind, group, float(value[row]), math.exp(before), math.exp(after), corrected)
        if chosen is None:
            return
        kind, group, value, before, after, corrected = chosen
        names = tuple(measurements.channels[usable[k]].name for k in group)
        yield from _named(kind, names, value, before, after)
        r = r.copy()
        r[:, group] = corrected


def _named(kind: str, names: tuple[str, ...], value: float, *errors: float, where: str = "") -> Iterator[Fault]:
    """A fault, of which a negative factor is a sign, and may be a factor as well."""
    if kind == "factor" and value < 0.0:
        yield Fault("sign", names, math.nan, *errors, where=where)
    if kind != "factor" or _is_factor(abs(value)):
        yield Fault(kind, names, abs(value) if kind == "factor" else value, *errors, where=where)


def _is_factor(value: float) -> bool:
    return value < 0.0 or abs(math.log(max(value, 1e-300))) > math.log(FACTOR)


def _log_errors(y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Logarithms of the RRMSE (n, n_channels)."""
    return np.log(np.maximum(relative_errors(y - r, y), FLOOR))


def _later(values: np.ndarray, k: int) -> np.ndarray:
    """Histories (..., n_samples) later by k steps, zero where nothing is known."""
    out, n = np.zeros_like(values), values.shape[-1]
    out[..., max(k, 0) : n + min(k, 0)] = values[..., max(-k, 0) : n - max(k, 0)]
    return out


def _hypotheses(
    measurements: Measurements, usable: np.ndarray, known: Sequence[int], y: np.ndarray, r: np.ndarray
) -> Iterator[tuple[str, list[int], np.ndarray, np.ndarray]]:
    """Kind, channels, factor or lag (n,) and responses of these channels with every fault."""
    channels, steps = [measurements.channels[k] for k in usable], np.array(measurements.steps)[usable]
    free, own = [k for k, row in enumerate(usable) if row not in known], np.square(y).sum(axis=-1)
    of_kind = [tuple(k for k in free if channels[k].dimension == each.dimension) for each in channels]
    for group in map(list, filter(None, dict.fromkeys([*((k,) for k in free), *of_kind, tuple(free)]))):
        # least squares of relative errors: no channel outweighs the others
        power, product = (
            ((each * r[:, group]).sum(axis=-1) / own[group]).sum(axis=1) for each in (r[:, group], y[group])
        )
        factor = product / np.maximum(power, 1e-300)
        yield "factor", group, factor, factor[:, None, None] * r[:, group]
        lags, count = _best_lags(y[group], r[:, group], steps[group]), range(len(r))
        late = [[_later(r[i, c], round(lags[i] / steps[c])) for c in group] for i in count]
        yield "lag", group, lags, np.array(late)
    timed = [(measurements.steps[k], measurements.starts[k]) for k in usable]
    for i, j in combinations(range(len(y)), 2):
        if timed[i] == timed[j]:  # each is read with the unit of the other
            one, other = (find_unit(channels[k].unit).factor for k in (i, j))
            ratio = 1.0 if channels[i].dimension == channels[j].dimension else one / other
            yield "swap", [i, j], np.full(len(r), np.nan), r[:, [j, i]] * [[ratio], [1.0 / ratio]]


def _best_lags(y: np.ndarray, r: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Lags (n,) [s] of ``r(t - lag)`` with the least errors, together for all channels."""
    n, coarse, total = y.shape[1], float(steps.max()), 0.0
    count = int(min(LONGEST_LAG, LONGEST_SHARE * n * float(steps.min())) / coarse)
    lags, size = coarse * np.arange(-count, count + 1), 2 ** (2 * n - 1).bit_length()
    for c, step in enumerate(steps):
        k = np.rint(lags / step).astype(int) % size
        products = np.fft.irfft(np.fft.rfft(y[c], size) * np.fft.rfft(r[:, c], size).conj(), size)[:, k]
        shares = 1.0 + (np.square(r[:, c]).sum(axis=1, keepdims=True) - 2.0 * products) / np.square(y[c]).sum()
        total = total + np.log(np.maximum(shares, FLOOR**2))
    return lags[np.argmin(total, axis=1)]


class SlowMotion(NamedTuple):
    """One history by another one in a band."""

    gain: float  # negative for the opposite sign
    lag: float  # positive where the first one is later [s]
    lag_error: float  # standard deviation [s]
    coherence: float
    before: float  # error without gain and lag (RRMSE)
    band: tuple[float, float]  # [Hz]


def _slow_faults(name: str, slow: SlowMotion, step: float) -> Iterator[Fault]:
    after = math.sqrt(max(1.0 - slow.coherence, 0.0))
    where = f" between {slow.band[0]:.2g} and {slow.band[1]:.2g} Hz, where parameters hardly change it"
    if _is_factor(slow.gain):
        yield from _named("factor", (name,), slow.gain, slow.before, after, where=where)
    if abs(slow.lag) > max(LARGE_LAG, 1.5 * step) and (slow.gain < 0.0 or after < BETTER * slow.before):
        yield Fault("lag", (name,), slow.lag, slow.before, after, where)


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
    correlation = 0.5 * size * np.fft.irfft(product, size)
    place = int(np.argmax(np.abs(correlation)))
    own, power, error = (
        float(np.square(np.abs(each[band])).sum()) + 1e-300 for each in (measured, reference, measured - reference)
    )
    frequency, coherence = np.fft.rfftfreq(n, step)[band], float(correlation[place] ** 2 / (own * power))
    usual = 2.0 * math.pi * math.sqrt(np.average(np.square(frequency), weights=np.abs(product[band]) + 1e-300))
    phase = math.sqrt(max(1.0 - coherence, 0.0) / (2 * len(frequency) * max(coherence, 1e-300)))
    return SlowMotion(
        gain=float(np.sign(correlation[place]) * np.sqrt(own / power)),
        lag=(place - size * (place > size // 2)) * step * n / size,
        lag_error=phase / usual,
        coherence=coherence,
        before=float(np.sqrt(error / own)),
        band=(float(frequency[0]), float(frequency[-1])),
    )


def slow_motion(measured: np.ndarray, draws: np.ndarray, step: float) -> SlowMotion | None:
    """A channel (n,), NaN where samples are missing, by draws of the prior (n_draws, n) where these agree.

    None where they agree in too few lines of the spectrum, or above its largest line only, or the channel is not
    coherent with them there.
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
    if band is None:
        return None
    slow = _in_band(_spectra(measured, there), centre, band, len(measured), step)
    return slow if slow.coherence > COHERENT else None


def slow_motions(
    motions: Sequence[np.ndarray], step: float, coherent: float = COHERENT, lines: int = 2 * SMOOTH
) -> dict[tuple[int, int], SlowMotion]:
    """Motions (n,) of supports (k, other), in the lowest lines in which they are coherent, where there are any.

    Gains are those of the first `lines` of them.
    """
    n, found = len(motions[0]), {}
    spectra = {k: _spectra(motion, np.ones(n, dtype=bool)) for k, motion in enumerate(motions) if np.any(motion)}
    for k, other in permutations(spectra, 2):
        own, reference = (_smooth(np.abs(spectra[i]) ** 2) for i in (k, other))
        cross = np.abs(_smooth(spectra[k] * spectra[other].conj())) ** 2
        band = _lowest_band(cross > coherent * own * reference, int(np.argmax(reference)))
        if band is not None:
            lowest = slice(band.start, min(band.stop, band.start + lines))
            whole, slow = (_in_band(spectra[k], spectra[other], each, n, step) for each in (band, lowest))
            found[k, other] = whole._replace(gain=slow.gain)
    return found


def supports_apart(
    slow: Mapping[tuple[int, int], SlowMotion], names: Sequence[str], factor: float = FACTOR
) -> Iterator[tuple[int, Fault]]:
    """Number and fault of supports whose slow motion has another sign, size or clock than that of all others known."""
    for k in sorted({k for k, _ in slow}):
        gains, lags, errors = np.array([(x.gain, x.lag, x.lag_error) for (one, _), x in slow.items() if one == k]).T
        if all(gain < 0.0 or abs(math.log(gain)) > math.log(factor) for gain in gains):
            yield from ((k, each) for each in _named("factor", (names[k],), float(np.median(gains))))
        lag = float(np.median(lags))
        if np.min(lags * np.sign(lag) - 2.0 * errors) > PASSED:
            yield k, Fault("lag", (names[k],), lag)
