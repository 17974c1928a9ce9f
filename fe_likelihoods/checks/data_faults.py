"""Faults of data that a fit shows: wrong units or signs, swapped channels, clocks that differ.

A fault of the data is seldom a fault of the fit: a sampler finds parameters that make up for a part of it, with a
frequency far from the true one. Each fault is therefore a hypothesis about responses of many parameters, such as draws
of the prior: with a factor, the other sign, a shift in time or another order of the channels, is one of them much
closer to the measurements than the best one is without it? For a channel with measurements y and a response r, the
errors relative to y are, with the correlation rho of y and r about zero, ::

    e = |y - r| / |y|,    e(factor) = sqrt(1 - rho^2),    e(sign) = |y + r| / |y|,    e(lag) = |y(t) - r(t - lag)| / |y|

and a hypothesis is named where it reduces the errors of the channels that it concerns to less than 0.6, in their
geometric mean, of the errors of the best response, and to less than 0.7 if the fit is among the responses.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..signals.channels import Measurements
from ..units import DIMENSIONS, UNITS

__all__ = ["LARGE_ERROR", "Fault", "describe_unit", "find_faults"]

LARGE_ERROR = 0.5  # RRMSE above which a channel is hardly reproduced
_BETTER = 0.6  # errors with a fault taken into account, as a share of the errors without
_BETTER_THAN_A_FIT = 0.7  # the same, where one of the responses is the fit
_EXPLAINED = 0.85  # error above which a response explains nothing
_FLOOR = 0.02  # error below which smaller ones count as equal
_FACTOR = 1.5  # from which a factor may be one between units
_LONGEST_LAG, _LONGEST_SHARE = 5.0, 0.2  # [s], and as a share of the record
_FEWEST_STEPS = 1.5  # a lag below this many steps is not named
_MOST_VALUES = 2**24  # of responses that are compared at once
_MOST_FAULTS = 4
# share of its gain with which a fault competes: half a period is nearly a sign, and all late supports an early sensor
_SIMPLE = {"factor": 1.0, "swap": 1.0, "lag": 0.85, "input lag": 0.75}
_SAME_UNITS = 1.25  # ratio of a factor to one between units, up to which it is named after them
_EQUALLY_NEAR, _NEAR_ENOUGH = 0.01, 0.03  # differences of logarithms of ratios that are named together


class Fault(NamedTuple):
    """A fault of channels, or of supports (input lag), that explains the measurements better."""

    kind: str  # "factor", "sign", "lag", "swap" or "input lag"
    names: tuple[str, ...]
    value: float  # measurements / responses [-], or time by which they are late [s]; NaN for a sign and a swap
    before: float  # error of the channels for the best response (RRMSE, geometric mean)
    after: float  # the same error with the fault


class _Hypothesis(NamedTuple):
    """A fault, the channels whose errors change, and what corrects responses for it."""

    kind: str
    channels: tuple[int, ...]
    errors: NDArray[np.float64]  # (n, n_channels) of each response
    value: NDArray[np.float64]  # (n,) factor or lag that gives these errors
    names: tuple[str, ...] = ()


def find_faults(
    measurements: Measurements,
    responses: np.ndarray,
    parts: Mapping[str, np.ndarray] | None = None,
    *,
    fitted: bool = False,
) -> tuple[Fault, ...]:
    """Faults that explain measurements better than any of the responses does without them, the strongest first.

    Responses (n, n_channels, n_samples) [SI] have any parameters; `parts` are their parts by the name of the support
    that causes them, and add up to them. With the fit among them (`fitted`), a smaller gain counts. Each fault is found
    after those before it are corrected.
    """
    values = np.asarray(measurements.values, dtype=float)
    there = np.isfinite(values)
    measured = np.where(there, values, 0.0)
    usable = np.flatnonzero(np.square(measured).sum(axis=1) > 0.0)
    responses = np.asarray(responses, dtype=float)
    kept = np.isfinite(responses[:, there]).all(axis=1)
    if not kept.any() or not len(usable):
        return ()
    names = [measurements.channels[row].name for row in usable]
    kinds = [measurements.channels[row].dimension for row in usable]
    steps = np.array([measurements.steps[row] for row in usable])
    starts = [measurements.starts[row] for row in usable]
    measured = measured[usable]

    def of_channels(given: np.ndarray) -> np.ndarray:
        return np.where(there[usable], given[kept][:, usable], 0.0)

    current = of_channels(responses)
    pieces = {name: of_channels(np.asarray(each, dtype=float)) for name, each in (parts or {}).items()}
    chosen = _closest(measured, current)
    current, pieces = current[chosen], {name: each[chosen] for name, each in pieces.items()}
    better = _BETTER_THAN_A_FIT if fitted else _BETTER
    found: list[Fault] = []
    while len(found) < _MOST_FAULTS:
        errors = _errors(measured, current)
        best = int(np.argmin(_score(errors)))
        most, explained = 0.0, None
        alike = [(kinds[c], steps[c], starts[c]) for c in range(len(names))]
        for each in _hypotheses(measured, current, pieces, kinds, steps, alike, errors):
            row = int(np.argmin(_score(each.errors)))
            channels = list(each.channels)
            before, after = (
                float(np.exp(np.mean(np.log(np.maximum(e[channels], _FLOOR)))))
                for e in (errors[best], each.errors[row])
            )
            gain = float(_score(errors)[best] - _score(each.errors)[row])
            clear = after < min(better * before, _EXPLAINED) and gain > -math.log(better) * len(channels)
            if clear and _SIMPLE[each.kind] * gain > most and _is_large(each, row, steps):
                most, explained = _SIMPLE[each.kind] * gain, (each, row, before, after)
        if explained is None:
            break
        each, row, before, after = explained
        value = float(each.value[row])
        concerned = each.names or tuple(names[c] for c in each.channels)
        if each.kind == "factor" and value < 0.0:
            found.append(Fault("sign", concerned, math.nan, before, after))
        if each.kind != "factor" or _is_factor(abs(value)):
            # a motion that is recorded late causes a response that must be earlier
            stated = {"factor": abs(value), "input lag": -value}.get(each.kind, value)
            found.append(Fault(each.kind, concerned, stated, before, after))
        current, pieces = _corrected(each, value, current, pieces, steps)
    return tuple(found)


def describe_unit(factor: float, dimension: str) -> str:
    """Units whose ratio is about a factor or its inverse, in words; empty if there are none.

    Ratios to the SI unit of the channel's dimension come first. Then come ratios of its other units, and units of
    accelerations, in which the base motion may be wrong.
    """
    own, motion = _ratios(dimension), _ratios("acceleration")
    bases = {DIMENSIONS[dimension], "m/s2", "g"}
    firsts, of_motion = (
        {names: value for names, value in ratios.items() if bases & set(names.split(" and "))}
        for ratios in (own, motion)
    )
    if dimension != "acceleration":
        own |= {f"{names} of the base motion": value for names, value in of_motion.items()}
    for ratios, near in ((firsts, _EQUALLY_NEAR), (own, _NEAR_ENOUGH)):
        apart = {names: abs(abs(math.log(ratio)) - abs(math.log(factor))) for names, ratio in ratios.items()}
        least = min(apart.values(), default=math.inf)
        if least < math.log(_SAME_UNITS):
            return " or ".join(names for names, value in apart.items() if value < least + near)
    return ""


def _ratios(dimension: str) -> dict[str, float]:
    """Ratios of the units of a dimension, by their names; the SI unit, and g, come first in a pair."""
    units = {unit.name: unit.factor for unit in UNITS.values() if unit.dimension == dimension}
    order = sorted(units, key=lambda name: (name != DIMENSIONS[dimension], name != "g"))
    return {f"{one} and {other}": units[one] / units[other] for one, other in combinations(order, 2)}


def _is_factor(value: float) -> bool:
    return max(value, 1.0 / value) > _FACTOR


def _is_large(each: _Hypothesis, row: int, steps: np.ndarray) -> bool:
    """Whether a factor or a lag is far enough from one, or zero, to be a fault."""
    value = float(each.value[row])
    if each.kind == "factor":
        return value < 0.0 or _is_factor(value)
    if "lag" in each.kind:
        return abs(value) > _FEWEST_STEPS * float(steps[list(each.channels)].max())
    return True


def _errors(measured: np.ndarray, responses: np.ndarray) -> np.ndarray:
    """RRMSE (n, n_channels)."""
    return np.sqrt(np.square(measured - responses).sum(axis=-1) / np.square(measured).sum(axis=-1))


def _score(errors: np.ndarray) -> np.ndarray:
    """Sum of the logarithms of the errors of all channels (n,)."""
    return np.log(np.maximum(errors, _FLOOR)).sum(axis=-1)


def _closest(measured: np.ndarray, responses: np.ndarray) -> np.ndarray:
    """Rows of the responses that are compared: all, or those with the best fit and the best correlation."""
    most = max(8, _MOST_VALUES // measured.size)
    if len(responses) <= most:
        return np.arange(len(responses))
    by_fit, by_shape = (np.argsort(_score(each)) for each in (_errors(measured, responses), _free(measured, responses)))
    return np.unique(np.concatenate([by_fit[: most // 2], by_shape[: most // 2]]))


def _free(measured: np.ndarray, responses: np.ndarray) -> np.ndarray:
    """Errors (n, n_channels) with the best factor of either sign."""
    power = np.square(responses).sum(axis=-1) * np.square(measured).sum(axis=-1)
    product = (measured * responses).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(power > 0.0, np.square(product) / power, 0.0)
    return np.sqrt(np.maximum(1.0 - share, 0.0))


def _hypotheses(
    measured: np.ndarray,
    responses: np.ndarray,
    parts: Mapping[str, np.ndarray],
    kinds: Sequence[str],
    steps: np.ndarray,
    alike: Sequence[tuple],
    errors: np.ndarray,
) -> Iterator[_Hypothesis]:
    """Every fault of one round, simple ones first."""
    n_channels, every = len(measured), tuple(range(len(measured)))
    groups = dict.fromkeys([(c,) for c in every])
    groups |= dict.fromkeys(tuple(c for c in every if kinds[c] == kind) for kind in dict.fromkeys(kinds))
    groups |= {every: None}
    power, own = np.square(responses).sum(axis=-1), np.square(measured).sum(axis=-1)
    product = (measured * responses).sum(axis=-1)
    none = np.full(len(responses), np.nan)

    def changed(channels: Sequence[int], new: np.ndarray) -> np.ndarray:
        out = errors.copy()
        out[:, list(channels)] = new
        return out

    for group in groups:
        c = list(group)
        # least squares of relative errors, so that no channel outweighs the others
        weight, along = (power[:, c] / own[c]).sum(axis=1), (product[:, c] / own[c]).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(weight > 0.0, along / weight, 0.0)
        scaled = np.sqrt(
            np.maximum(own[c] - 2.0 * factor[:, None] * product[:, c] + np.square(factor)[:, None] * power[:, c], 0.0)
            / own[c]
        )
        yield _Hypothesis("factor", group, changed(c, np.where(factor[:, None] == 0.0, np.inf, scaled)), factor)
    if n_channels > 1:
        yield from _swaps(measured, responses, alike, errors, none)
    shifts, by_lag = _lag_errors(measured, responses, steps)
    if len(shifts) > 1:
        for group in dict.fromkeys([*((c,) for c in every), every]):
            yield _best_lag("lag", group, by_lag, shifts, errors)
    for names, moving in _late_supports(parts):
        shifts, by_lag = _lag_errors(measured, moving, steps, responses - moving)
        if len(shifts) > 1:
            yield _best_lag("input lag", every, by_lag, shifts, errors)._replace(names=names)


def _best_lag(
    kind: str, group: tuple[int, ...], by_lag: np.ndarray, shifts: np.ndarray, errors: np.ndarray
) -> _Hypothesis:
    """A lag of some channels, the best one of each response; `by_lag` is (n, n_channels, n_lags)."""
    c = list(group)
    best = np.argmin(np.log(np.maximum(by_lag[:, c], _FLOOR)).sum(axis=1), axis=1)
    new = errors.copy()
    new[:, c] = np.take_along_axis(by_lag[:, c], best[:, None, None], axis=2)[..., 0]
    return _Hypothesis(kind, group, new, shifts[best])


def _late_supports(parts: Mapping[str, np.ndarray]) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    """Supports that may be late, and the parts of the responses that they cause: each one, and all but one."""
    names = list(parts)
    for name in names if len(names) > 1 else ():
        yield (name,), parts[name]
        others = tuple(other for other in names if other != name)
        if len(others) > 1:
            yield others, np.sum([parts[other] for other in others], axis=0)


def _swaps(
    measured: np.ndarray, responses: np.ndarray, alike: Sequence[tuple], errors: np.ndarray, none: np.ndarray
) -> Iterator[_Hypothesis]:
    """Pairs of channels of one quantity and the same times that are exchanged, where both errors fall."""
    own = np.square(measured).sum(axis=-1)
    # squared error of response i taken for channel j, (n, i, j)
    cross = np.square(responses).sum(axis=-1)[:, :, None] + own - 2.0 * np.einsum("nit,jt->nij", responses, measured)
    cross = np.sqrt(np.maximum(cross, 0.0) / own)
    for i in range(len(measured)):
        for j in range(i):
            if alike[i] == alike[j] and (cross[:, [i, j], [j, i]] < cross[:, [i, j], [i, j]]).all(axis=1).any():
                new = errors.copy()
                new[:, j], new[:, i] = cross[:, i, j], cross[:, j, i]
                yield _Hypothesis("swap", (j, i), new, none)


def _lag_errors(
    measured: np.ndarray, moving: np.ndarray, steps: np.ndarray, fixed: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Lags (n_lags,) [s], and errors (n, n_channels, n_lags) of ``fixed + moving(t - lag)``.

    Before its first sample a response is at rest; where a shifted response has ended, nothing is compared.
    """
    n_samples = measured.shape[1]
    coarse = float(steps.max())
    longest = min(_LONGEST_LAG, _LONGEST_SHARE * n_samples * float(steps.min()))
    count = int(longest / coarse)
    lags = coarse * np.arange(-count, count + 1)
    found = np.empty((*moving.shape[:2], len(lags)))
    size = 2 ** (2 * n_samples - 1).bit_length()
    target = measured - fixed
    for c, step in enumerate(steps):
        k = np.rint(lags / step).astype(int)
        one = np.broadcast_to(target[..., c, :], (len(moving), n_samples)) if np.ndim(fixed) else target[None, c]
        products = np.fft.irfft(np.fft.rfft(one, size) * np.fft.rfft(moving[:, c], size).conj(), size)[:, k % size]
        ends = n_samples - np.maximum(k, 0), n_samples - np.maximum(-k, 0)
        power = _sums(moving[:, c])
        squares = _sums(one)[:, ends[1]] + power[:, ends[0]] - power[:, np.maximum(-k, 0)] - 2.0 * products
        own = _sums(measured[None, c])[:, ends[1]]
        found[:, c] = np.sqrt(np.maximum(squares, 0.0) / np.where(own > 0.0, own, np.inf))
        found[:, c][:, own[0] < 0.5 * own[0].max()] = np.inf
    return lags, found


def _sums(values: np.ndarray) -> np.ndarray:
    """Sums of squares (n, n_samples + 1) of the first 0, 1, ... samples."""
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(np.square(values), axis=1)], axis=1)


def _corrected(
    fault: _Hypothesis, value: float, responses: np.ndarray, parts: dict[str, np.ndarray], steps: np.ndarray
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Responses, and their parts, as they would be compared with measurements that have the fault."""
    channels = list(fault.channels)

    def moved(given: np.ndarray) -> np.ndarray:
        out = given.copy()
        if fault.kind == "swap":
            out[:, channels] = given[:, channels[::-1]]
        elif "lag" in fault.kind:
            for c in channels:
                k = round(value / steps[c])
                out[:, c] = 0.0
                out[:, c, max(k, 0) : given.shape[-1] + min(k, 0)] = given[
                    :, c, max(-k, 0) : given.shape[-1] - max(k, 0)
                ]
        else:
            out[:, channels] *= value
        return out

    if fault.kind == "input lag":
        parts = {name: moved(each) if name in fault.names else each for name, each in parts.items()}
        return np.sum(list(parts.values()), axis=0), parts
    return moved(responses), {name: moved(each) for name, each in parts.items()}
