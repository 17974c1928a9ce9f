"""Every tutorial runs from top to bottom with ``FAST=1``, saves its figures, and finds known numbers.

Only the first runs with the quick tests.
"""

import ast
import contextlib
import csv
import importlib
import importlib.util
import io
import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.opensees_column import require_opensees
from tests.scripts import run_script

ROOT = Path(__file__).parents[1]
TUTORIALS = sorted((ROOT / "tutorials").glob("[0-9]*.py"))


def run_tutorial(name: str, *arguments: str) -> str:
    """Output of a tutorial in its fast setting, run in this process; the folder after ``--out`` has its results."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        run_script(ROOT / "tutorials" / name, *arguments, FAST="1")
    assert list(Path(arguments[arguments.index("--out") + 1]).glob("*.png"))
    return output.getvalue()


# 01


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
        assert np.all(error < 0.1 * sd), f"{name}: with a larger error the comparison would mean little"
        assert np.all(np.abs(mean - grid) < 4.0 * error), name
        assert np.all(np.abs(grid - truth) < 4.0 * sd)
    for name in ("SMC", "TMCMC"):
        run = result["samplers"][name]
        assert 0.0 < run["log_evidence_error"] < 0.1
        assert abs(run["log_evidence"] - result["log_evidence_grid"]) < 4.0 * run["log_evidence_error"], name
    assert result["coverage"] == pytest.approx([0.9, 0.9], abs=0.04)  # 800 samples: 4 standard errors


# 02


@pytest.fixture(scope="module")
def column(tmp_path_factory) -> Path:
    """Results of the bridge column."""
    out = tmp_path_factory.mktemp("column")
    assert "REDUCED SETTING" in run_tutorial("02_bridge_column.py", "--out", str(out))
    return out


@pytest.mark.slow
def test_bridge_column_compares_model_classes(tmp_path):
    """The data were made with the corotational geometry and with softening."""
    run_tutorial("02_bridge_column.py", "--classes", "--out", str(tmp_path))
    evidence = json.loads((tmp_path / "summary.json").read_text())["log_evidence_of_classes"]
    assert max(evidence, key=evidence.get) == "as updated"
    assert "as updated" in (tmp_path / "classes.txt").read_text()


@pytest.mark.slow
def test_bridge_column_writes_its_tables(column):
    with (column / "table2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["Parameter"] for row in rows[:5]] == ["Ec", "Es", "a0", "a1", "ft"]
    assert len(rows) == 7 and rows[0]["Reported value"] == "3320 ksi"
    assert len((column / "table2.txt").read_text().splitlines()) == 8
    stages = json.loads((column / "summary.json").read_text())["stages"]
    assert len(re.findall(r"(?m)^ *\d+ +\d\.\d+e", (column / "ladder.txt").read_text())) == stages
    import arviz

    data = arviz.from_netcdf(column / "posterior.nc")
    assert set(data.posterior.data_vars) >= {"Ec", "sigma_displacement"}
    assert (column / "chain.h5").is_file()


@pytest.mark.slow
def test_bridge_column_updating_explains_the_data(column):
    summary = json.loads((column / "summary.json").read_text())
    before, after = summary["rrmse"].values()
    assert before["displacement"] > 0.8
    assert after["displacement"] < 0.25
    # one sample in sixteen and long steps: Ec is biased, yet far from its nominal value 1 and near the true 0.59
    assert summary["posterior_mean"]["Ec"] == pytest.approx(0.59, abs=0.06)
    assert summary["failures"] < 0.01 * summary["simulations"]


@pytest.mark.slow
def test_bridge_column_on_another_record(shared, tmp_path):
    """The first part of a recorded motion; no number is checked, so few walkers are enough."""
    whole = shared / "records" / "loma_prieta_1989_apeel2_redwood_city_133.csv"
    record = tmp_path / whole.name
    lines = whole.read_text().splitlines(keepends=True)[:2400]
    record.write_text("".join(lines).replace("npts = 7183; ", ""))
    options = ("--record", str(record), "--scale", "0.85", "--walkers", "20")
    output = run_tutorial("02_bridge_column.py", *options, "--out", str(tmp_path))
    assert "x 0.85" in output and "SYNTHETIC" in output
    assert json.loads((tmp_path / "summary.json").read_text())["rrmse"]["Before updating (reported values)"]


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_main_job_has_the_evidence_and_the_posterior_of_the_annealing(tmp_path):
    """`make update` uses a guide and a tenth of the simulations."""
    runs = {}
    for name, options in {"guide": (), "annealing": ("--no-guide", "--walkers", "200")}.items():
        out = tmp_path / name
        output = run_tutorial("02_bridge_column.py", "--preset", "reduced", "--out", str(out), *options)
        runs[name] = json.loads((out / "summary.json").read_text())
        assert runs[name]["verdict"].capitalize() in output
    guide, annealing = runs["guide"], runs["annealing"]
    assert guide["verdict"] != "not usable"
    assert 10.0 * guide["simulations"] < annealing["simulations"]
    error = np.hypot(guide["log_evidence_error"], annealing["log_evidence_error"])
    assert abs(guide["log_evidence"] - annealing["log_evidence"]) < 4.0 * error < 1.0
    for name, mean in annealing["posterior_mean"].items():
        sd = annealing["posterior_sd"][name]
        assert guide["posterior_mean"][name] == pytest.approx(mean, abs=0.5 * sd), name
        assert guide["posterior_sd"][name] == pytest.approx(sd, rel=0.4), name


# 03


@pytest.fixture(scope="module")
def bridge(tmp_path_factory) -> Path:
    """Results of the isolated bridge with a guide, which needs a tenth of the simulations."""
    out = tmp_path_factory.mktemp("bridge")
    # with the long steps of the fast setting, some draws fail
    output = run_tutorial("03_isolated_bridge.py", "--sampler", "guide", "--step", "1e-3", "--out", str(out))
    assert "SYNTHETIC, nominal values assumed" in output
    return out


@pytest.mark.slow
def test_isolated_bridge_is_found_by_annealing(tmp_path):
    """The default sampler of the tutorial."""
    run_tutorial("03_isolated_bridge.py", "--step", "1e-3", "--out", str(tmp_path))
    assert json.loads((tmp_path / "summary.json").read_text())["sampler"] == "tmcmc"
    test_isolated_bridge_is_found_and_predicts(tmp_path)
    test_isolated_bridge_writes_its_tables(tmp_path)


@pytest.mark.slow
def test_isolated_bridge_is_found_and_predicts(bridge):
    summary = json.loads((bridge / "summary.json").read_text())
    # few samples: the well-known parameters are near their truth, which is not the nominal value
    for name, tolerance in (("fmin_1", 0.02), ("df_1", 0.05), ("C0_1", 0.03)):
        assert summary["posterior_mean"][name] == pytest.approx(summary["truth"][name], abs=tolerance)
    assert summary["posterior_mean"]["sigma"] == pytest.approx(0.05, rel=0.1)
    assert max(summary["rrmse"].values()) < 0.07  # the noise alone makes 0.05
    assert summary["log_evidence"] > summary["log_evidence_constant_friction"] + 1000.0
    probability = dict(zip(summary["fragility"]["intensity"], summary["fragility"]["probability"], strict=True))
    assert probability[min(probability)] <= probability[max(probability)]
    assert summary["failures"] == 0


@pytest.mark.slow
def test_isolated_bridge_writes_its_tables(bridge):
    lines = (bridge / "parameters.txt").read_text().splitlines()
    assert lines[0].split()[:4] == ["parameter", "truth", "mean", "sd"] and len(lines) == 12
    stages = json.loads((bridge / "summary.json").read_text())["stages"]
    assert len(re.findall(r"(?m)^ *\d+ +\d\.\d+e", (bridge / "ladder.txt").read_text())) == stages
    import arviz

    assert "fmin_1" in arviz.from_netcdf(bridge / "posterior.nc").posterior
    assert (bridge / "chain.h5").is_file()


# 04


@pytest.mark.slow
def test_comparison_run_twice_simulates_once(tmp_path):
    arguments = ("--problem", "bridge", "--cache", str(tmp_path / "simulations.db"))
    outputs = [run_tutorial("04_compare_samplers.py", *arguments, "--out", str(tmp_path)) for _ in range(2)]
    assert "warning of TMCMC as published: " in outputs[0]
    assert "\n0 simulations in total" not in outputs[0]
    assert "\n0 simulations in total" in outputs[1]
    results = json.loads((tmp_path / "comparison.json").read_text())["bridge"]
    assert results["SMC"]["mean"][0] == pytest.approx(1.15, abs=0.03)
    assert results["TMCMC as published"]["warnings"] and results["emcee from the prior"]["warnings"]

    guided = results["SMC with a guide"]
    assert guided["verdict"] != "not usable" and guided["mean"][0] == pytest.approx(1.15, abs=0.03)
    assert 3.0 * guided["simulations"] < results["SMC"]["simulations"]
    assert f"verdict of SMC with a guide: {guided['verdict'].capitalize()}" in outputs[0]


# 05


@pytest.mark.slow
@pytest.mark.parametrize("pool", ["local", "dask"])
def test_own_models_agree(pool, tmp_path):
    """Workers of dask are tested in `tests/faults/test_executors_faults.py` as well."""
    if pool == "dask":
        pytest.importorskip("distributed", reason="NO DISTRIBUTED: install it to test this executor")
    if importlib.util.find_spec("openseespy"):  # the tutorial leaves OpenSees out only where it is not installed
        require_opensees()
    run_tutorial("05_your_own_model.py", "--pool", pool, "--out", str(tmp_path))
    results = json.loads((tmp_path / "summary.json").read_text())
    assert set(results) >= {"function", "program"}
    assert results["program"]["mean"] == results["function"]["mean"], "the program prints all digits"
    for run in results.values():
        assert run["simulations"] > 100 and not run["failures"]
        assert run["mean"][0] == pytest.approx(1.15, abs=0.02)
        assert run["mean"][1] == pytest.approx(0.85, abs=0.02)


# 06 to 09


@pytest.mark.slow
def test_real_bridge_predicts_and_its_errors_are_not_white(shared, tmp_path):
    """Meloland: two supports win, unused channels are predicted, white noise makes the posterior too narrow."""
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
    assert white["two supports"] - white["ends only"] > 60.0, "far too certain"
    assert 5.0 < corrected["two supports"] - corrected["ends only"] < 30.0
    rows = {(row["case"], row["channel"]): row for row in result["predictions"] if row["noise"] == "n_eff"}
    assert rows["calibrated", "ch7"]["rrmse"] == pytest.approx(0.150, abs=0.01)
    unused = rows["unused channels", "ch9"]
    assert unused["rrmse"] == pytest.approx(0.114, abs=0.015) and unused["rrmse"] < 0.7 * unused["rrmse_of_the_end"]
    assert 0.85 < unused["coverage"] <= 1.0


@pytest.mark.slow
def test_real_frame_predicts_other_shakings(shared, tmp_path):
    run_tutorial("07_shake_table_frame.py", "--data", str(shared / "measured"), "--out", str(tmp_path))
    result = json.loads((tmp_path / "summary.json").read_text())
    assert max(result["n_effective"]) < 0.1 * result["n_steps"], "residuals of lightly damped modes are correlated"
    rows = {(row["shaking"], row["channel"]): row for row in result["predictions"] if row["noise"] == "n_eff"}
    assert rows["shaking 1", "floor2"]["kind"] == "prediction"
    assert all(rows[f"shaking {k}", "floor2"]["rrmse"] < 0.2 for k in (1, 2, 3))
    assert rows["shaking 3", "floor2"]["coverage"] > 0.8


@pytest.mark.slow
def test_real_column_is_calibrated_and_predicts(shared, tmp_path):
    """Lehman 415 is calibrated on its first half; its second half and another column are predicted."""
    data = shared / "measured" / "rc_column_cyclic"
    output = run_tutorial("08_cyclic_column.py", "--data", str(data), "--out", str(tmp_path))
    # table of nominal values: the slip of the bars explains half of the error, and the force is without P-Delta
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
    after_peak = {name: found["rrmse"] for name, found in summary["failure"].items()}
    assert set(after_peak) == {"Lehman 415", "Hose SRPH1", "Lehman 407", "Lehman 1015"}
    assert all(errors["literature"] < errors["no failure"] for errors in after_peak.values())
    assert after_peak["Lehman 415"]["0.15"] < 0.4 * after_peak["Lehman 415"]["no failure"]
    assert after_peak["Hose SRPH1"]["0.15"] > 2.0 * after_peak["Hose SRPH1"]["no failure"]


@pytest.mark.slow
def test_real_steel_is_calibrated_and_predicts(shared, tmp_path):
    """White noise gives bands that are too narrow, correlated errors give wider ones with white innovations."""
    data = shared / "measured" / "steel_coupon"
    run_tutorial("09_steel_coupon.py", "--data", str(data), "--out", str(tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["lag_one"]["white"] > 0.7 and abs(summary["lag_one"]["AR(1)"]) < 3.0 / 170**0.5
    assert summary["n_effective"] < 0.2 * summary["samples"] == 0.2 * 171
    half, rest = summary["predictions"]["first half"], summary["predictions"]["second half"]
    assert half["white"]["rrmse"] < 0.065 < half["nominal"] and rest["AR(1)"]["rrmse"] < 0.085 < rest["nominal"]
    assert rest["white"]["coverage"] < 0.8 < rest["AR(1)"]["coverage"] < 0.97
    assert summary["sd"]["AR(1)"]["Esh"] > 1.5 * summary["sd"]["white"]["Esh"]


# 10


@pytest.mark.slow
def test_four_earthquakes_damage_a_column(tmp_path):
    """The state that earlier events leave matters. EQ2 informs the yield strength, about which EQ1 says nothing."""
    output = run_tutorial("10_damage.py", "--out", str(tmp_path))
    assert "REDUCED SETTING" in output and "not the error of the model" in output
    assert "interval score" in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    before, after = (np.array(summary["sd"][name]) for name in ("EQ1", "EQ1 and EQ2"))
    assert before[-1] > 0.05 > 0.02 > after[-1], "fy"
    for event in ("EQ2", "EQ3", "EQ4"):
        carried, virgin = (np.array(summary["rrmse"][f"EQ1, {state}, {event}"]) for state in ("end", "virgin"))
        assert (carried < 0.6 * virgin).all()
        carried, virgin = (np.array(summary["coverage"][f"EQ1, {state}, {event}"]) for state in ("end", "virgin"))
        assert (carried > 2.0 * virgin).all()
        carried, virgin = (np.array(summary["interval_score"][f"EQ1, {state}, {event}"]) for state in ("end", "virgin"))
        assert (carried < 0.2 * virgin).all(), "misses, which the width does not show"
    for found in summary["scores"].values():
        assert 0.0 <= found["bands"] <= 1.0 and 0.0 < found["width"] <= found["interval_score"]
    for state, true in summary["presence"]["truth"].items():
        assert set(true) <= {0.0, 1.0} and true == sorted(true) or state == "large residual drift"
    assert summary["presence"]["truth"]["bar yield"] == [0.0, 1.0, 1.0, 1.0] == summary["presence"]["EQ1"]["bar yield"]


# 11


@pytest.mark.slow
def test_many_events_predict_new_ones(tmp_path):
    """The posterior of one event misses new peaks, the population of events does not; amplitude matters."""
    output = run_tutorial("11_many_events.py", "--out", str(tmp_path))
    assert "REDUCED SETTING" in output and "The tests differ in" in output and "propagate warned" in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    usual, events = summary["one event, as usual"], summary["population of events"]
    assert usual["within 90 %"] <= 0.5 <= events["within 90 %"]
    for score in ("CRPS / measured", "interval score / measured"):
        assert events[score] < 0.6 * usual[score]
    assert usual["upper / lower end"] < 1.2 < events["upper / lower end"]
    assert summary["evidence"]["by amplitude"] > summary["evidence"]["constant"] + 50.0
    usual, events = summary["fragility"]["one event, as usual"], summary["fragility"]["population of events"]
    assert events["wrong and certain"] <= usual["wrong and certain"] and 0.0 <= events["Brier score"] < 0.25


# 12


@pytest.mark.slow
def test_the_sensors_at_the_base_are_chosen_and_six_leave_what_was_predicted(tmp_path):
    """Gauges tell less along the column and towards its axis; a strong motion tells of the steel, and none of a1."""
    output = run_tutorial("12_which_sensors.py", "--out", str(tmp_path))
    assert "REDUCED SETTING" in output and "the motion to buy: EQ2" in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"strain@0.15:-0.525", "strain@0.15:0.525", "displacement", "acceleration"} <= set(summary["six"])
    gauges = {
        tuple(map(float, name.removeprefix("strain@").split(":"))): value
        for name, value in summary["information_alone"].items()
        if name.startswith("strain@")
    }
    heights = sorted({height for height, _ in gauges})
    for x in sorted({x for _, x in gauges}):
        assert (np.diff([gauges[height, x] for height in heights]) < 0.0).all(), x
    for height in heights:
        assert min(gauges[height, -0.525], gauges[height, 0.525]) > max(gauges[height, -0.263], gauges[height, 0.263])
    left = {name: dict(zip(summary["labels"], each, strict=False)) for name, each in summary["left_of_motions"].items()}
    assert left["EQ2"]["Es"] < 0.5 * left["EQ1"]["Es"] and min(each["a1"] for each in left.values()) > 0.85
    assert (np.diff(summary["target_left"]) < 0.0).all() and summary["target_left"][-1] < 0.02
    shown = {name: dict(zip(summary["labels"], each, strict=True)) for name, each in summary["sd_left"].items()}
    for sensors in ("six", "all"):
        for name, predicted in shown[f"{sensors}, predicted"].items():
            largest = {"a1": 1.3, "peak displacement": 3.0}.get(name, 2.0)
            ratio = shown[f"{sensors}, obtained"][name] / predicted
            assert 1.0 / largest < ratio < largest, f"{sensors}, {name}: {ratio:.2f}"
        assert np.max(summary["deviations"][sensors]) < 4.0
    assert all(shown["all, predicted"][name] < value for name, value in shown["six, predicted"].items())


# 13


@pytest.mark.slow
def test_damaged_storeys_are_found_and_a_colder_building_causes_no_alarm(tmp_path):
    """The storey, its loss and the temperature are found; two calibrations alone have wrong intervals for others."""
    output = run_tutorial("13_stiffness_loss.py", "--out", str(tmp_path))
    assert "REDUCED SETTING" in output and "P(any loss above 10 %)" in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert max(summary["simulations"].values()) < 150, "both states together below 800"
    assert summary["presence"]["after"] > 0.95 and summary["presence"]["control"] < 0.1
    assert np.argmax(summary["probability"]) == np.argmax(summary["location"]) == 2
    assert np.delete(summary["probability"], 2).max() < 0.1
    assert summary["median"][2] == pytest.approx(summary["truth"][2], abs=0.04)
    assert summary["common"] == pytest.approx(0.97, abs=0.02) and summary["error"] > 1.0


# 14


@pytest.mark.slow
def test_noise_is_worth_nothing_and_the_rates_have_their_closed_form(tmp_path):
    output = run_tutorial("14_decisions.py", "--out", str(tmp_path))
    assert "REDUCED SETTING" in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["sum"] == pytest.approx(1.0, abs=1e-5)
    assert 0.0 < summary["rates"]["replacement"] < summary["rates"]["repair"] < 0.05, "the rate of the weakest motion"
    values = {name: value for name, (value, _) in summary["values"].items()}
    assert max(values.values()) == values["everything"] > 0.0
    assert abs(values["noise"]) <= 4.0 * summary["values"]["noise"][1]


# 15


@pytest.mark.slow
def test_modes_find_the_damaged_storey_and_the_truck_the_stiffness(tmp_path):
    """The modes that were left out are near their intervals, the girder has 0.9 of its stiffness."""
    run_tutorial("15_modes_and_load_tests.py", "--out", str(tmp_path))
    found = json.loads((tmp_path / "summary.json").read_text())
    assert found["losses"][2] > 0.95 and max(found["losses"][:2] + found["losses"][3:]) < 0.05
    mean, deviation = found["girder"]
    assert abs(mean - 0.9) < 4.0 * deviation < 0.02
    low, measured, high = np.array(found["held out"])
    assert (abs(measured - 0.5 * (low + high)) < 1.5 * (high - low)).all()


# the data, and the form of the scripts


@pytest.mark.parametrize("name", [path.name for path in TUTORIALS if "06" <= path.name < "10"])
def test_real_data_must_be_named_and_the_message_says_where_they_come_from(name, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [name, "--out", str(tmp_path / "out")])
    monkeypatch.syspath_prepend(str(ROOT / "tutorials"))
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(str(ROOT / "tutorials" / name), run_name="__main__")
    assert not (tmp_path / "out").exists()
    message = stopped.value.code  # a text: Python prints it on stderr and exits with 1
    assert isinstance(message, str) and "--data is required" in message and "https://" in message


def test_data_files_are_found_at_any_depth(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tutorials"))
    real_data = importlib.import_module("real_data")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "records_ce01336p.zip").touch()
    assert real_data.find_file(tmp_path, "*ce01336p.zip", "CESMD").name == "records_ce01336p.zip"
    with pytest.raises(SystemExit, match="NO DATA.*ce89324p.zip.*Download it from CESMD.*--data"):
        real_data.find_file(tmp_path, "*ce89324p.zip", "CESMD")
    with pytest.raises(SystemExit, match="--data is required.*ce01336p.zip.*CESMD"):
        real_data.find_file(None, "*ce01336p.zip", "CESMD")


def test_tutorials_import_names_that_exist():
    """Most tutorials run with the slow tests only."""
    for path in (ROOT / "tutorials").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (getattr(node, "module", None) or "").partition(".")[0] in ("fe_likelihoods", "samplers"):
                module = importlib.import_module(node.module)
                assert all(hasattr(module, alias.name) for alias in node.names), f"{path.name}: {ast.unparse(node)}"
