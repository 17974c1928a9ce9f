"""Faults of the infrastructure and time limits: -inf in this run with a reason, and simulated again in a later one."""

import errno
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections import namedtuple
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest

from fe_likelihoods import (
    ExecutableModel,
    FELikelihood,
    FunctionModel,
    Measurements,
    SimulationCache,
    SimulationFailed,
)
from fe_likelihoods.simulation.failure_reasons import TransientReason
from fe_likelihoods.simulation.model import misfit_of_responses, sent_simulation, simulate_batch
from samplers import SMCSampler
from tests.cache.stored import store_outcomes, stored_outcomes
from tests.faults import treacherous as bad
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, Hidden, Treacherous, line
from tests.lines import misfit_batch

NAMES = ("offset", "slope")
THETAS = np.array([[0.2, 0.1], [0.4, 0.1], [0.6, 0.1]])


class Faulty(Treacherous):
    """Counts its runs; fails at the second of `THETAS` with an exception, if it is given one."""

    fingerprint = "faulty"
    error = Hidden()

    def __init__(self, error=None, time_limit=None):
        self.error, self.time_limit, self.runs = error, time_limit, 0

    def simulate(self, theta):
        self.runs += 1
        if self.error is not None and theta[0] == 0.4:
            raise self.error
        return line(theta)


class FaultyBatch(Faulty):
    """The same with a batch method of its own."""

    fingerprint = "faulty batch"

    def simulate_batch(self, thetas):
        return np.array([self.simulate(theta) for theta in thetas]), [""] * len(thetas)


def likelihood_of(model, cache=None, data=0.0, **options):
    return FELikelihood(model, Measurements(CHANNELS, DT, np.full((1, N_STEPS), data)), cache=cache, **options)


FAULTS = {
    "no space": OSError(errno.ENOSPC, "No space left on device"),
    "no folder": FileNotFoundError(errno.ENOENT, "No such file or directory", "/scratch/run"),
    "no memory": MemoryError("Unable to allocate 8 GiB"),
    "connection": ConnectionResetError("the licence server closed the connection"),
    "no library": ModuleNotFoundError("No module named 'solver'"),
    "own pool": BrokenProcessPool("a child process terminated abruptly"),
    "own time limit": subprocess.TimeoutExpired("solver", 5.0),
    "own program killed": subprocess.CalledProcessError(-9, "solver"),
    "declared": SimulationFailed(TransientReason("no licence was free")),
}
ANSWERS = {
    "exception": ZeroDivisionError("float division by zero"),
    "refused": SimulationFailed("no convergence at step 3"),
    "exit code": subprocess.CalledProcessError(2, "solver"),
}


@pytest.mark.parametrize("kind", [Faulty, FaultyBatch])
@pytest.mark.parametrize("name", FAULTS | ANSWERS)
def test_a_fault_is_simulated_again_in_a_later_run_and_an_answer_is_not(name, kind, tmp_path):
    error, transient = (FAULTS | ANSWERS)[name], name in FAULTS
    first = likelihood_of(kind(error), tmp_path / "cache.sqlite")
    for _ in range(2):  # the run itself does not repeat it
        assert np.isnan(first.misfit(THETAS)).any(axis=1).tolist() == [False, True, False]
    assert (first.simulations, first.simulator.failures.count, first.simulator.failures.transient) == (
        3,
        1,
        int(transient),
    )
    (failure,) = first.simulator.failures.records
    assert failure["parameters"] == {"offset": 0.4, "slope": 0.1}
    assert str(error) in failure["reason"]
    assert failure.get("transient", False) == transient
    assert first.simulator.cache.info().simulations == 3 - transient

    later = likelihood_of(kind(None if transient else error), tmp_path / "cache.sqlite")
    values = later.misfit(THETAS)
    assert np.isfinite(values).all() == transient
    assert later.simulations == int(transient)
    assert later.simulator.failures.count == int(not transient)
    again = likelihood_of(kind(None if transient else error), tmp_path / "cache.sqlite")
    np.testing.assert_array_equal(again.misfit(THETAS), values)
    assert again.simulations == 0


