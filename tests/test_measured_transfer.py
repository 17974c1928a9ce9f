"""Benchmarks of transfer with measured tests: what they say without data, and the scores of a known case."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import Channel, FunctionModel, LogNormal, Measurements, arias_intensity, peak
from tests.benchmarks import measured_columns, measured_tests, measured_transfer


@pytest.mark.parametrize(
    "benchmark", (measured_columns.columns, measured_tests.coupon, measured_tests.frame, measured_tests.meloland)
)
def test_predictions_of_measured_tests_say_where_the_data_are_missing(benchmark, tmp_path, monkeypatch):
    monkeypatch.setattr(measured_transfer, "SHARED", tmp_path)
    (row,) = benchmark()
    assert row.case == "SKIPPED" and row.value is None and str(tmp_path) in row.note


def test_scores_of_a_measured_transfer_prefer_the_noise_that_follows_the_motion(rng):
    """An oscillator that is ten times weaker than in its calibration, with errors of a quarter of the response."""
    time = 0.05 * np.arange(400)
    channels = [Channel("top", "acceleration", "g")]

    def test(amplitude):
        model = FunctionModel(lambda theta: [theta[0] * amplitude * np.sin(5.0 * time)], ["gain"], channels, 0.05, 400)
        response = model.simulate([1.0])
        errors = 0.25 * amplitude * np.sqrt(0.5) * rng.standard_normal(response.shape)
        return model, Measurements(channels, 0.05, response + errors)

    strong, weak = test(10.0), test(1.0)
    fit = measured_transfer.calibrate(*strong, {"gain": LogNormal(1.0, 0.5)}, 5.0, 1, walkers=100)
    numbers = {"peak": peak("top"), "energy": arias_intensity("top")}
    ratios = measured_transfer.ratios_of(fit, strong[0], numbers)
    assert ratios["energy"] == pytest.approx(1.0 + 0.25**2, abs=0.03)  # the measured energy contains the errors
    case = measured_transfer.Case("weak", *weak, slice(None), numbers)
    rows, scored = measured_transfer.score_case(case, fit, 1.0, ratios, None, 1)
    found = {row.what: row.value for row in rows}
    ideal = 0.25 * np.sqrt(0.5) * 2.0 * (stats.norm.ppf(0.95) + stats.norm.pdf(1.645) / 0.05 - stats.norm.ppf(0.95))
    rms = np.sqrt(np.mean(weak[1].values ** 2))
    assert found["interval score / RMS, relative"] == pytest.approx(ideal / rms, rel=0.15)
    assert found["interval score / RMS, SI"] > 5.0 * found["interval score / RMS, relative"]
    assert scored["relative"].within.all() and not scored["SI"].within.any()
    assert measured_transfer.within([scored])[0].note.startswith("of 2;")
