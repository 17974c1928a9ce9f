"""One wrong value, or exchanged load cases, among data without time: which change would draws of the prior expect?

Draws of the prior give values of all data together, with a mean and a covariance; the errors of the data add their
variances. Measured values y less this mean have the distance Q = (y - mean)^T W (y - mean), where W is the inverse of
the covariance. A value that may be anything reduces it by ``(W (y - mean))_k^2 / W_kk``, and exchanged values by what
they change. The change that reduces Q most is named if it does so 1.5 times as much as in any draw with errors (0 of
200 right frames), and if what is left is less than 1.5 times what errors make (up to 1.49 in 120 right load tests).

Of eleven structures with four seeds, right ones are named in 0 of 44, a frequency 10 % off in 33 of 40 (all rightly),
20 % in 36, exchanged ones in 40; of eleven load tests, right ones in 0 of 44, exchanged cases in 43, reversed ones in
43 (as another exchange in 8, which symmetric ones cannot tell apart), a value 10 or 30 deviations off in 43.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from .compared import MOST_DRAWS, Fit, ModalFit
from .data_faults import FACTOR
from .finding import HALF, SMALL_PROBABILITY, TAIL, WRONG, Finding

__all__ = ["check_frequency", "check_load_cases"]


def swapped(n: int, i: int, j: int) -> list[int]:
    """The places 0 to n - 1 with two of them exchanged."""
    order = list(range(n))
    order[i], order[j] = j, i
    return order


class Change(NamedTuple):
    """A change of values that explains the data."""

    name: str
    shift: float  # of a value that may be anything, from what the others predict; NaN of an exchange
    before: float  # mean squares, 1 for right data
    after: float


def find_change(
    errors: np.ndarray, deviations: np.ndarray, single: Mapping[str, int], moved: Mapping[str, np.ndarray]
) -> Change | None:
    """The change that explains data best, from measured less drawn values (n_draws, n) and deviations (n,) of errors.

    `single` are values that may be anything, by their place; `moved` are what exchanges add to the values (n,).
    """
    if len(errors) < HALF * MOST_DRAWS:
        return None
    n, mean = errors.shape[1], errors.mean(axis=0)
    weights = np.linalg.inv(np.atleast_2d(np.cov(errors.T)) + np.diag(np.square(deviations)))
    pull = weights @ mean
    before, shifts = float(pull @ mean), {name: float(pull[k] / weights[k, k]) for name, k in single.items()}
    drops = {name: pull[k] * shifts[name] for name, k in single.items()}
    drops |= {name: -float(2.0 * each @ pull + each @ weights @ each) for name, each in moved.items()}
    # draws with errors are right tests as well, which are not normal where responses are not linear
    right = errors - mean + deviations * np.random.default_rng(1).normal(size=errors.shape)
    places = list(single.values())
    chance = FACTOR * np.max(np.square(right @ weights)[:, places] / np.diag(weights)[places])
    exchanged = chi2.isf(SMALL_PROBABILITY / len(drops), 1)
    least = dict.fromkeys(single, chance) | dict.fromkeys(moved, exchanged)
    good = [name for name in drops if drops[name] > least[name] and before - drops[name] < FACTOR**2 * n]
    best = max(good, key=lambda name: (name in moved, drops[name]), default=None)  # an exchange has no number to fit
    if best is None:
        return None
    left = before - drops[best]
    return Change(best, shifts.get(best, np.nan), before / n, left / n)


def check_frequency(fit: ModalFit) -> list[Finding]:
    """One frequency of three or more that does not fit the other ones and the shapes, or two that are exchanged."""
    modes, data = fit.draws, fit.draws.data
    if data.n_modes < 3:
        return []
    first = data.has_shape.argmax(axis=0), np.arange(data.n_modes)
    logs = np.log(data.mean_frequencies / modes.frequencies)
    errors = np.concatenate([logs[..., None], data.shapes[first] - modes.shapes], axis=2)
    of_frequency, of_shape = fit.deviations
    deviations = np.column_stack([of_frequency, *[of_shape] * data.n_sensors])
    there = np.isfinite(errors).all(axis=0)
    places = np.cumsum(there).reshape(there.shape)[:, 0] - 1
    names = [f"{number} ({f:.4g} Hz)" for number, f in zip(data.mode_numbers, data.mean_frequencies, strict=True)]
    moved = {}
    for i, j in combinations(range(data.n_modes), 2):
        of_pair = np.zeros(there.shape)
        of_pair[[i, j], 0] = np.log(data.mean_frequencies[[j, i]] / data.mean_frequencies[[i, j]])
        moved[f"the frequencies of the modes {names[i]} and {names[j]} are exchanged"] = of_pair[there]
    change = find_change(errors[:, there], deviations[there], dict(zip(names, places, strict=True)), moved)
    if change is None or abs(change.shift) < TAIL:  # such a small one may be the error of the model as well
        return []
    if change.name in moved:
        return [_exchange(change, "Values may be exchanged", "Check the lines and columns of the file.")]
    ratio = float(np.exp(change.shift))
    text = f"The frequency of mode {change.name} is {ratio:.3g} times what the other modes and all shapes let expect."
    action = (
        "Check this number in the file, and whether this shape is of this mode; if both are right, look at the model."
    )
    return [Finding("A value may be wrong", WRONG, text, action, {"ratio": ratio})]


def check_load_cases(fit: Fit) -> list[Finding]:
    """Load cases that are exchanged or in reversed order, and one value that does not fit the others."""
    measured, there = fit.measurements, np.isfinite(fit.measurements.values)
    if fit.expected is None or not len(fit.draws):
        return []
    cases = [str(each) for each in measured.points or range(1, measured.n_steps + 1)]
    values, n = measured.values, len(cases)
    name = "the load cases {} and {} are exchanged"
    rows = combinations(range(n if n <= HALF * MOST_DRAWS else 0), 2)  # an influence line has more
    other = {name.format(cases[i], cases[j]): values[:, swapped(n, i, j)] for i, j in rows}
    other |= {"the load cases are in reversed order": values[:, ::-1]} if n > 3 else {}
    for i, j in combinations(range(measured.n_channels), 2):
        if (one := measured.channels[i]).dimension == (two := measured.channels[j]).dimension:
            other[f"the channels {one.name} and {two.name} are swapped"] = values[swapped(len(values), i, j)]
    moved = {name: np.nan_to_num(each - values)[there] for name, each in other.items()}
    places = np.cumsum(there).reshape(there.shape) - 1
    single = {
        f"{channel.name} at {cases[k]}": int(places[row, k])
        for row, channel in enumerate(measured.channels)
        for k in np.flatnonzero(there[row])
    }
    errors = (values - fit.draws)[:, there]
    deviations = np.broadcast_to(fit.expected, values.shape)[there]
    change = find_change(errors, deviations, single, moved)
    if change is None:
        return []
    if change.name in moved:
        action = "Check the order of lines and columns in the file, and the places of loads and sensors in the model."
        kind = "Channels may be swapped" if "channels" in change.name else "Load cases may be exchanged"
        return [_exchange(change, kind, action)]
    right = float(values[there][single[change.name]] - change.shift)
    ratio = float(values[there][single[change.name]] / right) if right else np.inf
    text = f"{change.name} is {ratio:.3g} times what the other values let expect."
    return [Finding("A value may be wrong", WRONG, text, "Check this number in the file.", {"ratio": ratio})]


def _exchange(change: Change, kind: str, action: str) -> Finding:
    """What is found of exchanged values."""
    text = (
        f"If {change.name}, values differ from draws of the prior by {change.after**0.5:.2g} of their spread (root "
        f"mean square) instead of {change.before**0.5:.2g}."
    )
    return Finding(kind, WRONG, text, action, {"before": change.before, "after": change.after})
