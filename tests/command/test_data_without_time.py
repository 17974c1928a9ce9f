"""Modes and load tests in a TOML file: from the file of the data to a report, and what is refused."""

import itertools
import re

import numpy as np
import pytest

from fe_likelihoods import BridgeDeck, LinearStructure, Record
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.main import write_templates
from fe_likelihoods.command.make_posterior import make_problem
from fe_likelihoods.command.runs import run_job
from tests.command.test_command import call

MATRICES = """
import numpy as np

def matrices(theta):
    k = 30e6 * theta
    return np.diag(k + [*k[1:], 0.0]) - np.diag(k[1:], 1) - np.diag(k[1:], -1), 20e3 * np.eye(4)

def modes(theta):
    values, shapes = np.linalg.eigh(matrices(theta)[0] / 20e3)
    return np.sqrt(values) / (2.0 * np.pi), shapes.T
"""


COUNT = itertools.count()


def own_module(folder, text):
    """The text of a file whose model has a name that no other test imports."""
    if (folder / "my_girder.py").exists():
        name = f"my_girder_{next(COUNT)}.py"
        (folder / "my_girder.py").rename(folder / name)
        text = text.replace("my_girder.py", name)
    return text


def changed(folder, kind, *changes):
    """The template of a kind with changes (old text, new text)."""
    if not (folder / f"{kind}.toml").exists():
        write_templates(kind, folder)
    text = own_module(folder, (folder / f"{kind}.toml").read_text())
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "changed.toml"
    path.write_text(text)
    return path


