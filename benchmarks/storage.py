"""Time to store a run in a file and to read it back, compared with emcee's own HDF5 backend.

The time of writing is the wall time of the run minus that of the same run in memory. The files that are read contain
500 walkers and 200 steps at beta = 1.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from emcee.backends import HDFBackend

from samplers.output import Output
from samplers.record import Record

from .cost import STEPS, per_evaluation, run_emcee, run_walk
from .rows import Row

__all__ = ["storage"]

LIMIT = 20.0
KINDS = {"SMC, random walk": run_walk, "emcee": run_emcee}
READ = 500


def _milliseconds(function: Callable[[], Any], repeats: int) -> float:
    """Median wall time [ms] of a function; its result is released before the next call."""
    values = []
    for _ in range(max(5, repeats)):
        start = time.perf_counter()
        function()
        values.append(time.perf_counter() - start)
    return 1e3 * median(values)


def storage(repeats: int) -> list[Row]:
    """Time of writing per evaluation, size of the files, time of reading per file."""
    rows = []
    for nwalkers in (40, 100, 500):
        for name, run in KINDS.items():
            kept, memory = (per_evaluation(run, nwalkers, f, time.perf_counter, repeats) for f in (True, False))
            note = f"at most {LIMIT:g}" if run is run_walk else ""
            case = f"{name}, {nwalkers} walkers"
            rows.append(Row("storage: writing, wall time per evaluation", case, 1e6 * (kept - memory), "us", note))
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / name.split(",")[0] / "run.h5" for name in KINDS}
        for name, run in KINDS.items():
            files[name].parent.mkdir()
            evaluations = run(READ, HDFBackend(str(files[name])))
            sizes = {path.suffix: path.stat().st_size for path in files[name].parent.iterdir()}
            parts = ", ".join(f"{size / 2**20:.1f} MiB of {kind}" for kind, size in sorted(sizes.items()))
            note = f"{evaluations} evaluations: {parts}"
            rows.append(Row("storage: size per evaluation", name, sum(sizes.values()) / evaluations, "B", note))
        case = f"{READ} walkers, {STEPS} steps"
        for name, path in files.items():
            seconds = _milliseconds(lambda path=path: HDFBackend(str(path), read_only=True).get_chain(), repeats)
            rows.append(Row("storage: reading the chain, wall time", f"{name}, {case}", seconds, "ms"))
        ours = str(files["SMC, random walk"])
        record = Record(Path(f"{ours}.mcmc.record"))
        seconds = _milliseconds(lambda: Output(HDFBackend(ours, read_only=True), record), repeats)
        rows.append(Row("storage: reading ladder and verdict, wall time", f"SMC, {case}", seconds, "ms"))
        seconds = _milliseconds(lambda: Record(Path(f"{ours}.mcmc.record")), repeats)
        rows.append(Row("storage: reading the record, wall time", f"SMC, {case}", seconds, "ms"))
    return rows
