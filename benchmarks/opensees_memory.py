"""Memory of the process of OpenSees over 10 000 runs, and the cost of replacing it.

A model of 30 beams computes two eigenvalues, as for Rayleigh damping, which leaks memory in OpenSees. The response of
each run is the resident memory of its process, so nothing else has to be observed.
"""

import inspect
import time
from pathlib import Path

import numpy as np

from fe_likelihoods import Channel, OpenSeesModel

from .rows import Row

__all__ = ["chain", "memory"]

CHANNELS = (Channel("memory", "displacement", "m"),)  # there is no quantity for bytes


def chain(ops, theta: np.ndarray) -> np.ndarray:
    """Resident memory [bytes] of this process after an eigenvalue analysis of a cantilever of 30 beams."""
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    ops.geomTransf("Linear", 1)
    for k in range(31):
        ops.node(k, 0.0, float(k))
        ops.mass(k, 1.0, 1.0, 1.0)
    ops.fix(0, 1, 1, 1)
    for k in range(30):
        ops.element("elasticBeamColumn", k, k, k + 1, 1.0, 1e9 * theta[0], 1.0, 1)
    ops.eigen(2)
    status = Path("/proc/self/status").read_text()
    return np.array([[1024.0 * int(status.split("VmRSS:")[1].split()[0])]])


def memory(repeats: int, runs: int = 10_000) -> list[Row]:
    """Memory at the first and the last of the runs, the largest one, and the mean duration of a run."""
    del repeats
    default = inspect.signature(OpenSeesModel).parameters["runs_per_process"].default
    rows = []
    for runs_per_process in (None, default):
        model = OpenSeesModel(chain, ("E",), CHANNELS, 1.0, 1, runs_per_process=runs_per_process)
        start = time.perf_counter()
        used = np.array([model.simulate(np.ones(1))[0, 0] for _ in range(runs)]) / 2**20
        seconds = time.perf_counter() - start
        what = f"OpenSees, {runs} runs, runs_per_process={runs_per_process}"
        rows += [
            Row(what, "memory at the first run", used[0], "MiB"),
            Row(what, "memory at the last run", used[-1], "MiB"),
            Row(what, "largest memory", used.max(), "MiB"),
            Row(what, "time of a run", 1e3 * seconds / runs, "ms"),
        ]
    return rows
