"""Faults of data that a fit shows: wrong units or signs, swapped channels, clocks that differ.

A fault of the data is seldom a fault of the fit: a sampler finds parameters that make up for a part of it, with a
frequency far from the true one. Each fault is therefore a hypothesis about responses of many parameters, such as draws
of the prior: with a factor, the other sign, a shift in time or another order of the channels, is one of them much
closer to the measurements than the best one is without it? For a channel with measurements y and a response r, the
errors relative to y are, with the correlation rho of y and r about zero, ::

    e = |y - r| / |y|,    e(factor) = sqrt(1 - rho^2),    e(sign) = |y + r| / |y|,    e(lag) = |y(t) - r(t - lag)| / |y|

and a hypothesis is named where it reduces the errors of the channels that it concerns to less than 0.6, in their
geometric mean, of the errors of the best response. Study ``fit_gate`` of docs/results.rst has chosen this limit.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..signals.channels import Measurements
from ..signals.error_measures import relative_errors
from ..units import DIMENSIONS, UNITS

__all__ = ["BETTER", "EXPLAINED", "FACTOR", "Fault", "describe_unit", "find_faults"]

BETTER = 0.6  # errors with a fault taken into account, as a share of the errors without
EXPLAINED = 0.85  # error above which a response explains nothing: a correlation of a half
FLOOR = 0.02  # error below which smaller ones count as equal
FACTOR = 1.5  # from which a factor may be one between units
LONGEST_LAG, LONGEST_SHARE = 5.0, 0.2  # [s], and as a share of the record
MOST_VALUES = 2**24  # of responses that are compared at once
MOST_FAULTS = 4  # that are found one after the other
SAME_UNITS = 1.25  # ratio of a factor to one between units, up to which it is named after them
EQUALLY_NEAR, NEAR_ENOUGH = 0.01, 0.03  # differences of logarithms of ratios that are named together


class Fault(NamedTuple):
    """A fault of channels that explains the measurements better."""

    kind: str  # "factor", "sign", "lag" or "swap"
    names: tuple[str, ...]
    value: float  # measurements / responses [-], or time by which they are late [s]; NaN for a sign and a swap
    before: float  # error of the channels for the best response (RRMSE, geometric mean)
    after: float  # the same error with the fault


class _Hypothesis(NamedTuple):
    """A fault, the channels whose errors change, and what corrects responses for it."""

    kind: str
    channels: tuple[int, ...]
    errors: np.ndarray  # (n, n of these channels), logarithms, of each response
    value: np.ndarray  # (n,) factor or lag that gives these errors


def find_faults(measurements: Measurements, responses: np.ndarray) -> tuple[Fault, ...]:
    """Faults that explain measurements better than any of the responses does without them, the strongest first.

    Responses (n, n_channels, n_samples) [SI] have any parameters. Each fault is found after those before it are
    corrected.
    """
    values = np.asarray(measurements.values, dtype=float)
    there, usable = np.isfinite(values), np.flatnonzero(np.nan_to_num(values).any(axis=1))
    responses = np.asarray(responses, dtype=float)
    kept = np.isfinite(responses[:, there]).all(axis=1)
    if not kept.any() or not len(usable):
        return ()
    channels = [measurements.channels[row] for row in usable]
    steps, starts = (np.array(each)[usable] for each in (measurements.steps, measurements.starts))
    alike = [(channel.dimension, *when) for channel, *when in zip(channels, steps, starts, strict=True)]
    y = np.where(there, values, 0.0)[usable]
    r, found = np.where(there[usable], responses[kept][:, usable], 0.0), list[Fault]()
    r = r[np.argsort(_log_errors(y, r).sum(axis=1), kind="stable")[: max(8, MOST_VALUES // y.size)]]
    while len(found) < MOST_FAULTS:
        errors = _log_errors(y, r)
        best, most, explained = int(np.argmin(errors.sum(axis=1))), 0.0, None
        for each in _hypotheses(y, r, alike, steps, errors):
            c = list(each.channels)
            total = errors.sum(axis=1) + (each.errors - errors[:, c]).sum(axis=1)
            row = int(np.argmin(total))
            gain, before, after = errors[best].sum() - total[row], errors[best, c].mean(), each.errors[row].mean()
            value = float(each.value[row])
            is_large = value < 0.0 or _is_factor(value) if each.kind == "factor" else True
            if each.kind == "lag":  # one step is a convention of files
                is_large = measurements.is_history and round(abs(value) / steps[c].max()) > 1
            clear = after < min(math.log(BETTER) + before, math.log(EXPLAINED)) and gain > -math.log(BETTER) * len(c)
            if is_large and clear and gain > most:
                most, explained = gain, (each, value, math.exp(before), math.exp(after))
        if explained is None:
            break
        each, value, *change = explained
        names = tuple(channels[c].name for c in each.channels)
        if each.kind == "factor" and value < 0.0:
            found.append(Fault("sign", names, math.nan, *change))
        if each.kind != "factor" or _is_factor(abs(value)):
            found.append(Fault(each.kind, names, abs(value) if each.kind == "factor" else value, *change))
        r = _corrected(each, value, r, steps)
    return tuple(found)


def describe_unit(factor: float, dimension: str) -> str:
    """Units whose ratio is about a factor or its inverse, in words; empty if there are none.

    Ratios to the SI unit of the channel's dimension come first. Then come ratios of its other units, and those of the
    base motion to m/s2 and g.
    """
    near: dict[bool, dict[str, float]] = {True: {}, False: {}}
    for of in dict.fromkeys((dimension, "acceleration")):
        bases, units = (DIMENSIONS[of], "g"), [unit for unit in UNITS.values() if unit.dimension == of]
        for one, other in combinations(sorted(units, key=lambda u: (u.name != bases[0], u.name != "g")), 2):
            apart = abs(abs(math.log(one.factor / other.factor)) - abs(math.log(factor)))
            if apart < math.log(SAME_UNITS) and (of == dimension or one.name in bases):
                words = f"{one.name} and {other.name}{'' if of == dimension else ' of the base motion'}"
                near[of == dimension and one.name in bases][words] = apart
    chosen, margin = (near[True], EQUALLY_NEAR) if near[True] else (near[False], NEAR_ENOUGH)
    return " or ".join(words for words, apart in chosen.items() if apart < min(chosen.values()) + margin)


def _is_factor(value: float) -> bool:
    return max(value, 1.0 / value) > FACTOR


def _log_errors(y: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Logarithms of the RRMSE (n, n_channels)."""
    return np.log(np.maximum(relative_errors(y - r, y), FLOOR))


