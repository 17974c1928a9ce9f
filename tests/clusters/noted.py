"""Models and functions for jobs and workers of dask."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np

from tests.faults.treacherous import Treacherous, line

_lock, _running, most = threading.Lock(), 0, 0


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


def counted(item: int) -> tuple[int, str]:
    """An outcome; notes in `most` how many calls run at once in the threads of a process."""
    global _running, most
    with _lock:
        _running += 1
        most = max(most, _running)
    time.sleep(0.1)
    with _lock:
        _running -= 1
    return item, ""


class Gate:
    """A function whose calls leave a file each, and wait until a folder has the file ``go``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, item: int) -> int:
        (self.folder / str(item)).touch()
        while not (self.folder / "go").exists():
            time.sleep(0.005)
        return item
