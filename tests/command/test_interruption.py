"""Real processes of the command: killed, continued, and stopped with Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.command.test_command import OSCILLATOR, ROOT, folder

__all__ = ["folder"]  # the fixture

SLOW_STEPS = OSCILLATOR.replace("steps = 2", "steps = 100")
SAME = ("summary.csv",)  # the verdict in summary.txt counts the simulations of one process


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
