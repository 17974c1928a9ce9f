"""Faults of data that a fit shows: wrong units or signs, swapped channels, clocks that differ.

A sampler finds parameters that make up for a part of a fault, with a frequency far from the true one. Each fault is
therefore a hypothesis about responses of many parameters, such as draws of the prior: with a factor, the other sign, a
shift in time or another order of the channels, is one of them much closer to the measurements than the best one is
without it? It is named where it reduces the errors (RRMSE) of its channels to less than 0.6, in their geometric mean.
Study ``fit_gate`` of docs/results.rst has chosen this limit.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.error_measures import relative_errors
from ..units import DIMENSIONS, UNITS

__all__ = ["EXPLAINED", "FACTOR", "Fault", "describe_unit", "find_faults"]

BETTER = 0.6  # errors with a fault taken into account, as a share of the errors without
EXPLAINED = 0.85  # error above which a response explains nothing: a correlation of a half
GOOD = 0.05  # error of the best response below which nothing is wrong: of 44 right load tests, 1 is blamed without it
FLOOR = 0.02  # error below which smaller ones count as equal
FACTOR = 1.5  # from which a factor may be one between units
LONGEST_LAG, LONGEST_SHARE = 5.0, 0.2  # [s], and as a share of the record
MOST_VALUES = 2**24  # of responses that are compared at once
MOST_FAULTS = 4  # that are found one after the other
SAME_UNITS = 1.25  # ratio of a factor to one between units, up to which it is named after them
NEAR_ENOUGH = 0.03  # difference of logarithms of ratios that are named together


class Fault(NamedTuple):
    """A fault of channels that explains the measurements better."""

    kind: str  # "factor", "sign", "lag" or "swap"
    names: tuple[str, ...]
    value: float  # measurements / responses [-], or time by which they are late [s]; NaN for a sign and a swap
    before: float  # error of the channels for the best response (RRMSE, geometric mean)
    after: float  # the same error with the fault


def find_faults(measurements: Measurements, responses: np.ndarray) -> tuple[Fault, ...]:
    """Faults that explain measurements better than any of the responses does without them, the strongest first.

    Responses (n, n_channels, n_samples) [SI] have any parameters. Each fault is found after those before it are
    corrected.
    """
    values, r = measurements.values, np.asarray(responses, dtype=float)
    there, usable = np.isfinite(values), np.flatnonzero(np.nan_to_num(values).any(axis=1))
    r = r[np.isfinite(r[:, there]).all(axis=1)]
    if not len(r) or not len(usable):
        return ()
    channels, steps = [measurements.channels[row] for row in usable], np.array(measurements.steps)[usable]
    timed = [(steps[k], measurements.starts[usable[k]]) for k in range(len(channels))]
    y, r, found = np.nan_to_num(values)[usable], np.where(there, r, 0.0)[:, usable], list[Fault]()
    r = r[np.argsort(_log_errors(y, r).sum(axis=1), kind="stable")[: max(8, MOST_VALUES // y.size)]]
    while len(found) < MOST_FAULTS:
        errors, most, chosen = _log_errors(y, r), 0.0, None
        best = int(np.argmin(errors.sum(axis=1)))
        for kind, group, value, of_group in _hypotheses(y, r, channels, timed, measurements.is_history):
            total = errors.sum(axis=1) + (of_group - errors[:, group]).sum(axis=1)
            row = int(np.argmin(total))
            gain, before, after = errors[best].sum() - total[row], errors[best, group].mean(), of_group[row].mean()
            if kind == "factor":
                is_large = value[row] < 0.0 or _is_factor(value[row])
            else:  # one step is a convention of files
                is_large = kind == "swap" or round(abs(value[row]) / steps[group].max()) > 1
            needed = before > math.log(GOOD) and gain > -math.log(BETTER) * len(group)
            clear = needed and after < min(math.log(BETTER) + before, math.log(EXPLAINED))
            if is_large and clear and gain > most:
                most, chosen = gain, (kind, group, float(value[row]), math.exp(before), math.exp(after))
        if chosen is None:
            break
        kind, group, value, *change = chosen
        names = tuple(channels[c].name for c in group)
        if kind == "factor" and value < 0.0:
            found.append(Fault("sign", names, math.nan, *change))
        if kind != "factor" or _is_factor(value):
            found.append(Fault(kind, names, abs(value) if kind == "factor" else value, *change))
        r = r.copy()
        if kind == "lag":
            r[:, group] = np.stack([_later(r[:, c], round(value / steps[c])) for c in group], axis=1)
        else:
            r[:, group] = value * r[:, group] if kind == "factor" else _swapped(r, group, channels)
    return tuple(found)


def describe_unit(factor: float, dimension: str, unit: str = "", loads: bool = False) -> str:
    """Units whose ratio is about a factor or its inverse, in words; empty if there are none.

    One of the two is the SI unit or the `unit` of the channel, or they are m/s2 and g of the base motion; with `loads`,
    all channels of a static test have this factor.
    """
    bases, near = (unit, DIMENSIONS[dimension]), dict[str, float]()
    units = sorted((each for each in UNITS.values() if each.dimension == dimension), key=lambda u: u.name not in bases)
    ratios = {9.80665: "m/s2 and g of the base motion"} if dimension != "acceleration" else {}
    for one, other in combinations(units, 2):
        if one.name in bases:  # of two names of a unit, the first
            ratios.setdefault(one.factor / other.factor, f"{one.name} and {other.name}")
    for ratio, words in ratios.items():
        apart = abs(abs(math.log(ratio)) - abs(math.log(factor)))
        near |= {words: apart} if apart < math.log(SAME_UNITS) else {}
    # stiffnesses are not known to a factor of 2: 86 of 88 load tests are named
    kilo = loads and abs(abs(math.log(factor)) - math.log(1000.0)) < math.log(2.0)
    near |= {"kN and N of the loads": 0.0} if kilo else {}
    return " or ".join(words for words, apart in near.items() if apart < min(near.values()) + NEAR_ENOUGH)


def _is_factor(value: float) -> bool:
    return max(abs(value), 1.0 / max(abs(value), 1e-300)) > FACTOR


def _log_errors(y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Logarithms of the RRMSE (n, n_channels)."""
    return np.log(np.maximum(relative_errors(y - r, y), FLOOR))


