"""Calibration on synthetic twins: ratios that depend on the level, fragility with the error of the model, annual rates.

`level_ratios`: ratios of measured to predicted peaks of K events, without a prior of their scatter. Their logarithms
have a standard deviation of 0.1 around a constant, a line (slopes 0.1 and 0.2 per unit of the log level) or a curve;
the log levels are normal with a standard deviation of 0.8. The rows are the shares of 40 new events within their
intervals, those of the events whose level is far from the mean of the calibration (more than 1.5 standard deviations),
and the mean interval score of the log ratio (90 %, smaller is better), over 200 data sets per repeat, with standard
errors from the scatter between data sets.

`fragility_bands`: the peak in an event is a gain times the intensity, measured peaks are this times a ratio; logarithms
of gains and ratios are normal between events. The hyper-parameters of the gain are drawn from the priors that the
hierarchical model states, those of the ratio are fixed. Each data set has K events, from which `fragility` with a
`Hierarchy` and `event_ratios` finds the curve at nine intensities. The rows are the shares of the data sets whose band
holds the whole true curve (`Fragility.band`) and those whose intervals hold it at single intensities, with the interval
score of these. The control is `fragility` with the posterior of one event and ``noise=False``.
"""

import logging

import numpy as np

from fe_likelihoods import annual_risk
from fe_likelihoods.prediction.fragility_curve import curve_with_errors
from tests.prediction.twins import TRUTHS, fragility_twin, ratio_twin

from .rows import Row

__all__ = ["annual_rates", "fragility_bands", "level_ratios"]


def level_ratios(repeats: int = 1, data_sets: int = 200) -> list[Row]:
    """Coverage near and far, and interval scores, of constant and level-dependent ratios."""
    rows = []
    for truth in TRUTHS:
        for events in (5, 10, 20):
            for form in ("constant", "linear"):
                found = [ratio_twin(truth, events, form, seed) for seed in range(repeats * data_sets)]
                case = f"{form}, {truth}, {events} events"
                inside, far, score = (np.array(each) for each in zip(*found, strict=True))
                for k, level in enumerate((0.5, 0.9)):
                    error = 100.0 * inside[:, k].std() / np.sqrt(len(inside))
                    hits, number = far[:, k].sum(), far[:, 2].sum()
                    note = f"+- {error:.1f}; far: {100.0 * hits / number:.0f} %"
                    rows.append(Row(f"coverage, {level:.0%}", case, 100.0 * inside[:, k].mean(), "%", note))
                rows.append(Row("interval score of the log ratio", case, float(score.mean()), ""))
    return rows


def fragility_bands(repeats: int = 1, data_sets: int = 200) -> list[Row]:
    """Shares of the data sets whose band, and whose intervals, hold the true fragility; with the control."""
    logging.getLogger("fe_likelihoods.prediction.fragility").setLevel(logging.ERROR)  # the control has no curve
    rows = []
    for events in (3, 5, 10):
        found = [fragility_twin(events, seed) for seed in range(repeats * data_sets)]
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


def annual_rates(repeats: int = 1, data_sets: int = 200) -> list[Row]:
    """Errors, stated errors and coverage of annual rates from finite simulations."""
    rows, dispersion, k = [], 0.35, 2.3
    intensity = np.array([0.3, 0.5, 0.7, 0.9, 1.2, 1.6, 2.2])
    hazard = np.array([0.05, 20.0]), 1e-3 * np.array([0.05, 20.0]) ** -k
    exact = 1e-3 * np.exp(0.5 * (k * dispersion) ** 2)
    for case, samples, stated in (("100", 100, 100), ("800", 800, 800), ("control: 80 stated as 800", 80, 800)):
        found = []
        for seed in range(repeats * data_sets):
            rng = np.random.default_rng(seed)
            exceeds = (np.exp(dispersion * rng.standard_normal(samples)) < intensity[:, None]).astype(float)
            curve = curve_with_errors(intensity, exceeds, np.ones(exceeds.shape), stated, None, rng)
            risk = annual_risk(curve, *hazard)
            found.append((risk.rate[0], risk.standard_error[0], risk.lower[0] <= exact <= risk.upper[0]))
        rate, error, inside = np.array(found).T
        scatter = rate.std() / exact
        note = f"+- {100.0 * scatter / np.sqrt(len(rate)):.1f}"
        rows.append(Row("mean error of the rate", f"{case} samples", 100.0 * (rate.mean() / exact - 1.0), "%", note))
        rows.append(Row("scatter of the rate", f"{case} samples", 100.0 * scatter, "%"))
        rows.append(Row("stated error", f"{case} samples", 100.0 * error.mean() / exact, "%"))
        note = f"+- {100.0 * inside.std() / np.sqrt(len(inside)):.1f}"
        rows.append(Row("90 % interval holds the rate", f"{case} samples", 100.0 * inside.mean(), "%", note))
    return rows