@pytest.mark.parametrize("responses", [False, True])
def test_a_failure_of_the_model_is_not_repeated_for_other_measurements(responses, tmp_path):
    cache = SimulationCache(tmp_path / "cache.sqlite", responses=responses)
    likelihood_of(Faulty(ANSWERS["refused"]), cache).misfit(THETAS)
    other = likelihood_of(Faulty(ANSWERS["refused"]), cache, data=1.0)
    assert np.isnan(other.misfit(THETAS)[1]).all()
    assert other.model.runs - other.simulator.verifications == other.simulations == (0 if responses else 2)
    assert other.simulator.failures.records == [
        {"parameters": {"offset": 0.4, "slope": 0.1}, "reason": "no convergence at step 3"}
    ]


def _undefined(residuals):
    if residuals.max() < -10.0:
        raise ZeroDivisionError("the statistic is not defined")
    return np.square(residuals).sum(axis=-1)


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_failure_that_depends_on_the_measurements_is_not_used_for_others(tmp_path):
    """The misfit overflows with the first data; it does not with the others."""
    cache = SimulationCache(tmp_path / "cache.sqlite")
    first = likelihood_of(Faulty(), cache, data=1e200)
    assert np.isnan(first.misfit(THETAS)).all()
    assert first.simulator.failures.reasons == {"the misfit of channel 'a' is not finite": 3}
    other = likelihood_of(Faulty(), cache)
    assert np.isfinite(other.misfit(THETAS)).all()
    run = sent_simulation(Faulty(), np.full((1, N_STEPS), 100.0), _undefined)
    far = [run(theta)[1] for theta in THETAS]
    store_outcomes(cache, Faulty(), THETAS, far)
    assert far == ["ZeroDivisionError: the statistic is not defined"] * 3
    responses = simulate_batch(Faulty(), THETAS)
    misfit, reasons = misfit_of_responses(Faulty(), responses, np.full((1, N_STEPS), 100.0), _undefined)
    assert reasons == far and np.isnan(misfit).all()
    assert stored_outcomes(cache, Faulty(), THETAS) == [None] * 3


# real faults ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "pool"), [("CRASHES", None), pytest.param("LEAVES", 1, marks=pytest.mark.slow)], ids=["isolated", "pool"]
)
def test_a_worker_that_dies_is_not_an_answer(what, pool, tmp_path):
    model = (
        FunctionModel(bad.treacherous, NAMES, CHANNELS, DT, N_STEPS, isolated=True) if pool is None else Treacherous()
    )
    x = np.array([[getattr(bad, what) + 0.5, 0.1], [0.3, 0.1]])
    first = likelihood_of(model, tmp_path / "cache.sqlite", pool=pool)
    for n in (1, 2):
        likelihood = first if n == 1 else likelihood_of(model, tmp_path / "cache.sqlite", pool=first.simulator.pool)
        assert np.isnan(likelihood.misfit(x)).all(axis=1).tolist() == [True, False]
        assert likelihood.simulations == 3 - n
        assert likelihood.simulator.failures.transient == 1
        assert likelihood.simulator.failures.records[0]["parameters"]["offset"] == x[0, 0]
    if pool is not None:
        first.simulator.pool.close()


def test_faults_in_an_isolated_process_keep_their_kind():
    """Also an exception that cannot be unpickled; a function that cannot be loaded there is an error."""
    model = FunctionModel(bad.unreachable, NAMES, CHANNELS, DT, N_STEPS, isolated=True, version="1")
    (found,) = simulate_batch(model, THETAS[:1]).reasons
    assert isinstance(found, TransientReason)
    assert found.startswith("Unreachable: licences:27000 is unreachable")
    model = FunctionModel(bad.Absent().simulate, NAMES, CHANNELS, DT, N_STEPS, isolated=True, version="1")
    with pytest.raises(ValueError, match="a function cannot be loaded in a worker process: ModuleNotFoundError"):
        simulate_batch(model, THETAS[:1])


SOLVER = "import sys; offset, slope = map(float, open('in.txt').read().split()); {do}; " + (
    f"open('out.txt', 'w').write(''.join(f'{{{{offset + slope * {DT} * k!r}}}}\\n' for k in range({N_STEPS})))"
)


def program(do="pass", **options):
    return ExecutableModel(
        [sys.executable, "-S", "-c", SOLVER.format(do=do)],
        {"in.txt": "$offset $slope"},
        "out.txt",
        NAMES,
        CHANNELS,
        DT,
        N_STEPS,
        **{"time_limit": 20.0, "version": "1"} | options,
    )