def test_from_a_table_of_modes_to_a_report(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call("new", "modal", "a")
    said = call("check", "a/modal.toml")
    assert "mode  measured [Hz]  computed [Hz]" in said
    assert "CAUTION" not in said and (tmp_path / "check-modal.png").stat().st_size > 10_000
    said = call("run", "a/modal.toml", "--quiet")
    assert "Use." in said and "measured [Hz]" in said and "RRMSE" not in said
    rows = re.findall(r"(?m)^(\d) .* (\S+)$", (tmp_path / "results-modal" / "summary.txt").read_text())
    assert [mode for mode, _ in rows] == ["1", "2", "3"] and float(rows[0][1]) > 0.99
    assert "Measured and computed modes" in (tmp_path / "results-modal" / "report.html").read_text()


def test_from_a_load_test_to_a_report(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = changed(tmp_path, "load-test")
    said = call("check", str(path))
    assert "midspan    mm        3 " in said and "CAUTION" not in said
    outcome = run_job(path, progress=False)
    samples = outcome.sampler.get_chain(flat=True)[:, 0]
    assert abs(samples.mean() - 0.9) < 3.0 * samples.std() and outcome.usable
    assert "Predicted values" in (outcome.folder / "report.html").read_text()


def test_other_models_have_modes(tmp_path):
    write_templates("modal", tmp_path)
    (tmp_path / "my_storeys.py").write_text(MATRICES)
    frame = make_problem(read_job(tmp_path / "modal.toml")).posterior
    point, text = [1.0, 0.9, 1.1, 1.0], (tmp_path / "modal.toml").read_text()
    start, end = text.index("[model]"), text.index("[modes]")
    rows = "{floor_1 = 0, floor_2 = 1, floor_3 = 2, floor_4 = 3}"
    names = '["stiffness_1", "stiffness_2", "stiffness_3", "stiffness_4"]'
    for function, sensors in (("matrices", rows), ("modes", '["floor_1", "floor_2", "floor_3", "floor_4"]')):
        own = f'kind = "function"\nfunction = "my_storeys.py:{function}"\nparameters = {names}\nsensors = {sensors}'
        (tmp_path / "own.toml").write_text(f"{text[:start]}[model]\n{own}\n{text[end:]}")  # n_modes: all that there are
        assert make_problem(read_job(tmp_path / "own.toml")).posterior(point) == pytest.approx(frame(point), rel=1e-9)
    path = changed(tmp_path, "modal", ("[modes]", "groups = [1, 2, 3, 4]\n[modes]"))
    assert make_problem(read_job(path)).posterior(point) == pytest.approx(frame(point), rel=1e-12)


def test_held_out_modes_are_predicted_and_shown(tmp_path, monkeypatch):
    """Report and summary have equal intervals."""
    monkeypatch.chdir(tmp_path)
    errors = ("frequency_cv = 0.005", "frequency_cv = [0.005, 0.005, 0.005, 0.01]")  # of those held out as well
    path = changed(tmp_path, "modal", ("modes = [1, 2, 3]", "held_out = [4, 3]"), errors)
    held_out = make_problem(read_job(path)).posterior.likelihood.held_out
    assert held_out.frequency_cv.tolist() == [0.01, 0.005]
    call("run", str(path), "--quiet")
    rows = re.findall(r"(?m)^(\d) +\S+ +\S+ +(\S+) ", (tmp_path / "results-changed" / "summary.txt").read_text())
    page = (tmp_path / "results-changed" / "report.html").read_text()
    assert [mode for mode, _ in rows] == ["1", "2", "4", "3"] and "Modes that were held out" in page
    assert all(f"{low}<" in page for _, low in rows)


def test_columns_and_errors_of_modes(tmp_path):
    write_templates("modal", tmp_path)
    modes = (tmp_path / "synthetic_modes.csv").read_text()
    (tmp_path / "synthetic_modes.csv").write_text(modes.replace("floor_4", "A4 [1]"))
    columns = '[modes]\ncolumns = {floor_2 = "floor_2", floor_4 = "A4 [1]"}\nunknown_errors = "mode"'
    errors = "shape_error = 0.02", "shape_error = [0.02, 0.03, 0.02, 0.02]"  # of the modes of the file
    path = changed(tmp_path, "modal", ("[modes]", columns), errors)
    problem = make_problem(read_job(path))
    data = problem.posterior.likelihood.model.data
    assert data.sensors == ("floor_2", "floor_4") and data.shape_error.tolist() == [0.02, 0.03, 0.02]
    assert [name for name in problem.assumed if name.startswith("frequency")] == [
        f"frequency_error_{i}" for i in (1, 2, 3)
    ]
    known = "covariance = [[1e-4, 5e-5], [5e-5, 4e-4]]\ntemperatures = 12"
    path = changed(tmp_path, "modal", ("frequency_cv = 0.005", known), ("[1, 2, 3]", "[1, 2]"))
    (tmp_path / "synthetic_modes.csv").write_text(modes)
    problem = make_problem(read_job(path))
    data = problem.posterior.likelihood.model.data
    assert "temperature_slope" in problem.assumed
    assert data.covariance.tolist() == [[1e-4, 5e-5], [5e-5, 4e-4]] and data.temperatures.tolist() == [12.0]


def test_a_bridge_deck_has_a_mode(tmp_path):
    (tmp_path / "deck.csv").write_text("frequency_Hz,quarter,mid\n3.0,0.7,1.0\n")
    model = '[model]\nkind = "bridge deck"\nmiddle = "mid"\nfirst_span = "quarter"\nshare = 0.5\n'
    modes = '[modes]\nfile = "deck.csv"\nfrequency_cv = 0.01\nshape_error = 0.02\n'
    priors = '[priors]\nfrequency = "log-normal(3, 0.2)"\nshape = "uniform(0, 1)"\n'
    (tmp_path / "deck.toml").write_text(model + modes + priors)
    posterior = make_problem(read_job(tmp_path / "deck.toml")).posterior
    assert posterior.parameter_names == ["frequency", "shape"]
    assert posterior.log_likelihood([3.0, 0.7]) > posterior.log_likelihood([3.0, 0.5])


@pytest.mark.parametrize(
    ("kind", "changes", "text"),
    [
        ("modal", [("[sampler]", '[record]\nfile = "a.csv"\n[sampler]')], "modes and load tests have no"),
        ("modal", [("[sampler]", "[load_test]\nfile = 'a'\n[sampler]")], r"beside other data, \[load_test.model\] is"),
        ("modal", [('"frame"  ', '"column" '), ("floors =", "# floors =")], r"\[model\]"),
        ("modal", [('"frame"  ', '"oscillator" '), ("floors =", "# floors =")], r"\[model\]"),
        ("modal", [("modes = [1, 2, 3]", "modes = [1, 7]")], r"\[modes\] ModalData has no modes"),
        ("modal", [("[modes]", "[modes]\nheld_out = [3]")], r"the modes \[3\] are in modes too"),
        (
            "modal",
            [("[modes]", "[modes]\ncovariance = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]")],
            "the same errors: leave one out",
        ),
        ("modal", [("frequency_cv = 0.005", "covariance = [[1, 2], [1]]")], "symmetric positive definite"),
        ("modal", [("frequency_cv = 0.005", "frequency_cv = [0.005, 0.01]")], "one for each of 4 modes"),
        ("modal", [("frequency_cv = 0.005", "temperatures = 293")], "from -80 to 80"),
        ("modal", [("[sampler]", '[noise]\ngroups = "all"\n[sampler]')], "modes have no such errors"),
        ("modal", [("floor_4 = 4}", "roof = 4}")], "the model has no sensors floor_4"),
        ("modal", [("synthetic_modes", "synthetic_mode")], "did you mean synthetic_modes.csv"),
        ("load-test", [("errors = {quarter", "errors = {third")], "third: unknown channel"),
        ("load-test", [("[priors]", "[priors]\nsigma_midspan = 'half-normal(1 mm)'")], "is known from"),
        ("load-test", [("[model.channels]", "sensors = ['a']\n[model.channels]")], "sensors are for"),
        ("load-test", [('midspan = "displacement [mm]"', 'top = "displacement [mm]"')], "midspan: unknown channel"),
        (
            "load-test",
            [("[load_test]", "[load_test]\ncolumns = {midspan = 'top'}")],
            "one column of values named 'top'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(kind, changes, text, tmp_path):
    with pytest.raises(ValueError, match=text):
        make_problem(read_job(changed(tmp_path, kind, *changes)))


DECK = """
[model]
kind = "bridge deck"
middle = "ch7"
shape = 0.7
[record]
supports = ["supports.csv:base [g]", "supports.csv:south [g]", "supports.csv:north [g]"]
[measurements]
file = "deck.csv"
columns = {ch7 = "ch7 [g]"}
[priors]
frequency = "log-normal(3, 0.2)"
damping = "log-normal(0.05, 0.3)"
share = "uniform(0, 1)"
sigma_ch7 = "half-normal(0.1 g)"
"""


def test_a_bridge_deck_has_three_supports(tmp_path):
    motion = np.random.default_rng(1).normal(size=(3, 200))
    rows = [f"{0.02 * k:.2f}," + ",".join(f"{x:.6f}" for x in motion[:, k]) for k in range(200)]
    (tmp_path / "supports.csv").write_text("\n".join(["time_s,base [g],south [g],north [g]", *rows]))
    supports = [Record("a", 0.02, 9.80665 * each.round(6)) for each in motion]
    (response,) = LinearStructure(BridgeDeck("ch7", shape=0.7), supports).simulate([3.0, 0.05, 0.6]) / 9.80665
    rows = [f"{0.02 * k:.2f},{x!r}" for k, x in enumerate(response.tolist())]
    (tmp_path / "deck.csv").write_text("\n".join(["time_s,ch7 [g]", *rows]))
    path = tmp_path / "deck.toml"
    path.write_text(DECK)
    likelihood = make_problem(read_job(path)).posterior.likelihood
    assert likelihood.model.parameter_names == ("frequency", "damping", "share")
    assert np.abs(likelihood.residuals_of(likelihood.model.simulate([3.0, 0.05, 0.6]))).max() < 1e-6
    for old, new, text in (
        ("supports =", "file = 'deck.csv'\nsupports =", "file: leave it out with supports"),
        ('"bridge deck"\nmiddle = "ch7"\nshape = 0.7', '"oscillator"\nperiod = 1.0', "supports: a bridge deck needs"),
        (', "supports.csv:north [g]"', "", "one record for each of the 3 supports"),
    ):
        path.write_text(DECK.replace(old, new))
        with pytest.raises(ValueError, match=text):
            make_problem(read_job(path))
