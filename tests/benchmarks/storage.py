"""What it costs to keep a run in a file and to read it back: chain, ladder and journal, beside emcee's own backend.

Writing is the wall time of the run less that of the same run in memory. What is read was written by 500 walkers in 200
steps at beta = 1; opening it for a run includes the comparison of the chain with its journal.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from emcee.backends import HDFBackend

from samplers import read_ladder
from samplers.storage.backends import JournaledBackend

from .cost import STEPS, per_evaluation, run_emcee, run_walk
from .rows import Row

__all__ = ["storage"]

LIMIT = 20.0
KINDS = {"SMC, random walk": run_walk, "emcee": run_emcee}
READ = 500


def _milliseconds(function: Callable[[], Any], repeats: int) -> float:
    """Median wall time; what was opened is let go before the next time."""
    values = []
    for _ in range(max(5, repeats)):
        start = time.perf_counter()
        function()
        values.append(time.perf_counter() - start)
    return 1e3 * median(values)


def storage(repeats: int) -> list[Row]:
    """Writing by the evaluation, the size of what was written, reading by the file."""
    rows = []
    for nwalkers in (40, 100, 500):
        for name, run in KINDS.items():
            kept, memory = (per_evaluation(run, nwalkers, f, time.perf_counter, repeats) for f in (True, False))
            note = f"at most {LIMIT:g}" if run is run_walk else ""
            case = f"{name}, {nwalkers} walkers"
            rows.append(Row("storage: written, wall an evaluation", case, 1e6 * (kept - memory), "us", note))
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / name.split(",")[0] / "run.h5" for name in KINDS}
        for name, run in KINDS.items():
            files[name].parent.mkdir()
            evaluations = run(READ, HDFBackend(str(files[name])))
            sizes = {path.suffix: path.stat().st_size for path in files[name].parent.iterdir()}
            parts = ", ".join(f"{size / 2**20:.1f} MiB of {kind}" for kind, size in sorted(sizes.items()))
            note = f"{evaluations} evaluations: {parts}"
            rows.append(Row("storage: size, an evaluation", name, sum(sizes.values()) / evaluations, "B", note))
        case = f"{READ} walkers, {STEPS} steps"
        for name, path in files.items():
            seconds = _milliseconds(lambda path=path: HDFBackend(str(path), read_only=True).get_chain(), repeats)
            rows.append(Row("storage: chain read, wall", f"{name}, {case}", seconds, "ms"))
        ours = str(files["SMC, random walk"])
        seconds = _milliseconds(lambda: read_ladder(HDFBackend(ours, read_only=True)), repeats)
        rows.append(Row("storage: ladder read, wall", f"SMC, {case}", seconds, "ms"))
        seconds = _milliseconds(lambda: JournaledBackend.of(HDFBackend(ours)), repeats)
        rows.append(Row("storage: opened to go on, wall", f"SMC, {case}", seconds, "ms", "checked against its journal"))
    return rows
