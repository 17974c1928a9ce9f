"""Ratios that depend on the level, and fragility curves with the error of the model: calibration on synthetic twins.

`level_ratios`: ratios of measured to predicted peaks of K events, whose logarithms have a standard deviation of 0.1
around a constant, a line (slopes 0.1 and 0.2 per unit of the log level) or a curve; the log levels are normal with a
standard deviation of 0.8. The rows are the shares of 40 new events within their intervals, those of the events whose
level is far from the mean of the calibration (more than 1.5 standard deviations), and the mean interval score of the
log ratio (90 %, smaller is better), over 200 data sets per repeat, with standard errors from the scatter between data
sets.

`fragility_bands`: the peak in an event is a gain times the intensity, measured peaks are this times a ratio; logarithms
of gains and ratios are normal between events. The hyper-parameters of the gain are drawn from the priors that the
hierarchical model states, those of the ratio are fixed. Each data set has K events, from which `fragility` with a
`Hierarchy` and `EventRatios` finds the curve at nine intensities. The rows are the shares of the data sets whose band
holds the whole true curve (`Fragility.band`) and those whose intervals hold it at single intensities, with the interval
score of these. The control is `fragility` with the posterior of one event and ``noise=False``.
"""

import logging
import warnings

import numpy as np
from scipy import special, stats

from fe_likelihoods import (
    EventRatios,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LevelRatios,
    LogNormal,
    Prior,
    StoredPosterior,
    Varying,
    fragility,
    interval_score,
    peak,
)
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.signals.channels import Channel
from fe_likelihoods.signals.records import Record

from .new_event import ERROR, MEDIAN_SD, SPREAD_SD, hyper_samples
from .rows import Row

__all__ = ["fragility_bands", "fragility_twin", "level_ratios", "ratio_twin"]

_SETS, _NEW, _SD, _LEVEL_SD = 200, 40, 0.1, 0.8
_TRUTHS = {
    "slope 0": lambda x: 0.0 * x,
    "slope 0.1": lambda x: 0.1 * x,
    "slope 0.2": lambda x: 0.2 * x,
    "curve": lambda x: 0.25 * np.tanh(2.0 * x),
}
_PROBABILITIES = np.linspace(0.05, 0.95, 9)  # of the true curve at the intensities


def level_ratios(repeats: int = 1) -> list[Row]:
    """Coverage near and far, and interval scores, of constant and level-dependent ratios."""
    rows = []
    for truth in _TRUTHS:
        for events in (5, 10, 20):
            for form in ("constant", None):
                found = [ratio_twin(truth, events, form, seed) for seed in range(repeats * _SETS)]
                case = f"{'averaged forms' if form is None else form}, {truth}, {events} events"
                inside, far, score = (np.array(each) for each in zip(*found, strict=True))
                for k, level in enumerate((0.5, 0.9)):
                    error = 100.0 * inside[:, k].std() / np.sqrt(len(inside))
                    hits, number = far[:, k].sum(), far[:, 2].sum()
                    note = f"+- {error:.1f}; far: {100.0 * hits / number:.0f} %"
                    rows.append(Row(f"coverage, {level:.0%}", case, 100.0 * inside[:, k].mean(), "%", note))
                rows.append(Row("interval score of the log ratio", case, float(score.mean()), ""))
    return rows


