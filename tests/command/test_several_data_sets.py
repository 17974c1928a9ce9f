"""Modes, a load test and histories of one frame in one TOML file: one posterior, one cache, one report."""

import itertools
import re
import sys

import numpy as np
import pytest

from fe_likelihoods import LinearStructure, Record, ShearFrame
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.make_posterior import make_problem
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
    alone = [part([point[column] for column in columns]) for part, columns in joint.data_sets()]
    assert list(parts) == ["measurements", "modes", "load_test"] and joint(point) == pytest.approx(sum(alone))
    assert parts["load_test"].model.parameter_names == ("stiffness_1", "stiffness_2")


@pytest.mark.slow
def test_a_check_and_a_run_have_one_report(settings_of, tmp_path):
    said = call("check", "frame.toml")
    assert "mode  measured [Hz]" in said and " 300 " in said
    assert all((tmp_path / f"check-frame-{name}.png").exists() for name in ("measurements", "modes", "load_test"))
    outcome = run_job(settings_of(), progress=False)
    samples = outcome.sampler.get_chain(flat=True)[:, :2]
    assert outcome.usable and (np.abs(samples.mean(axis=0) - TRUTH[:2]) < 4.0 * samples.std(axis=0)).all()
    summary = (outcome.folder / "summary.txt").read_text()
    assert "mode  measured [Hz]" in summary and all(
        f"(RRMSE) ({name})" in summary for name in ("load_test", "measurements")
    )
    assert len(list(outcome.folder.glob("*.sqlite"))) == 1
    page = (outcome.folder / "report.html").read_text()
    assert "Measured and computed modes" in page and outcome.sampler.simulations < 1500
    with pytest.raises(ValueError, match="--run-code"):
        report_run(outcome.folder)


TOGETHER = """
import sys
from pathlib import Path
import numpy as np
from fe_likelihoods.modal.mode_models import modal_response

def responses(theta):
    with open(Path(__file__).with_name("count.txt"), "a") as count:
        count.write("x")
    k, time = 9e6 * np.asarray(theta), 0.02 * np.arange(300)
    matrix = np.array([[k[0] + k[1], -k[1]], [-k[1], k[1]]]) / 1e4
    values, shapes = np.linalg.eigh(matrix)
    roof = np.exp(-0.05 * time) * np.cos(np.sqrt(values[0]) * time)
    modes = modal_response(np.sqrt(values) / (2 * np.pi), shapes.T)
    return {"modes": modes, "load_test": np.outer([(1.0 / k).sum()], [10e3, 20e3]), "measurements": [roof]}

if __name__ == "__main__":
    found = responses([float(each) for each in sys.argv[1:]])
    for name, values in found.items():
        np.savetxt(f"{name}.txt", np.transpose(values))
"""
FUNCTION = 'kind = "function"\nfunction = "together.py:responses"'
PROGRAM = f"""kind = "executable"
command = ["{sys.executable}", "together.py", "$stiffness_1", "$stiffness_2"]
time_limit = 60"""


def of_one_run(text, name, model):
    """Settings whose three data sets one run of a model answers."""
    end = text.index("[modes]")
    files = ["", "", ""]
    if model is PROGRAM:
        files = [f'output = "{each}.txt"\n' for each in ("modes", "load_test", "measurements")]
    text = f'[model]\n{model}\nparameters = ["stiffness_1", "stiffness_2"]\n{text[end:]}'.replace("together", name)
    own = text.index("[load_test.model]")
    text = text[:own] + text[text.index("[record]") :].replace('[record]\nfile = "base.csv"\n', "")
    text = re.sub(r"(?m)^damping.*\n", "", text).replace("[modes]\n", "[modes]\nn_modes = 2\n")
    text += f'[modes.model]\nsensors = ["floor", "roof"]\n{files[0]}'
    text += f'[load_test.model]\nchannels = {{top = "displacement [mm]"}}\n{files[1]}'
    return text + f'[measurements.model]\nchannels = {{roof = "acceleration [m/s2]"}}\n{files[2]}'


@pytest.mark.parametrize("model", [FUNCTION, pytest.param(PROGRAM, marks=pytest.mark.slow)])
def test_one_run_answers_three_data_sets(settings_of, tmp_path, model):
    name = f"together_{next(COUNT)}"
    (tmp_path / f"{name}.py").write_text(TOGETHER)
    text = of_one_run(settings_of().read_text(), name, model)
    (tmp_path / "frame.toml").write_text(text)
    posterior = make_problem(read_job(tmp_path / "frame.toml")).posterior
    assert posterior.parameter_names == ["stiffness_1", "stiffness_2", "sigma_roof"]
    points = [[0.9, 1.1, 0.02], [1.0, 1.1, 0.02], [0.9, 1.0, 0.02]]
    values = posterior(points)
    frame = make_problem(read_job(settings_of())).posterior.likelihood
    others = frame["modes"]([[0.9, 1.1], [1.0, 1.1]]) + frame["load_test"]([[0.9, 1.1], [1.0, 1.1]])
    parts = posterior.likelihood
    mine = parts["modes"]([[0.9, 1.1], [1.0, 1.1]]) + parts["load_test"]([[0.9, 1.1], [1.0, 1.1]])
    np.testing.assert_allclose(mine, others, rtol=1e-6)
    if model is FUNCTION:
        assert np.isfinite(values).all() and len((tmp_path / "count.txt").read_text()) == 3
    (tmp_path / "frame.toml").write_text(text.replace("[measurements]", '[record]\nfile = "base.csv"\n[measurements]'))
    with pytest.raises(ValueError, match=r"\[record\] one run for several data sets reads its motion itself"):
        make_problem(read_job(tmp_path / "frame.toml"))


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
        ("[measurements]", "[measurement]", "unknown section"),
        ('"stiffness_2"]', '"stiffness_3"]', "stiffness_3: this prior is missing"),
    ],
)
def test_what_does_not_fit_is_refused(settings_of, old, new, text):
    path = settings_of(old, new)
    with pytest.raises(ValueError, match=text):
        make_problem(read_job(path))
