"""The scripts of docs/clusters with MPI and on one machine; jobs, workers and parents end in the middle."""

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.cache.verification import FIRST_ROWS
from samplers.record import Record

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "docs" / "clusters"
WALKERS = 250  # of slow_model.py
LOG_EVIDENCE = 2427.63  # +- 0.01, of problem.py with 2000 walkers in one process
PRINTED = re.compile(r"log-evidence ([\d.]+) \+- ([\d.]+)")


def needs(module):
    missing = importlib.util.find_spec(module) is None
    return pytest.mark.skipif(missing, reason=f"NO {module.upper()}: install it to test the scripts for clusters")


@pytest.fixture
def place(tmp_path):
    """Folder with the scripts of the documentation, whose model is slow."""
    for script in SCRIPTS.iterdir():
        if script.suffix in (".py", ".sh"):
            shutil.copy(script, tmp_path)
    slow = (Path(__file__).parent / "slow_model.py").read_text()
    with open(tmp_path / "problem.py", "a") as file:
        file.write(slow)
    return tmp_path


@contextlib.contextmanager
def started(place, *command):
    """A process of a script, which is killed at the end."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with (
        open(place / "output.txt", "ab") as output,
        subprocess.Popen(
            [sys.executable, *command], cwd=place, env=environment, stdout=output, stderr=output
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def lines(place, name):
    path = place / name
    return path.read_text().splitlines() if path.exists() else []


def progressed(place, process, number):
    """Wait until a number of simulations has ended."""
    stop = time.monotonic() + 300.0
    while len(lines(place, "ends.txt")) < number:
        assert process.poll() is None, (place / "output.txt").read_text()
        assert time.monotonic() < stop, "no progress"
        time.sleep(0.1)


def check_result(place, workers):
    """Every simulation that ended is kept, and the evidence equals that from one machine without interruptions.

    No evaluation has failed, so that none was given up because of the ends of its workers. Every simulation that ended
    is in the record and in the cache.
    Each of the workers of the process that was stopped may have run a simulation, which is made again, and may have
    sent another one that the cache has and the record does not: then two rows of the cache are verified at most.
    """
    text = (place / "output.txt").read_text()
    estimate, error = map(float, PRINTED.search(text).groups())
    assert abs(estimate - LOG_EVIDENCE) < 4.0 * np.hypot(error, 0.01) + 0.01, text  # printed with two digits
    record = Record(place / "run.h5.mcmc.record")
    evaluated = record.latest(record.count)
    assert record.count >= WALKERS
    assert np.isfinite(evaluated.log_prob).all() and not record.failed
    starts, ends = Counter(lines(place, "starts.txt")), Counter(lines(place, "ends.txt"))
    assert set(starts) == set(ends)  # what was interrupted was simulated again
    # the measurements are a simulation of the function, in each process, that is not one of the likelihood
    known = {tuple(row[:2]) for row in evaluated.coords}
    (measured,) = [each for each in ends if tuple(map(float, re.findall(r"[-+.e\d]{3,}(?=\))", each))) not in known]
    assert starts.pop(measured) == 2
    repeated = starts.total() - len(starts)
    assert repeated <= workers + FIRST_ROWS, (repeated, workers)
    with contextlib.closing(sqlite3.connect(place / "simulations.db")) as cache:
        rows = cache.execute("select count(*) from rows where size is null").fetchone()[0]
    assert rows == len(starts)


@pytest.mark.slow
def test_one_machine_stopped_by_a_signal_goes_on(place, monkeypatch):
    monkeypatch.setenv("SECONDS_PER_SIMULATION", "0.01")
    with started(place, "one_machine.py", "--cores", "2") as parent:
        progressed(place, parent, 1000)
        parent.send_signal(signal.SIGTERM)
        assert parent.wait(60) != 0
    with started(place, "one_machine.py", "--cores", "2") as parent:
        assert parent.wait(300) == 0
    check_result(place, 2)
