"""Executors of ``pool=``: same bits, one transfer of the model per process, early errors for invalid pools."""

import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing.pool import ThreadPool
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation import by_value, files
from fe_likelihoods.simulation.executors import LocalPool, as_executor
from fe_likelihoods.simulation.failure_reasons import ClosedPool
from fe_likelihoods.simulation.model import sent_simulation, simulate_batch
from tests.faults.treacherous import Absent, Gated, Large, Treacherous, Unpicklable, gone, posterior_of
from tests.lines import misfit_batch

SLOW = ("executor", "multiprocessing")  # kinds of pools
SPAWN = multiprocessing.get_context("spawn")


class Recorder:
    """A pool that pickles like processes."""

    def map(self, function, items):
        for item in items:
            function, item = pickle.loads(pickle.dumps((function, item)))
            yield function(item)


@pytest.fixture(autouse=True)
def nothing_known():
    by_value.load.cache_clear()


@pytest.fixture
def oscillator(rng):
    return LinearOscillator(Record("noise", 0.02, rng.normal(size=300)), period=0.6)


@pytest.fixture
def thetas(rng):
    thetas = rng.uniform(0.5, 2.0, size=(23, 2))
    thetas[5, 1] = 25.0  # overdamped: fails
    return thetas


POOLS = {
    "None": lambda: None,
    "three processes": lambda: LocalPool(3),
    "threads": lambda: ThreadPoolExecutor(3),
    "ThreadPool": lambda: ThreadPool(2),
    "executor": lambda: ProcessPoolExecutor(2, mp_context=SPAWN),
    "multiprocessing": lambda: SPAWN.Pool(2),
    "another object": Recorder,
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in POOLS])
def test_same_bits_on_every_executor(name, oscillator, thetas, rng):
    measured = rng.normal(size=(2, 300))
    expected = misfit_batch(oscillator, thetas, measured)
    assert [bool(reason) for reason in expected.reasons] == [row == 5 for row in range(23)]
    pool = POOLS[name]()
    executor = as_executor(pool, oscillator)
    for n in (23, 3, 1):
        result = misfit_batch(oscillator, thetas[:n], measured, executor)
        np.testing.assert_array_equal(result.misfit, expected.misfit[:n])
        assert result.reasons == expected.reasons[:n]
    function = sent_simulation(oscillator, measured)
    if executor is not None:
        outcomes = [future.result() for future in executor.submit_all(function, list(thetas))]
        np.testing.assert_array_equal([x for x, why in outcomes if not why], np.delete(expected.misfit, 5, axis=0))
        assert [why for _, why in outcomes] == expected.reasons
        assert executor.submit(function, thetas[5]).result() == (None, expected.reasons[5])
    responses = simulate_batch(oscillator, thetas, executor)
    np.testing.assert_array_equal(responses.response, simulate_batch(oscillator, thetas).response)
    for end in ("terminate", "shutdown", "close"):
        if hasattr(pool, end):
            getattr(pool, end)()
            break


@pytest.mark.parametrize(
    "pool",
    [0, -1, True, 2.5, "four", object(), float("nan"), [2]],
    ids=lambda pool: type(pool).__name__ if type(pool) is object else str(pool),
)
def test_invalid_pools_are_refused(pool):
    with pytest.raises(ValueError, match="pool must be None, a positive number of processes, or an object with map"):
        posterior_of(Treacherous(), pool=pool)


def test_a_worker_of_another_pool_loads_the_model_once():
    model, thetas = Large(), np.tile([0.2, 0.3], (20, 1))
    executor = as_executor(Recorder())
    for _ in range(2):
        assert simulate_batch(model, thetas, executor).reasons == [""] * 20
        assert by_value.load.cache_info().misses == 1


@pytest.mark.parametrize(
    "make", [lambda: 2, lambda: ProcessPoolExecutor(1), lambda: LocalPool(1)], ids=["2", "executor", "pool"]
)
def test_model_that_cannot_be_pickled_is_refused_with_the_type(make):
    with pytest.raises(
        ValueError, match="Unpicklable cannot be sent to another process .*Cannot pickle files"
    ) as error:
        posterior_of(Unpicklable(), pool=make())
    assert "must not contain open files" in str(error.value)


