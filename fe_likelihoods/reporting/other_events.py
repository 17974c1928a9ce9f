"""Predictions of events other than the calibration event: numbers, scores and sentences about each of them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..checks.finding import Finding, percent
from ..prediction.prediction import Prediction
from ..prediction.scores import HistoryScores, QuantityScores, central_interval, share_within
from ..signals.channels import Measurements
from ..simulation.model import SimulationFailed
from ..units import from_si
from .contents import names_of_values

EventPredictions = Mapping[str, Prediction]
"""Predictions of one event by quantity, such as the result of `fe_likelihoods.propagate` for several quantities."""

LEVEL = 0.9  # of the intervals
MOST_NUMBERS = 20  # of a prediction that are shown


class NumberRow(NamedTuple):
    """A predicted number of an event, such as a peak, in the unit of its channel; NaN without measurements."""

    name: str  # such as "peak of deck"
    unit: str  # for display
    median: float
    quartiles: tuple[float, float]  # of the central interval with probability 0.5
    ends: tuple[float, float]  # of the central interval with probability 0.9
    measured: float
    pit: float  # predicted probability of a value smaller than the measured one

    @property
    def place(self) -> str:
        """Where the measured value is, in words; empty without one."""
        if not np.isfinite(self.pit):
            return ""
        if abs(self.pit - 0.5) <= 0.25:
            return "within 50 %"
        if abs(self.pit - 0.5) <= 0.5 * LEVEL:
            return f"within {percent(LEVEL)}"
        return "above" if self.pit > 0.5 else "below"


class OtherEvent(NamedTuple):
    """The prediction of one event; its scores exist where there are measurements."""

    name: str
    predictions: EventPredictions  # by quantity; none if all simulations failed
    measured: Measurements | None
    numbers: tuple[NumberRow, ...]  # of all predictions that are not histories
    histories: tuple[HistoryScores, ...]
    values: tuple[QuantityScores, ...]
    sentence: str  # how it was predicted, and how the measurements compare with it
    findings: tuple[Finding, ...] = ()  # of the predictions, and failed samples


def as_events(events: Any) -> dict[str, EventPredictions | SimulationFailed]:
    """Predictions of each event by quantity, or why there are none; ValueError for other objects.

    The events map names to a `Prediction`, a mapping of predictions, or `SimulationFailed`.
    """
    if not isinstance(events, Mapping):
        raise ValueError(f"events must be a mapping of names to predictions of these events; got {events!r}")
    found = {}
    for name, given in events.items():
        if isinstance(given, SimulationFailed):
            found[str(name)] = given
            continue
        of_event = {"": given} if isinstance(given, Prediction) else given
        if not isinstance(of_event, Mapping) or not all(isinstance(each, Prediction) for each in of_event.values()):
            raise ValueError(
                f"events: expected the result of propagate for each event, of one quantity or of several by name; "
                f"{name!r} is {given!r}"
            )
        if not of_event:
            raise ValueError(
                f"events: {name!r} has no prediction; give the result of propagate for it, or leave the event out"
            )
        found[str(name)] = dict(of_event)
    return found


def describe_event(
    name: str, predictions: EventPredictions | SimulationFailed, measured: Measurements | None
) -> OtherEvent:
    """Describe and score the predictions of an event, or the error that `propagate` raises if all simulations fail."""
    if isinstance(predictions, SimulationFailed):
        text = f"It could not be predicted: {predictions.reason}. Mend the model for this motion; the samples stay."
        return OtherEvent(name, {}, measured, (), (), (), text)
    findings = list(dict.fromkeys(found for each in predictions.values() for found in each.findings))
    first = next(iter(predictions.values()))
    reasons = "; ".join(f"{count}: {reason}" for reason, count in first.failure_reasons.items())
    told = f" {first.n_failed} samples failed and are left out ({reasons})." if first.n_failed else ""
    histories, values, numbers = [], [], []
    for each in predictions.values():
        scores = None
        if measured is not None:
            try:
                scores = each.score(measured, LEVEL)
            except ValueError as error:
                told += f" No scores: {error}."
        if scores is not None:
            (histories if each.dt is not None else values).append(scores)
        if each.dt is None and each.values is not None:
            numbers += _number_rows(each, scores)
    sentence = _sentence(first, measured, histories, numbers) + told
    return OtherEvent(
        name, predictions, measured, tuple(numbers), tuple(histories), tuple(values), sentence, tuple(findings)
    )


def _number_rows(prediction: Prediction, scores: QuantityScores | None) -> list[NumberRow]:
    """The numbers of a prediction, in the units of their channels where these are known."""
    values = np.sort(prediction.values.reshape(len(prediction.values), -1), axis=0)
    ends, quartiles = central_interval(values, LEVEL), central_interval(values, 0.5)
    known, names = len(prediction.channels) == values.shape[1], names_of_values(prediction)
    rows = []
    for k, name in enumerate(names[:MOST_NUMBERS]):
        unit = prediction.channels[k].unit if known else "SI"
        found = [np.median(values[:, k]), *(end[k] for end in (*quartiles, *ends))]
        found.append(np.nan if scores is None else scores.measured[k])
        shown = [float(each if unit == "SI" else from_si(each, unit)) for each in found]
        pit = np.nan if scores is None else float(scores.pit[k])
        rows.append(NumberRow(name, unit, shown[0], tuple(shown[1:3]), tuple(shown[3:5]), shown[5], pit))
    return rows


def _sentence(
    first: Prediction, measured: Measurements | None, histories: list[HistoryScores], numbers: list[NumberRow]
) -> str:
    """How an event was predicted, and how the measurements compare with it."""
    noise = "with the noise of measurements" if first.noise else "without the noise of measurements"
    if first.ratios is not None:
        noise = "times ratios of measured to simulated values in other events"
    state = "as the event of the calibration has left it" if first.from_state == "end" else "before any other event"
    text = f"Predicted from {first.n_samples} samples, {noise}."
    text += f" The motion meets the structure {state}." if first.data is None or first.data.is_history else ""
    if measured is None:
        return f"{text} There are no measurements to compare with."
    known = [row for row in numbers if np.isfinite(row.pit)]
    if known:
        share = share_within([row.pit for row in known], LEVEL)
        text += f" {share.inside} of {share.n} measured numbers are within their {percent(LEVEL)} intervals"
        outside = [f"{row.name} {row.place}" for row in known if not row.place.startswith("within")]
        text += f" ({', '.join(outside)})" if outside else ""
        text += "; so few show a share between {} and {} of all such numbers.".format(*map(percent, share.interval))
    for scores in histories:
        shares = ", ".join(
            f"{percent(share)} of {channel.name}"
            for channel, share in zip(scores.channels, scores.coverage, strict=True)
        )
        text += f" The {percent(LEVEL)} band contains {shares}."
    if not first.noise:
        text += " A band without noise is that of the response, and contains fewer measurements."
    return text