def _later(values: np.ndarray, k: int) -> np.ndarray:
    """Histories (..., n_samples) later by k steps, zero where nothing is known."""
    out, n = np.zeros_like(values), values.shape[-1]
    out[..., max(k, 0) : n + min(k, 0)] = values[..., max(-k, 0) : n - max(k, 0)]
    return out


def _swapped(r: np.ndarray, group: list[int], channels: Sequence[Channel]) -> np.ndarray:
    """Two channels of responses (n, n_channels, n_samples) as read from each other's column, with its unit."""
    one, other = (channels[c] for c in group)
    ratio = 1.0 if one.dimension == other.dimension else UNITS[one.unit].factor / UNITS[other.unit].factor
    return r[:, group[::-1]] * [[ratio], [1.0 / ratio]]


def _hypotheses(
    y: np.ndarray, r: np.ndarray, channels: Sequence[Channel], timed: Sequence[tuple], is_history: bool
) -> Iterator[tuple[str, list[int], np.ndarray, np.ndarray]]:
    """Kind, channels, factor or lag (n,) and logarithms of errors (n, n of these channels) of every fault of one round.

    Simple ones come first; only channels of the same times can be swapped.
    """
    steps = np.array([step for step, _ in timed])
    every, own = list(range(len(y))), np.square(y).sum(axis=-1)
    power, product = np.square(r).sum(axis=-1) / own, (y * r).sum(axis=-1) / own
    kinds = [each.dimension for each in channels]
    of_kind = [tuple(c for c in every if kinds[c] == kind) for kind in dict.fromkeys(kinds)]
    for group in map(list, dict.fromkeys([*((c,) for c in every), *of_kind, tuple(every)])):
        weight = power[:, group].sum(axis=1)  # least squares of relative errors: no channel outweighs the others
        factor = np.where(weight > 0.0, product[:, group].sum(axis=1) / np.where(weight > 0.0, weight, 1.0), 0.0)
        squares = 1.0 + np.square(factor)[:, None] * power[:, group] - 2.0 * factor[:, None] * product[:, group]
        squares = np.where(factor[:, None] == 0.0, np.inf, np.maximum(squares, FLOOR**2))
        yield "factor", group, factor, 0.5 * np.log(squares)
    for j, i in combinations(every, 2):
        if timed[i] == timed[j]:
            yield "swap", [j, i], np.full(len(r), np.nan), _log_errors(y[[j, i]], _swapped(r, [j, i], channels))
    lags, by_lag = _lag_errors(y, r, steps)
    for group in (
        map(list, dict.fromkeys([*((c,) for c in every), tuple(every)])) if is_history and len(lags) > 1 else ()
    ):
        best = np.argmin(by_lag[:, group].sum(axis=1), axis=1)
        yield "lag", group, lags[best], np.take_along_axis(by_lag[:, group], best[:, None, None], axis=2)[..., 0]


def _lag_errors(y: np.ndarray, r: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lags (n_lags,) [s], and logarithms of the errors (n, n_channels, n_lags) of ``r(t - lag)``.

    Before its first sample a response is at rest; where a shifted response has ended, nothing is compared.
    """
    n, coarse = y.shape[1], float(steps.max())
    count = int(min(LONGEST_LAG, LONGEST_SHARE * n * float(steps.min())) / coarse)
    lags = coarse * np.arange(-count, count + 1)
    found, size = np.empty((*r.shape[:2], len(lags))), 2 ** (2 * n - 1).bit_length()
    for c, step in enumerate(steps):
        k = np.rint(lags / step).astype(int)
        products = np.fft.irfft(np.fft.rfft(y[c], size) * np.fft.rfft(r[:, c], size).conj(), size)[:, k % size]
        ends, power, own = n - np.maximum(-k, 0), _sums(r[:, c]), _sums(y[None, c])[0]
        squares = own[ends] + power[:, n - np.maximum(k, 0)] - power[:, np.maximum(-k, 0)] - 2.0 * products
        own = np.where(own[ends] < 0.5 * own[-1], 0.0, own[ends])  # too little is left to compare
        shares = np.maximum(squares, 0.0) / np.where(own > 0.0, own, 1.0)
        found[:, c] = np.where(own > 0.0, 0.5 * np.log(np.maximum(shares, FLOOR**2)), np.inf)
    return lags, found


def _sums(values: np.ndarray) -> np.ndarray:
    """Sums of squares (n, n_samples + 1) of the first 0, 1, ... samples."""
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(np.square(values), axis=1)], axis=1)
