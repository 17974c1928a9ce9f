"""Responses on request: killed programs and workers lose no finished simulation and change no result."""

import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.signals.channels import Measurements
from tests.cache.stored import stored_outcomes
from tests.faults import guided_run
from tests.faults import treacherous as bad
from tests.faults.treacherous import CHANNELS, DT, DiesOnce, line

ROOT = Path(__file__).parents[2]


def guided(path, log):
    """A run with a guide over two processes, in a program of its own."""
    command = [sys.executable, "-m", "tests.faults.guided_run", str(path), str(log), "0.02"]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_a_guide_that_is_killed_repeats_no_stored_simulation(tmp_path, stop=120):
    """Started again from scratch: ``cache="path"`` has the responses, of short parts of the record as well.

    Only the few rows of every part are simulated again by which a new program verifies what is stored.
    """
    path, log = tmp_path / "killed.sqlite", tmp_path / "log"  # the log's name is an attribute of the model
    with guided(path, log) as process:
        while len(guided_run.runs(log)) < stop:
            assert process.poll() is None
            time.sleep(0.002)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    time.sleep(0.2)  # the workers end
    first = guided_run.runs(log)
    cache, stored = SimulationCache(path), set()
    for n_steps, *theta in first:
        model = guided_run.Vibration(str(log), 0.0, n_steps)
        (response,) = stored_outcomes(cache, model, [theta])
        if response is not None and not isinstance(response, str):
            stored.add((n_steps, *theta))
            np.testing.assert_array_equal(response, model.simulate(theta))
    assert len(stored) == cache.info().responses > 0
    cache.close()
    before = len(guided_run.runs(log))
    with guided(path, log) as process:
        again = process.communicate()[0].split()
    with guided(tmp_path / "whole.sqlite", tmp_path / "whole") as process:
        whole = process.communicate()[0].split()
    second, third = guided_run.runs(log)[before:], guided_run.runs(tmp_path / "whole")
    verified = Counter(n_steps for n_steps, *_ in stored & set(second))
    assert max(verified.values()) <= 3 < min(stop / 5, len(stored) / 5)
    new = [run for run in second if run not in stored]
    assert set(first) | set(new) == set(third)  # of walkers the misfits are stored, without the response
    assert len(set(first) & set(new)) <= 4  # simulations under way at the kill
    assert len(set(new)) == len(new) and len(set(third)) == len(third)
    assert again[0] == whole[0]


def test_points_of_killed_workers_are_run_again(tmp_path):
    offset = np.linspace(0.1, 0.9, 4)
    thetas = np.column_stack([np.append(bad.KILLED + offset, bad.FINE + offset), np.full(8, 0.1)])
    (tmp_path / "deaths").mkdir()
    model = DiesOnce(tmp_path / "deaths")
    measured = Measurements(CHANNELS, DT, np.zeros((len(CHANNELS), model.n_steps)))
    likelihood = FELikelihood(model, measured, pool=2)
    try:
        batch = likelihood.simulate(thetas)
    finally:
        likelihood.simulator.pool.close()
    assert batch.reasons == [""] * 8
    assert (likelihood.simulations, likelihood.simulator.failures.count) == (8, 0)
    np.testing.assert_array_equal(batch.response, [line(theta) for theta in thetas])
