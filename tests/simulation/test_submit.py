"""Items that are submitted to an executor: each ends by itself, and as with ``map`` if it kills its process."""

import os
import threading
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, as_completed

import numpy as np
import pytest

from fe_likelihoods.simulation.executors import LocalPool, as_executor
from fe_likelihoods.simulation.model import sent_simulation
from tests.faults.treacherous import (
    Absent,
    Gated,
    Large,
    Treacherous,
    gone,
    line,
)

LONG, SHORT = np.array([0.95, 0.1]), [np.array([offset, 0.1]) for offset in (0.1, 0.2, 0.3, 0.4)]
SECONDS = 60.0  # after which a test gives up


@pytest.fixture
def function(tmp_path):
    return sent_simulation(Gated(tmp_path))


def wait_until(condition):
    stop = threading.Event()
    for _ in range(int(SECONDS / 0.01)):
        if condition():
            return
        stop.wait(0.01)
    raise AssertionError("it does not happen")


@pytest.mark.parametrize("kind", ["local", "threads"])
def test_whichever_ends_first_comes_first(kind, function, tmp_path, shared_pool):
    with shared_pool(2) if kind == "local" else ThreadPoolExecutor(2) as pool:
        check_order_of_arrival(as_executor(pool), function, tmp_path)


def check_order_of_arrival(executor, function, tmp_path):
    futures = executor.submit_all(function, [LONG, *SHORT])
    arrivals = as_completed(futures, timeout=SECONDS)
    assert {next(arrivals) for _ in SHORT} == set(futures[1:])
    assert not futures[0].done()
    (tmp_path / "go").touch()
    assert next(arrivals) is futures[0]
    for future, theta in zip(futures, [LONG, *SHORT], strict=True):
        response, reason = future.result()
        np.testing.assert_array_equal(response, line(theta))
        assert reason == ""


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


def test_map_goes_before_items_that_wait(function, tmp_path, shared_pool):
    """A verification does not wait for a batch of long runs."""
    with shared_pool(1) as pool:
        first = pool.submit_all(function, [SHORT[0], LONG])
        first[0].result()
        waiting = pool.submit_all(function, [LONG + 0.01])
        (tmp_path / "go").touch()
        assert pool.map(abs, [-1, -2]) == [1, 2]
        assert all(future.result()[1] == "" for future in [*first, *waiting])


def test_items_are_given_up(function, tmp_path):
    with LocalPool(1) as pool:
        (pid,) = pool.map(os.getsid, [0])
        running, waiting = pool.submit_all(function, [LONG, SHORT[0]])
        wait_until(lambda: (tmp_path / f"started {LONG[0]!r}").exists())
        pool.give_up([running, waiting], running=False)
        assert waiting.cancelled() and running.running()
        pool.give_up([running])
        assert gone([pid])
        with pytest.raises(CancelledError):
            running.result()
        assert pool.submit(function, SHORT[1]).result()[1] == ""
        left = pool.submit(function, LONG)
    with pytest.raises(CancelledError):  # the pool was closed
        left.result(SECONDS)
    assert not (tmp_path / f"started {SHORT[0][0]!r}").exists()


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
        executor.give_up([first], running=False)
        go.set()
        assert first.result()[1] == "True"
        assert isinstance(first, Future)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_forked_process_starts_workers_of_its_own():
    with LocalPool(1) as pool:
        parent = pool.map(os.getsid, [0])
        child = os.fork()
        if not child:
            os._exit(int(pool.map(os.getsid, [0]) == parent))
        assert os.waitpid(child, 0)[1] == 0
        assert pool.map(os.getsid, [0]) == parent
