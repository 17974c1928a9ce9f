"""Time per simulation of the bridge column, compared with OpenSees: 50 s at 1/256 s, six sections of 88 fibers."""

import importlib.util
import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any

import numba
import numpy as np

from fe_likelihoods import ColumnAnalysis, RCColumn
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, bridge_column_data, bridge_column_prior
from fe_likelihoods.simulation.executors import LocalPool, as_executor
from fe_likelihoods.simulation.model import simulate_batch
from tests.opensees_column import INCH, peer_of, shake

from .rows import Row

__all__ = ["batch", "simulation"]

TOLERANCE = 1e-8  # norm of the last increment [in and rad]
NOMINAL, PAPER = np.ones(5), np.array(list(BRIDGE_COLUMN_MEANS.values()))
CASES = {
    "nominal": (NOMINAL, 1.0),
    "paper's posterior": (PAPER, 1.0),
    "nominal, bars yield (record x 4)": (NOMINAL, 4.0),
}


def _cpu_seconds(function, *arguments) -> float:
    start = time.process_time()
    function(*arguments)
    return time.process_time() - start


def simulation(repeats: int) -> list[Row]:
    """CPU time of one simulation on one thread with equal tolerances, and the difference of the responses."""
    rows = []
    for case, (theta, scale) in CASES.items():
        record = bridge_column_data().record.scale(scale)
        usual = RCColumn.lhpost(record)
        model = RCColumn.lhpost(record, analysis=ColumnAnalysis(tolerance=TOLERANCE * INCH))
        fibers = sum(map(len, model.section.fibers()))
        peer = peer_of(model, theta)
        response = model.simulate(theta)  # compile before the measurement
        ours, defaults, theirs = [], [], []
        for _ in range(repeats):
            ours.append(_cpu_seconds(model.simulate, theta))
            defaults.append(_cpu_seconds(usual.simulate, theta))
            run = shake(peer, record.acceleration / INCH, record.dt, TOLERANCE)
            theirs.append(run.seconds)
        done = run.response.shape[1]
        difference = response[1, :done] / INCH - run.response[0]
        rrmse = np.sqrt(np.sum(difference**2) / np.sum(run.response[0] ** 2))
        spread = f"{fibers} fibers; from {{:.3g}} to {{:.3g}} s"
        rows += [
            Row("OpenSees, CPU time", case, median(theirs), "s", spread.format(min(theirs), max(theirs))),
            Row("RCColumn, CPU time", case, median(ours), "s", spread.format(min(ours), max(ours))),
            Row("RCColumn, times faster", case, median(theirs) / median(ours), "", f"tolerance {TOLERANCE:g} in both"),
            Row("RCColumn, default tolerances", case, median(defaults), "s", "1e-8 m and rad"),
            Row("RRMSE between the two", case, 100 * rrmse, "%", f"displacement, {done} of {record.n_steps} samples"),
        ]
    return rows


def batch(repeats: int) -> list[Row]:
    """Wall time of 64 draws of the prior on one and more threads, and on two processes."""
    model = RCColumn.lhpost(bridge_column_data().record)
    thetas = bridge_column_prior().rvs(64, 1)[:, :5]
    model.simulate(thetas[0])
    before = numba.get_num_threads()
    counts = [n for n in (1, 2, 4, 8, 16) if n <= numba.config.NUMBA_NUM_THREADS]
    seconds = {n: [] for n in counts}
    for _ in range(repeats):
        for n in counts:
            numba.set_num_threads(n)
            start = time.perf_counter()
            simulate_batch(model, thetas)
            seconds[n].append(time.perf_counter() - start)
    rows = [
        Row("batch of 64, wall time", f"{n} thread" + "s" * (n > 1), median(times), "s", _speedup(seconds, n))
        for n, times in seconds.items()
    ]
    numba.set_num_threads(1)
    for name, pool, close in _pools():
        executor, times = as_executor(pool, model), {1: [], 2: []}
        simulate_batch(model, thetas, executor)  # start the workers
        for _ in range(repeats):
            for n, used in ((1, None), (2, executor)):
                start = time.perf_counter()
                simulate_batch(model, thetas, used)
                times[n].append(time.perf_counter() - start)
        rows.append(Row("batch of 64, wall time", name, median(times[2]), "s", _speedup(times, 2)))
        close()
    numba.set_num_threads(before)
    return rows


def _pools() -> Iterator[tuple[str, Any, Callable[[], None]]]:
    """Pools of two processes, and the function that ends each."""
    local = LocalPool(2)
    yield "2 processes, local pool", local, local.close
    if importlib.util.find_spec("distributed"):
        from distributed import Client, LocalCluster

        cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        client = Client(cluster)
        yield "2 processes, dask", client, lambda: (client.close(), cluster.close())


def _speedup(seconds: dict[int, list[float]], n: int) -> str:
    return f"{median(seconds[1]) / median(seconds[n]):.2f} times one thread" if n > 1 else ""
