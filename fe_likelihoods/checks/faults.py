"""Faults of measurements that responses show: wrong units or signs, swapped channels, clocks that differ; in words.

A sampler finds parameters that make up for a part of a fault. Each fault is therefore a hypothesis about draws of the
prior: with a factor, the other sign, a lag or another order of the channels, is one of them much closer to the
measurements than the best one is without it? Gain g and lag of measurements y by responses r follow from spectra::

    c(lag) = sum_f Y conj(R) exp(2 pi i f lag),   g = c / sum_f |R|^2,   error^2 = 1 - c^2 / (sum_f |Y|^2 sum_f |R|^2)

Errors are relative to the smaller of y and r: half a gain is then as far from one as a gain of two. Far below its
lowest frequency a structure moves as its supports do. Where draws agree, only these lines are compared, with the median
of the draws. Two supports are compared in the lowest lines in which they are coherent. Counts are in docs/results.rst.
"""

import math
from collections.abc import Sequence
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np

from ..likelihood.fits import FEWEST_DRAWS
from ..signals.channels import Channel, Measurements
from ..text_tables import listed
from ..units import DIMENSIONS, UNITS, find_unit
from .finding import HALF, TAIL, WRONG, Finding, percent
from .screening import ONE_CAUSE, runs_of

BETTER = 0.6  # error with a fault taken into account, as a share of the error without: study `fit_gate`
EXPLAINED = math.sqrt(1.0 - HALF**2)  # error (RRMSE) above which a response explains nothing: a correlation of HALF
FLOOR = 0.02  # error below which smaller ones count as equal
FACTOR = 1.5  # from which a factor may be one between units; from 1.67 on, 433 of 444 faults of supports for 442
SAME_UNITS = 1.25  # ratio of a factor to one between units, up to which it is named after them
AGREE = 0.1  # difference of a draw from the median, half of the draws: gains of 45 right fits are then 0.96 to 1.21
SMOOTH = 7  # lines of the spectrum over which powers are averaged, and fewest lines of a band
LARGE_LAG = 0.025  # [s]; right fits have at most 0.02
PASSED = 0.06  # [s] between supports; waves make 0.05 at most in 37 right events, 100 of 111 late by 0.1 s have more


class Fault(NamedTuple):
    """A fault of channels that explains the measurements better."""

    kind: str  # "factor", "sign", "lag" or "swap"
    names: tuple[str, ...]
    value: float  # measurements / responses [-], or time by which they are late [s]; NaN for a sign and a swap
    before: float = math.nan  # error of the channels for the best response (RRMSE, geometric mean); NaN of supports
    after: float = math.nan  # the same error with the fault
    where: str = ""  # that it was looked for, in words


def find_faults(measurements: Measurements, draws: np.ndarray) -> tuple[Fault, ...]:
    """Faults of histories or load cases, from responses (n, n_channels, n_samples) [SI] at draws of the prior.

    Exchanged channels come first, because a gain, a sign and a lag make up for them. Gain and clock of a channel are
    judged where the draws agree, if there is such a band, else by the whole record, the strongest fault first.
    """
    there, history = np.isfinite(measurements.values), measurements.is_history
    usable = np.flatnonzero(np.nan_to_num(measurements.values).any(axis=1) & (history | (there.sum(axis=1) > 2)))
    draws = draws[np.isfinite(draws[:, there]).all(axis=1)]
    y, r = (_spectra(each, there) if history else np.where(there, each, 0.0) for each in (measurements.values, draws))
    y, r, n = y[usable], r[:, usable], there.shape[1] * history
    channels, steps = [measurements.channels[k] for k in usable], np.array(measurements.steps)[usable]
    names, found, free = [each.name for each in channels], list[Fault](), list[int]()
    timed = [(measurements.steps[k], measurements.starts[k]) for k in usable]
    pairs = [(i, j) for i, j in combinations(range(len(y)), 2) if timed[i] == timed[j]]
    swaps = [([i, j], ratio) for i, j in pairs for ratio in _ratios(channels[i], channels[j])]

    def strongest(groups: Sequence[list[int]]) -> tuple[list[int], list[Fault], np.ndarray] | None:
        """The group or pair, the faults and the corrected responses of the hypothesis that explains most."""
        errors, most, chosen = _log_errors(y, r), 0.0, None
        best = int(np.argmin(errors.sum(axis=1)))
        hypotheses = [(group, *_fitted(y[group], r[:, group], steps[group], n)) for group in groups]
        hypotheses += [(pair, None, None, r[:, pair[::-1]] * [[ratio], [1.0 / ratio]]) for pair, ratio in swaps]
        for group, gains, lags, corrected in hypotheses:
            after = _log_errors(y[group], corrected)
            row = int(np.argmin(errors.sum(axis=1) + (after - errors[:, group]).sum(axis=1)))
            gain = errors[best].sum() - errors[row].sum() + (errors[row, group] - after[row]).sum()
            least = -math.log(BETTER) * (1 if gains is None else len(group))  # a swap has no number to fit
            before, left = (_error(y[group], each) for each in (r[best, group], corrected[row]))
            nearer = errors[best, group].mean() - after[row].mean() > least / len(group)
            score = gain - least * (gains is None)  # and is named where no other fault explains nearly as much
            if gain > least and score > most and nearer and left < EXPLAINED:
                of = [names[k] for k in group]
                faults = [Fault("swap", tuple(of), math.nan, before, left)]
                if gains is not None:
                    faults = _named(of, gains[row], lags[row], max(steps[group]), before, left)
                if faults:
                    most, chosen = score, (group, faults, corrected)
        return chosen

    groups = [[k] for k in range(len(y))] + [[*range(len(y))]]
    while len(r) and strongest([]) and (chosen := strongest(groups)) and chosen[1][0].kind == "swap":
        group, faults, r[:, group] = chosen
        found += faults
    for k, step in enumerate(steps):
        slow = slow_motion(y[k], r[:, k], step, n)
        if slow is None:
            free.append(k)
            continue
        clear = abs(slow.lag) > LARGE_LAG and (slow.gain < 0.0 or slow.after < BETTER * slow.before)
        where = f" between {slow.band[0]:.2g} and {slow.band[1]:.2g} Hz, where parameters hardly change it"
        found += _named([names[k]], slow.gain, slow.lag * clear, step, slow.before, slow.after, where)
    groups = [[k] for k in free] + ([free] if len(free) > 1 else [])
    named = {name for fault in found for name in fault.names}
    swaps = [(pair, ratio) for pair, ratio in swaps if not named.intersection(names[k] for k in pair)]
    while len(r) and (chosen := strongest(groups)):
        group, faults, r[:, group] = chosen
        found += faults
    return tuple(found)