def test_model_that_cannot_be_loaded_is_an_error_not_a_failure():
    posterior = posterior_of(Absent(), pool=1)
    with pytest.raises(ValueError, match="cannot be loaded in a worker process: ModuleNotFoundError"):
        posterior(posterior.sample_prior(5, 1))
    with SPAWN.Pool(1) as pool:
        posterior = posterior_of(Absent(), pool=pool)
        with pytest.raises(ValueError, match="cannot be loaded in a worker process: ModuleNotFoundError"):
            posterior(posterior.sample_prior(5, 1))
    assert posterior.report()["simulations"] == 0


def test_threads_in_workers_are_limited(monkeypatch):
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"]
    for name in names:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # a choice of the user, which is kept
    with LocalPool(1) as pool:
        assert pool.map(os.getenv, names) == ["2", "1", "1"]


def test_likelihood_with_a_pool_of_its_own_pickles_without_it():
    posterior = posterior_of(Treacherous(), pool=2)
    x = posterior.sample_prior(7, 2)
    values = posterior(x)
    copy = pickle.loads(pickle.dumps(posterior))
    assert copy.likelihood.simulator.pool is None
    np.testing.assert_array_equal(copy(x), values)
    posterior.likelihood.simulator.pool.close()


SCRIPT = """
import sys
import numpy as np
COUNT = int(sys.argv[1])
print('run', end=' ')
unused = (number for number in range(3))
from fe_likelihoods.models.function import FunctionModel
from tests.faults.treacherous import CHANNELS, line, posterior_of

def mine(theta):
    return 2.0 * line(theta)

x = np.array([[0.1 * k, 0.2, 0.5] for k in range(1, 9)])
for limit in (None, 60.0):
    model = FunctionModel(mine, ("offset", "slope"), CHANNELS, 0.1, 20, time_limit=limit)
    print(posterior_of(model, pool=2)(x).tolist() == posterior_of(model)(x).tolist())
"""


