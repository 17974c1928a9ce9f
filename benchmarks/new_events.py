"""Numbers of a new event, predicted from a few events of the same structure by `fe_likelihoods.predict_new_event`.

Real structures are the decks and frames of ``badge`` with three events or more, and two decks more. Each event is
calibrated to its best mode under white noise. The means of the parameters of a random subset of the events (geometric
ones, for what is positive) stand for the population, and the other events are predicted.

Twins are oscillators whose stiffness differs between events by a known standard deviation of its logarithm, and whose
damping differs by five times as much, at most 0.4. In 200 data sets, 1, 3 or 5 events predict one, with the usual
``spread=`` and with the true one ("stated"). Columns are `tested_column.next_columns`.

A row has the share of measured numbers in intervals of 90 %, as the mean over the subsets. Its note has the worst
subset, the share in intervals of 50 %, the ratio of the ends of the intervals of 90 % (median), and the interval score
of the logarithm. A ratio of the ends of 1.6 is the interval of a known normal scatter of 0.14.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fe_likelihoods import FELikelihood, LinearOscillator, Measurements, Record, peak
from fe_likelihoods.prediction.new_event import _event, event_ratios
from fe_likelihoods.prediction.quantities import arias_intensity
from fe_likelihoods.priors.between_events import BETWEEN_EVENTS

from .badge import STRUCTURES, Deck, best_mode, posterior_of
from .rows import Row
from .targets import SHARED
from .tested_column import next_columns

__all__ = ["new_events"]

_MORE = {
    "Painter Street east end": Deck("*ce89324p.zip", (3, 17, 17), (9,), 8),
    "Painter Street three": Deck("*ce89324p.zip", (3, 17, 20), (4, 7, 9), 8),
}
_LINEAR = "share", "shape"  # parameters that may be zero
_OF_TWINS = 0.02, 0.05, 0.1, 0.2  # standard deviations of log stiffnesses


def new_events(
    repeats: int = 1,
    structures: tuple[str, ...] = (*STRUCTURES, *_MORE, "twins", "columns"),
    sizes: tuple[int, ...] = (1, 3, 5),
    subsets: int = 11,
    twins: int = 200,
) -> Iterator[Row]:
    """Coverage of peaks and Arias intensities of events that are left out, from `sizes` events of a structure."""
    for name in (each for each in structures if each not in ("twins", "columns")):
        fitted = [(posterior, best_mode(posterior)) for posterior in map(posterior_of, _events(name))]
        fitted = [(posterior.likelihood, mode.parameters) for posterior, mode in fitted if mode is not None]
        if not fitted:
            yield Row("new_events", "SKIPPED", None, "", f"no files in {SHARED / 'measured'}: set FE_SHARED")
        for size in sizes if len(fitted) > 2 else ():
            if size < len(fitted):
                orders = [np.random.default_rng([size, seed]).permutation(len(fitted)) for seed in range(subsets)]
                found = [_predicted([fitted[k] for k in order], size) for order in orders]
                yield from _rows(f"{name}, {size} of {len(fitted)}", found)
    for sd in _OF_TWINS if "twins" in structures else ():
        spread = {"stiffness": sd, "damping": min(5.0 * sd, 0.4)}
        for size in sizes:
            sets = [_twins(spread, size + 1, seed) for seed in range(twins)]
            for said, stated in ("", BETWEEN_EVENTS), (", stated", spread):
                yield from _rows(f"twins of {sd:g}, {size} events{said}", [_predicted(t, size, stated) for t in sets])
    if "columns" in structures:
        yield from next_columns()


def _events(name: str) -> list[Any]:
    try:
        return list((STRUCTURES | _MORE)[name].events())
    except ValueError:  # a file without one of the channels
        return []


def _twins(spread: Mapping[str, float], n: int, seed: int) -> list[tuple[FELikelihood, np.ndarray]]:
    """Likelihoods of n events of an oscillator, and its true parameters in each."""
    rng, found = np.random.default_rng([n, seed]), []
    for theta in np.exp([*spread.values()] * rng.standard_normal((n, 2))):
        motion = rng.standard_normal(400) * np.hanning(400) * np.exp(rng.standard_normal())
        model = LinearOscillator(Record("noise", 0.02, motion), 0.5)
        found.append((FELikelihood(model, Measurements(model.channels, model.dt, model.simulate(theta))), theta))
    return found


def _predicted(
    fitted: Sequence[tuple[FELikelihood, np.ndarray]], size: int, spread: Mapping[str, float] = BETWEEN_EVENTS
) -> np.ndarray:
    """PIT, log ratio of the ends, and interval score (3, n, 2) of n peaks and Arias intensities of the later events."""
    model = fitted[0][0].model
    names = [channel.name for channel in model.channels if "acceleration" in channel.quantity]
    numbers = [*map(peak, names), *map(arias_intensity, names)]
    rows = np.array([theta[: len(model.parameter_names)] for _, theta in fitted[:size]])
    logs = np.array([not name.startswith(_LINEAR) for name in model.parameter_names])
    at = np.where(logs, np.exp(np.log(np.where(logs, rows, 1.0)).mean(axis=0)), rows.mean(axis=0))
    at = dict(zip(model.parameter_names, at, strict=True))
    known = {f"{k}": each for k, (each, _) in enumerate(fitted[:size])}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ratios, found = event_ratios(at, known, numbers, spread=spread), []
        for likelihood, _ in fitted[size:]:
            ratio, level, variance, _ = _event(likelihood, at, numbers, spread)
            own = replace(ratios, new_sd=np.sqrt(variance + ratios.remainder))
            low, high = np.log(own.quantile(0.05, level)), np.log(own.quantile(0.95, level))
            missed = np.maximum(low - np.log(ratio), 0.0) + np.maximum(np.log(ratio) - high, 0.0)
            found.append(
                [1.0 - own.probability_above(ratio, np.log(level)), high - low, high - low + 2.0 / 0.1 * missed]
            )
    return np.array(found).swapaxes(0, 1).reshape(3, len(found), 2, -1).swapaxes(2, 3).reshape(3, -1, 2)


def _rows(case: str, found: Sequence[np.ndarray]) -> Iterator[Row]:
    """Rows of peaks and of Arias intensities from the results of all subsets."""
    pit, ends, score = np.concatenate(found, axis=1)
    for k, what in enumerate(("peaks", "Arias intensities")):
        shares = [[(np.abs(each[0, :, k] - 0.5) < 0.5 * level).mean() for each in found] for level in (0.9, 0.5)]
        note = f"worst {100 * min(shares[0]):.0f}; " if len(found[0][0]) > 1 else ""
        note += f"in 50 %: {100 * np.mean(shares[1]):.0f}; ends "
        note += f"{np.exp(np.median(ends[:, k])):.2f}; score {score[:, k].mean():.2f}"
        yield Row(f"{what} in 90 %", case, 100.0 * float(np.mean(shares[0])), "%", note)
