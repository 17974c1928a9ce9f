"""Every tutorial runs from top to bottom with ``FAST=1``, finds known numbers, and draws what its text describes."""

import csv
import importlib.util
import json
import os
import pickle
import re
import runpy
import subprocess
import sys
from pathlib import Path

import arviz
import matplotlib

matplotlib.use("Agg")
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fe_likelihoods import from_si, problems, rrmse
from tests.opensees_column import require_opensees

ROOT = Path(__file__).parents[1]
TUTORIALS = sorted((ROOT / "tutorials").glob("[0-9]*.py"))


def run_tutorial(name: str, *arguments: str, timeout: float = 570.0) -> str:
    """Output of a tutorial in its fast setting; its figures are pickled beside the pictures (timeout in seconds)."""
    done = subprocess.run(
        [sys.executable, ROOT / "tests" / "tutorial_runner.py", ROOT / "tutorials" / name, *arguments],
        env=os.environ | {"FAST": "1"},
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(autouse=True)
def no_open_figures():
    """Unpickled figures are registered with pyplot: close them after each test."""
    yield
    pyplot.close("all")


def read_figure(folder: Path, name: str) -> Figure:
    """A figure that a tutorial saved, with the picture beside it."""
    assert (folder / f"{name}.png").is_file()
    return pickle.loads((folder / f"{name}.pickle").read_bytes())


def line(axes: Axes, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Data of the line with a label."""
    (found,) = (line for line in axes.lines if line.get_label().startswith(label))
    return np.asarray(found.get_xdata()), np.asarray(found.get_ydata())


def texts(axes: Axes) -> list[str]:
    """Entries of a legend."""
    return [text.get_text() for text in axes.get_legend().get_texts()]


def inside(axes: Axes, x: float, y: float | None = None) -> bool:
    """Whether a point, or a position on the horizontal axis, is within the limits."""
    (left, right), (bottom, top) = sorted(axes.get_xlim()), sorted(axes.get_ylim())
    return left < x < right and (y is None or bottom < y < top)


def has_vertical_line(axes: Axes, x: float) -> bool:
    return any(len(line.get_xdata()) == 2 and np.allclose(line.get_xdata(), x, rtol=1e-9) for line in axes.lines)


def check_corner(figure: Figure, labels: list[str], truth: list[float] = (), n_posteriors: int = 1) -> None:
    """A corner plot has its labels, draws every posterior, and marks every true value within a panel by a line."""
    n = len(labels)
    grid = np.reshape(np.array(figure.axes, dtype=object), (n, n))
    plain = ["".join(label.split()) for label in labels]  # long labels are broken into lines
    assert ["".join(axes.get_xlabel().split()) for axes in grid[-1]] == plain
    assert ["".join(axes.get_ylabel().split()) for axes in grid[1:, 0]] == plain[1:]
    for i in range(n):
        histograms = [patch.get_xy() for patch in grid[i, i].patches]
        assert len(histograms) == n_posteriors
        assert max(xy[:, 1].max() for xy in histograms) < grid[i, i].get_ylim()[1], "every histogram fits"
    for i, value in enumerate(truth):
        assert has_vertical_line(grid[i, i], value) or not inside(grid[i, i], value), labels[i]


def check_bands(axes: Axes, label: str) -> None:
    """A band, the measurement and the mean: the mean lies in the band, all within the limits of the vertical axis."""
    assert axes.get_ylabel() == label
    (band,) = axes.collections
    time, mean = line(axes, "mean")
    _, measured = line(axes, "measured")
    assert len(mean) == len(measured) and np.isfinite(measured).all()
    shown = (time >= axes.get_xlim()[0]) & (time <= axes.get_xlim()[1])
    assert all(inside(axes, np.mean(axes.get_xlim()), y) for values in (mean, measured) for y in values[shown])
    (path,) = band.get_paths()
    # the mean of the response may leave a band without noise by rounding, but not by a visible distance
    thickness = 1e-3 * np.ptp(axes.get_ylim())
    low, high = (np.full(len(time), limit) for limit in (np.inf, -np.inf))
    index = np.clip(np.searchsorted(time, path.vertices[:, 0] - 1e-9), 0, len(time) - 1)
    np.minimum.at(low, index, path.vertices[:, 1])
    np.maximum.at(high, index, path.vertices[:, 1])
    assert np.all((low - thickness <= mean) & (mean <= high + thickness))


def check_residuals(figure: Figure, labels: list[str], horizontal: str = "time [s]") -> None:
    """History, autocorrelation and normal plot of the residuals of each channel."""
    rows = np.reshape(np.array(figure.axes, dtype=object), (-1, 3))
    assert [row[0].get_ylabel() for row in rows] == labels
    assert rows[-1, 0].get_xlabel() == horizontal and rows[-1, 1].get_xlabel().startswith("lag")
    assert rows[-1, 2].get_xlabel().startswith("quantile")
    for history, correlation, quantiles in rows:
        values = history.lines[0].get_ydata()
        assert inside(correlation, 0.0, 1.0), "the autocorrelation at lag zero"
        assert np.allclose(np.sort(values), np.sort(quantiles.lines[1].get_ydata()))


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


def test_introduction_draws_record_and_measurements(oscillator):
    motion, spectrum = read_figure(oscillator, "record").axes
    assert (motion.get_xlabel(), motion.get_ylabel()) == ("time [s]", "ground acceleration [g]")
    assert motion.get_xlim() == pytest.approx((0.0, 25.0))
    assert spectrum.get_xscale() == "log" and texts(spectrum) == ["2 %", "5 %", "10 %"]
    periods, accelerations = line(spectrum, "5 %")
    assert np.interp(1.0, periods, accelerations) == pytest.approx(0.16, abs=0.005), "the value in the text"
    labels = [axes.get_ylabel() for axes in read_figure(oscillator, "measurements").axes]
    assert labels == ["acceleration [g]", "displacement [cm]"]


def test_introduction_draws_three_posteriors_around_the_true_values(oscillator):
    stiffness, damping, sigma_a, sigma_d = json.loads((oscillator / "summary.json").read_text())["truth"]
    labels = ["stiffness [x nominal]", "damping [x nominal]", "sigma_acceleration [g]", "sigma_displacement [cm]"]
    truth = [stiffness, damping, float(from_si(sigma_a, "g")), float(from_si(sigma_d, "cm"))]
    figure = read_figure(oscillator, "corner")
    check_corner(figure, labels, truth, n_posteriors=3)
    entries = [text.get_text() for text in figure.legends[0].get_texts()]
    assert entries[:3] == ["emcee", "SMC", "TMCMC"] and entries[3].startswith("prior")
    assert entries[4:] == ["true value"]


def test_introduction_draws_fit_and_prediction(oscillator):
    before, after, zoom = read_figure(oscillator, "fit").axes[3:]
    assert after.get_xlabel() == "time [s]" and before.get_ylabel() == "displacement [cm]"
    errors = [int(re.search(r"RRMSE (\d+) %", axes.get_title())[1]) for axes in (before, after)]
    assert errors[0] > 90 and errors[1] < 40
    for axes, (start, error) in zip((before, after), zip(("nominal", "posterior"), errors, strict=True), strict=True):
        measured, response = line(axes, "measured")[1], line(axes, start)[1]
        assert 100 * rrmse(response, measured) == pytest.approx(error, abs=0.5)
        assert inside(axes, 12.0, measured.max()) and inside(axes, 12.0, measured.min())
    assert np.ptp(zoom.get_xlim()) == pytest.approx(5.0)
    figure = read_figure(oscillator, "prediction")
    for axes, label in zip(figure.axes, ("acceleration [g]", "displacement [cm]"), strict=True):
        check_bands(axes, label)
        assert axes.get_xlim() == (4.0, 14.0)


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


def test_bridge_column_writes_its_tables(column):
    with (column / "table2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["Parameter"] for row in rows[:5]] == ["Ec", "Es", "a0", "a1", "ft"]
    assert len(rows) == 7 and rows[0]["Reported value"] == "3320 ksi"
    assert len((column / "table2.txt").read_text().splitlines()) == 8
    stages = json.loads((column / "summary.json").read_text())["stages"]
    assert len(re.findall(r"(?m)^ *\d+ +\d\.\d+e", (column / "ladder.txt").read_text())) == stages
    data = arviz.from_netcdf(column / "posterior.nc")
    assert set(data.posterior.data_vars) >= {"Ec", "sigma_displacement"}
    assert (column / "chain.h5").is_file()


def test_bridge_column_updating_explains_the_data(column):
    summary = json.loads((column / "summary.json").read_text())
    before, after = summary["rrmse"].values()
    assert before["displacement"] > 0.8
    assert after["displacement"] < 0.25
    # one sample in sixteen and long steps: Ec is biased, yet far from its nominal value 1 and near the true 0.59
    assert summary["posterior_mean"]["Ec"] == pytest.approx(0.59, abs=0.06)
    assert summary["failures"] < 0.01 * summary["simulations"]


def test_bridge_column_draws_the_figures_of_the_paper(column):
    summary = json.loads((column / "summary.json").read_text())
    data = read_figure(column, "fig3_data").axes
    assert [axes.get_ylabel() for axes in data] == ["acceleration [g]", "displacement [in]", "acceleration [g]"]
    for axes in data:
        assert inside(axes, 25.0, axes.lines[0].get_ydata().max()) and inside(
            axes, 25.0, axes.lines[0].get_ydata().min()
        )

    labels = [parameter.label for parameter in problems.bridge_column(every=16).parameters]
    assert labels[0] == "Ec [x 22.89 GPa]" and labels[-1] == "sigma_displacement [in]"
    truth = list(summary["truth"].values())
    truth = [*truth[:5], float(from_si(truth[5], "g")), float(from_si(truth[6], "in"))]
    check_corner(read_figure(column, "corner"), labels, truth)
    pairs = np.reshape(np.array(read_figure(column, "fig4_pair").axes, dtype=object), (7, 7))
    assert [axes.get_xlabel().replace("\n", " ") for axes in pairs[-1]] == labels
    assert all(axes.get_title().startswith("CV = ") for axes in pairs.diagonal())
    for axes, value in zip(pairs.diagonal(), truth, strict=True):
        marks = [text.get_text().strip("←→ ") for text in axes.texts]
        assert has_vertical_line(axes, value) if inside(axes, value) else f"{value:.4g}" in marks
        assert "nan" not in marks, "levels of the noise have no nominal value"
    assert "1 →" in [text.get_text() for text in pairs[0, 0].texts], "the reported Ec is outside"

    response = np.reshape(np.array(read_figure(column, "fig5_response").axes, dtype=object), (2, 3))
    assert [row[0].get_ylabel() for row in response] == ["acceleration [g]", "displacement [in]"]
    for k, title in enumerate(summary["rrmse"]):
        for axes, error in zip(response[:, k], summary["rrmse"][title].values(), strict=True):
            shown = f"{100 * error:.1f}" if error < 0.1 else f"{100 * error:.0f}"
            assert axes.get_title() == f"{title}, RRMSE {shown} %"
            measured, simulated = line(axes, "measured")[1], line(axes, title)[1]
            assert rrmse(simulated, measured) == pytest.approx(error)
        assert {line.get_label() for line in response[0, 2].lines} == {"measured", *summary["rrmse"]}


def test_bridge_column_draws_the_tempering_stages(column):
    beta = read_figure(column, "run").axes[1]
    stages, values = beta.lines[0].get_data()
    assert beta.get_yscale() == "log" and values[-1] == 1.0 and np.all(np.diff(values) > 0.0)
    assert len(stages) == json.loads((column / "summary.json").read_text())["stages"]


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
    for name, options in {"guide": (), "annealing": ("--no-guide", "--walkers", "500")}.items():
        out = tmp_path / name
        output = run_tutorial("02_bridge_column.py", "--preset", "reduced", "--out", str(out), *options, timeout=1750.0)
        runs[name] = json.loads((out / "summary.json").read_text())
        assert runs[name]["verdict"].capitalize() in output and runs[name]["verdict"] != "not usable"
    guide, annealing = runs["guide"], runs["annealing"]
    assert guide["verdict"] == "converged"
    assert guide["simulations"] < 1000 < 10_000 < annealing["simulations"]
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
    output = run_tutorial("03_isolated_bridge.py", "--sampler", "guide", "--out", str(out))
    assert "SYNTHETIC, nominal values assumed" in output
    return out


@pytest.mark.slow
def test_isolated_bridge_is_found_by_annealing(tmp_path):
    """The default sampler of the tutorial; tutorial 04 runs it on this posterior among the quick tests."""
    # from the prior, some simulations with the long steps of the fast setting fail
    run_tutorial("03_isolated_bridge.py", "--step", "1e-3", "--out", str(tmp_path))
    assert json.loads((tmp_path / "summary.json").read_text())["sampler"] == "tmcmc"
    test_isolated_bridge_is_found_and_predicts(tmp_path)
    test_isolated_bridge_writes_its_tables(tmp_path)
    test_isolated_bridge_draws_the_figures_of_the_paper(tmp_path)
    test_isolated_bridge_draws_fragility_and_stages(tmp_path)


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


def test_isolated_bridge_writes_its_tables(bridge):
    lines = (bridge / "parameters.txt").read_text().splitlines()
    assert lines[0].split()[:4] == ["parameter", "truth", "mean", "sd"] and len(lines) == 12
    stages = json.loads((bridge / "summary.json").read_text())["stages"]
    assert len(re.findall(r"(?m)^ *\d+ +\d\.\d+e", (bridge / "ladder.txt").read_text())) == stages
    assert "fmin_1" in arviz.from_netcdf(bridge / "posterior.nc").posterior
    assert (bridge / "chain.h5").is_file()


def test_isolated_bridge_draws_the_figures_of_the_paper(bridge):
    assert (bridge / "fig2_scheme_and_channels.png").is_file()
    summary = json.loads((bridge / "summary.json").read_text())
    truth = list(summary["truth"].values())
    parameters, misfit = read_figure(bridge, "fig5_parameters_and_fit").axes
    position, values = line(parameters, "truth (synthetic)")
    assert list(values) == truth and all(inside(parameters, x, y) for x, y in zip(position, values, strict=True))
    assert [label.get_text() for label in parameters.get_xticklabels()][-1] == "sigma"
    assert len(parameters.get_xticklabels()) == 11 and len(misfit.get_xticklabels()) == 6
    assert misfit.get_yscale() == "log" and misfit.get_ylabel() == "misfit J [-]"

    marginals = read_figure(bridge, "fig6_marginals").axes
    for axes, value in zip(marginals[:10], truth, strict=True):
        assert has_vertical_line(axes, value) or not inside(axes, value), axes.get_xlabel()
    labels = [axes.get_xlabel() for axes in marginals]
    assert len(labels) == 11 and labels[0] == "fmin_1 [x 0.055]" and labels[-1] == "sigma [-]"
    check_corner(read_figure(bridge, "corner"), labels, truth)

    histories = read_figure(bridge, "fig7_predictions").axes
    for axes, label in zip(histories, ("Ub_1 [mm]", "shear_1 [kN]", "acc_p1 [g]", "drift_1 [mm]"), strict=True):
        check_bands(axes, label)


def test_isolated_bridge_draws_fragility_and_stages(bridge):
    summary = json.loads((bridge / "summary.json").read_text())
    (fragility,) = read_figure(bridge, "fragility").axes
    assert fragility.get_xlabel() == "peak ground acceleration [g]"
    assert fragility.get_ylabel() == "probability of exceedance [-]"
    points = np.column_stack(fragility.lines[0].get_data())
    expected = [from_si(summary["fragility"]["intensity"], "g"), summary["fragility"]["probability"]]
    assert np.allclose(points, np.column_stack(expected))
    assert all(inside(fragility, x, y) for x, y in points)
    assert all(axes.lines or axes.patches or axes.collections for axes in read_figure(bridge, "run").axes)


# 04


@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_comparison_run_twice_simulates_once(times, tmp_path):
    arguments = ("--problem", "bridge", "--cache", str(tmp_path / "simulations.db"))
    outputs = [run_tutorial("04_compare_samplers.py", *arguments, "--out", str(tmp_path)) for _ in range(times)]
    assert "warning of TMCMC as published: " in outputs[0]
    assert "\n0 simulations in total" not in outputs[0]
    assert times == 1 or "\n0 simulations in total" in outputs[1]
    results = json.loads((tmp_path / "comparison.json").read_text())["bridge"]
    assert results["SMC"]["mean"][0] == pytest.approx(1.15, abs=0.03)
    assert results["TMCMC as published"]["warnings"] and results["emcee from the prior"]["warnings"]

    guided = results["SMC with a guide"]
    assert guided["verdict"] != "not usable" and guided["mean"][0] == pytest.approx(1.15, abs=0.03)
    assert 3.0 * guided["simulations"] < results["SMC"]["simulations"]
    assert f"verdict of SMC with a guide: {guided['verdict'].capitalize()}" in outputs[0]

    panels = read_figure(tmp_path, "wrong_bridge").axes
    assert [axes.get_title().split("\n")[0] for axes in panels] == list(results)
    for axes, run in zip(panels, results.values(), strict=True):
        x, y = line(axes, "truth (synthetic)")
        assert (x[0], y[0]) == (0.85, 1.1) and inside(axes, x[0], y[0]), "true df_1 and df_2"
        assert axes.get_title().endswith("warning (see the output)" if run["warnings"] else "no warning")
    labels = [parameter.label for parameter in problems.isolated_bridge().parameters]
    truth = [1.15, 0.85, 1.2, 0.9, 1.1, 0.8, 0.8, 1.25, 1.3, 0.9, 0.05]
    check_corner(read_figure(tmp_path, "corner_bridge"), labels, truth, n_posteriors=4)


# 05


@pytest.mark.parametrize("pool", ["local", pytest.param("dask", marks=pytest.mark.slow)])
def test_own_models_agree_and_are_simulated_once(pool, tmp_path):
    """Workers of dask are tested in `tests/faults/test_executors_faults.py` as well."""
    if pool == "dask":
        pytest.importorskip("distributed", reason="NO DISTRIBUTED: install it to test this executor")
    if importlib.util.find_spec("openseespy"):  # the tutorial leaves OpenSees out only where it is not installed
        require_opensees()
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
    labels = ["stiffness [x nominal]", "strength [x nominal]"]
    check_corner(read_figure(tmp_path, "corner"), labels, [1.15, 0.85], n_posteriors=len(first))
    (loop,) = read_figure(tmp_path, "loops").axes
    assert loop.get_xlabel() == "displacement [mm]" and loop.get_ylabel().endswith("[m/s²]")
    displacement, force = loop.lines[0].get_data()
    assert np.abs(displacement).max() > 2.0 * 20.0 * 0.85, "well beyond the yield displacement of 20 mm x strength"
    work = np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(displacement))
    assert work > 0.0, "spring and damper dissipate energy"


# 06 to 09


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

    histories, spectra = read_figure(tmp_path, "meloland_data").axes
    assert histories.get_ylabel() == "acceleration [g]" and len(histories.lines) == 3
    assert texts(spectra) == ["ch2, base of the column", "ch3, one end of the deck", "ch7, middle of the deck"]
    frequency, amplitude = line(spectra, "ch7")
    assert frequency[np.argmax(amplitude)] == pytest.approx(2.3, abs=0.2), "the peak that the text names"
    labels = ["frequency [Hz]", "damping ratio [-]", "share of the ends [-]"]
    corner = read_figure(tmp_path, "meloland_corner")
    check_corner(corner, labels, n_posteriors=2)
    assert inside(corner.axes[0], result["posterior_mean"]["white"]["frequency"])
    check_residuals(read_figure(tmp_path, "meloland_residuals"), ["ch7 [g]"])
    for axes, label in zip(
        read_figure(tmp_path, "meloland_prediction").axes, ("ch5 [g]", "ch7 [g]", "ch9 [g]"), strict=True
    ):
        check_bands(axes, label)


def test_real_frame_predicts_other_shakings(shared, tmp_path):
    run_tutorial("07_shake_table_frame.py", "--data", str(shared / "measured"), "--out", str(tmp_path))
    result = json.loads((tmp_path / "summary.json").read_text())
    assert max(result["n_effective"]) < 0.1 * result["n_steps"], "residuals of lightly damped modes are correlated"
    rows = {(row["shaking"], row["channel"]): row for row in result["predictions"] if row["noise"] == "n_eff"}
    assert rows["shaking 1", "floor2"]["kind"] == "prediction"
    assert all(rows[f"shaking {k}", "floor2"]["rrmse"] < 0.2 for k in (1, 2, 3))
    assert rows["shaking 3", "floor2"]["coverage"] > 0.8

    data = read_figure(tmp_path, "data").axes
    assert [axes.get_ylabel() for axes in data] == ["table [g]", "floor1 [g]", "floor2 [g]", "floor3 [g]"]
    for axes in data:
        spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
        assert spans == [(18.0, 26.0), (36.0, 44.0), (54.0, 62.0)] and inside(axes, 18.0) and inside(axes, 62.0)
    labels = [*(f"stiffness {i} [x nominal]" for i in (1, 2, 3)), "damping 1 [-]", "mass 3 [x floor]"]
    check_corner(read_figure(tmp_path, "corner"), labels, n_posteriors=2)
    check_residuals(read_figure(tmp_path, "residuals"), ["floor1 [g]", "floor3 [g]"])
    for name in ("calibration", "prediction"):
        for axes, label in zip(
            read_figure(tmp_path, name).axes, ("floor1 [g]", "floor2 [g]", "floor3 [g]"), strict=True
        ):
            check_bands(axes, label)


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
    for axes in read_figure(tmp_path, "failure").axes:
        measured, simulated = line(axes, "measured")[1], line(axes, "literature")[1]
        assert rrmse(simulated, measured) < 0.6

    histories = read_figure(tmp_path, "data").axes
    assert [axes.get_title() for axes in histories[:2]] == ["Lehman 415", "Hose SRPH1"]
    for loops in histories[2:]:
        assert (loops.get_xlabel(), loops.get_ylabel()) == ("drift [%]", "lateral force [kip]")
        assert [line.get_label() for line in loops.lines] == ["first half", "second half, to failure", "after failure"]
    labels = [f"{name} [x nominal]" for name in ("Ec", "fy", "penetration")]
    check_corner(read_figure(tmp_path, "corner"), labels, n_posteriors=3)
    for name, error in (("white", "white"), ("ar1", "AR(1)")):
        check_residuals(read_figure(tmp_path, f"residuals_{name}"), ["force [kip]"], "sample")
        for axes in read_figure(tmp_path, f"loops_{name}").axes:
            column, part, rest = re.fullmatch(r"(\w+ \w+), (.*): (.*)", axes.get_title()).groups()
            assert rest.startswith("calibration" if (column, part) == ("Lehman 415", "first half") else "prediction")
            measured, mean = line(axes, "measured")[1], line(axes, "mean")[1]
            assert rrmse(mean, measured) == pytest.approx(parts[f"{column}, {part}"][error]["rrmse"]), (
                "what is drawn is what is reported"
            )


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

    labels = [f"{name} [x nominal]" for name in ("fy", "fu", "Es", "Esh", "eps_sh", "eps_u")]
    check_corner(read_figure(tmp_path, "corner"), labels, n_posteriors=3)
    for name in ("white", "ar1"):
        check_residuals(read_figure(tmp_path, f"residuals_{name}"), ["stress [MPa]"], "sample")
    figure = read_figure(tmp_path, "loops").axes
    for loops, part in zip(figure[:2], (half, rest), strict=True):
        assert (loops.get_xlabel(), loops.get_ylabel()) == ("strain [%]", "stress [MPa]")
        measured, mean = line(loops, "measured")[1], line(loops, "mean")[1]
        assert rrmse(mean, measured) == pytest.approx(part["AR(1)"]["rrmse"])
    assert all(len(history.collections) == 2 for history in figure[2:]), "a band of the response, and one with noise"


# 10


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
    titles = [axes.get_title() for axes in read_figure(tmp_path, "damage_predicted").axes]
    assert sum(title.startswith("bar yield\n100 %") for title in titles) == 2, "after EQ2 and after EQ4"
    panels = read_figure(tmp_path, "prediction").axes
    assert [panel.get_ylabel() for panel in panels] == ["displacement [in]"] * 3
    shown = line(panels[1], "measured")[1]
    assert len(shown) > 50 and len(panels[1].collections) == 1


# 11


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
    panels = read_figure(tmp_path, "fragility").axes
    assert [panel.get_xlabel() for panel in panels] == ["peak acceleration of the base [g]"] * 2
    for name in ("scores_as_usual", "scores_events", "events"):
        assert len(read_figure(tmp_path, name).axes) >= 2


# 12


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
    ranks, _ = read_figure(tmp_path, "ranks").axes
    assert [text.get_text() for text in ranks.get_yticklabels()] == summary["six"]
    drawn, along = read_figure(tmp_path, "column").axes
    numbered = {f"{k}. {name}" for k, name in enumerate(summary["six"], 1)}
    assert numbered == {text.get_text() for text in drawn.texts} and len(along.lines) == 4
    (compared,) = read_figure(tmp_path, "predicted_and_obtained").axes
    np.testing.assert_allclose(
        [bar.get_height() for bar in compared.patches], 100.0 * np.concatenate(list(summary["sd_left"].values()))
    )


# 13


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
    losses = read_figure(tmp_path, "losses").axes
    assert [axes.get_title().split(":")[0] for axes in losses] == ["after"] * 2 + ["colder, no damage"] * 2
    assert losses[0].get_ylabel() == "stiffness loss [%]"
    np.testing.assert_allclose(line(losses[0], "truth")[1], 100.0 * np.array(summary["truth"]))
    (probabilities,) = read_figure(tmp_path, "probabilities").axes
    heights = [bar.get_height() for bar in probabilities.patches]
    np.testing.assert_allclose(heights[: len(heights) // 2], summary["probability"])


# 14


def test_noise_is_worth_nothing_and_the_rates_have_their_closed_form(tmp_path):
    output = run_tutorial("14_decisions.py", "--out", str(tmp_path))
    assert "REDUCED SETTING" in output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["sum"] == pytest.approx(1.0, abs=1e-5)
    assert 0.0 < summary["rates"]["replacement"] < summary["rates"]["repair"] < 0.05, "the rate of the weakest motion"
    values = {name: value for name, (value, _) in summary["values"].items()}
    assert max(values.values()) == values["everything"] > 0.0
    assert abs(values["noise"]) <= 4.0 * summary["values"]["noise"][1]
    fragilities, worth = read_figure(tmp_path, "decisions").axes
    assert texts(fragilities) == ["repair: 10 cm", "replacement: 25 cm"]
    np.testing.assert_allclose([bar.get_width() for bar in worth.patches], list(values.values()))


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


def test_tutorials_have_the_form_that_the_documentation_renders():
    """A docstring with an underlined title, and cells of reStructuredText."""
    for path in TUTORIALS:
        text = path.read_text()
        opening, title, underline = text.split("\n")[:3]
        assert opening == '"""' and set(underline) == {"="} and len(underline) == len(title), path.name
        assert "[markdown]" not in text and text.count("\n# %%\n") >= 3, path.name
