"""Modes, a load test and histories of one frame in one TOML file: one posterior, one cache, one report."""

import csv
import itertools

import numpy as np
import pytest

from fe_likelihoods import LinearStructure, Record, ShearFrame
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.models import make_problem
from fe_likelihoods.command.runs import report_run, run_job
from tests.command.test_command import call

TRUTH = [0.9, 1.1, 0.03, 0.03]
COUNT = itertools.count()  # each test imports a module of its own name
DEFLECTIONS = """
import numpy as np

def deflections(theta):  # of the roof, under forces there
    return np.outer([(1.0 / (9e6 * theta)).sum()], [10e3, 20e3])
"""
SETTINGS = """
[model]
kind = "frame"
floors = {floor = 1, roof = 2}
masses = [1e4, 1e4]
stiffnesses = [9e6, 9e6]
[modes]
file = "modes.csv"
frequency_cv = 0.01
shape_error = 0.03
[load_test]
file = "loads.csv"
errors = {top = "0.05 mm"}
[load_test.model]
kind = "function"
function = "deflections_of_a_frame.py:deflections"
parameters = ["stiffness_1", "stiffness_2"]
channels = {top = "displacement [mm]"}
[record]
file = "base.csv"
[measurements]
file = "roof.csv"
columns = {roof = "roof [m/s2]"}
[priors]
stiffness_1 = "log-normal(1, 0.2)"
stiffness_2 = "log-normal(1, 0.2)"
damping_1 = "log-normal(0.03, 0.3)"
damping_2 = "log-normal(0.03, 0.3)"
[sampler]
walkers = 100
steps = 1
guide = true
"""


@pytest.fixture
def settings_of(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng, time = np.random.default_rng(4), 0.02 * np.arange(300)
    frame = ShearFrame({"floor": 1, "roof": 2}, [1e4, 1e4], [9e6, 9e6])
    motion = np.convolve(rng.normal(size=300), np.hanning(9), "same") * np.sin(np.pi * time / 6.0)
    model = LinearStructure(frame, Record("base", 0.02, motion), outputs=("roof",))
    roof = model.simulate(TRUTH)[0] + 0.02 * rng.normal(size=300)
    modes = model.modes(TRUTH)
    tables = {
        "base.csv": ("time_s,base [m/s2]", zip(time, motion, strict=True)),
        "roof.csv": ("time_s,roof [m/s2]", zip(time, roof, strict=True)),
        "modes.csv": ("frequency_Hz,floor,roof", np.column_stack([modes.frequencies, modes.shapes])),
        "loads.csv": ("load,top [mm]", [(1, 2.246), (2, 4.490)]),
    }
    for name, (head, rows) in tables.items():
        (tmp_path / name).write_text("\n".join([head, *(",".join(f"{x:.8g}" for x in row) for row in rows)]) + "\n")
    name = f"deflections_{next(COUNT)}"
    (tmp_path / f"{name}.py").write_text(DEFLECTIONS)

    def settings(old="", new=""):
        assert old in SETTINGS
        text = SETTINGS.replace(old, new) if old else SETTINGS
        (tmp_path / "frame.toml").write_text(text.replace("deflections_of_a_frame", name))
        return tmp_path / "frame.toml"

    settings()
    return settings


def test_three_data_sets_are_one_posterior(settings_of):
    posterior = make_problem(read_job(settings_of())).posterior
    assert posterior.parameter_names == ["stiffness_1", "stiffness_2", "damping_1", "damping_2", "sigma_roof"]
    joint, point = posterior.likelihood, [*TRUTH, 0.02]
    parts = joint.likelihoods
    alone = [part([point[column] for column in columns]) for part, columns in joint.parts()]
    assert list(parts) == ["measurements", "modes", "load_test"] and joint(point) == pytest.approx(sum(alone))
    assert parts["load_test"].model.parameter_names == ("stiffness_1", "stiffness_2")


def test_a_check_and_a_run_have_one_report(settings_of, tmp_path):
    said = call("check", "frame.toml", "--quiet")
    assert "mode  measured [Hz]" in said and "top: 2 values" in said and "roof: 300 samples" in said
    assert all((tmp_path / f"check-frame-{name}.png").exists() for name in ("measurements", "modes", "load_test"))
    outcome = run_job(settings_of(), progress=False)
    samples = outcome.sampler.get_chain(flat=True)[:, :2]
    assert outcome.usable and (np.abs(samples.mean(axis=0) - TRUTH[:2]) < 4.0 * samples.std(axis=0)).all()
    assert {"fit-modes.csv", "fit-load_test.csv", "fit-measurements.csv", "report.html"} <= set(outcome.files)
    with (outcome.folder / "fit-modes.csv").open() as file:
        assert [row["mode"] for row in csv.DictReader(file)] == ["1", "2"]
    assert len(list(outcome.folder.glob("*.sqlite"))) == 1
    page = (outcome.folder / "report.html").read_text()
    assert "Measured and computed modes" in page and outcome.sampler.simulations < 1500
    with pytest.raises(ValueError, match="--run-code"):
        report_run(outcome.folder)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("[load_test.model]\n", "[load_test.other]\n", r"\[load_test\] other: unknown key"),
        ('kind = "function"\n', "", r"\[load_test.model\] kind: expected the kind"),
        (
            '[load_test.model]\nkind = "function"',
            '[load_test.model]\nkind = "frame"',
            r"\[load_test.model\] function: unk",
        ),
        ("[sampler]", '[events.next]\nfile = "base.csv"\n[sampler]', "only a file with one data set predicts events"),
        ("[measurements]", "[measurement]", "unknown section"),
        ('"stiffness_2"]', '"stiffness_3"]', "stiffness_3: this prior is missing"),
    ],
)
def test_what_does_not_fit_is_refused(settings_of, old, new, text):
    path = settings_of(old, new)
    with pytest.raises(ValueError, match=text):
        make_problem(read_job(path))
