"""What a user waits for before the first simulation: imports, compilation, compiled kernels read from disk."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from .rows import Row

__all__ = ["compilation", "imports"]

ROOT = Path(__file__).resolve().parents[2]
FIRST_SIMULATION = """
import json, time
start = time.perf_counter()
import numpy as np
from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.records import Record
imported = time.perf_counter()
model = RCColumn.lhpost(Record("pulse", 0.01, np.sin(np.arange(20) / 3)))
model.simulate(np.ones(5))
first = time.perf_counter()
model.simulate(np.ones(5))
print(json.dumps([imported - start, first - imported, time.perf_counter() - first]))
"""
IMPORT = "import json, time; start = time.perf_counter(); import {}; print(json.dumps([time.perf_counter() - start]))"


def _run(code: str, cache: str | None = None) -> list[float]:
    """Seconds that `code` prints, run by a fresh interpreter, with its own folder of compiled kernels if given."""
    environment = dict(os.environ) | ({} if cache is None else {"FE_LIKELIHOODS_CACHE": cache})
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"the process ended with code {run.returncode}: {run.stderr[-2000:]}")
    return json.loads(run.stdout)


def imports(repeats: int) -> list[Row]:
    """Wall time of importing the packages in a fresh interpreter."""
    modules = ("numba", "fe_likelihoods.problems", "samplers")
    seconds = {name: [_run(IMPORT.format(name))[0] for _ in range(repeats)] for name in modules}
    return [Row("import, wall time", name, median(times), "s") for name, times in seconds.items()]


def compilation(repeats: int) -> list[Row]:
    """Wall time of the first simulation of a 20-step record: kernels compiled, then read from disk."""
    with tempfile.TemporaryDirectory() as cache:
        _, cold, _ = _run(FIRST_SIMULATION, cache)
        warm = [_run(FIRST_SIMULATION, cache)[1] for _ in range(repeats)]
        size = sum(file.stat().st_size for file in Path(cache).rglob("*") if file.is_file())
    return [
        Row("first simulation, wall time", "nothing compiled", cold, "s", "once for each version of the kernels"),
        Row("first simulation, wall time", "kernels on disk", median(warm), "s", f"{size / 2**20:.1f} MiB"),
    ]