def _named(names: Sequence[str], gain: float, lag: float, step: float, *more: Any) -> list[Fault]:
    """A sign, a factor, and a lag of more than a step, which is a convention of files; `more` are fields of `Fault`."""
    found = [Fault("sign", tuple(names), math.nan, *more)] if gain < 0.0 else []
    large = abs(math.log(max(abs(gain), 1e-300))) > math.log(FACTOR)
    found += [Fault("factor", tuple(names), float(abs(gain)), *more)] if large else []
    return found + ([Fault("lag", tuple(names), float(lag), *more)] if abs(lag) > 1.5 * step else [])


def _log_errors(y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Logarithms of errors (n, n_channels) relative to the smaller of measurement and response."""
    norms = np.minimum(np.linalg.norm(y, axis=-1), np.linalg.norm(r, axis=-1))
    return np.log(np.maximum(np.linalg.norm(y - r, axis=-1) / np.maximum(norms, 1e-300), FLOOR))


def _error(y: np.ndarray, r: np.ndarray) -> float:
    """Geometric mean of the RRMSE of channels (n_channels, n)."""
    errors = np.linalg.norm(y - r, axis=-1) / np.linalg.norm(y, axis=-1)
    return float(np.exp(np.log(np.maximum(errors, FLOOR)).mean()))


def _fitted(y: np.ndarray, r: np.ndarray, steps: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors and lags [s] (n_draws,), common to all channels, with the least errors, and responses with both.

    Spectra (n_channels, n_lines) and (n_draws, n_channels, n_lines) of n samples; n is zero for data without time.
    """
    own = np.square(np.abs(y)).sum(axis=-1)
    power, lags = np.square(np.abs(r)).sum(axis=-1) / own, np.zeros(1)
    products = (y * r.conj()).real.sum(axis=-1)[..., None] / own[:, None]
    if n:
        reach = int(HALF * n * steps.min() / steps.max())
        lags = steps.max() * np.arange(-reach, reach + 1)
        all_lags = 0.5 * n * np.fft.irfft(y * r.conj(), n) / own[:, None]
        products = np.stack([all_lags[:, c, np.rint(lags / step).astype(int)] for c, step in enumerate(steps)], axis=1)
    # least squares of relative errors: no channel outweighs the others
    gains = products.sum(axis=1) / np.maximum(power.sum(axis=1), 1e-300)[:, None]
    if not n:  # a factor of a single draw is its stiffness as well
        gains = np.full_like(gains, np.median(gains))
    shares = 1.0 + gains[:, None] ** 2 * power[:, :, None] - 2.0 * gains[:, None] * products
    best = np.log(np.maximum(shares, FLOOR**2)).sum(axis=1).argmin(axis=1)
    gain, lag = gains[np.arange(len(r)), best], lags[best]
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(n) * np.rint(lag[:, None] / steps)[:, :, None]) if n else 1.0
    return gain, lag, r * gain[:, None, None] * shift


