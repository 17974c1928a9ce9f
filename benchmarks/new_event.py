"""Coverage of predicted peaks of new events, on synthetic twins whose spread between events is known.

The peak of an event is a gain times the motion, and the measured peak this times a ratio; logarithms of gains and
ratios are normal between events. Each data set has K events with measured gains (errors of 5 %) and ratios, from which
`predict_new_event` predicts 20 further events. The median and the spread of the gains are drawn from the priors that
the hierarchical model states, so that its intervals must have their level, or they are fixed. The control leaves out
the spread between events: the posterior of one event, as without `Hierarchy`.

The rows are the shares of the measured peaks within their intervals over 200 data sets per repeat, with the standard
error from the scatter between data sets, the interval score of the logarithms, and the median ratio of the upper end to
the median.
"""

import warnings

import numpy as np

from fe_likelihoods import (
    Channel,
    EventRatios,
    FunctionModel,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Prior,
    StoredPosterior,
    Varying,
    interval_score,
    peak,
    predict_new_event,
)
from fe_likelihoods.prediction.scores import pit_samples
from tests.prediction.twins import ERROR, MEDIAN_SD, SPREAD_SD, hyper_samples

from .rows import Row

__all__ = ["new_event"]

_NEW, _DRAWS, _RATIO = 20, 400, 0.1
_CASES = {  # number of events, median and spread of the gains; None: drawn from the priors
    "5 events, truth from the priors": (5, None),
    "1 event, truth from the priors": (1, None),
    "5 events, spread 0.2": (5, (1.0, 0.2)),
}


class _Twin(FunctionModel):
    """A response whose peak is the gain."""

    def __init__(self) -> None:
        super().__init__(_respond, ["gain"], [Channel("top", "displacement", "m")], 0.1, 2)
        self.path_dependent = False

    def with_record(self, record: object) -> "_Twin":
        return self


def _respond(theta: np.ndarray) -> list[np.ndarray]:
    return [theta[0] * np.array([0.0, 1.0])]


def new_event(repeats: int = 1, data_sets: int = 200) -> list[Row]:
    """Rows of coverage and of the interval score per case and for the control, and one of sharpness."""
    rows = []
    for case, (events, truth) in _CASES.items():
        results = [_data_set(events, truth, seed) for seed in range(repeats * data_sets)]
        pit, single, scores, ends = (np.array(each) for each in zip(*results, strict=True))
        for k, (what, values) in enumerate((("coverage", pit), ("control: one posterior", single))):
            for level in (0.5, 0.9):
                inside = (np.abs(values - 0.5) <= 0.5 * level).mean(axis=1)
                error = inside.std() / np.sqrt(len(inside))
                rows.append(Row(f"{what}, {level:.0%}", case, 100.0 * inside.mean(), "%", f"+- {100.0 * error:.1f}"))
            score, error = scores[:, k].mean(), scores[:, k].std() / np.sqrt(len(scores))
            rows.append(Row(f"{what}, interval score of the log peak", case, float(score), "", f"+- {error:.2f}"))
        rows.append(Row("upper end / median", case, float(np.median(ends)), ""))
    return rows


def _data_set(
    events: int, truth: tuple[float, float] | None, seed: int
) -> tuple[np.ndarray, np.ndarray, list[float], float]:
    """PIT of new peaks, the same from the posterior of one event alone, both scores, and the relative upper end."""
    rng = np.random.default_rng([seed, events])
    center, spread = rng.standard_normal(2) * [MEDIAN_SD, SPREAD_SD] if truth is None else np.array(truth)
    center, spread, ratio_sd = (center, abs(spread), _RATIO) if truth is None else (np.log(center), spread, _RATIO)
    degrees = 3.0
    if events == 1:  # the guess of the spread of the ratios is right on average
        ratio_sd *= np.sqrt(degrees / rng.chisquare(degrees))
    logs, ratios = center + spread * rng.standard_normal(events), np.exp(ratio_sd * rng.standard_normal(events))
    data = logs + ERROR * rng.standard_normal(events)
    prior, sd = Prior({"gain": LogNormal(1.0, 1.0)}), ERROR / np.sqrt(1.0 + ERROR**2)
    stored = {
        f"EQ{k}": StoredPosterior({"gain": np.exp(sd**2 / ERROR**2 * each + sd * rng.standard_normal(200))}, prior)
        for k, each in enumerate(data)
    }
    varying = {"gain": Varying(LogNormal(1.0, MEDIAN_SD), HalfNormal(SPREAD_SD))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hierarchy = Hierarchy(HierarchicalPosterior(stored, varying, max_samples=100), hyper_samples(data, rng))
    prior_of_ratio = {"prior_sd": _RATIO, "prior_events": degrees} if events == 1 else {}
    known = EventRatios(ratios, **prior_of_ratio)
    predicted = predict_new_event(hierarchy, _Twin(), None, quantity=peak("top"), ratios=known, n=_DRAWS, seed=seed)
    new = np.exp(center + spread * rng.standard_normal(_NEW) + ratio_sd * rng.standard_normal(_NEW))
    alone = stored["EQ0"].samples[:, 0] * ratios[0]
    both = predicted.values, alone
    pit, single = (pit_samples(np.repeat(values[:, None], _NEW, axis=1), new) for values in both)
    ends = [np.quantile(np.log(values), (0.05, 0.95)) for values in both]
    scores = [float(interval_score(low, high, np.log(new), 0.9).mean()) for low, high in ends]
    return pit, single, scores, float(predicted.quantile(0.95) / predicted.quantile(0.5))
