"""The folder of a run may come from a stranger: a report of it runs no code that the folder names."""

import pickle
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
    source = folder / "strange_model.py"
    source.write_text(FUNCTION)
    (folder / "own.toml").write_text(OWN)
    call("run", "own.toml", "--out", "r")
    whole = (folder / "r" / "summary.txt").read_text()
    assert "RRMSE" in whole and (folder / "r" / "fit.csv").exists()
    sys.modules.pop("strange_model", None)
    source.write_text(HOSTILE + FUNCTION)
    if kind == "program":
        program = folder / "program.py"
        program.write_text(HOSTILE)
        command = f'command = ["{sys.executable}", "program.py", "$stiffness", "$damping"]\noutput = "out.txt"\ntemplates = {{"in.txt" = "base.csv"}}\n'
        settings = OWN.replace(
            'kind = "function"\nfunction = "strange_model.py:simulate"', 'kind = "executable"\n' + command
        )
        (folder / "r" / "settings.toml").write_text(settings)
    with monkeypatch.context() as patched:
        patched.setattr(models, "load_function", _refuse)
        for name in ("load", "loads", "Unpickler"):
            patched.setattr(pickle, name, _refuse)
        said = call("report", "r")
    assert "which was not run: the report has no responses" in " ".join(said.split())
    assert not (folder / "was_run").exists() and "strange_model" not in sys.modules
    summary = (folder / "r" / "summary.txt").read_text()
    assert summary.splitlines()[:4] == whole.splitlines()[:4]  # moments of the same samples
    assert "log-evidence" in summary
    if kind == "function":
        call("report", "r", "--run-code")
        assert (folder / "was_run").exists()  # the test can fail
        assert (folder / "r" / "fit.csv").exists()
