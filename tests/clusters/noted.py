"""Models and functions for jobs and workers of dask."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from tests.faults.treacherous import Treacherous, line


class EndsItsJob(Treacherous):
    """A model whose first simulation ends the job that it is a part of, as a queueing system does at the walltime."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        try:
            (self.folder / "ended").touch(exist_ok=False)
        except FileExistsError:
            return line(theta)
        os.kill(os.getppid(), signal.SIGKILL)  # of both workers, which end with it
        time.sleep(3600)


class Gate:
    """A function whose calls leave a file each, and wait until a folder has the file ``go``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, item: int) -> int:
        (self.folder / str(item)).touch()
        while not (self.folder / "go").exists():
            time.sleep(0.005)
        return item
