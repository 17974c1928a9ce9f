"""A run over processes that a test can kill: ``python -m tests.faults.pooled_run CASE FOLDER``.

Each process that runs a simulation writes a file named by its process id in FOLDER. The simulations take an hour.
"""

import sys
import time
from pathlib import Path

import numpy as np

from fe_likelihoods.models.executable import ExecutableModel
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.simulation.executors import LocalPool
from tests.faults.treacherous import (
    CHANNELS,
    DT,
    HANGS,
    HANGS_HARD,
    N_STEPS,
    Announced,
    Treacherous,
    posterior_of,
    treacherous,
)

NAMES = ("offset", "slope")
WORKERS = 2


def at_work(folder: Path) -> set[int]:
    """Ids of the processes that run a simulation."""
    return {int(path.name) for path in folder.iterdir()}


def _dask():
    from dask.distributed import Client, LocalCluster

    return Client(LocalCluster(n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None))


def _isolated() -> FunctionModel:
    return FunctionModel(treacherous, NAMES, CHANNELS, DT, N_STEPS, time_limit=3600.0)


def _program() -> ExecutableModel:
    code = "import subprocess, sys; subprocess.run(['sleep', '3600'], env={})"
    command = [sys.executable, "-c", code, "$offset", "$slope"]
    return ExecutableModel(command, {}, "out.txt", NAMES, CHANNELS, DT, N_STEPS, time_limit=3600.0)


# model, pool, and way of hanging
CASES = {
    "local": (Treacherous, lambda: LocalPool(WORKERS), HANGS),
    "dask": (Treacherous, _dask, HANGS),
    "deaf": (Treacherous, lambda: LocalPool(WORKERS), HANGS_HARD),
    "nested": (_isolated, lambda: LocalPool(WORKERS), HANGS_HARD),
    "isolated": (_isolated, lambda: None, HANGS_HARD),
    "program": (_program, lambda: LocalPool(WORKERS), HANGS),
}


def main() -> None:
    """Run until killed."""
    model, pool, hangs = CASES[sys.argv[1]]
    posterior = posterior_of(Announced(Path(sys.argv[2]), model()), top=20.0, pool=pool())
    posterior(np.array([[hangs + 0.1 * k, 0.1, 0.5] for k in range(1, 9)]))
    time.sleep(3600)


if __name__ == "__main__":
    main()