def _ratios(one: Channel, other: Channel) -> set[float]:
    """Units of one channel by units of another one: of the channels, or of a model, which are mostly SI."""
    units = ({1.0, find_unit(each.unit).factor} for each in (one, other))
    return {1.0} if one.dimension == other.dimension else {a / b for a, b in product(*units)}


def _spectra(histories: np.ndarray, there: np.ndarray | bool = True) -> np.ndarray:
    """Spectra (..., n_lines) of histories (..., n) with tapered ends, zero where samples are missing; no mean."""
    k = np.arange(histories.shape[-1]) + 0.5
    ends = np.minimum(np.minimum(k, k[::-1]) / max(TAIL * len(k), 1.0), 1.0)
    spectra = np.fft.rfft(np.where(there, histories, 0.0) * np.sin(0.5 * np.pi * ends) ** 2)
    spectra[..., 0] = 0.0
    return spectra


def _smooth(power: np.ndarray) -> np.ndarray:
    return np.convolve(power, np.ones(SMOOTH) / SMOOTH, "same")


class SlowMotion(NamedTuple):
    """One history by another one in a band, with errors without and with gain and lag."""

    gain: float  # negative for the opposite sign
    lag: float  # positive where the first one is later [s]
    before: float
    after: float
    band: tuple[float, float]  # [Hz]


def _in_band(good: np.ndarray, y: np.ndarray, r: np.ndarray, step: float, n: int) -> SlowMotion | None:
    """Compare two spectra in the lowest lines in a row that are good; None if these are few, or above the largest."""
    good[:2] = False  # the mean, and what the taper makes of it
    runs = [slice(*run) for run in runs_of(good) if run[1] - run[0] >= SMOOTH]
    if not runs or runs[0].start > np.argmax(_smooth(np.abs(r) ** 2)):  # below it, filtered motions are noise
        return None
    inside, frequency = np.isin(np.arange(len(y)), np.r_[runs[0]]), np.fft.rfftfreq(n, step)[runs[0]]
    y, r = y * inside, r * inside
    (gain,), (lag,), ((fitted,),) = _fitted(y[None], r[None, None], np.array([step]), n)
    low = slice(runs[0].start, runs[0].start + 2 * SMOOTH)  # gains of supports are 0.74 to 1.36 there
    gain = np.sign(gain) * np.linalg.norm(y[low]) / max(np.linalg.norm(r[low]), 1e-300)
    before, after = (float(np.linalg.norm(y - each) / max(np.linalg.norm(y), 1e-300)) for each in (r, fitted))
    return SlowMotion(float(gain), float(lag), before, after, (float(frequency[0]), float(frequency[-1])))


def slow_motion(y: np.ndarray, r: np.ndarray, step: float, n: int) -> SlowMotion | None:
    """The spectrum of a channel (n_lines,) of n samples by draws of the prior (n_draws, n_lines) where these agree.

    None where they agree in too few lines of the spectrum, or above its largest line only, or the channel is not
    coherent with them there.
    """
    if not n or len(r) < FEWEST_DRAWS:
        return None
    centre = np.median(r.real, axis=0) + 1j * np.median(r.imag, axis=0)
    agree = _smooth(np.median(np.abs(r - centre), axis=0) ** 2) < AGREE**2 * _smooth(np.abs(centre) ** 2)
    slow = _in_band(agree, y, centre, step, n)
    # 0.985 or more is coherent in 45 right fits of nine real structures
    return slow if slow is not None and slow.after**2 < 1.0 - ONE_CAUSE else None


def supports_apart(motions: Sequence[np.ndarray], names: Sequence[str], step: float) -> dict[int, list[Fault]]:
    """Faults of motions (n,), by number, whose slow part has another sign, size or clock than all others."""
    spectra, found = {k: _spectra(motion) for k, motion in enumerate(motions) if np.any(motion)}, {}
    for k, own in spectra.items():
        slow = list[SlowMotion]()
        for reference in (each for other, each in spectra.items() if other != k):
            powers = (_smooth(np.abs(each) ** 2) for each in (own, reference))
            # two supports are coherent in a band for 103 of 109 right pairs
            good = np.abs(_smooth(own * reference.conj())) ** 2 > ONE_CAUSE * math.prod(powers)
            slow += filter(None, [_in_band(good, own, reference, step, len(motions[0]))])
        if slow:
            gain, lag = np.median([each[:2] for each in slow], axis=0)
            apart = all(_named(names, each.gain, 0.0, step) for each in slow)
            late = all(each.lag * np.sign(lag) > PASSED for each in slow)
            found[k] = _named([names[k]], gain if apart else 1.0, lag * late, step)
    return found


