"""Cyclic columns that fail: the coefficient of fatigue with which each fails when it did, and predictions of others.

The tests of `benchmarks.tested_column`; all constants but one are nominal, and the bars do not buckle. ``Cf``
(`LowCycleFatigue`) is matched to each column: the geometric mean of the largest value with which it fails earlier than
measured, and the next value with which it fails later (`find_failure`). The columns of one series have the same steel
and hoops and count as one event, by their geometric mean; tests of bars (`BARS`) are another event. `EventRatios` of
these, with a prior of their scatter (`PRIOR`), is the population behind `LowCycleFatigue.prior`.

Each column is predicted from the population without it, and without its series: the largest drift before failure, the
path until then (which grows with the number of cycles), and the peak force, by the ratios of the other columns'
measured forces to nominal ones. Predictions have steps where a protocol repeats an amplitude: the PIT counts half of
the draws that are equal to the measured value. The measurements are real and no part of the project: set FE_SHARED.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fe_likelihoods import EventRatios, LowCycleFatigue, RCColumn, SimulationFailed, propagate, rrmse, share_within
from fe_likelihoods.prediction.quantities import find_failure

from . import tested_column
from .rows import Row
from .tested_column import Specimen

__all__ = ["failing_columns"]

BARS = 0.26  # bars No. 7, Brown & Kunnath (docs/theory/reinforcing_steel.rst)
PRIOR = {"prior_sd": 0.25, "prior_events": 6.0}  # displacements at buckling, Berry & Eberhard (2005)
_GRID = np.geomspace(0.08, 0.389, 80)
_EQUAL = 1e-3  # relative difference up to which values are equal
_SLENDER = 2.5  # height by diameter, below which columns may fail by shear


class _Failing(NamedTuple):
    """A column that failed: test, model with the parameter ``Cf``, measured `_numbers`, and matched coefficient."""

    test: Specimen
    model: RCColumn
    numbers: np.ndarray
    cf: float


def failing_columns(repeats: int = 1, draws: int = 400, every: int = 4) -> list[Row]:
    """Matched coefficients, predictions of each column from others, and shares within 50 and 90 % intervals."""
    tests, unused = tested_column.specimens(every) if tested_column.FOLDER.is_dir() else ((), {})
    rows = [Row("columns", "LEFT OUT", None, "", f"{file}: {why}") for file, why in unused.items()]
    found = []
    for test in tests:
        model = replace(test.model, fatigue=LowCycleFatigue(), parameters=("Cf",))
        measured = _numbers(model, test.measured.values[0])
        slender = model.height >= _SLENDER * model.diameter
        earlier, later = _matched(model, measured[1]) if slender else (np.nan, np.nan)
        if np.isnan(earlier * later):
            rows.append(Row("Cf", test.name, None, "", "no failure by flexure, or with no value of Cf"))
            continue
        cf = float(np.sqrt(earlier * later))
        rows.append(Row("Cf", test.name, cf, "", f"{earlier:.3f} to {later:.3f}"))
        found.append(_Failing(test, model, measured, cf))
    if len({_series(each) for each in found}) < 2:
        return [*rows, Row("columns", "SKIPPED", None, "", f"no two series in {tested_column.FOLDER}: set FE_SHARED")]
    ratios = _population(found)
    middle, width = np.log(ratios.quantile(0.5)), np.log(ratios.quantile(0.95) / ratios.quantile(0.05))
    note = f"90 %: {BARS * ratios.quantile(0.05):.3f} to {BARS * ratios.quantile(0.95):.3f}"
    rows.append(Row("median Cf of a new column", "all", BARS * float(np.exp(middle)), "", note))
    rows.append(Row("sd of log Cf of a new column", "all", float(width / 3.29), "", f"prior {ratios.prior_share:.0%}"))
    for way in ("without the column", "without its series"):
        pit = []
        for each in found:
            others = [other for other in found if other is not each]
            if way == "without its series":
                others = [other for other in others if _series(other) != _series(each)]
            for seed in range(repeats):
                pit.append(_predicted(each, others, draws, seed, rows, way))
        for name, values in (("displacement", 0), ("path", 1), ("peak force", 2), ("all", slice(None))):
            for level in (0.5, 0.9):
                share = share_within(np.ravel(np.array(pit)[:, values]), level)
                rows.append(Row(f"{name} within {level:.0%}", way, share.value, "", f"{share}"))
    return rows


def _series(column: _Failing) -> str:
    return column.test.name.split()[0]


def _numbers(model: RCColumn, force: np.ndarray) -> np.ndarray:
    """Largest drift before failure, path until then by the height, and peak force [N]."""
    displacement = model.loading.displacement
    end = find_failure(force, displacement)
    path = np.abs(np.diff(displacement[:end])).sum()
    return np.array([np.abs(displacement[:end]).max() / model.height, path / model.height, np.abs(force).max()])


def _matched(model: RCColumn, path: float) -> tuple[float, float]:
    """Coefficients with which the column fails earlier and later than after a path; NaN if there are none."""
    earlier = np.nan
    for cf in _GRID[_GRID < model.fatigue.cd]:
        try:
            found = _numbers(model, model.simulate([cf / model.fatigue.cf])[0])[1]
        except SimulationFailed:  # too many bars have fractured to find equilibrium
            continue
        if found < (1.0 - _EQUAL) * path:
            earlier = cf
        elif found > (1.0 + _EQUAL) * path:
            return earlier, cf
    return earlier, np.nan


def _population(columns: list[_Failing]) -> EventRatios:
    """Ratios of the coefficients of series to the coefficient of bars."""
    series: dict[str, list[float]] = {}
    for each in columns:
        series.setdefault(_series(each), []).append(each.cf / BARS)
    return EventRatios([*(np.exp(np.mean(np.log(values))) for values in series.values()), 1.0], **PRIOR)


def _predicted(
    column: _Failing, others: list[_Failing], draws: int, seed: int, rows: list[Row], way: str
) -> np.ndarray:
    """PIT of the numbers of a column; appends their rows."""
    rng = np.random.default_rng(seed)
    ratios = _population(others)
    options: Mapping = {"quantiles": (), "progress": False, "check": False}
    fatigue = column.model.fatigue
    samples = np.minimum(ratios.draw(np.ones((draws, 1)), rng), fatigue.cd / fatigue.cf)  # more is no coefficient
    force = column.test.measured.values[0]
    late = slice(int(np.argmax(np.abs(force))), None)

    def numbers(response: np.ndarray) -> np.ndarray:
        return np.append(_numbers(column.model, response[0]), rrmse(response[0, late], force[late]))

    predicted = propagate(column.model, samples, quantity=numbers, **options)
    values, errors = predicted.values[:, :3], predicted.values[:, 3]
    peaks = [each.numbers[2] / _numbers(each.model, each.model.simulate([1.0])[0])[2] for each in others]
    values[:, 2] *= EventRatios(peaks).draw(np.ones(len(values)), rng)
    measured = column.numbers
    equal = np.isclose(values, measured, rtol=_EQUAL, atol=0.0)
    pit = ((values < measured) & ~equal).mean(axis=0) + 0.5 * equal.mean(axis=0)
    low, high = np.quantile(values, [0.05, 0.95], axis=0)
    for k, name in enumerate(("drift before failure", "path before failure / height", "peak force [N]")):
        note = f"90 %: {low[k]:.4g} to {high[k]:.4g}, PIT {pit[k]:.2f}"
        rows.append(Row(name, f"{column.test.name}, {way}", float(measured[k]), "", note))
    note = f"{np.min(errors):.2f} to {np.max(errors):.2f}"
    rows.append(Row("RRMSE after the peak, median", f"{column.test.name}, {way}", float(np.median(errors)), "", note))
    return pit
