"""The folder of a run may come from a stranger: a report of it runs no code that the folder names."""

import pickle
import re
import sys

import pytest
from emcee.backends import HDFBackend

from fe_likelihoods.command import models
from tests.command.test_command import OSCILLATOR, call, folder  # noqa: F401

FUNCTION = """
from fe_likelihoods import LinearOscillator

def simulate(theta, record):
    return LinearOscillator(record, 0.8).simulate([*theta])
"""
OWN = OSCILLATOR.replace(
    'kind = "oscillator"\nperiod = "0.8 s"',
    """kind = "function"
function = "strange_model.py:simulate"
parameters = ["stiffness", "damping"]
channels = {acceleration = "absolute acceleration [g]", displacement = "relative displacement [cm]"}""",
)
RESULTS = {".html", ".txt", ".csv", ".nc"}
HOSTILE = "open('was_run', 'w').close()\n"


def _refuse(*arguments, **options):
    raise AssertionError("a report unpickles nothing")


@pytest.mark.slow
def test_a_report_of_a_folder_of_a_stranger_runs_no_code(folder, monkeypatch):  # noqa: F811
    source, settings = folder / "strange_model.py", folder / "r" / "settings.toml"
    source.write_text(FUNCTION)
    (folder / "own.toml").write_text(OWN)
    call("run", "own.toml", "--out", "r")
    whole = (folder / "r" / "summary.txt").read_text()
    assert "RRMSE" in whole and (folder / "r" / "fit.csv").exists()
    before = (folder / "r" / "summary.csv").read_text().splitlines()
    complete = {path.name: path.read_bytes() for path in (folder / "r").iterdir() if path.suffix in RESULTS}
    beside = folder / "r" / "without-model"
    evidence = re.search(r"log-evidence -?(\S+) \+- ([\d.]+)", whole)
    sys.modules.pop("strange_model", None)
    source.write_text(HOSTILE + FUNCTION)
    (folder / "program.py").write_text(HOSTILE)
    command = f'command = ["{sys.executable}", "program.py", "$stiffness", "$damping"]\ntime_limit = "20 s"\n'
    command += 'output = "out.txt"\ntemplates = {"in.txt" = "base.csv"}\n'
    function = 'kind = "function"\nfunction = "strange_model.py:simulate"'
    stored = settings.read_text()
    for text in (OWN.replace(function, 'kind = "executable"\n' + command), stored):  # a program, then the function
        settings.write_text(text)
        with monkeypatch.context() as patched:
            patched.setattr(models, "load_function", _refuse)
            for reader in ("load", "loads", "Unpickler"):
                patched.setattr(pickle, reader, _refuse)
            said = call("report", "r")
        assert "which was not run: the report has no responses and no predictions" in " ".join(said.split())
        assert not (folder / "was_run").exists() and "strange_model" not in sys.modules
        summary = (beside / "summary.txt").read_text()
        assert "stiffness" in summary and "the model was not run" in summary
        verdict = "Verdict of the sampler, as the run has stored it: "
        for written in (summary, (beside / "report.html").read_text()):
            assert f"{evidence[1]} ± {evidence[2]}, as the run has stored it" in written and verdict in written
            assert "gives no evidence" not in written
        rows = [(beside / name).read_text().splitlines() for name in ("summary.csv", "report.html")]
        assert len(rows[0]) == 5 and len(rows[1]) > 10
        means = [float(row.split(",")[1]) for row in rows[0][1:]]
        chain = HDFBackend(str(folder / "r" / "run.h5"), read_only=True).get_chain(flat=True)
        assert means[:2] == pytest.approx(chain.mean(axis=0)[:2], rel=1e-6)  # those of multiples have no unit
        # the run itself has weighted draws, whose means are more accurate
        found = [[float(each) for each in row.split(",")[1:4]] for row in before[1:]]
        assert all(abs(mean - other) < 0.2 * sd for mean, (other, _, sd) in zip(means, found, strict=True))
    assert complete == {name: (folder / "r" / name).read_bytes() for name in complete} and len(complete) > 4
    assert "contains another run" in call("report", "r", "--run-code", code=1)  # the code differs
    assert (folder / "was_run").exists()  # the test can fail
    (folder / "was_run").unlink()
    sys.modules.pop("strange_model", None)
    source.write_text(FUNCTION)
    call("report", "r", "--run-code")
    assert (folder / "r" / "fit.csv").exists()
    sys.modules.pop("strange_model", None)
