"""Workers that die, parents that die, models that fail: no run hangs, no result is lost, no process is left over."""

import gc
import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.simulation.executors import LocalPool
from fe_likelihoods.simulation.model import simulate_batch
from tests.faults import treacherous as bad
from tests.faults.pooled_run import WORKERS, at_work
from tests.faults.treacherous import (
    DiesLoading,
    DiesOnce,
    Treacherous,
    descendants,
    gone,
    posterior_of,
)

ROOT = Path(__file__).parents[2]
needs_proc = pytest.mark.skipif(not Path("/proc").is_dir(), reason="NO /proc: cannot list processes")


def needs(module):
    missing = importlib.util.find_spec(module) is None
    return pytest.mark.skipif(missing, reason=f"NO {module.upper()}: install it to test this pool")


@pytest.fixture(autouse=True)
def nothing_is_left():
    """No process that a test started outlives it."""
    before = workers_now() if Path("/proc").is_dir() else set()
    yield
    gc.collect()  # samplers and their states refer to each other
    if Path("/proc").is_dir():
        assert gone(list(workers_now() - before))  # the resource tracker of multiprocessing stays


def workers_now():
    """Worker processes of this process, also in pools that other tests share."""
    return {child for child in descendants(os.getpid()) if b"fe_likelihoods.simulation.executors" in _command(child)}


def _command(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def theta(what, n=1):
    return np.column_stack([what + np.linspace(0.1, 0.9, n), np.full(n, 0.1)])


# workers that die ---------------------------------------------------------------------------------------------------


def test_processes_may_die_while_they_load_the_function(tmp_path):
    function = DiesLoading(tmp_path)
    with LocalPool(1) as pool:
        assert pool.map(function, [5, 6]) == [5, 6]
    assert len(list(tmp_path.iterdir())) == 2


@needs_proc
def test_idle_worker_that_is_killed_is_replaced():
    others = workers_now()
    with LocalPool(1) as pool:
        expected = simulate_batch(Treacherous(), theta(bad.FINE, 3), pool)
        (pid,) = workers_now() - others
        os.kill(pid, 9)
        assert gone([pid])
        batch = simulate_batch(Treacherous(), theta(bad.FINE, 3), pool)
        np.testing.assert_array_equal(batch.response, expected.response)


@needs_proc
def test_workers_end_with_the_likelihood_and_after_an_interrupt():
    others, posterior = workers_now(), posterior_of(Treacherous(), pool=2)
    posterior(posterior.sample_prior(4, 1))
    workers = list(workers_now() - others)
    assert len(workers) == 2
    del posterior
    assert gone(workers)
    with LocalPool(2) as pool, pytest.raises(KeyboardInterrupt):
        pool.map(_interrupts, range(4))


class _Interrupt(Exception):
    def __reduce__(self):
        return _interrupt, ()


def _interrupt():
    raise KeyboardInterrupt  # when the parent reads the reply of a worker


def _interrupts(item):
    return _Interrupt()


@pytest.mark.slow
@needs("dask")
@needs("distributed")
def test_dask_retries_and_gives_up_on_the_item_that_kills_its_worker_only(tmp_path):
    import dask
    from dask.distributed import Client, LocalCluster

    thetas = np.concatenate([theta(bad.FINE, 3), theta(bad.KILLED), theta(bad.FINE, 3)])
    x = np.column_stack([thetas, np.full(7, 0.5)])
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 2, "distributed.deploy.lost-worker-timeout": "60s"}),
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        expected = posterior_of(Treacherous(), top=20.0)(x[:3])
        posterior = posterior_of(DiesOnce(tmp_path), top=20.0, pool=client)
        assert np.isfinite(posterior(x)).all()
        posterior = posterior_of(Treacherous(), top=20.0, pool=client)
        values = posterior(x)
        np.testing.assert_array_equal(values[:3], expected)
        assert np.isneginf(values[3])
        assert np.isfinite(values[4:]).all()
        assert posterior.report()["failure_reasons"] == {"the worker process died in every attempt of dask": 1}
        # beside many short runs
        many = np.column_stack([theta(bad.FINE, 40), np.full(40, 0.5)])
        expected = posterior_of(Treacherous(), top=20.0)(many)
        np.testing.assert_array_equal(posterior(many), expected)
        many[:, 1] *= 0.5
        expected = posterior_of(Treacherous(), top=20.0)(many)
        many[3, 0] += bad.KILLED
        values = posterior(many)
        assert np.isneginf(values[3])
        np.testing.assert_array_equal(np.delete(values, 3), np.delete(expected, 3))


# parents that die ---------------------------------------------------------------------------------------------------

PARENTS = [
    "nested",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("local", "deaf", "isolated", "program")),
    pytest.param("dask", marks=[needs("distributed"), pytest.mark.slow]),
]


@needs_proc
@pytest.mark.parametrize("pool", PARENTS)
def test_nothing_outlives_a_parent_that_is_killed(pool, tmp_path, tmp_path_factory):
    # three more for the program, its watcher and its child
    expected = {"isolated": 1, "nested": 2 * WORKERS, "program": 4 * WORKERS}.get(pool, WORKERS)
    at_once = 1 if pool == "isolated" else WORKERS
    command = [sys.executable, "-m", "tests.faults.pooled_run", pool, str(tmp_path)]
    place = tmp_path_factory.mktemp("place")
    environment = os.environ | {"TMPDIR": str(place)}
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as parent:
        try:
            stop = time.monotonic() + 60.0
            while len(at_work(tmp_path)) < at_once or len(descendants(parent.pid)) < expected:
                assert parent.poll() is None, parent.stdout.read().decode()
                assert time.monotonic() < stop, descendants(parent.pid)
                time.sleep(0.02)
            children = descendants(parent.pid)
        finally:
            parent.kill()
        assert at_work(tmp_path) - {parent.pid} <= set(children)
        assert gone(children)
    assert list(place.glob("fe_likelihoods_*")) == []
