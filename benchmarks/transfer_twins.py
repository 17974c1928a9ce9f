"""Synthetic twins of the eleven earthquakes of `benchmarks.transfer`, whose spread between events is known.

The parameters of each event are drawn from a population like the one that the real events have, and the peak of the
deck under the real excitation of the event is multiplied by a ratio with a lognormal error of 9 %, which depends on the
parameters with a correlation of 0 or -0.8. Each peak is predicted from the ten others as by `predict_from_median`: by
the parameters in the middle, and Student's t distribution of the ratios there. The sensitivities of the peaks to the
parameters are those of the real events, which differ.

The rows are the shares of the peaks within their intervals over 300 data sets per repeat, with the standard error from
the scatter between data sets, the share of the data sets in which 7 or more, and 8 or more, of the eleven are within
those of 50 %, and the median factor between the ends of the 90 % interval. The last rows have log peaks that are
independent and normal (7 %), and the same with one event that is four standard deviations off. The excitations are real
and no part of the project, see `benchmarks.transfer`.
"""

import numpy as np
from scipy import special, stats

from . import transfer
from .rows import Row

__all__ = ["leave_one_out_t", "transfer_twins"]

_CENTER = np.array([np.log(5.1), np.log(0.12), special.logit(0.84)])  # of frequency [Hz], damping and share
_SD = np.array([0.09, 0.54, 0.85])
_CORRELATION = np.array([[1.0, -0.58, 0.5], [-0.58, 1.0, 0.3], [0.5, 0.3, 1.0]])
_RATIO_SD = 0.09


def transfer_twins(repeats: int = 1, data_sets: int = 300) -> list[Row]:
    """Shares of the peaks of twins within their intervals, for two correlations of ratio and parameters."""
    records, rows = transfer.read_events()
    if len(records) < 4:
        return [*rows, Row("transfer_twins", "SKIPPED", None, "", f"no files *ce89324p.zip in {transfer._FOLDER}")]
    models = [transfer._model_and_measurements(each)[0] for each in records.values()]
    rng, sets = np.random.default_rng(3), repeats * data_sets
    for correlation in (0.0, -0.8):
        errors = np.array([_log_errors(models, correlation, rng) for _ in range(sets)])
        rows += _rows(f"{len(models)} events, correlation {correlation:g}", errors)
    errors = 0.07 * rng.standard_normal((20_000, len(models)))
    rows += _rows("independent normal log peaks", errors)
    errors[:, 0] += 4.0 * 0.07
    return rows + _rows("normal log peaks, one of them 4 sd off", errors)


def leave_one_out_t(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Student's t of each log ratio (n, K) given the K - 1 others of its row, and the scales of the predictions."""
    others = errors.shape[1] - 1
    mean = (errors.sum(axis=1, keepdims=True) - errors) / others
    squares = np.square(errors).sum(axis=1, keepdims=True) - np.square(errors) - others * np.square(mean)
    scale = np.sqrt(squares / (others - 1.0) * (1.0 + 1.0 / others))
    return (errors - mean) / scale, scale


def _log_errors(models: list, correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Logarithms of the ratios of the true peaks to those at the mean of the parameters of the events."""
    factor = np.linalg.cholesky(_CORRELATION)
    z = rng.standard_normal((len(models), 3))
    points = _CENTER + _SD * (z @ factor.T)
    direction = np.array([-1.0, -1.0, 1.0]) @ factor  # in which the peak grows, about
    along = z @ direction / np.linalg.norm(direction)
    ratios = _RATIO_SD * (correlation * along + np.sqrt(1.0 - correlation**2) * rng.standard_normal(len(models)))
    middle = points.mean(axis=0)
    peaks, at_middle = (
        np.array([_log_peak(model, point) for model, point in zip(models, each, strict=True)])
        for each in (points, [middle] * len(models))
    )
    return peaks + ratios - at_middle


def _log_peak(model: object, point: np.ndarray) -> float:
    theta = np.array([np.exp(point[0]), np.exp(point[1]), special.expit(point[2])])
    return float(np.log(np.abs(model.simulate(theta)).max()))


def _rows(case: str, errors: np.ndarray) -> list[Row]:
    t, scale = leave_one_out_t(errors)
    degrees, rows = errors.shape[1] - 2, []
    for level in (0.5, 0.9):
        inside = (np.abs(t) < stats.t.ppf(0.5 + 0.5 * level, degrees)).mean(axis=1)
        note = f"+- {100.0 * inside.std() / np.sqrt(len(inside)):.1f}"
        rows.append(Row(f"peaks within {level:.0%}", case, 100.0 * float(inside.mean()), "%", note))
        half = stats.t.ppf(0.5 + 0.5 * level, degrees)
        score = scale * (2.0 * half + 2.0 / (1.0 - level) * np.maximum(np.abs(t) - half, 0.0))
        rows.append(Row(f"interval score of the log peak, {level:.0%}", case, float(score.mean()), ""))
        if level == 0.5:
            counts = np.round(inside * errors.shape[1])
            for least in (7, 8):
                rows.append(
                    Row(f"data sets with {least} or more within 50%", case, 100.0 * (counts >= least).mean(), "%")
                )
    apart = np.exp(2.0 * stats.t.ppf(0.95, degrees) * scale)
    return [*rows, Row("upper / lower end of the peak", case, float(np.median(apart)), "")]
