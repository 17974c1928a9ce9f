"""Faults of data without time: which single change of a table of values would draws of the prior expect?

Load tests have a row for each channel and a column for each load case; modes have a column each, with their frequency
above the components of the shape. Draws of the prior give all values together, with a mean and a covariance; the errors
of the data add their variances, and an unknown scale of a shape adds its own. Measured values y less this mean have the
distance ``Q = (y - mean)^T W (y - mean)``, where W is the inverse of the covariance. It is compared with Q where

* a value may be anything: Q is less by ``(W (y - mean))_k^2 / W_kk``,
* values are exchanged,
* rows of the draws have a factor, which is fitted to what the other rows let expect.

The change that reduces Q most is named if it does so 1.5 times as much as in any draw with errors, and if what is left
is less than 1.5 times what errors make (up to 1.49 in 120 right load tests). Counts are in docs/results.rst.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from .faults import FACTOR, Fault
from .finding import HALF, SMALL_PROBABILITY, TAIL

__all__ = ["MOST_DRAWS", "Table", "find_changes", "find_changes_of_modes"]

MOST_DRAWS = 100  # of the prior
MENDED = 0.1  # of the distance that is left without a fault, if the model is not right either


class Table(NamedTuple):
    """Values beside draws of the prior, in rows and columns; NaN where there is none."""

    values: np.ndarray  # (n_rows, n_columns)
    draws: np.ndarray  # (n_draws, n_rows, n_columns)
    deviations: np.ndarray  # of the errors of the values (n_rows, n_columns)
    rows: Sequence[str]
    columns: Sequence[str]
    scaled: slice = slice(0)  # rows that have an unknown scale in each column

    def distance(self) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Q, values less their mean (n,), W and the covariance (n, n) of the values that are there."""
        there, mean = self.there, self.draws.mean(axis=0)
        covariance = np.atleast_2d(np.cov(self.draws[:, there].T)) + np.diag(np.square(self.deviations[there]))
        for column in range(mean.shape[1] if mean[self.scaled].size else 0):
            direction = np.zeros(mean.shape)
            direction[self.scaled, column] = mean[self.scaled, column]
            covariance += np.outer(direction[there], direction[there])
        weights, off = np.linalg.inv(covariance), (self.values - mean)[there]
        return float(off @ weights @ off), off, weights, covariance

    @property
    def there(self) -> np.ndarray:
        """Which values are known (n_rows, n_columns)."""
        return np.isfinite(self.values) & np.isfinite(self.draws).all(axis=0)

    def times(self, rows: list[int]) -> tuple["Table", float]:
        """The table with a factor of some rows of the draws, and this factor, by what all other rows let expect."""
        there, (_, off, _, covariance) = self.there, self.distance()
        own = np.isin(np.nonzero(there)[0], rows)
        expected = self.draws.mean(axis=0)[there][own]
        if not own.all():
            mixed, others = covariance[np.ix_(own, ~own)], covariance[np.ix_(~own, ~own)]
            expected = expected + mixed @ np.linalg.solve(others, off[~own])
        factor = float(self.values[there][own] @ expected / max(expected @ expected, 1e-300))
        draws, deviations = self.draws.copy(), self.deviations.copy()
        draws[:, rows] *= factor
        deviations[rows] *= max(abs(factor), 1.0)
        return self._replace(draws=draws, deviations=deviations), factor


def find_change(
    table: Table, factors: Mapping[tuple[str, ...], list[int]], others: Mapping[tuple[str, ...], Table]
) -> Fault | None:
    """The change that explains a table best: a factor of rows, by names, or another table, by kind and names."""
    if len(table.draws) < HALF * MOST_DRAWS or table.there.sum() < 3:
        return None
    (before, off, weights, _), n = table.distance(), int(table.there.sum())
    # draws with errors are right tests as well, which are not normal where responses are not linear
    errors = table.deviations[table.there] * np.random.default_rng(1).normal(size=(len(table.draws), n))
    right = (table.draws - table.draws.mean(axis=0))[:, table.there] + errors
    chance = FACTOR * float(np.max(np.square(right @ weights) / np.diag(weights)))
    found = []  # of these kinds the first ones have fewer numbers to fit
    for (kind, *names), other in others.items():
        least = chdtri(1, SMALL_PROBABILITY / len(others))
        rank, value = (0, -1.0) if kind == "value" else (2, np.nan)  # a number with the other sign
        found.append((rank, before - other.distance()[0], least, kind, tuple(names), value))
    for names, rows in factors.items():
        other, factor = table.times(rows)
        if not 1.0 / FACTOR < factor < FACTOR:
            kind = "sign" if factor < 0.0 else "factor"
            found.append((1, before - other.distance()[0], chance, kind, names, factor))
    pull, places = weights @ off, zip(*np.nonzero(table.there), strict=True)
    for k, (row, column) in enumerate(places):
        value, shift = table.values[row, column], pull[k] / weights[k, k]
        ratio = float(value / (value - shift)) if value != shift else np.inf
        found.append((0, float(pull[k] * shift), chance, "value", (table.rows[row], table.columns[column]), ratio))
    # a model that is not right leaves more, but then one value must not explain as much
    rough, one = max(FACTOR**2 * n, MENDED * before), max(each[1] for each in found if not each[0])
    limits = [rough if each[0] and each[1] > one else FACTOR**2 * n for each in found]
    good = [each for each, limit in zip(found, limits, strict=True) if each[1] > each[2] and before - each[1] < limit]
    if not good:
        return None
    _, drop, _, kind, names, value = max(good, key=lambda each: each[:2])
    return Fault(kind, names, value, float(np.sqrt(before / n)), float(np.sqrt((before - drop) / n)))


