"""What `print` shows of results: short tables and sentences with units, not arrays."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    EventRatios,
    Record,
    average_predictions,
    exceedance,
    fragility,
    peak,
    propagate,
)
from fe_likelihoods.checks.finding import CARE, Finding
from fe_likelihoods.prediction.fragility import fit_fragility
from fe_likelihoods.prediction.held_out import HeldOutScore, HeldOutScores
from fe_likelihoods.prediction.scores import score_values
from tests.prediction.flexible import Flexible, strongest, under

RECORD = Record("base", 0.1, np.sin(np.arange(40.0)))
RATIOS = EventRatios([0.8, 1.0, 1.25])


def cells(text, row):
    """Cells of a row of a printed table."""
    return [cell.strip() for cell in text.splitlines()[row].split("  ") if cell.strip()]


@pytest.fixture
def predicted():
    options = {"quantity": {"histories": None, "peak": peak("displacement")}, "progress": False}
    return propagate(Flexible(RECORD), np.linspace(-0.5, 0.5, 41)[:, None], **options)


def test_predictions(predicted):
    text = str(predicted["peak"])
    assert text.startswith("Prediction: 41 samples, without measurement noise; effective sample size 41\n")
    assert cells(text, 1) == ["value", "unit", "mean", "MC error", "sd", "5 %", "50 %", "95 %"]
    name, unit, mean, *_, median, _ = cells(text, 2)
    assert (name, unit) == ("displacement", "cm")
    assert float(mean) == pytest.approx(1e2 * predicted["peak"].mean, rel=5e-3)
    assert float(median) == pytest.approx(1e2 * predicted["peak"].quantile(0.5), rel=5e-3)
    text = str(predicted["histories"])
    assert cells(text, 1)[2:4] == ["largest mean", "at [s]"] and "array" not in text
    largest = np.abs(predicted["histories"].mean).max()
    assert abs(float(cells(text, 2)[2])) == pytest.approx(1e2 * largest, rel=5e-3)


def test_averages_of_models_have_the_findings_of_each_once(predicted):
    far, peak = tuple(Finding(text, CARE, "Why.") for text in ("Far away", "Few samples")), predicted["peak"]
    parts = {"a": peak, "b": replace(peak, findings=far[:1]), "c": replace(peak, findings=far)}
    average = average_predictions(parts, {"a": 0.2, "b": 0.3, "c": 0.5})
    assert average.findings == far
    assert cells(str(average), 3) == ["value", "unit", "mean", "MC error", "sd"]


def test_exceedance_and_fragility(predicted):
    found = exceedance(predicted["peak"], [10.0, 12.0], unit="cm", ratios=RATIOS)
    text = str(found)
    assert cells(text, 0)[::4] == ["threshold [m]", "upper end by the events alone"]
    assert [cells(text, row)[0] for row in (1, 2)] == ["0.1", "0.12"]
    assert [float(cells(text, row)[4]) for row in (1, 2)] == pytest.approx(list(found.upper_by_events), rel=5e-3)
    assert float(cells(text, 1)[1]) == pytest.approx(found.probability[0], rel=5e-3)
    assert text.endswith("The probability contains " + found.uncertainty + ".")
    alone = str(exceedance(predicted["peak"], 0.1, noise=False))
    assert cells(alone, 0)[0] == "threshold [m]" and "events" not in alone
    assert cells(str(exceedance([0.1, 0.2], 0.15, noise=False)), 0)[0] == "threshold [SI]"
    assert cells(str(exceedance([0.1, 0.2], 15.0, unit="cm", noise=False)), 0)[0] == "threshold [m]"
    records = [RECORD.scale(factor) for factor in (0.5, 1.0, 2.0)]
    predictions = under(records, Flexible(RECORD), np.linspace(-0.5, 0.5, 41)[:, None])
    curve = fragility(predictions, strongest(records), 2.0, unit="cm", ratios=RATIOS, seed=1)
    text = str(curve)
    assert text.startswith("Probability to exceed 0.02 m\n") and cells(text, 1)[0] == "intensity"
    assert [float(cells(text, row)[1]) for row in (2, 3, 4)] == pytest.approx(
        list(curve.exceedance.probability), rel=5e-3
    )
    assert f"lognormal fragility curve: median {curve.curve.median:.3g}" in text and "array" not in text
    assert text.endswith(f"The probabilities contain {curve.exceedance.uncertainty}.")
    alone = str(fit_fragility([1.0, 2.0, 3.0], [1, 5, 9], [10, 10, 10]))
    assert alone.count("+-") == 0 and "SI" not in alone


def test_held_out_scores(predicted, rng):
    values = 0.01 * np.exp(0.2 * rng.normal(size=(100, 2)))
    scores = {
        name: HeldOutScore(score_values(["a", "b"], ["cm", "cm"], values, factor * np.array([0.01, 0.011]), 0.9), 0)
        for name, factor in {"first": 1.0, "second": 1.5}.items()
    }
    text = str(HeldOutScores(scores))
    assert cells(text, 0)[:3] == ["event", "a [cm]", "90% interval of a"]
    assert cells(text, 2)[:2] == ["second", "1.5"]
    assert len({len(cells(text, row)) for row in range(3)}) == 1
    assert text.splitlines()[3].startswith("a: within 90%, 1 of 2: 9 to 91 %; within 50%, 1 of 2: 9 to 91 %")
