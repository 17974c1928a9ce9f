"""Workers that a dask cluster has given up, with real clusters."""

import importlib.util
import time

import numpy as np
import pytest

from tests.faults.treacherous import Gated, Treacherous, posterior_of

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="NO DISTRIBUTED: install it to test dask clusters"
)

LATE = """
import asyncio

async def dask_setup(worker):
    await asyncio.sleep({seconds})
"""


@pytest.fixture
def cluster():
    """A function that makes a client of a cluster without workers, whose workers take some seconds to start."""
    import dask
    from dask.distributed import Client, LocalCluster

    opened = []

    def make(seconds):
        options = {"processes": False, "threads_per_worker": 1, "dashboard_address": None}
        opened.append(LocalCluster(n_workers=0, preload=[LATE.format(seconds=seconds)], **options))
        opened.append(Client(opened[0]))
        return opened[1]

    with dask.config.set({"distributed.deploy.lost-worker-timeout": "0s"}):
        yield make
        for each in reversed(opened):
            each.close()


def test_simulations_wait_for_workers_that_are_still_starting(cluster):
    client = cluster(1.0)
    posterior = posterior_of(Treacherous(), pool=client)
    points = posterior.sample_prior(4, 1)
    client.cluster.scale(2)
    np.testing.assert_array_equal(posterior(points), posterior_of(Treacherous())(points))


def test_an_adaptive_cluster_replaces_its_workers(cluster, tmp_path):
    """Both workers are closed while a simulation runs."""
    client = cluster(0.0)
    client.cluster.adapt(minimum=2, maximum=2, interval="0.1s")
    client.wait_for_workers(2)
    posterior = posterior_of(Gated(tmp_path), top=20.0, pool=client)
    executor, stop = posterior.executor(), time.monotonic() + 30.0
    future = executor.submit(posterior, [0.95, 0.1, 0.5])
    while not list(tmp_path.iterdir()):
        assert time.monotonic() < stop
        time.sleep(0.01)
    before = set(client.scheduler_info()["workers"])
    client.retire_workers(list(before), close_workers=True)
    (tmp_path / "go").touch()
    assert np.isfinite(future.result())
    stop = time.monotonic() + 30.0
    while len(set(client.scheduler_info()["workers"]) - before) < 1:
        assert time.monotonic() < stop
        time.sleep(0.01)