def swapped(n: int, i: int, j: int) -> list[int]:
    """The places 0 to n - 1 with two of them exchanged."""
    order = list(range(n))
    order[i], order[j] = j, i
    return order


def find_changes(table: Table, kinds: Sequence[str]) -> tuple[Fault, ...]:
    """What explains load cases: a factor or sign, exchanged cases or channels, one value; `kinds` of the channels."""
    n, values = len(table.columns), table.values
    factors = {(name,): [row] for row, name in enumerate(table.rows)} | {tuple(table.rows): [*range(len(table.rows))]}
    others = {("exchange", "lines, in reversed order,"): values[:, ::-1]} if n > 3 else {}
    for i, j in combinations(range(n if n <= HALF * MOST_DRAWS else 0), 2):  # an influence line has more
        others["exchange", table.columns[i], table.columns[j]] = values[:, swapped(n, i, j)]
    for i, j in combinations(range(len(values)), 2):
        if kinds[i] == kinds[j]:
            others["swap", table.rows[i], table.rows[j]] = values[swapped(len(values), i, j)]
    change = find_change(table, factors, {key: table._replace(values=each) for key, each in others.items()})
    return () if change is None else (change,)


def table_of_modes(modes: Any, deviations: np.ndarray) -> Table:
    """Frequencies as multiples of the mean of the draws, and shapes of length 1, of `PredictedModes`."""
    data, mean = modes.data, modes.frequencies.mean(axis=0)
    first = data.has_shape.argmax(axis=0), np.arange(data.n_modes)
    lengths = np.linalg.norm(modes.shapes, axis=2, keepdims=True)
    shapes = modes.shapes / np.where(lengths > 0.0, lengths, np.nan)
    values = np.vstack([data.mean_frequencies / mean, data.shapes[first].T])
    draws = np.concatenate([(modes.frequencies / mean)[:, None], np.swapaxes(shapes, 1, 2)], axis=1)
    errors = np.vstack([deviations[0] * values[0], np.tile(deviations[1], (data.n_sensors, 1))])
    names = [f"mode {number} ({f:.4g} Hz)" for number, f in zip(data.mode_numbers, data.mean_frequencies, strict=True)]
    return Table(values, draws, errors, ["frequency", *data.sensors], names, slice(1, None))


def _turned(modes: Any) -> np.ndarray:
    """Component (m,) of each measured shape whose other sign makes a computed one most alike, by half of the draws."""
    data, computed = modes.data, modes.computed[:, 1:]  # (n, n_sensors, n_modes)
    first, lengths = data.has_shape.argmax(axis=0), np.linalg.norm(computed, axis=1, keepdims=True)
    measured, computed = data.shapes[first, np.arange(len(first))], computed / np.where(lengths > 0.0, lengths, 1.0)
    parts = np.nan_to_num(measured)[:, :, None] * computed[:, None]
    alike = np.square(parts.sum(axis=2, keepdims=True) - 2.0 * parts)  # (n, m, n_sensors, n_modes)
    return np.median(alike.max(axis=3), axis=0).argmax(axis=1)


def find_changes_of_modes(modes: Any, deviations: np.ndarray) -> tuple[Fault, ...]:
    """What explains modes, `PredictedModes` at draws of the prior: a unit, a sensor, exchanged numbers or one number.

    The deviations (2, m) are those of the errors of frequencies, as shares, and of components of shapes.
    """
    found, data = list[Fault](), modes.data
    logs = np.log(data.mean_frequencies / modes.frequencies)
    median, half = float(np.median(logs)), (data.n_modes - 1) // 2
    common = np.sort(np.sign(median) * logs, axis=1)[:, half]  # of half of the modes: one wrong number is no unit
    if data.n_modes > 1 and common.min() > np.log(FACTOR):
        found.append(Fault("factor", ("frequencies",), float(np.exp(median)), float(np.exp(median)), 1.0))
        data = replace(data, frequencies=data.frequencies / np.exp(median))
    modes, n = modes.against(data), data.n_sensors
    table = table_of_modes(modes, deviations)
    factors = {(name,): [row] for row, name in enumerate(table.rows) if row} if n > 2 else {}
    others = dict[tuple[str, ...], Table]()
    for i, j in combinations(range(data.n_modes if data.n_modes > 2 else 0), 2):
        values = table.values.copy()
        values[0, [i, j]] = values[0, [j, i]] * (means := data.mean_frequencies / values[0])[[j, i]] / means[[i, j]]
        names = (f"the frequency of {table.columns[k]}" for k in (i, j))
        others["exchange", *names] = table._replace(values=values)
    if table.distance()[0] > FACTOR**2 * table.there.sum() and data.has_shape.any() and n > 2:
        for i, j in combinations(range(n), 2):  # a wrong sensor changes which mode is which
            other = replace(data, shapes=data.shapes[:, :, swapped(n, i, j)])
            others["swap", data.sensors[i], data.sensors[j]] = table_of_modes(modes.against(other), deviations)
        turned = {("sign", name): np.where(np.arange(n) == j, -1.0, 1.0) for j, name in enumerate(data.sensors)}
        for mode, j in enumerate(_turned(modes)):
            turned["value", data.sensors[j], table.columns[mode]] = np.ones((data.n_modes, n))
            turned["value", data.sensors[j], table.columns[mode]][mode, j] = -1.0
        for key, signs in turned.items():
            others[key] = table_of_modes(modes.against(replace(data, shapes=data.shapes * signs)), deviations)
    change = find_change(table, factors, others)
    # a small one may be the error of the model as well, and one of two frequencies be right
    small = change is not None and change.kind == "value" and np.exp(-TAIL) < change.value < np.exp(TAIL)
    if change is None or small or (change.names[0] == "frequency" and data.n_modes < 3):
        return tuple(found)
    return (*found, change)
