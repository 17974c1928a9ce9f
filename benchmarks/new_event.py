"""Predicted numbers of new events: random subsets of the events at hand calibrate, the others are predicted.

*Structures*: eleven earthquakes of the Painter Street Overpass (`benchmarks.transfer`; peak, root mean square and Arias
intensity of the deck), three shakings of a frame (`benchmarks.measured_tests`; peaks and Arias intensities of three
floors), the weak and the strong part of the Meloland record, and the peak forces of cyclic columns at their nominal
parameters (`benchmarks.tested_column`). Each event is calibrated once; a subset of the events has the geometric means
of their medians as parameters, and the ratios of its events there (`event_ratios`). The prior of the scatter
(`EventRatios`) is the default, half and twice as strong, and left out.

*Twins*: log peaks that scatter by a known standard deviation between events, of gains and of ratios that are correlated
with them (-0.5); 200 data sets per repeat.

The rows are the shares of numbers within their 50 and 90 % intervals, in the mean and in the worst of twenty subsets,
with the number of the pooled ones, the median ratio of the ends of the 90 % interval, and the mean interval score of
the logarithm. The measurements are real and no part of the project: set FE_SHARED. What is missing has a row.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import (
    EventRatios,
    FELikelihood,
    Measurements,
    arias_intensity,
    event_ratios,
    interval_score,
    peak,
    rms,
    share_within,
)
from fe_likelihoods.prediction.quantities import ChannelQuantity

from . import measured_tests, tested_column, transfer
from .measured_transfer import calibrate, skipped
from .rows import Row

__all__ = ["new_event"]

_PRIORS: dict[str, dict[str, float]] = {"default prior": {}, "prior worth 12": {"prior_events": 12.0}}
_PRIORS |= {"prior worth 3": {"prior_events": 3.0}, "no prior": {"prior_events": 0.0}}
_SPREADS = (0.05, 0.1, 0.15, 0.2, None)  # of twins; None: between 0.05 and 0.2, another one in each data set
_CORRELATION, _OF_GAINS = -0.5, 0.7  # of gains and ratios; share of the standard deviation that the gains have


class Structure(NamedTuple):
    """Events of a structure: likelihoods, and the median parameters of each event.

    Attributes
    ----------
    likelihoods : dict of str to FELikelihood
    medians : dict of str to dict of str to float
    quantities : list of ChannelQuantity
    """

    likelihoods: dict[str, FELikelihood]
    medians: dict[str, dict[str, float]]
    quantities: list[ChannelQuantity]


class Scored(NamedTuple):
    """Predictions of one subset (n, n_quantities): PIT, ratios of the ends, and interval scores of the logarithms."""

    pit: np.ndarray
    ends: np.ndarray
    score: np.ndarray


def new_event(repeats: int = 1, data_sets: int = 200, subsets: int = 20) -> list[Row]:
    """Rows of all structures whose data are there, and of twins."""
    rows = []
    for name, read in (("Painter Street", _painter_street), ("frame", _frame), ("Meloland", _meloland)):
        structure, found = read()
        rows += found
        if structure is not None:
            rows += _subsets(name, structure, repeats * subsets)
    return rows + _columns(repeats * subsets) + _twins(repeats * data_sets)


def scored(ratios: EventRatios, measured: np.ndarray, predicted: np.ndarray) -> Scored:
    """Scores of measured numbers (n, n_quantities), whose values at the parameters of the ratios are predicted."""
    low, high = (ratios.quantile(p, predicted) * predicted for p in (0.05, 0.95))
    pit = 1.0 - ratios.probability_above(measured / predicted, np.log(predicted))
    score = interval_score(np.log(low), np.log(high), np.log(measured), 0.9)
    return Scored(pit, high / low, score)


def rows_of(case: str, found: Sequence[Scored], worst: bool = True) -> list[Row]:
    """Rows of all subsets together, and the worst one, or the pooled number of values."""
    pit, rows = np.concatenate([np.ravel(each.pit) for each in found]), []
    for level in (0.5, 0.9):
        shares = [100.0 * share_within(each.pit, level).value for each in found]
        note = f"worst of {len(found)}: {min(shares):.0f} %" if worst else f"{share_within(pit, level)}"
        rows.append(Row(f"within {level:.0%}", case, float(np.mean(shares)), "%", note))
    for what, name in (("upper / lower end", "ends"), ("interval score of the logarithm", "score")):
        values = [np.median(each.ends) if name == "ends" else each.score.mean() for each in found]
        note = f"{min(values):.2f} to {max(values):.2f}"
        rows.append(Row(what, case, float(np.mean(values)), "", note))
    return rows


def _at_random(names: Sequence[str], size: int, most: int) -> list[tuple[str, ...]]:
    """At most this many different random subsets of a size."""
    rng, found = np.random.default_rng(size), {}
    for _ in range(20 * most):
        found[tuple(sorted(rng.choice(len(names), size, replace=False)))] = None
    return [tuple(names[k] for k in each) for each in islice(found, most)]


def _subsets(name: str, structure: Structure, most: int) -> list[Row]:
    """Rows of subsets of 1, 3, 5 and 8 events for each prior, for a line, and for each quantity."""
    rows, names = [], list(structure.likelihoods)
    known: dict[tuple, EventRatios] = {}

    def ratios_of(events: Sequence[str], at: Mapping[str, float]) -> EventRatios:
        """Ratios of events at some parameters, each simulated once there."""
        for event in events:
            if (event, *at.values()) not in known:
                own = {event: structure.likelihoods[event]}
                known[(event, *at.values())] = event_ratios(at, own, structure.quantities)
        found = [known[(event, *at.values())] for event in events]
        levels = np.concatenate([each.levels for each in found])
        return EventRatios(np.concatenate([each.values for each in found]), levels=levels, at=at)

    own = [ratios_of([event], structure.medians[event]).values[0, 0] for event in names]
    spread = float(np.log(own).std(ddof=1))
    rows.append(Row("sd of the log ratio of the first number", name, spread, "", "at the medians of each event"))
    for size in (1, 3, 5, 8) if len(names) > 4 else range(1, len(names)):
        found: dict[str, list[Scored]] = {}
        for chosen in _at_random(names, size, most):
            points = [structure.medians[event] for event in chosen]
            at = {name: float(np.exp(np.mean([np.log(point[name]) for point in points]))) for name in points[0]}
            ratios, of_others = ratios_of(chosen, at), ratios_of([each for each in names if each not in chosen], at)
            measured, predicted = of_others.values * of_others.levels, np.array(of_others.levels)
            for label, prior in _PRIORS.items():
                if size > 1 or prior.get("prior_events") != 0.0:
                    found.setdefault(label, []).append(scored(replace(ratios, **prior), measured, predicted))
            if size >= 5:
                line = replace(ratios, form="linear")
                found.setdefault("default prior, line", []).append(scored(line, measured, predicted))
        for label, each in found.items():
            rows += rows_of(f"{name}, {size} of {len(names)}, {label}", each)
        for k, quantity in enumerate(structure.quantities if len(structure.quantities) > 1 else ()):
            one = [Scored(*(values[:, [k]] for values in each)) for each in found["default prior"]]
            rows += rows_of(f"{name}, {size} of {len(names)}, {quantity}", one)
    return rows


def _painter_street() -> tuple[Structure | None, list[Row]]:
    records, rows = transfer.read_events()
    if len(records) < 4:
        return None, [
            *rows,
            Row("Painter Street", "SKIPPED", None, "", f"no files *ce89324p.zip in {transfer._FOLDER}"),
        ]
    fits = {name: transfer._calibrate(each, "relative", 1) for name, each in records.items()}
    names = ("frequency", "damping", "share")
    medians = {name: dict(zip(names, np.median(each.samples, axis=0), strict=False)) for name, each in fits.items()}
    likelihoods = {name: each.posterior.likelihood for name, each in fits.items()}
    return Structure(likelihoods, medians, [peak("ch7"), rms("ch7"), arias_intensity("ch7")]), rows


def _calibrated(
    tests: Mapping[str, tuple[Any, Measurements]], prior: Mapping[str, Any], scale: float, quantities: list
) -> Structure:
    """A structure whose events are calibrated with white noise."""
    likelihoods, medians = {}, {}
    for name, (model, measured) in tests.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the evidence, which is not used
            fit = calibrate(model, measured, prior, scale, 1, walkers=150)
        likelihoods[name] = FELikelihood(model, measured)
        medians[name] = dict(zip(model.parameter_names, np.median(fit.structure, axis=0), strict=True))
    return Structure(likelihoods, medians, quantities)


def _frame() -> tuple[Structure | None, list[Row]]:
    if rows := skipped("frame", measured_tests.FRAME):
        return None, rows
    data, _ = measured_tests.read_frame()
    floors = tuple(measured_tests.FLOORS)
    tests = {
        name: (measured_tests.frame_model(data, floors, name), data.select(floors).trim(*ends))
        for name, ends in measured_tests.SHAKINGS.items()
    }
    quantities = [kind(floor) for floor in floors for kind in (peak, arias_intensity)]
    return _calibrated(tests, measured_tests.FRAME_PRIOR, 3.0, quantities), []


def _meloland() -> tuple[Structure | None, list[Row]]:
    if rows := skipped("Meloland", measured_tests.MELOLAND):
        return None, rows
    tests = {name: measured_tests.meloland_part(name) for name in measured_tests.MELOLAND_PARTS}
    return _calibrated(tests, measured_tests.MELOLAND_PRIOR, 1.0, [peak("ch7"), arias_intensity("ch7")]), []


def _columns(most: int) -> list[Row]:
    """Peak forces of cyclic columns from others, all at their nominal parameters: one simulation of each."""
    tests, unused = tested_column.specimens() if tested_column.FOLDER.is_dir() else ((), {})
    rows = [Row("columns", "LEFT OUT", None, "", f"{file}: {why}") for file, why in unused.items()]
    if len(tests) < 3:
        return [*rows, Row("columns", "SKIPPED", None, "", f"no three tests in {tested_column.FOLDER}: set FE_SHARED")]
    likelihoods = {each.name: FELikelihood(each.model, each.measured) for each in tests}
    medians = {each.name: dict.fromkeys(each.model.parameter_names, 1.0) for each in tests}
    return rows + _subsets("columns", Structure(likelihoods, medians, [peak("force")]), most)


def _twins(data_sets: int) -> list[Row]:
    """Rows of twins with known scatters, from 1, 3, 5 and 11 events; their worst data sets are not judged."""
    rows = []
    for events in (1, 3, 5, 11):
        for spread in _SPREADS:
            each = [_twin(events, spread, seed) for seed in range(data_sets)]
            said = "spread 0.05 to 0.2" if spread is None else f"spread {spread:g}"
            rows += rows_of(f"twins, {events} events, {said}", each, worst=False)
    return rows


def _twin(events: int, spread: float | None, seed: int, new: int = 20) -> Scored:
    """Scores of new events of one data set."""
    rng = np.random.default_rng([seed, events])
    spread = rng.uniform(0.05, 0.2) if spread is None else spread
    parts = np.linalg.cholesky([[1.0, _CORRELATION], [_CORRELATION, 1.0]]) @ rng.standard_normal((2, events + new))
    weights = np.array([_OF_GAINS, np.sqrt(1.0 - _OF_GAINS**2)])
    gains, ratios = parts * weights[:, None] * spread / np.sqrt(1.0 + 2.0 * _CORRELATION * weights.prod())
    peaks, gain = np.exp(gains + ratios), float(np.exp(gains[:events].mean()))
    return scored(EventRatios(peaks[:events] / gain), peaks[events:], np.full(new, gain))
