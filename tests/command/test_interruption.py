"""Real processes of the command: killed, continued, and stopped with Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.command.test_command import OSCILLATOR, ROOT, folder, function_settings

__all__ = ["folder"]  # the fixture

SLOW_STEPS = OSCILLATOR.replace("steps = 2", "steps = 100")
SAME = ("summary.csv", "fit.csv")  # the verdict in summary.txt counts the simulations of one process


def start(out: str, file: str = "oscillator.toml") -> subprocess.Popen:
    """The command in a process that Ctrl-C reaches, also where the tests run in the background."""
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"from fe_likelihoods.command.main import main; main(['run', {file!r}, '--quiet', '--out', {out!r}])"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code], env=environment, **streams)


def wait_for_steps(run: subprocess.Popen, out: str) -> None:
    """Wait until the record of a run has more than its first blocks."""
    record = Path(out) / "run.h5.mcmc.record"
    while not (record.exists() and record.stat().st_size > 20_000):
        assert run.poll() is None, run.communicate()
        time.sleep(0.01)


@pytest.mark.slow  # five processes, each with its imports
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_run_is_continued_by_the_same_command(folder):
    (folder / "oscillator.toml").write_text(SLOW_STEPS)
    killed = start("killed")
    wait_for_steps(killed, "killed")
    killed.kill()
    killed.communicate()
    assert not Path("killed/summary.csv").exists()
    stopped = start("stopped")
    wait_for_steps(stopped, "stopped")
    stopped.send_signal(signal.SIGINT)
    output = stopped.communicate()[1]
    assert stopped.returncode == 130 and "Traceback" not in output
    assert output.splitlines()[-1] == (
        "Interrupted. What was computed is kept in stopped/; "
        "go on with: fe-likelihoods run oscillator.toml --out stopped"
    )
    for out in ("killed", "stopped", "whole"):
        run = start(out)
        assert run.wait(timeout=500) == 0, run.communicate()
    for name in SAME:
        whole = (folder / "whole" / name).read_text()
        assert (folder / "killed" / name).read_text() == whole
        assert (folder / "stopped" / name).read_text() == whole


FUNCTION = """
import time
import numpy as np
from fe_likelihoods import LinearOscillator

def simulate(theta, record):
    if record.name == "event":
        with open("simulated.txt", "a") as file:
            file.write(f"{theta[0]!r}\\n")
        time.sleep(0.3)
    return LinearOscillator(record, 0.8).simulate([*theta])
"""
OWN = function_settings("my_model")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_prediction_of_an_event_repeats_nothing(folder):
    """Of 10 simulations of an event, those that ended before kill -9 are not run again, but for two to verify."""
    (folder / "my_model.py").write_text(FUNCTION)
    (folder / "event.csv").write_text((folder / "base.csv").read_text())
    (folder / "own.toml").write_text(OWN + '[events.second]\nfile = "event.csv"\nscale = 0.9\n')
    simulated = folder / "simulated.txt"
    killed = start("r", "own.toml")
    while not (simulated.exists() and len(simulated.read_text().splitlines()) >= 6):
        assert killed.poll() is None, killed.communicate()
        time.sleep(0.01)
    killed.kill()
    killed.communicate()
    before = len(simulated.read_text().splitlines())
    assert before < 10 and not (folder / "r" / "events.csv").exists()
    again = start("r", "own.toml")
    assert again.wait(timeout=500) == 0, again.communicate()
    lines = simulated.read_text().splitlines()
    assert len(set(lines)) == 10
    assert len(lines) <= 10 + 1 + 2, lines  # the one that was killed, and two that are verified
    assert (folder / "r" / "events.csv").exists()