OF_MODES = {  # ratios of measured to computed frequencies
    2.0 * math.pi: "rad/s read as Hz",
    0.5 / math.pi: "rad/s in the model",
    60.0: "1/min read as Hz",
    1e-3: "kHz read as Hz",
    1000.0**0.5: "a stiffness in kN, or a mass in kg beside a stiffness in kN",
    1000.0**-0.5: "a mass in t",
    9.81**0.5: "a weight instead of a mass",
}
FAULTS = {  # kind, text and action
    "factor": (
        "A {what} may be wrong",
        "{measured} are {value} times {computed}",
        "Look up unit and gain of the channel, base motion, loads and stiffnesses; a model must return SI units, "
        "frequencies in Hz.",
    ),
    "sign": (
        "A sign may be wrong",
        "{measured} have the opposite sign of {computed}",
        "Where the sensor counts the other way, change its sign in the file, or by `reversed` in [measurements].",
    ),
    "lag": (
        "Clocks may differ",
        "{measured} are {value} s {late} than {computed}",
        "If all channels are {late} by the same time, the clock of their logger or of the motion is wrong: {add} "
        "`zero` in [measurements], or use measurements.shift({shift}). "
        "The lag of one sensor can be sampled (`Sensor`).",
    ),
    "swap": (
        "Channels may be swapped",
        "each measurement resembles the computed response of the other",
        "Look up which cable or column (of a file or of a program's output) belongs to which; exchange the wrong ones.",
    ),
}
OF_SUPPORTS = "Check unit, sign and clock of its file: slow motions of one site are alike, except for waves and slips."


def finding_of(
    fault: Fault, title: str, channels: Sequence[Channel] = (), severity: str = WRONG, error: str = "RRMSE"
) -> Finding:
    """A fault of a data set with a title, and its channels (of modes none); `error` is what was compared."""
    of_supports, value, modes = math.isnan(fault.before), abs(fault.value), fault.names == ("frequencies",)
    kinds = [("frequency", "")] if modes else [(each.dimension, each.unit) for each in channels]
    near = [describe_unit(fault.value, *each) for each in kinds] if fault.kind == "factor" else []
    units = " or ".join(filter(None, dict.fromkeys(near)))
    words = {"measured": "its slow motions", "computed": "the slow motions of other supports"} if of_supports else {}
    words = {"measured": "measured values", "computed": "the computed ones"} | words
    words |= {"value": f"{value:.0f}" if value >= 1e3 else f"{value:.3g}", "what": "unit" if units or modes else "gain"}
    late, add = ("later", f"add {value:.3g} s to") if fault.value > 0.0 else ("earlier", f"subtract {value:.3g} s from")
    kind, text, action = (
        each.format(**words, late=late, add=add, shift=f"{-fault.value:.3g}") for each in FAULTS[fault.kind]
    )
    text = f"{listed(fault.names)}{f' ({title})' if title else ''}: {text}{f', as with {units}' if units else ''}"
    numbers = {"before": fault.before, "after": fault.after, fault.kind: fault.value}
    numbers = {name: number for name, number in numbers.items() if not math.isnan(number)}
    if of_supports:
        return Finding(kind, severity, f"{text}.", OF_SUPPORTS, numbers, "input")
    after, before = percent(fault.after), percent(fault.before)
    text += f"; corrected, the error ({error}) is {after} instead of {before}{fault.where}."
    return Finding(kind, severity, text, action, numbers, "data")


def describe_unit(factor: float, dimension: str, unit: str = "") -> str:
    """Which unit, read as which other one, gives about this factor, in words; empty if there are none.

    One of the two is the SI unit or the `unit` of the channel, or they are m/s2 and g of the base motion.
    """
    bases = unit, DIMENSIONS[dimension]
    of_motion = {ratio: "m/s2 and g of the base motion" for ratio in (9.80665, 1.0 / 9.80665)}
    ratios = dict({"acceleration": {}, "frequency": OF_MODES}.get(dimension, of_motion))
    units = sorted((each for each in UNITS.values() if each.dimension == dimension), key=lambda u: u.name not in bases)
    for one, other in () if dimension == "frequency" else combinations(units, 2):
        if one.name in bases:  # of two names of a unit, the first
            ratios.setdefault(one.factor / other.factor, f"{other.name} read as {one.name}")
            ratios.setdefault(other.factor / one.factor, f"{one.name} read as {other.name}")
    near = (words for ratio, words in ratios.items() if abs(math.log(ratio / factor)) < math.log(SAME_UNITS))
    return " or ".join(dict.fromkeys(near))
