"""Peaks of the eleven earthquakes of `benchmarks.transfer`, with the error of the model in three forms.

The peak of each event is predicted by its own posterior, without an error of the model, with white noise and with
``noise="model"``. The measurements are real and no part of the project, see `benchmarks.transfer`.
"""

import numpy as np

from fe_likelihoods import propagate, share_within
from fe_likelihoods.prediction.score_tables import QuantityScores

from . import transfer
from .rows import Row

__all__ = ["measured_peaks"]


def measured_peaks(repeats: int = 1) -> list[Row]:
    """Shares of measured peaks within their intervals, widths and interval scores; one seed per repeat."""
    records, rows = transfer.read_events()
    if len(records) < 4:
        return [*rows, Row("measured_peaks", "SKIPPED", None, "", f"no files *ce89324p.zip in {transfer._FOLDER}")]
    for seed in range(1, repeats + 1):
        fits = {name: transfer._calibrate(each, "relative", seed) for name, each in records.items()}
        for name, kind in (("parameters alone", False), ("white noise", True), ('noise="model"', "model")):
            own = [_own_peak(fit, kind, seed) for fit in fits.values()]
            rows += _peak_rows(f"own event, {name}, seed {seed}", own)
    return rows


def _own_peak(fit: transfer._Fit, kind: bool | str, seed: int) -> QuantityScores:
    """Scores of the peak of the event that a posterior was calibrated with."""
    options = {"quantity": transfer._PEAK, "noise": kind, "seed": seed, "progress": False}
    predicted = propagate(fit.posterior, fit.samples, **options)
    return predicted.score(fit.posterior.likelihood.measurements)


def _peak_rows(case: str, scores: list[QuantityScores]) -> list[Row]:
    pit = np.array([each.pit[0] for each in scores])
    biases = [each.median[0] / each.measured[0] for each in scores]
    ends = [each.upper[0] / each.median[0] for each in scores]
    interval = [each.interval_score[0] / each.measured[0] for each in scores]
    shares = {level: share_within(pit, level) for level in (0.5, 0.9)}
    rows = [Row(f"peaks within {level:.0%}", case, each.inside, "", f"{each}") for level, each in shares.items()]
    for what, values in (
        ("predicted median / measured peak", biases),
        ("upper end / median of the peak", ends),
        ("interval score / measured peak", interval),
    ):
        note = f"{min(values):.2f} to {max(values):.2f}; mean {np.mean(values):.3f}"
        rows.append(Row(what, case, float(np.median(values)), "", note))
    return rows
