"""Waiting time before the first simulation: imports, compilation, compiled kernels read from disk."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from .rows import Row

__all__ = ["compilation", "imports"]

ROOT = Path(__file__).resolve().parents[1]
LIMIT_IMPORT, LIMIT_COMPILATION = 0.5, 60.0
IMPORTS = (
    "import fe_likelihoods, samplers",
    "from fe_likelihoods import *; from samplers import *",
    "from samplers import SMCSampler",
    "import fe_likelihoods; fe_likelihoods.problems.bridge_column()",
    "import fe_likelihoods; fe_likelihoods.problems.isolated_bridge()",
    "import numpy",
    "import numba",
    "import emcee",
)
TIMED = """
import json, os, time
start, cpu = time.perf_counter(), time.process_time()
{}
print(json.dumps([time.perf_counter() - start, time.process_time() - cpu]))
"""
FIRST_EVALUATION = """
import json, time
from numba.core.event import install_recorder
from fe_likelihoods import problems
with install_recorder("numba:compile") as compiled:
    posterior = problems.{}()
    theta = posterior.sample_prior(1, 1)[0]
    start, cpu = time.perf_counter(), time.process_time()
    posterior(theta)
    first = time.perf_counter() - start, time.process_time() - cpu
    start = time.perf_counter()
    posterior(1.001 * theta)
print(json.dumps([*first, time.perf_counter() - start, len(compiled.buffer) / 2]))
"""


def _run(code: str, cache: str | None = None, root: Path = ROOT) -> list[float]:
    """Seconds that `code` prints in a new interpreter, with the folder `cache` for compiled kernels if given."""
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": ""} | ({"FE_LIKELIHOODS_CACHE": cache} if cache else {})
    run = subprocess.run([sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"the process ended with code {run.returncode}: {run.stderr[-2000:]}")
    return json.loads(run.stdout)


def imports(repeats: int) -> list[Row]:
    """Wall time of imports in new interpreters, in alternation, together with their dependencies."""
    seconds = {code: [] for code in IMPORTS}
    for _ in range(repeats):
        for code in IMPORTS:
            seconds[code].append(_run(TIMED.format(code)))
    rows = []
    for code, found in seconds.items():
        wall, cpu = (median(column) for column in zip(*found, strict=True))
        limit = f"; at most {LIMIT_IMPORT:g}" if code == IMPORTS[0] else ""
        rows.append(Row("start-up, wall time", code, wall, "s", f"CPU {cpu:.2f} s{limit}"))
    return rows


def compilation(repeats: int) -> list[Row]:
    """Wall time of the first likelihood of both posteriors: compiled, with kernels on disk, and in another checkout."""
    rows = []
    for name in ("bridge_column", "isolated_bridge"):
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as other:
            cold = _run(FIRST_EVALUATION.format(name), cache)
            found = [_run(FIRST_EVALUATION.format(name), cache) for _ in range(repeats)]
            for part in ("fe_likelihoods", "samplers", "data"):
                shutil.copytree(ROOT / part, Path(other) / part)
            shared = _run(FIRST_EVALUATION.format(name), cache, Path(other))
            size = sum(file.stat().st_size for file in Path(cache).rglob("*") if file.is_file())
        warm, cpu, again, compiled = (median(column) for column in zip(*found, strict=True))
        note = f"CPU {cold[1]:.1f} s, {cold[3]:.0f} kernels; once for each version; at most {LIMIT_COMPILATION:g}"
        rows += [
            Row("first likelihood, wall time", f"{name}, nothing compiled", cold[0], "s", note),
            Row(
                "first likelihood, wall time",
                f"{name}, kernels on disk",
                warm,
                "s",
                f"CPU {cpu:.2f} s, {compiled:.0f} compiled, {size / 2**20:.1f} MiB on disk",
            ),
            Row("first likelihood, CPU time", f"{name}, another checkout", shared[1], "s", f"{shared[3]:.0f} compiled"),
            Row("first likelihood, wall time", f"{name}, the second one", again, "s"),
        ]
    return rows
