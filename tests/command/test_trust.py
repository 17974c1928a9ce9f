"""The folder of a run may come from a stranger: a report of it runs no code that the folder names."""

import pickle
import sys

import pytest

from fe_likelihoods.command import make_posterior
from tests.command.test_command import call, folder, function_settings  # noqa: F401

FUNCTION = """
from fe_likelihoods import LinearOscillator

def simulate(theta, record):
    return LinearOscillator(record, 0.8).simulate([*theta])
"""
OWN = function_settings("strange_model")
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
    files = {path.name: path.read_bytes() for path in (folder / "r").iterdir() if path.suffix in RESULTS}
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
            patched.setattr(make_posterior, "load_function", _refuse)
            for reader in ("load", "loads", "Unpickler"):
                patched.setattr(pickle, reader, _refuse)
            assert "nothing was run: give --run-code if you trust" in " ".join(call("report", "r", code=1).split())
        assert not (folder / "was_run").exists() and "strange_model" not in sys.modules
    assert files == {name: (folder / "r" / name).read_bytes() for name in files} and len(files) > 3
    assert "contains a run with other data" in call("report", "r", "--run-code", code=1)  # the code differs
    assert (folder / "was_run").exists()  # the test can fail
    (folder / "was_run").unlink()
    sys.modules.pop("strange_model", None)
    source.write_text(FUNCTION)
    call("report", "r", "--run-code")
    assert (folder / "r" / "summary.csv").exists()
    sys.modules.pop("strange_model", None)
