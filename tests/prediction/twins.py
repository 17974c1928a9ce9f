"""Synthetic twins of events whose spread is known, and their fragility curves.

`fragility_twin`: the peak in an event is a gain times the intensity, measured peaks are this times a ratio; logarithms
of gains and ratios are normal between events. The hyper-parameters of the gain are drawn from the priors that the
hierarchical model states, those of the ratio are fixed.
"""

import warnings

import numpy as np
from scipy import special, stats

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Measurements,
    Prior,
    StoredPosterior,
    Varying,
    event_ratios,
    fragility,
    interval_score,
    peak,
)
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.signals.channels import Channel
from fe_likelihoods.signals.records import Record

__all__ = ["fragility_twin", "hyper_samples"]

ERROR = 0.05  # of a measured log gain
MEDIAN_SD, SPREAD_SD = 0.5, 0.3  # of the priors of the population's median and spread
_PROBABILITIES = np.linspace(0.05, 0.95, 9)  # of the true curve at the intensities
_GRID = np.meshgrid(np.linspace(-2.0, 2.0, 161), np.linspace(0.0025, 1.2, 120), indexing="ij")


class _Scaled(FunctionModel):
    """A response that is the gain times the motion."""

    def __init__(self, record: Record) -> None:
        super().__init__(self.respond, ["gain"], [Channel("top", "displacement", "m")], record.dt, record.n_steps)
        self.record, self.path_dependent = record, False

    def respond(self, theta: np.ndarray) -> list[np.ndarray]:
        return [theta[0] * self.record.acceleration]

    def with_record(self, record: Record) -> "_Scaled":
        return _Scaled(record)


def fragility_twin(events: int, seed: int, ratio_sd: float = 0.2) -> tuple[bool, np.ndarray, np.ndarray, list[float]]:
    """Whether the band holds the curve, and the intervals its points; those of one posterior without error; scores."""
    rng = np.random.default_rng([seed, events])
    center, spread = MEDIAN_SD * rng.standard_normal(), abs(SPREAD_SD * rng.standard_normal())
    logs = center + spread * rng.standard_normal(events)
    bias = 0.1
    peaks = np.exp(logs + bias + ratio_sd * rng.standard_normal(events))
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
    model = _Scaled(record)
    likelihoods = {
        name: FELikelihood(model, Measurements(model.channels, model.dt, [value * record.acceleration]))
        for name, value in zip(stored, peaks, strict=True)
    }
    ratios = event_ratios(hierarchy, likelihoods, peak("top"), prior_events=0)
    found = fragility(model, hierarchy, records, peak("top"), 1.0, ratios=ratios, **options)
    lower, upper = found.band(0.9)
    alone = fragility(model, stored["EQ0"].samples, records, peak("top"), 1.0, noise=False, **options)
    return (
        bool(((lower <= truth) & (truth <= upper)).all()),
        (found.lower <= truth) & (truth <= found.upper),
        (alone.lower <= truth) & (truth <= alone.upper),
        [float(interval_score(each.lower, each.upper, truth, 0.9).mean()) for each in (found, alone)],
    )


def hyper_samples(data: np.ndarray, rng: np.random.Generator, n: int = 200) -> np.ndarray:
    """Samples of median and spread from their exact posterior density on a grid."""
    center, spread = _GRID
    variance = spread**2 + ERROR**2
    log_density = -0.5 * (center / MEDIAN_SD) ** 2 - 0.5 * (spread / SPREAD_SD) ** 2
    for each in data:
        log_density = log_density - 0.5 * np.log(variance) - 0.5 * (each - center) ** 2 / variance
    density = np.exp(log_density - log_density.max()).ravel()
    cells = rng.choice(density.size, n, p=density / density.sum())
    width = center[1, 0] - center[0, 0], spread[0, 1] - spread[0, 0]
    jitter = rng.random((2, n)) - 0.5
    logs = center.ravel()[cells] + width[0] * jitter[0]
    return np.stack([np.exp(logs), np.abs(spread.ravel()[cells] + width[1] * jitter[1])], axis=1)