def reason_of_run(model):
    (reason,) = simulate_batch(model, THETAS[:1]).reasons
    return reason


def test_a_program_without_its_temporary_folder(tmp_path, monkeypatch):
    likelihood = likelihood_of(program(), tmp_path / "cache.sqlite")
    with monkeypatch.context() as patched:
        patched.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
        assert np.isnan(likelihood.misfit(THETAS[:1])).all()
    assert "No such file or directory" in likelihood.simulator.failures.records[0]["reason"]
    assert np.isfinite(likelihood_of(program(), tmp_path / "cache.sqlite").misfit(THETAS[:1])).all()


def test_a_program_on_a_full_disk(monkeypatch):
    """It ends with exit code 0 and an incomplete output file."""
    model = program("sys.exit()")
    assert not isinstance(reason_of_run(model), TransientReason)
    usage = namedtuple("usage", "total used free")(100, 100, 0)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    reason = reason_of_run(model)
    assert isinstance(reason, TransientReason)
    assert reason.startswith("the program succeeded but wrote no file out.txt (the disk of the temporary folder")


@pytest.mark.parametrize(
    ("do", "transient"),
    [("sys.exit('no convergence')", False), ("sys.exit(137)", True), ("import os; os.kill(os.getpid(), 9)", True)],
)
def test_exit_codes_of_programs(do, transient):
    assert isinstance(reason_of_run(program(do)), TransientReason) == transient


# records ------------------------------------------------------------------------------------------------------------


class FullDisk(Treacherous):
    """Fails at offsets below 0.1."""

    def simulate(self, theta):
        if theta[0] < 0.1:
            raise FAULTS["no space"]
        return line(theta)


class Copies:
    """A pool that calls a copy of the function, as other processes do."""

    def map(self, function, items):
        return map(pickle.loads(pickle.dumps(function)), items)


def test_faults_in_the_pool_of_a_sampler_are_in_its_records(seed):
    """The records of the posterior equal the records of its copy in a worker."""
    points = np.random.default_rng(seed).uniform(0.2, 0.8, size=(20, 3))
    points[7, 0] = 0.05
    posterior = bad.posterior_of(FullDisk())
    sampler = SMCSampler(20, 3, posterior, pool=Copies(), log_prior_fn=posterior.log_prior, seed=seed)
    log_prob, _ = sampler.compute_log_prob(points)
    assert np.isneginf(log_prob).tolist() == (np.arange(20) == 7).tolist()
    (failure,) = sampler.failures
    np.testing.assert_array_equal(failure["parameters"], points[7])
    assert failure["reason"] == "OSError: [Errno 28] No space left on device"


# complex responses ---------------------------------------------------------------------------------------------------


def complex_line(theta):
    return line(theta) + (1e-20j if theta[0] == 0.4 else 0.0)


@pytest.mark.filterwarnings("error")
def test_a_complex_response_is_refused():
    model = FunctionModel(complex_line, NAMES, CHANNELS, DT, N_STEPS)
    for batch in (simulate_batch(model, THETAS), misfit_batch(model, THETAS, line(THETAS[0]))):
        assert [bool(reason) for reason in batch.reasons] == [False, True, False]
        assert batch.reasons[1].startswith("the response of channel 'a' is complex, expected real numbers")
        assert not isinstance(batch.reasons[1], TransientReason)


@pytest.mark.parametrize("form", [lambda rows: rows, list, tuple, lambda rows: [*rows[:-1], rows[-1]]])
def test_a_masked_sample_is_no_number(form):
    def simulate(theta):
        return form(np.ma.masked_where((theta[0] == 0.4) & (np.arange(N_STEPS) == 2)[None], line(theta)))

    batch = simulate_batch(FunctionModel(simulate, NAMES, CHANNELS, DT, N_STEPS), THETAS)
    assert [bool(reason) for reason in batch.reasons] == [False, True, False]


def test_masked_integers_without_a_mask_are_numbers():
    model = FunctionModel(lambda theta: np.ma.array(np.round(line(theta)), dtype=int), NAMES, CHANNELS, DT, N_STEPS)
    assert simulate_batch(model, THETAS).reasons == [""] * 3
