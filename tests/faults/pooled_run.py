"""A run over processes that a test can kill: ``python -m tests.faults.pooled_run ENGINE FILE``.

Once all its workers are at work, it writes their process numbers into FILE. What the simulations do would take an hour.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

from fe_likelihoods.models.executable import ExecutableModel
from fe_likelihoods.models.function import FunctionModel
from tests.faults.treacherous import CHANNELS, DT, HANGS, HANGS_HARD, N_STEPS, Treacherous, posterior_of, treacherous

NAMES = ("offset", "slope")
WORKERS = 2


class Announced(Treacherous):
    """Tells that it is at work, and hangs as it is told to."""

    def __init__(self, folder: Path, model) -> None:
        self.folder, self.model = folder, model

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        (self.folder / f"{os.getpid()}").touch()
        return self.model.simulate(theta)


class Engines:
    """What runs the simulations, and the value of theta[0] with which they hang."""

    @staticmethod
    def local():
        return Treacherous(), WORKERS, HANGS

    @staticmethod
    def deaf():
        return Treacherous(), WORKERS, HANGS_HARD

    @staticmethod
    def nested():
        return FunctionModel(treacherous, NAMES, CHANNELS, DT, N_STEPS, time_limit=3600.0), WORKERS, HANGS_HARD

    @staticmethod
    def isolated():
        return FunctionModel(treacherous, NAMES, CHANNELS, DT, N_STEPS, time_limit=3600.0), None, HANGS_HARD

    @staticmethod
    def program():
        code = "import subprocess, sys; subprocess.run(['sleep', '3600'], start_new_session=True)"
        command = [sys.executable, "-c", code, "$offset", "$slope"]
        return ExecutableModel(command, {}, "out.txt", NAMES, CHANNELS, DT, N_STEPS, time_limit=3600.0), WORKERS, HANGS

    @staticmethod
    def dask():
        from dask.distributed import Client, LocalCluster

        cluster = LocalCluster(WORKERS, threads_per_worker=1, processes=True, dashboard_address=None)
        return Treacherous(), Client(cluster), HANGS


def main() -> None:
    """Run until killed."""
    folder = Path(sys.argv[2])
    model, pool, hangs = getattr(Engines, sys.argv[1])()
    posterior = posterior_of(Announced(folder, model), top=20.0, pool=pool)
    posterior(np.array([[hangs + 0.1 * k, 0.1, 0.5] for k in range(1, 9)]))
    time.sleep(3600)


if __name__ == "__main__":
    main()
