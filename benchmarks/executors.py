"""Overhead of the executors of ``pool=``, and simulations per second of the parent.

The model takes almost no time, so the result is the overhead of sending and receiving. Each case runs in a separate
process, ``python -m benchmarks.executors WHAT POOL REPEATS WORKERS``, killed if it hangs.
"""

import contextlib
import importlib
import importlib.util
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from fe_likelihoods.models.executable import ExecutableModel
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.simulation.executors import LocalPool, as_executor
from fe_likelihoods.simulation.model import simulate_batch
from tests.faults.pooled_run import CASES, NAMES, WORKERS
from tests.faults.treacherous import (
    CHANNELS,
    DT,
    N_STEPS,
    Treacherous,
    line,
    posterior_of,
)

from .rows import Row

__all__ = ["executors"]

ROOT = Path(__file__).resolve().parents[1]
MODULES = {"dask": "distributed", "mpi": "mpi4py", "loky": "joblib"}
ITEMS = 1000
LIMIT = 20.0  # seconds of a case, after which it hangs
THREADS = 64
SPAWN = multiprocessing.get_context("spawn")
POOLS = {
    "local": CASES["local"][1],
    "executor": lambda: ProcessPoolExecutor(WORKERS, mp_context=SPAWN),
    "multiprocessing": lambda: SPAWN.Pool(WORKERS),
    "loky": lambda: importlib.import_module("joblib.externals.loky").get_reusable_executor(WORKERS),
    "dask": CASES["dask"][1],
    "mpi": lambda: importlib.import_module("mpi4py.futures").MPIPoolExecutor(WORKERS),
}


def executors(repeats: int) -> list[Row]:
    """One row per pool and question."""
    rows = []
    for name in POOLS:
        if name in MODULES and importlib.util.find_spec(MODULES[name]) is None:
            rows.append(Row("executor", name, None, "", f"not installed: {MODULES[name]}"))
            continue
        answer = _answer("overhead", name, repeats)
        case = f"{name}, {WORKERS} workers"
        rows.append(
            Row("executor: overhead per simulation", case, answer.get("microseconds"), "us", answer.get("note", ""))
        )
    for count in (1, 4, 16):
        answer = _answer("parent", "local", repeats, count)
        case = f"local, {count} worker{'s' if count > 1 else ''}"
        for way in ("a batch", "one by one"):
            rows.append(Row("executor: simulations of 0 s per second", f"{case}, {way}", answer.get(way), "1/s"))
    for name in ("isolated function", "program"):
        answer = _answer("overhead", name, repeats)
        rows.append(Row("executor: overhead per simulation", f"{name}, no pool", answer.get("microseconds"), "us"))
    if importlib.util.find_spec("distributed"):
        answer = _answer("cluster", "dask", repeats)
        case = f"dask, {THREADS} sleeping threads in {WORKERS} processes"
        rows.append(
            Row(
                "executor: overhead of a simulation of 1 s",
                case,
                answer.get("microseconds"),
                "us",
                answer.get("note", ""),
            )
        )
    return rows


def _command(module: str, name: str, *arguments: object) -> list[str]:
    command = [sys.executable, "-m", module, *map(str, arguments)]
    if name != "mpi":
        return command
    mpiexec = Path(sys.executable).with_name("mpiexec")
    first = [str(mpiexec) if mpiexec.exists() else "mpiexec", "--oversubscribe", "-n", str(WORKERS + 1)]
    return [*first, sys.executable, "-m", "mpi4py.futures", *command[1:]]


ENVIRONMENT = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}


def _start(command: list[str], output: Any) -> subprocess.Popen:
    options = {"stdout": output, "stderr": subprocess.STDOUT, "start_new_session": True}
    return subprocess.Popen(command, cwd=ROOT, env=os.environ | ENVIRONMENT, **options)


