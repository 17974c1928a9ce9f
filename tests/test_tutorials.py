"""Every tutorial runs from top to bottom (`FAST=1`) and leaves what it promises."""

import csv
import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def run_tutorial(name: str, *arguments: str) -> str:
    """Output of a tutorial in its fast setting."""
    done = subprocess.run(
        [sys.executable, ROOT / "tutorials" / name, *arguments],
        env=os.environ | {"FAST": "1"},
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def oscillator(tmp_path_factory) -> Path:
    """Results of the ten-minute introduction."""
    out = tmp_path_factory.mktemp("oscillator")
    run_tutorial("01_linear_oscillator.py", "--out", str(out))
    return out


def test_three_samplers_agree_with_integrals_on_a_grid(oscillator):
    result = json.loads((oscillator / "summary.json").read_text())
    assert set(result["samplers"]) == {"emcee", "SMC", "TMCMC"}
    grid, truth = np.array(result["grid"]), np.array(result["truth"])
    for name, run in result["samplers"].items():
        mean, sd, error = (np.array(run[key]) for key in ("mean", "sd", "mean_error"))
        assert np.all(error < 0.1 * sd), f"{name}: a larger error would not say much"
        assert np.all(np.abs(mean - grid) < 4.0 * error), name
        assert np.all(np.abs(grid - truth) < 4.0 * sd)
    for name in ("SMC", "TMCMC"):
        run = result["samplers"][name]
        assert 0.0 < run["log_evidence_error"] < 0.1
        assert abs(run["log_evidence"] - result["log_evidence_grid"]) < 4.0 * run["log_evidence_error"], name
    assert result["coverage"] == pytest.approx([0.9, 0.9], abs=0.04)  # of 800 samples: 4 standard errors


def test_introduction_leaves_its_figures(oscillator):
    for name in ("record", "measurements", "corner", "fit", "prediction"):
        assert (oscillator / f"{name}.png").stat().st_size > 10_000, name


@pytest.fixture(scope="module")
def column(tmp_path_factory) -> Path:
    """Results of the bridge column."""
    out = tmp_path_factory.mktemp("column")
    assert "REDUCED SETTING" in run_tutorial("02_bridge_column.py", "--classes", "--out", str(out))
    return out


def test_bridge_column_compares_classes_of_models(column):
    """The data were made with the corotational geometry and with softening."""
    evidence = json.loads((column / "summary.json").read_text())["log_evidence_of_classes"]
    assert max(evidence, key=evidence.get) == "as updated"
    assert "as updated" in (column / "classes.txt").read_text()


def test_bridge_column_leaves_tables_and_figures(column):
    figures = {"fig3_data.png", "fig4_pair.png", "corner.png", "fig5_response.png", "ladder.png"}
    tables = {"table2.txt", "table2.csv", "ladder.txt", "summary.json", "posterior.nc", "chain.h5"}
    for name in figures | tables:
        assert (column / name).stat().st_size > 200, name
    with (column / "table2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["Parameter"] for row in rows[:5]] == ["Ec", "Es", "a0", "a1", "ft"]
    assert len(rows) == 7


def test_bridge_column_updating_explains_the_data(column):
    summary = json.loads((column / "summary.json").read_text())
    before, after = summary["rrmse"].values()
    assert before["displacement"] > 0.8
    assert after["displacement"] < 0.25
    # one sample in sixteen and long steps: Ec is biased, yet far from its nominal value of 1 and near the truth of .59
    assert summary["posterior_mean"]["Ec"] == pytest.approx(0.59, abs=0.06)
    assert summary["failures"] < 0.01 * summary["simulations"]


def test_bridge_column_data_can_be_read_by_arviz(column):
    import arviz

    data = arviz.from_netcdf(column / "posterior.nc")
    assert set(data.posterior.data_vars) >= {"Ec", "sigma_displacement"}


def test_bridge_column_on_another_record(shared, tmp_path):
    record = shared / "records" / "loma_prieta_1989_apeel2_redwood_city_133.csv"
    output = run_tutorial("02_bridge_column.py", "--record", str(record), "--scale", "0.85", "--out", str(tmp_path))
    assert "x 0.85" in output and "SYNTHETIC" in output
    assert json.loads((tmp_path / "summary.json").read_text())["rrmse"]["Before updating (reported values)"]


@pytest.fixture(scope="module")
def bridge(tmp_path_factory) -> Path:
    """Results of the isolated bridge."""
    out = tmp_path_factory.mktemp("bridge")
    assert "SYNTHETIC, nominal values assumed" in run_tutorial("03_isolated_bridge.py", "--out", str(out))
    return out


def test_isolated_bridge_leaves_tables_and_figures(bridge):
    figures = {"fig5_parameters_and_fit", "fig6_marginals", "fig7_predictions", "corner", "ladder", "fragility"}
    tables = {"parameters.txt", "ladder.txt", "summary.json", "posterior.nc", "chain.h5"}
    for name in {f"{figure}.png" for figure in figures} | tables:
        assert (bridge / name).stat().st_size > 200, name


def test_isolated_bridge_is_found_and_predicts(bridge):
    summary = json.loads((bridge / "summary.json").read_text())
    # few samples: the well-known parameters are near their truth, which is not the nominal value
    for name, tolerance in (("fmin_1", 0.02), ("df_1", 0.05), ("C0_1", 0.03)):
        assert summary["posterior_mean"][name] == pytest.approx(summary["truth"][name], abs=tolerance)
    assert summary["posterior_mean"]["sigma"] == pytest.approx(0.05, rel=0.1)
    assert max(summary["rrmse"].values()) < 0.07  # the noise alone makes .05
    assert summary["log_evidence"] > summary["log_evidence_constant_friction"] + 1000.0
    probability = dict(zip(summary["fragility"]["intensity"], summary["fragility"]["probability"], strict=True))
    assert probability[min(probability)] <= probability[max(probability)]
    assert summary["failures"] == 0


@pytest.mark.parametrize("pool", ["local", "dask"])
def test_own_models_agree_and_are_simulated_once(pool, tmp_path):
    if pool == "dask":
        pytest.importorskip("distributed", reason="NO DISTRIBUTED: install it to test this engine")
    results = []
    for used in (pool, "none"):  # the second run needs no pool
        run_tutorial("05_your_own_model.py", "--pool", used, "--out", str(tmp_path))
        results.append(json.loads((tmp_path / "summary.json").read_text()))
    first, second = results
    assert set(first) >= {"function", "program"}
    assert first["program"]["mean"] == first["function"]["mean"], "the program prints all digits"
    for name, run in first.items():
        assert run["simulations"] > 100 and not run["failures"]
        assert second[name]["simulations"] == 0, "a second run finds all in the cache"
        assert second[name]["mean"] == run["mean"]
        assert run["mean"][0] == pytest.approx(1.15, abs=0.02)
        assert run["mean"][1] == pytest.approx(0.85, abs=0.02)
    for name in ("corner.png", "loops.png"):
        assert (tmp_path / name).stat().st_size > 1000


def test_comparison_run_twice_simulates_once(tmp_path):
    arguments = ("--problem", "bridge", "--cache", str(tmp_path / "simulations.db"))
    outputs = [run_tutorial("04_compare_samplers.py", *arguments, "--out", str(tmp_path)) for _ in range(2)]
    assert "WARNS: the points remember" in outputs[0]
    assert "\n0 simulations in all" not in outputs[0]
    assert "\n0 simulations in all" in outputs[1]
    results = json.loads((tmp_path / "comparison.json").read_text())
    assert results["bridge"]["SMC"]["mean"][0] == pytest.approx(1.15, abs=0.03)
    assert (tmp_path / "corner_bridge.png").stat().st_size > 1000


def test_real_bridge_predicts_and_its_errors_are_not_white(shared, tmp_path):
    """Meloland: the two supports win, the channels that were not used come out, white noise is three times too sure."""
    output = run_tutorial(
        "06_real_bridges.py", "--bridge", "meloland", "--data", str(shared / "measured"), "--out", str(tmp_path)
    )
    assert "two supports" in output
    result = json.loads((tmp_path / "summary.json").read_text())["meloland"]
    assert result["posterior_mean"]["white"]["frequency"] == pytest.approx(3.72, abs=0.05)
    assert result["posterior_mean"]["white"]["share"] == pytest.approx(0.815, abs=0.03)
    assert result["lag_one"] == pytest.approx(0.90, abs=0.02)
    assert 100 < result["n_effective"] < 180 and result["n_steps"] == 1138
    assert 1.8 < result["posterior_sd"]["n_eff"]["frequency"] / result["posterior_sd"]["white"]["frequency"] < 5.0
    for evidence in result["log_evidence"].values():
        assert max(evidence, key=evidence.get) == "two supports"
    white, corrected = (result["log_evidence"][noise] for noise in ("white", "n_eff"))
    assert white["two supports"] - white["ends only"] > 60.0, "far too sure"
    assert 5.0 < corrected["two supports"] - corrected["ends only"] < 30.0
    rows = {(row["case"], row["channel"]): row for row in result["predictions"] if row["noise"] == "n_eff"}
    assert rows["calibrated", "ch7"]["rrmse"] == pytest.approx(0.150, abs=0.01)
    unused = rows["unused channels", "ch9"]
    assert unused["rrmse"] == pytest.approx(0.114, abs=0.015) and unused["rrmse"] < 0.7 * unused["rrmse_of_the_end"]
    assert 0.85 < unused["coverage"] <= 1.0
    for figure in ("data", "corner", "residuals", "prediction"):
        assert (tmp_path / f"meloland_{figure}.png").stat().st_size > 10_000


def test_real_frame_predicts_other_shakings(shared, tmp_path):
    run_tutorial("07_shake_table_frame.py", "--data", str(shared / "measured"), "--out", str(tmp_path))
    result = json.loads((tmp_path / "summary.json").read_text())
    assert max(result["n_effective"]) < 0.1 * result["n_steps"], "lightly damped residuals last"
    rows = {(row["shaking"], row["channel"]): row for row in result["predictions"] if row["noise"] == "n_eff"}
    assert rows["shaking 1", "floor2"]["kind"] == "prediction"
    assert all(rows[f"shaking {k}", "floor2"]["rrmse"] < 0.2 for k in (1, 2, 3))
    assert rows["shaking 3", "floor2"]["coverage"] > 0.8
    for name in ("data", "corner", "residuals", "calibration", "prediction"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_real_data_say_where_they_come_from(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(ROOT / "tutorials"))
    real_data = importlib.import_module("real_data")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "records_ce01336p.zip").touch()
    assert real_data.find(tmp_path, "*ce01336p.zip", "CESMD").name == "records_ce01336p.zip"
    with pytest.raises(SystemExit, match="NO DATA.*get it from CESMD.*--data"):
        real_data.find(tmp_path, "*ce89324p.zip", "CESMD")
    monkeypatch.setattr(real_data, "BESIDE", tmp_path / "nowhere")
    with pytest.raises(SystemExit) as ended:  # nobody asked for that folder: all tutorials in a row must go on
        real_data.find(None, "*ce01336p.zip", "CESMD")
    assert ended.value.code == 0
    assert "NO DATA" in capsys.readouterr().out


def test_real_column_is_calibrated_and_predicts(shared, tmp_path):
    """Lehman 415 on its first half, then its second half and another column; the data stay where they are."""
    data = shared / "measured" / "rc_column_cyclic"
    output = run_tutorial("08_cyclic_column.py", "--data", str(data), "--out", str(tmp_path))
    # the table of nominal values: the slip of the bars explains half of the error, and the force is without P-Delta
    lehman, hose = (re.search(rf"{name} .*?((?: +[0-9.]+ %){{4}})", output) for name in ("Lehman 415", "Hose SRPH1"))
    lehman, hose = ([float(value) for value in re.findall("[0-9.]+", found[1])] for found in (lehman, hose))
    assert lehman == pytest.approx([20.3, 10.6, 19.9, 12.1], abs=0.3)
    assert hose == pytest.approx([11.6, 8.7, 21.1, 22.4], abs=0.3)
    summary = json.loads((tmp_path / "summary.json").read_text())
    parts = summary["predictions"]
    assert parts["Lehman 415, first half"]["white"]["rrmse"] < 0.095 < parts["Lehman 415, first half"]["nominal"]
    assert parts["Hose SRPH1, second half, to failure"]["white"]["rrmse"] < 0.15
    assert parts["Lehman 415, after failure"]["white"]["rrmse"] > 1.0, "bars do not break in this model"
    assert summary["sigma"]["white"] > 10.0 * summary["sensor"], "the error is the model's, not the sensor's"
    for name in ("data", "corner", "residuals_white", "residuals_ar1", "loops_white", "loops_ar1"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000, name


def test_real_steel_is_calibrated_and_predicts(shared, tmp_path):
    """White noise makes too narrow bands, errors that last wider ones; the innovations of the latter are white."""
    data = shared / "measured" / "steel_coupon"
    run_tutorial("09_steel_coupon.py", "--data", str(data), "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["lag_one"]["white"] > 0.7 and abs(summary["lag_one"]["AR(1)"]) < 3.0 / 170**0.5
    assert summary["n_effective"] < 0.2 * summary["samples"] == 0.2 * 171
    half, rest = summary["predictions"]["first half"], summary["predictions"]["second half"]
    assert half["white"]["rrmse"] < 0.065 < half["nominal"] and rest["AR(1)"]["rrmse"] < 0.085 < rest["nominal"]
    assert rest["white"]["coverage"] < 0.8 < rest["AR(1)"]["coverage"] < 0.97
    assert summary["sd"]["AR(1)"]["Esh"] > 1.5 * summary["sd"]["white"]["Esh"]
    for name in ("corner", "residuals_white", "residuals_ar1", "loops"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000, name


def test_a_tutorial_without_its_data_says_where_to_get_them(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "tutorials" / "09_steel_coupon.py", "--data", tmp_path, "--out", tmp_path / "out"],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 1 and not (tmp_path / "out").exists()
    assert "NO DATA" in done.stderr and "GitHub" in done.stderr and "Traceback" not in done.stderr