def _hypotheses(
    y: np.ndarray,
    r: np.ndarray,
    alike: Sequence[tuple],
    steps: np.ndarray,
    errors: np.ndarray,
) -> Iterator[_Hypothesis]:
    """Every fault of one round, simple ones first; only channels of one quantity and the same times can be swapped."""
    every = tuple(range(len(y)))
    power, own, product = np.square(r).sum(axis=-1), np.square(y).sum(axis=-1), (y * r).sum(axis=-1)
    single = [(c,) for c in every]
    of_kind = [tuple(c for c in every if alike[c][0] == kind) for kind in dict.fromkeys(each[0] for each in alike)]
    for group in dict.fromkeys([*single, *of_kind, every]):
        c = list(group)
        # least squares of relative errors, so that no channel outweighs the others
        weight, along = (power[:, c] / own[c]).sum(axis=1), (product[:, c] / own[c]).sum(axis=1)
        factor = np.where(weight > 0.0, along / np.where(weight > 0.0, weight, 1.0), 0.0)[:, None]
        squares = 1.0 + (np.square(factor) * power[:, c] - 2.0 * factor * product[:, c]) / own[c]
        squares = np.where(factor == 0.0, np.inf, np.maximum(squares, FLOOR**2))
        yield _Hypothesis("factor", group, 0.5 * np.log(squares), factor[:, 0])
    cross = (power[:, :, None] + own - 2.0 * np.einsum("nit,jt->nij", r, y)) / own  # of response i for channel j
    cross = 0.5 * np.log(np.maximum(cross, FLOOR**2))
    for j, i in combinations(every, 2):
        swapped = np.stack([cross[:, i, j], cross[:, j, i]], axis=1)
        if alike[i] == alike[j] and (swapped < errors[:, [j, i]]).all(axis=1).any():
            yield _Hypothesis("swap", (j, i), swapped, np.full(len(r), np.nan))
    lags, by_lag = _lag_errors(y, r, steps)
    for group in dict.fromkeys([*single, every]) if len(lags) > 1 else ():
        chosen = by_lag[:, list(group)]
        best = np.argmin(chosen.sum(axis=1), axis=1)
        yield _Hypothesis("lag", group, np.take_along_axis(chosen, best[:, None, None], axis=2)[..., 0], lags[best])


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
        with np.errstate(divide="ignore"):
            shares = np.maximum(squares, 0.0) / np.where(own > 0.0, own, 1.0)
            found[:, c] = 0.5 * np.log(np.where(own > 0.0, shares, np.inf))
    return lags, np.maximum(found, math.log(FLOOR))


def _sums(values: np.ndarray) -> np.ndarray:
    """Sums of squares (n, n_samples + 1) of the first 0, 1, ... samples."""
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(np.square(values), axis=1)], axis=1)


def _corrected(fault: _Hypothesis, value: float, given: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Responses (n, n_channels, n_samples) as they would be compared with measurements that have the fault."""
    out, c = given.copy(), list(fault.channels)
    if fault.kind == "factor":
        out[:, c] *= value
    elif fault.kind == "swap":
        out[:, c] = given[:, c[::-1]]
    else:
        for row in c:
            k, n = round(value / steps[row]), given.shape[-1]
            out[:, row] = 0.0
            out[:, row, max(k, 0) : n + min(k, 0)] = given[:, row, max(-k, 0) : n - max(k, 0)]
    return out