def _kill(process: subprocess.Popen) -> int:
    """Kill a process with its session; returns its exit code."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


def _answer(what: str, name: str, repeats: int, count: int = WORKERS) -> dict:
    """The last line of JSON that the process of one case prints, or how the process ended."""
    with tempfile.TemporaryFile("w+") as output:
        command = _command("benchmarks.executors", name, what, name, repeats, count)
        process = _start(command, output)
        stop = time.monotonic() + LIMIT
        while process.poll() is None and time.monotonic() < stop:
            time.sleep(0.05)
        hangs = process.poll() is None
        exit_code = _kill(process)
        output.seek(0)
        found = [row for row in output.read().splitlines() if row.startswith('{"')]
    if found:
        return json.loads(found[-1])
    return {"note": f"hangs: stopped after {LIMIT:g} s" if hangs else f"everything ends (exit code {exit_code})"}


def _thetas() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.0, 1.0, size=(ITEMS, 2))


def _seconds(model, thetas: np.ndarray, executor, repeats: int) -> float:
    """Median wall time per simulation, with workers that have started and loaded the model."""
    simulate_batch(model, thetas[:50], executor)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        batch = simulate_batch(model, thetas, executor)
        times.append((time.perf_counter() - start) / len(thetas))
        if any(batch.reasons):
            raise RuntimeError(f"a run failed: {next(filter(None, batch.reasons))}")
    return median(times)


def _overhead(name: str, repeats: int) -> dict:
    thetas = _thetas()
    cheap = _seconds(Treacherous(), thetas, None, repeats)
    if name == "isolated function":
        model = FunctionModel(line, NAMES, CHANNELS, DT, N_STEPS, isolated=True)
        seconds = _seconds(model, thetas[:200], None, repeats)
    elif name == "program":
        settings = {"columns": [0], "time_limit": 60.0}
        command = ["cp", "in.txt", "out.txt"]
        template = {"in.txt": "1 # $offset $slope\n" * N_STEPS}
        model = ExecutableModel(command, template, "out.txt", NAMES, CHANNELS, DT, N_STEPS, **settings)
        seconds = _seconds(model, thetas[:100], None, repeats)
    else:
        seconds = _seconds(Treacherous(), thetas, as_executor(POOLS[name]()), repeats)
    return {"microseconds": 1e6 * (seconds - cheap)}


def _parent(count: int, repeats: int) -> dict:
    """Simulations per second that a parent sends to a pool and receives, in a batch and one by one as they end."""
    thetas = _thetas()
    with LocalPool(count) as pool:
        batch = 1.0 / _seconds(Treacherous(), thetas, pool, repeats)
        points = np.column_stack([thetas, np.full(ITEMS, 0.5)])
        rates = []
        for _ in range(repeats):
            posterior = posterior_of(Treacherous(), pool=pool)
            executor = posterior.executor()
            for some in (points[: 2 * count] + [0.0, 1.0, 0.0], points):  # the first ones load the model
                start = time.perf_counter()
                for future in [executor.submit(posterior, point) for point in some]:
                    future.result()
            rates.append(ITEMS / (time.perf_counter() - start))
    return {"a batch": batch, "one by one": median(rates)}


class Sleeper(Treacherous):
    """A model that takes a second of somebody else's time."""

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """A straight line, later."""
        time.sleep(1.0)
        return line(theta)


def _cluster() -> dict:
    """Four rounds of a model that sleeps for a second on a cluster of many threads, as far as two cores carry it."""
    from distributed import Client, LocalCluster

    cluster = LocalCluster(n_workers=WORKERS, threads_per_worker=THREADS // WORKERS, dashboard_address=None)
    executor = as_executor(Client(cluster))
    thetas = _thetas()[: 4 * THREADS]
    simulate_batch(Sleeper(), thetas[:THREADS], executor)
    start = time.perf_counter()
    batch = simulate_batch(Sleeper(), thetas, executor)
    seconds = time.perf_counter() - start
    if any(batch.reasons):
        return {"note": f"a run failed: {next(filter(None, batch.reasons))}"}
    efficiency = len(thetas) / THREADS / seconds
    note = f"{len(thetas)} runs in {seconds:.2f} s, {100 * efficiency:.0f} % of {THREADS} threads used"
    return {"microseconds": 1e6 * (seconds - len(thetas) / THREADS) / len(thetas), "note": note}


def main() -> None:
    """One case: print its answer as JSON, and end without waiting for the pool."""
    what, name, repeats, count = sys.argv[1:]
    cases = {
        "overhead": lambda: _overhead(name, int(repeats)),
        "parent": lambda: _parent(int(count), int(repeats)),
        "cluster": _cluster,
    }
    answer = cases[what]()
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()
    if name != "mpi":
        os._exit(0)


if __name__ == "__main__":
    main()
