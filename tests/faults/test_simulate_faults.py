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
from tests.faults import cached_run, guided_run
from tests.faults import treacherous as bad
from tests.faults.treacherous import CHANNELS, DT, DiesOnce, Treacherous, line

ROOT = Path(__file__).parents[2]
PROGRAM = """
import os
import sys
from fe_likelihoods import SimulationCache
from tests.faults import cached_run, test_simulate_faults

os.environ["SECONDS_PER_SIMULATION"] = "0.01"
posterior = cached_run.make(SimulationCache(sys.argv[1], responses=True))[1]
posterior.likelihood.simulate(test_simulate_faults.requested())
"""


def requested():
    """Structural parameters of 300 oscillators, of which about 30 fail because their damping is negative."""
    random = np.random.default_rng(5)
    return np.column_stack([random.uniform(0.5, 1.5, 300), random.uniform(-0.1, 1.0, 300)])


def test_a_killed_program_has_stored_what_it_finished(tmp_path):
    path = tmp_path / "killed.sqlite"
    command = [sys.executable, "-c", PROGRAM, str(path)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        watched = None
        while watched is None or watched.info().simulations < 80:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
            if watched is None and path.exists():
                watched = SimulationCache(path)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    stored = watched.info()
    assert 80 <= stored.simulations < 300  # so many that they are adopted

    thetas = requested()
    whole = cached_run.make(SimulationCache(tmp_path / "whole.sqlite", responses=True))[1].likelihood
    expected = whole.simulate(thetas)
    again = cached_run.make(SimulationCache(path, responses=True))[1].likelihood
    batch = again.simulate(thetas)
    np.testing.assert_array_equal(batch.response, expected.response)
    assert batch.reasons == expected.reasons
    assert 10 < again.simulator.failures.count == sum(map(bool, batch.reasons))
    known = stored.failures + stored.responses
    assert stored.simulations <= known < 300
    assert again.simulations == again.model.runs - again.simulator.verifications == 300 - known
    np.testing.assert_array_equal(again.simulator.statistics(thetas), whole.simulator.statistics(thetas))
    assert again.simulations == 300 - known


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


def test_a_point_that_kills_its_worker_fails_alone(tmp_path):
    offset = np.linspace(0.1, 0.9, 12)
    thetas = np.column_stack([bad.FINE + offset, np.full(12, 0.1)])
    thetas[[3, 8], 0] += bad.CRASHES - bad.FINE
    model = Treacherous()
    measured = Measurements(CHANNELS, DT, np.zeros((len(CHANNELS), model.n_steps)))
    likelihood = FELikelihood(model, measured, pool=2, cache=tmp_path / "cache.sqlite")
    try:
        batch = likelihood.simulate(thetas)
        fine = np.setdiff1d(np.arange(12), [3, 8])
        np.testing.assert_array_equal(batch.response[fine], [line(theta) for theta in thetas[fine]])
        assert np.isnan(batch.response[[3, 8]]).all()
        assert likelihood.simulator.failures.reasons == {"the worker process died (signal 11)": 2}
        assert (likelihood.simulations, likelihood.simulator.cache.info().simulations) == (12, 10)
        again = likelihood.simulate(thetas)  # neither the responses nor the failures are repeated
        np.testing.assert_array_equal(again.response, batch.response)
        assert np.isfinite(likelihood.simulator.statistics(thetas)[fine]).all()
        assert likelihood.simulations == 12
    finally:
        likelihood.simulator.pool.close()


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
