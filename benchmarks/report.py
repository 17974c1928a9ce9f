"""CPU time of the results of `make update`: samples for arviz, figures, files of figures, all else."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from .rows import Row

__all__ = ["report"]

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("whole command", "results", "samples for arviz", "figures", "files of figures")
MEASURED = """
import contextlib, functools, io, json, sys, time
from matplotlib.figure import Figure
from fe_likelihoods.command import runs
from fe_likelihoods.command.main import main
from fe_likelihoods.reporting import report

spent = {}

def timed(place, name, part):
    function = getattr(place, name)
    @functools.wraps(function)
    def call(*arguments, **options):
        start = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            spent[part] = spent.get(part, 0.0) + time.process_time() - start
    setattr(place, name, call)

timed(runs, "_write", "results")
timed(runs, "write_samples", "samples for arviz")
timed(pictures, "_picture", "figures")
timed(Figure, "savefig", "files of figures")
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main()
spent["figures"] -= spent["files of figures"]
print(json.dumps(spent | {"whole command": time.process_time()}))
"""


def _cpu(checkout: Path, command: str, *arguments: str) -> dict[str, float]:
    """CPU seconds of the parts of a command in a new interpreter."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "MPLBACKEND": "agg"}
    call = [sys.executable, "-c", MEASURED, command, *arguments]
    run = subprocess.run(call, cwd=checkout, env=environment, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"{command} ended with code {run.returncode}: {run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])


def report(repeats: int, checkouts: tuple[str, ...] = (str(ROOT),)) -> list[Row]:
    """CPU time [s] of the report of one update of the column, in alternation by the code of each of `checkouts`."""
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "run"
        update = _cpu(ROOT, "run", str(ROOT / "data" / "templates" / "column.toml"), "--out", str(made))
        found = {checkout: [] for checkout in checkouts}
        for k in range(repeats):
            for checkout in checkouts:
                copy = shutil.copytree(made, Path(folder) / f"copy-{k}")
                found[checkout].append(_cpu(Path(checkout), "report", str(copy)))
                shutil.rmtree(copy)
    rows = [Row("update of the column, CPU time", part, update[part], "s", "fe-likelihoods run") for part in PARTS]
    for checkout, each in found.items():
        for part in PARTS:
            value = median(times[part] for times in each)
            rows.append(Row("report of the column, CPU time", part, value, "s", Path(checkout).name))
    return rows