def ratio_twin(truth: str, events: int, form: str | None, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Shares of new events within intervals of 50 and 90 %, the counts of far ones (and their number), and the score.

    ``form="constant"`` is `EventRatios`.
    """
    rng = np.random.default_rng([seed, events])
    x = _LEVEL_SD * rng.standard_normal(events + _NEW)
    logs = _TRUTHS[truth](x) + _SD * rng.standard_normal(len(x))
    ratios = (
        EventRatios(np.exp(logs[:events]))
        if form == "constant"
        else LevelRatios(np.exp(logs[:events]), np.exp(x[:events]), form)
    )
    new, at = logs[events:], x[events:]
    above = ratios.probability_above(np.exp(new), at)
    inside = np.stack([np.abs(above - 0.5) <= 0.5 * level for level in (0.5, 0.9)])
    far = np.abs(at - x[:events].mean()) > 1.5 * _LEVEL_SD
    if form == "constant":
        width = np.log(ratios.factor(0.9))
        low, high = (np.full(_NEW, np.log(ratios.median) + sign * width) for sign in (-1.0, 1.0))
    else:
        low, high = (np.log(ratios.quantile(p, np.exp(at))) for p in (0.05, 0.95))
    score = high - low + 20.0 * (np.maximum(low - new, 0.0) + np.maximum(new - high, 0.0))
    return inside.mean(axis=1), np.array([*inside[:, far].sum(axis=1), far.sum()]), float(score.mean())


class _Scaled(FunctionModel):
    """A response that is the gain times the motion."""

    def __init__(self, record: Record) -> None:
        super().__init__(self.respond, ["gain"], [Channel("top", "displacement", "m")], record.dt, record.n_steps)
        self.record, self.path_dependent = record, False

    def respond(self, theta: np.ndarray) -> list[np.ndarray]:
        return [theta[0] * self.record.acceleration]

    def with_record(self, record: Record) -> "_Scaled":
        return _Scaled(record)


def fragility_bands(repeats: int = 1) -> list[Row]:
    """Shares of the data sets whose band, and whose intervals, hold the true fragility; with the control."""
    logging.getLogger("fe_likelihoods.prediction.fragility").setLevel(logging.ERROR)  # the control has no curve
    rows = []
    for events in (3, 5, 10):
        found = [fragility_twin(events, seed) for seed in range(repeats * _SETS)]
        whole, points, control, scores = (np.array(each) for each in zip(*found, strict=True))
        case = f"{events} events"
        for what, inside in (
            ("90 % band holds the whole curve", whole),
            ("90 % intervals hold the curve at single intensities", points.mean(axis=1)),
            ("control, one posterior, noise=False: at single intensities", control.mean(axis=1)),
            ("control, one posterior, noise=False: the whole curve", control.all(axis=1)),
        ):
            error = 100.0 * np.std(inside) / np.sqrt(len(inside))
            rows.append(Row(what, case, 100.0 * float(np.mean(inside)), "%", f"+- {error:.1f}"))
        for what, score in zip(("intervals", "control"), scores.T, strict=True):
            error = score.std() / np.sqrt(len(score))
            rows.append(Row(f"{what}: interval score of the probability", case, score.mean(), "", f"+- {error:.3f}"))
        each = ", ".join(f"{share:.0f}" for share in 100.0 * points.mean(axis=0))
        rows.append(Row("intervals, by the true probability 5 to 95 %", case, None, "%", each))
    return rows


def fragility_twin(
    events: int, seed: int, ratio_sd: float = 0.2, n: int = 400
) -> tuple[bool, np.ndarray, np.ndarray, list[float]]:
    """Whether the band holds the curve, and the intervals its points; those of one posterior without error; scores."""
    rng = np.random.default_rng([seed, events])
    center, spread = MEDIAN_SD * rng.standard_normal(), abs(SPREAD_SD * rng.standard_normal())
    logs = center + spread * rng.standard_normal(events)
    bias = 0.1
    ratios = EventRatios(np.exp(bias + ratio_sd * rng.standard_normal(events)))
    data = logs + ERROR * rng.standard_normal(events)
    prior, sd = Prior({"gain": LogNormal(1.0, 1.0)}), ERROR / np.sqrt(1.0 + ERROR**2)
    stored = {
        f"EQ{k}": StoredPosterior({"gain": np.exp(sd**2 / ERROR**2 * each + sd * rng.standard_normal(200))}, prior)
        for k, each in enumerate(data)
    }
    varying = {"gain": Varying(LogNormal(1.0, MEDIAN_SD), HalfNormal(SPREAD_SD))}
    total = np.hypot(spread, ratio_sd)
    intensities = np.exp(total * stats.norm.ppf(_PROBABILITIES) - center - bias)  # of the limit 1
    truth = special.ndtr((np.log(intensities) + center + bias) / total)
    record = Record("motion", 0.1, np.array([0.0, 1.0, -0.5]))
    records = [record.scale(each) for each in intensities]
    options = {"level": 0.9, "seed": seed, "progress": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hierarchy = Hierarchy(HierarchicalPosterior(stored, varying, max_samples=100), hyper_samples(data, rng, 300))
    found = fragility(_Scaled(record), hierarchy, records, peak("top"), 1.0, ratios=ratios, n=n, **options)
    lower, upper = found.band(0.9)
    alone = fragility(_Scaled(record), stored["EQ0"].samples, records, peak("top"), 1.0, noise=False, **options)
    return (
        bool(((lower <= truth) & (truth <= upper)).all()),
        (found.lower <= truth) & (truth <= found.upper),
        (alone.lower <= truth) & (truth <= alone.upper),
        [float(interval_score(each.lower, each.upper, truth, 0.9).mean()) for each in (found, alone)],
    )
