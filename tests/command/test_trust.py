"""The folder of a run may come from a stranger: a report of it runs no code that the folder names."""

import pickle
import re
import sys

import pytest

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
HOSTILE = "open('was_run', 'w').close()\n"


def _refuse(*arguments, **options):
    raise AssertionError("a report unpickles nothing")


@pytest.mark.parametrize("kind", ["function", "program"])
def test_a_report_of_a_folder_of_a_stranger_runs_no_code(kind, folder, monkeypatch):  # noqa: F811
    own = OWN.replace("strange_model", name := f"strange_{kind}")  # imported once per process
    source = folder / f"{name}.py"
    source.write_text(FUNCTION)
    (folder / "own.toml").write_text(own)
    call("run", "own.toml", "--out", "r")
    whole = (folder / "r" / "summary.txt").read_text()
    assert "RRMSE" in whole and (folder / "r" / "fit.csv").exists()
    before = (folder / "r" / "summary.csv").read_text().splitlines()
    sys.modules.pop(name, None)
    source.write_text(HOSTILE + FUNCTION)
    if kind == "program":
        program = folder / "program.py"
        program.write_text(HOSTILE)
        command = f'command = ["{sys.executable}", "program.py", "$stiffness", "$damping"]'
        command += '\noutput = "out.txt"\ntemplates = {"in.txt" = "base.csv"}\n'
        settings = own.replace(
            'kind = "function"\nfunction = "strange_program.py:simulate"', 'kind = "executable"\n' + command
        )
        (folder / "r" / "settings.toml").write_text(settings)
    with monkeypatch.context() as patched:
        patched.setattr(models, "load_function", _refuse)
        for reader in ("load", "loads", "Unpickler"):
            patched.setattr(pickle, reader, _refuse)
        said = call("report", "r")
    assert "which was not run: the report has no responses and no predictions" in " ".join(said.split())
    assert not (folder / "was_run").exists() and name not in sys.modules
    summary = (folder / "r" / "summary.txt").read_text()
    assert "stiffness" in summary and "the model was not run" in summary
    evidence = re.search(r"log-evidence -?(\S+) \+- ([\d.]+)", whole)
    verdict = "Verdict of the sampler, as the run has stored it: "
    for text in (summary, (folder / "r" / "report.html").read_text()):
        assert f"{evidence[1]} ± {evidence[2]}, as the run has stored it" in text and verdict in text
        assert "gives no evidence" not in text
    rows = [
        (folder / "r" / name).read_text().splitlines() for name in ("summary.csv", "report.html", "posterior.nc")[:2]
    ]
    assert len(rows[0]) == 5 and len(rows[1]) > 10
    means = [float(row.split(",")[1]) for row in rows[0][1:]]
    assert means == pytest.approx([float(row.split(",")[1]) for row in before[1:]], rel=1e-6)  # of the same samples
    if kind == "function":
        assert "contains another run" in call("report", "r", "--run-code", code=1)  # the code differs
        assert (folder / "was_run").exists()  # the test can fail
        (folder / "was_run").unlink()
        sys.modules.pop(name, None)
        source.write_text(FUNCTION)
        call("report", "r", "--run-code")
        assert (folder / "r" / "fit.csv").exists()
