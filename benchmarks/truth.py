"""``python -m benchmarks truth [families] [--cells all] [--walkers 250 500]``: is a run right, or doubted?

Samplers run on analytic posteriors (`tests.statistics.analytic_posteriors`) with exact answers and a new seed each
time. A run is *doubted* if it issued a `SamplingWarning` or if its verdict is not "converged". Otherwise it is
*silent*.

Families: ``two`` and ``three`` (Gaussian modes at random positions; dimensions, separations, ratios of masses and
priors vary from seed to seed, the ratio of volumes is part of the cell), ``narrow`` and ``shapes`` (single hard cases
of several modes), ``sharp``, ``banana``, ``rotated``, ``rosenbrock``, ``bounds``, ``student``, ``rough1``, ``rough2``,
``rough3`` (coverage), ``growth`` (a Gaussian in 2 to 50 dimensions).

Columns: ``lost``, runs in which the share of a mode differs from the truth by more than 0.15, or, without modes, whose
log-evidence is off by more than four stated errors and 0.5, or a mean by more than four stated errors and a quarter of
the standard deviation; ``silent``, those among them that are not doubted;
``doubted``, all doubted runs; ``false``, the doubted runs that are right; ``log Z``, ``means``, percentage within two
stated errors; ``or doubted``, the smaller of these percentages if doubted runs count as covered; ``z``, root mean
square error of the log-evidence in stated errors; ``sd``, smallest ratio, over the parameters, of the median standard
deviation to the truth; ``evaluations``, the median.
"""

import argparse
import itertools
import json
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from tests.statistics.analytic_runs import SAMPLERS, SINGLE, Cell, is_doubted, is_lost, run

from .rows import aligned, number

__all__ = ["Cell", "cells", "main", "run", "table"]

VOLUME_RATIOS = (1.0, 5.0, 20.0, 100.0)
GROWTH = (2, 5, 10, 20, 30, 40, 50)
FAMILIES = ("two", "three", *SINGLE, "growth")
# the cells that are run by default
FEW_RATIOS = (1.0, 20.0)
FEW_DIMENSIONS = (5, 20)
HEADER = (
    "posterior",
    "sampler",
    "walkers",
    "runs",
    "lost",
    "silent",
    "doubted",
    "false",
    "log Z [%]",
    "means [%]",
    "or doubted [%]",
    "z",
    "sd",
    "evaluations",
)


def cells(families: Sequence[str], samplers: Sequence[str], walkers: Sequence[int], everything: bool) -> Iterator[Cell]:
    """The cells of some families; without `everything`, few of their parameters."""
    for family in families:
        parameters: Sequence[float] = (0.0,)
        if family in ("two", "three"):
            parameters = VOLUME_RATIOS if everything else FEW_RATIOS
        if family == "growth":
            parameters = GROWTH if everything else FEW_DIMENSIONS
        for parameter, n, sampler in itertools.product(parameters, walkers, samplers):
            yield Cell(family, parameter, sampler, n)


def _line(cell: Cell, runs: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """The runs of one cell as a line of the table."""
    lost = np.array([is_lost(each) for each in runs])
    doubted = np.array([is_doubted(each) for each in runs])
    z = np.array([each["log_evidence_error"] / max(each["stated_error"], 1e-300) for each in runs])
    means = np.array([np.mean(np.abs(each["mean_z"]) < 2.0) for each in runs])
    near = np.abs(z) < 2.0
    # dimensions vary within the families of modes
    sd = np.min(np.median([each["sd_ratio"] for each in runs], axis=0)) if len({r["ndim"] for r in runs}) == 1 else None
    numbers = (
        100.0 * np.mean(near),
        100.0 * np.mean(means),
        100.0 * min(np.mean(near | doubted), np.mean(np.where(doubted, 1.0, means))),
        np.sqrt(np.mean(z**2)),
        sd,
        np.median([each["evaluations"] for each in runs]),
    )
    counts = (len(runs), lost.sum(), (lost & ~doubted).sum(), doubted.sum(), (doubted & ~lost).sum())
    return cell.name, cell.sampler, str(cell.walkers), *(str(n) for n in counts), *(number(value) for value in numbers)


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Stored runs as a table, one line per cell."""
    groups: dict[Cell, list[dict[str, Any]]] = {}
    for each in runs:
        groups.setdefault(Cell(*(each[name] for name in Cell._fields)), []).append(each)
    return aligned([HEADER, *(_line(cell, group) for cell, group in groups.items())], right=range(2, len(HEADER)))


def _run(job: tuple[Cell, int, int, dict[str, Any]]) -> dict[str, Any]:
    return run(*job)


def _results(jobs: Sequence[tuple], processes: int) -> Iterator[dict[str, Any]]:
    """Run the jobs in new processes with one thread each."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_run, jobs)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the cells, store every run and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks truth",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("families", nargs="*", help=f"some of {', '.join(FAMILIES)}; all by default")
    parser.add_argument("--cells", choices=("few", "all"), default="few", help="ratios of volumes, dimensions")
    parser.add_argument("--walkers", nargs="+", type=int, default=[500])
    parser.add_argument("--samplers", nargs="+", choices=SAMPLERS, default=["SMC"])
    parser.add_argument("--seeds", type=int, default=10, help="runs of each cell (default 10)")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=5, help="length of the chain (default 5)")
    parser.add_argument("--settings", type=json.loads, default={}, help='settings of the samplers, as {"max_moves": 9}')
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument(
        "--everything", action="store_true", help="all cells of both samplers, 250, 500 and 1000 walkers, 100 seeds"
    )
    parser.add_argument("--out", type=Path, default=Path("results") / "truth.json", help="file of all runs")
    parser.add_argument("--read", type=Path, nargs="+", help="print the table of stored runs instead")
    given = parser.parse_args(arguments)
    if given.read:
        print(table([each for path in given.read for each in json.loads(path.read_text())]))
        return
    if unknown := set(given.families) - set(FAMILIES):
        parser.error(f"expected families among {', '.join(FAMILIES)}; got {', '.join(sorted(unknown))}")
    if given.everything:
        given.cells, given.samplers, given.walkers, given.seeds = "all", list(SAMPLERS), [250, 500, 1000], 100
    wanted = list(cells(given.families or FAMILIES, given.samplers, given.walkers, given.cells == "all"))
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    jobs = [(cell, seed, given.steps, given.settings) for cell in wanted for seed in seeds]
    stored: list[dict[str, Any]] = []
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for found in _results(jobs, given.jobs):
        stored.append(found)
        if len(stored) % given.seeds == 0:
            print(*_line(wanted[len(stored) // given.seeds - 1], stored[-given.seeds :]), sep="  ", flush=True)
            given.out.write_text(json.dumps(stored) + "\n")
    print()
    print(table(stored))


if __name__ == "__main__":
    main()