def test_models_defined_in_a_script(tmp_path):
    """Workers do not run the script, so it needs no guard; values that the functions do not use are not sent."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    run = subprocess.run([sys.executable, script, "8"], env=environment, capture_output=True, text=True, timeout=120)
    assert " ".join(run.stdout.split()) == "run True True", run.stderr


# items that are submitted: each ends by itself -----------------------------------------------------------------------

LONG, SHORT = np.array([0.95, 0.1]), [np.array([offset, 0.1]) for offset in (0.1, 0.2, 0.3, 0.4)]
SECONDS = 60.0  # after which a test gives up


@pytest.fixture
def function(tmp_path):
    return sent_simulation(Gated(tmp_path))


def _process(_item):
    return os.getpid()


def wait_until(condition):
    stop = threading.Event()
    for _ in range(int(SECONDS / 0.01)):
        if condition():
            return
        stop.wait(0.01)
    raise AssertionError("it does not happen")


def test_a_function_that_cannot_be_loaded_is_the_error_of_its_items_only(shared_pool):
    with shared_pool(2) as pool:
        absent = pool.submit_all(sent_simulation(Absent()), SHORT)
        fine = pool.submit_all(sent_simulation(Treacherous()), SHORT)
        for future in absent:
            with pytest.raises(ValueError, match="cannot be loaded in a worker process: ModuleNotFoundError"):
                future.result()
        assert [future.result()[1] for future in fine] == [""] * 4
        unpicklable = pool.submit_all(abs, [threading.Lock(), -1])
        with pytest.raises(TypeError, match="cannot pickle"):
            unpicklable[0].result()
        assert unpicklable[1].result() == 1


def test_the_function_is_sent_once_to_each_process(shared_pool):
    function = sent_simulation(Large())
    with shared_pool(2) as pool:
        futures = [pool.submit(function, theta) for theta in SHORT * 5]
        assert {future.result()[0][0, 0] for future in futures} == {1.0}


def test_items_are_given_up(function, tmp_path):
    with LocalPool(1) as pool:
        (pid,) = pool.map(_process, [0])
        running, waiting = pool.submit_all(function, [LONG, SHORT[0]])
        wait_until(lambda: (tmp_path / f"started {LONG[0]!r}").exists())
        pool.give_up([running, waiting])
        assert waiting.cancelled()
        assert gone([pid])
        with pytest.raises(CancelledError):
            running.result()
        assert pool.submit(function, SHORT[1]).result()[1] == ""
        left = pool.submit(function, LONG)
    with pytest.raises(CancelledError):  # the pool was closed
        left.result(SECONDS)
    assert not (tmp_path / f"started {SHORT[0][0]!r}").exists()


@pytest.mark.parametrize("name", ["three processes", "threads"])
def test_a_run_whose_pool_is_closed_says_what_to_do(name, function, tmp_path):
    pool = POOLS[name]()
    close = partial(pool.shutdown, wait=False, cancel_futures=True) if name == "threads" else pool.close
    closing = threading.Thread(
        target=lambda: (wait_until(lambda: (tmp_path / f"started {LONG[0]!r}").exists()), close())
    )
    closing.start()
    with pytest.raises(ClosedPool, match="the pool was closed.*run again with an open pool") as raised:
        as_executor(pool).map(function, [LONG] * 5)
    assert str(pickle.loads(pickle.dumps(raised.value))) == str(raised.value)
    (tmp_path / "go").touch()
    closing.join()
    if name == "threads":  # a `LocalPool` starts new processes
        with pytest.raises(ClosedPool, match="run again with an open pool"):
            as_executor(pool).map(function, [LONG] * 5)


def test_a_process_that_starts_while_another_thread_ends_its_group_is_killed(monkeypatch):
    group, kill, killed, has_started = files.Group(), os.killpg, threading.Event(), threading.Event()

    def killpg(*arguments):
        kill(*arguments)
        killed.set()
        if threading.current_thread() is ending:
            has_started.wait(60.0)

    monkeypatch.setattr(files.os, "killpg", killpg)
    ending = threading.Thread(target=group.end, daemon=True)
    ending.start()
    assert killed.wait(60.0)
    process = group.start(["sleep", "600"])
    has_started.set()
    ending.join(60.0)
    assert not ending.is_alive() and process.poll() is not None


def test_items_whose_submission_is_interrupted_are_cancelled():
    class Interrupted:
        futures = []

        def submit(self, function, item):
            if item == 2:
                raise KeyboardInterrupt
            self.futures.append(Future())
            return self.futures[-1]

        map = None

    with pytest.raises(KeyboardInterrupt):
        as_executor(Interrupted()).map(abs, [0, 1, 2, 3])
    assert len(Interrupted.futures) == 2 and all(each.cancelled() for each in Interrupted.futures)


def test_cancelled_items_are_not_run(function, tmp_path, shared_pool):
    with shared_pool(1) as pool:
        futures = pool.submit_all(function, [LONG, *SHORT])
        wait_until(lambda: (tmp_path / f"started {LONG[0]!r}").exists())
        assert [future.cancel() for future in futures] == [False, True, True, True, True]
        (tmp_path / "go").touch()
        assert futures[0].result()[1] == ""
    with ThreadPoolExecutor(1) as threads:
        started, go = threading.Event(), threading.Event()
        executor = as_executor(threads)
        first, second = executor.submit_all(lambda item: (started.set(), str(go.wait(SECONDS))), [1, 2])
        assert started.wait(SECONDS)
        assert [first.cancel(), second.cancel()] == [False, True]
        executor.give_up([first])
        go.set()
        assert first.result()[1] == "True"
        assert isinstance(first, Future)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_forked_process_starts_workers_of_its_own():
    with LocalPool(1) as pool:
        parent = pool.map(_process, [0])
        child = os.fork()
        if not child:
            os._exit(int(pool.map(_process, [0]) == parent))
        assert os.waitpid(child, 0)[1] == 0
        assert pool.map(_process, [0]) == parent
