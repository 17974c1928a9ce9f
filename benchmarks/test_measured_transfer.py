"""Benchmarks of transfer with measured tests: what they say without data, and the scores of a known case."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks import (
    failing_columns,
    measured_columns,
    measured_tests,
    measured_transfer,
    strain_penetration,
    tested_column,
)
from fe_likelihoods import (
    Channel,
    DisplacementHistory,
    FunctionModel,
    GaussianNoise,
    LogNormal,
    LowCycleFatigue,
    Measurements,
    RCColumn,
    arias_intensity,
    peak,
)

BENCHMARKS = (
    measured_columns.columns,
    strain_penetration.evidence,
    measured_tests.coupon,
    measured_tests.frame,
    measured_tests.meloland,
)
PROPERTIES = {  # a made-up column [in, kip, ksi]
    "L (in)": 100.0,
    "D (in)": 20.0,
    "c (in)": 1.0,
    "fc (ksi)": -5.0,
    "ft (ksi)": 0.3,
    "Ec (ksi)": 4000.0,
    "nsl": 12,
    "dbl (in)": 0.75,
    "fyl (ksi)": 60.0,
    "ful (ksi)": 90.0,
    "esy": 0.002,
    "esh": 0.01,
    "esu": 0.1,
    "Esl (ksi)": 29000.0,
    "Esh (ksi)": 900.0,
    "dbt (in)": 0.375,
    "fyt (ksi)": 60.0,
    "s (in)": 2.0,
    "P (kips)": 100.0,
    "Sy": 0.016,
}


@pytest.mark.parametrize("benchmark", BENCHMARKS)
def test_predictions_of_measured_tests_say_where_the_data_are_missing(benchmark, tmp_path, monkeypatch):
    monkeypatch.setattr(measured_transfer, "SHARED", tmp_path)
    (row,) = benchmark()
    assert row.case == "SKIPPED" and row.value is None and str(tmp_path) in row.note


def test_further_column_tests_are_found_by_their_row_in_the_table(tmp_path, monkeypatch):
    """Units, hoops and geometry come from the table; files that cannot be used say why."""
    rows = [
        PROPERTIES | {"No.": 13, "Test": "Lehman_415", "TSN": 2017},
        PROPERTIES | {"No.": 25, "Test": "Other_A5", "TSN": 2011, "L (in)": 40.0},
        PROPERTIES | {"No.": 14, "Test": "Lehman_815", "TSN": 2018, "esu": ""},
        PROPERTIES | {"No.": 18, "Test": "Mixed_units", "TSN": 2022, "Ec (ksi)": 4.0},
    ]
    lines = [",".join(rows[0]), *(",".join(str(row[key]) for key in rows[0]) for row in rows)]
    (tmp_path / tested_column.PROPERTIES).write_text("\n".join(lines))
    history = [f"{2.0 * np.sin(0.1 * i):.4f},{30.0 * np.sin(0.1 * i):.4f}" for i in range(200)]
    for name in ("2017_Lehman_415", "2011_Other_A5", "2018_Lehman_815", "2022_Mixed_units", "2099_Unknown"):
        (tmp_path / f"{name}.csv").write_text("\n".join(["disp_in,force_kip", *history]))
    (tmp_path / "2017_Lehman_415.txt").write_text("not a table")
    monkeypatch.setattr(tested_column, "FOLDER", tmp_path)
    found = tested_column.specimens()
    assert [each.name for each in found.specimens] == ["Lehman 415", "Other A5"]
    first, other = (each.model for each in found.specimens)
    assert (first.geometry, other.geometry) == ("linear", "corotational")
    assert first.height == pytest.approx(2.54)
    assert other.height / other.diameter == pytest.approx(2.0)
    assert first.hoops.spacing == pytest.approx(0.0508)
    assert first.penetration == pytest.approx(8.0 * 0.0254)
    assert np.abs(first.loading.displacement).max() == pytest.approx(0.0508, rel=1e-3)
    assert list(found.skipped) == ["2018_Lehman_815.csv", "2022_Mixed_units.csv", "2099_Unknown.csv"]
    incomplete, mixed, unknown = found.skipped.values()
    assert "no 'esu' of Lehman_815" in incomplete
    assert "modulus ec above the strength" in mixed
    assert "no row whose TSN and Test make the name '2099_Unknown'" in unknown


def test_coefficients_of_fatigue_are_found_and_predict_another_series(tmp_path, monkeypatch):
    """Synthetic tests of one column whose bars have known coefficients."""
    amplitudes = [sign * drift for drift in np.arange(0.02, 0.125, 0.01) for sign in (1.0, -1.0)]
    drift = np.interp(np.arange(0.0, len(amplitudes) + 1.0, 0.1), np.arange(len(amplitudes) + 1), [0.0, *amplitudes])
    history = DisplacementHistory("cycles", 7.3152 * drift)
    options = {"penetration": 0.3, "geometry": "linear", "mesh": 8, "max_increment": 0.05}
    column = RCColumn.lhpost(history, parameters=("Ec",), **options)

    def test(name, cf):
        force = replace(column, fatigue=LowCycleFatigue(cf=cf)).simulate([1.0])
        return tested_column.Specimen(name, column, Measurements(column.channels, column.dt, 1.1 * force), {})

    truth = {"One A": 0.14, "One B": 0.16, "Two": 0.22}
    found = tested_column.Found(tuple(test(*each) for each in truth.items()), {"x.csv": "no row"})
    monkeypatch.setattr(tested_column, "FOLDER", tmp_path)
    monkeypatch.setattr(tested_column, "specimens", lambda every: found)
    rows = failing_columns.failing_columns(draws=10)
    assert (rows[0].case, rows[0].note) == ("LEFT OUT", "x.csv: no row")
    for name, cf in truth.items():
        (row,) = (row for row in rows if (row.what, row.case) == ("Cf", name))
        earlier, later = map(float, row.note.split(" to "))
        assert earlier <= cf <= later and earlier < row.value < later < 1.25 * earlier
    middle = (np.prod([np.sqrt(0.14 * 0.16), 0.22, 0.26])) ** (1 / 3)
    (row,) = (row for row in rows if row.what == "median Cf of a new column")
    assert row.value == pytest.approx(middle, rel=0.06)
    (row,) = (row for row in rows if (row.what, row.case) == ("peak force within 50%", "without its series"))
    assert row.value == 1.0 and row.note.startswith("3 of 3: "), "all forces are 1.1 times the simulated ones"
    monkeypatch.setattr(tested_column, "specimens", lambda every: found._replace(specimens=found.specimens[:2]))
    *_, last = failing_columns.failing_columns(draws=10)
    assert last.case == "SKIPPED" and str(tmp_path) in last.note


def test_scores_of_a_measured_transfer_prefer_the_noise_that_follows_the_motion(rng, monkeypatch):
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
    noise = GaussianNoise(channels, level="response", window=1.0, sensor=[1e-3])
    modulated = measured_transfer.calibrate(*strong, {"gain": LogNormal(1.0, 0.5)}, 5.0, 1, noise=noise, walkers=100)
    case = measured_transfer.Case("weak", *weak, slice(None), numbers, noise)
    runs = 0

    def counted(model, theta, simulate=FunctionModel.simulate):
        nonlocal runs
        runs += 1
        return simulate(model, theta)

    monkeypatch.setattr(FunctionModel, "simulate", counted)
    rows, scored = measured_transfer.score_case(case, fit, modulated, ratios, 1)
    assert runs == len(np.unique(np.concatenate([fit.structure, modulated.structure]))), "each is simulated once"
    found = {row.what: row.value for row in rows}
    ideal = 0.25 * np.sqrt(0.5) * 2.0 * (stats.norm.ppf(0.95) + stats.norm.pdf(1.645) / 0.05 - stats.norm.ppf(0.95))
    rms = np.sqrt(np.mean(weak[1].values ** 2))
    assert found["interval score / RMS, relative"] == pytest.approx(ideal / rms, rel=0.15)
    assert found["interval score / RMS, modulated"] == pytest.approx(ideal / rms, rel=0.15)
    assert found["interval score / RMS, SI"] > 5.0 * found["interval score / RMS, relative"]
    assert scored["relative"].within.all() and not scored["SI"].within.any()
    assert set(scored) == {"SI", "relative", "relative, model", "window", "modulated", "modulated, model", "ratios"}
    for way in ("relative", "modulated"):  # independent errors add to the largest value
        assert scored[f"{way}, model"].median[0] < scored[way].median[0]
    assert measured_transfer.within([scored])[0].note.startswith("0 of 2: 0 to 66 %; mean width")
