"""Is a run right, or doubted? Samplers on analytic posteriors with exact answers and a new seed each time.

A run is *doubted* if it issued a `SamplingWarning` or if its verdict is not "converged". Otherwise it is *silent*.

Families of `tests.statistics.analytic_posteriors`: ``two`` and ``three`` (Gaussian modes at random positions;
dimensions, separations, ratios of masses and priors vary from seed to seed, the ratio of volumes is part of the cell),
``narrow`` and ``shapes`` (single hard cases of several modes), ``sharp``, ``banana``, ``rotated``, ``rosenbrock``,
``bounds``, ``student``, ``rough1``, ``rough2``, ``rough3`` (coverage), ``growth`` (a Gaussian in 2 to 50 dimensions).

Columns: ``lost``, runs in which the share of a mode differs from the truth by more than 0.15, or, without modes, whose
log-evidence is off by more than four stated errors and 0.5, or a mean by more than four stated errors and a quarter of
the standard deviation; ``silent``, those among them that are not doubted; ``doubted``, all doubted runs; ``false``, the
doubted runs that are right; ``log_Z``, ``means``, percentage within two stated errors; ``or_doubted``, the smaller of
these percentages if doubted runs count as covered; ``z``, root mean square error of the log-evidence in stated errors;
``sd``, smallest ratio, over the parameters, of the median standard deviation to the truth; ``evaluations``, the median.

The table of the documentation: ``python -m benchmarks truth --repeats 20 walkers=250,500 samplers=SMC,TMCMC``.
"""

import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np

from tests.statistics.analytic_runs import SINGLE, Cell, is_doubted, is_lost, run

__all__ = ["Line", "line", "truth"]

FAMILIES = ("two", "three", *SINGLE, "growth")


class Line(NamedTuple):
    """The runs of one cell."""

    posterior: str
    sampler: str
    walkers: int
    runs: int
    lost: int
    silent: int
    doubted: int
    false: int
    log_Z: float
    means: float
    or_doubted: float
    z: float
    sd: float | None
    evaluations: float


def truth(
    repeats: int,
    families: tuple[str, ...] = FAMILIES,
    walkers: tuple[int, ...] = (500,),
    samplers: tuple[str, ...] = ("SMC",),
    ratios: tuple[float, ...] = (1.0, 20.0),
    dimensions: tuple[int, ...] = (5, 20),
    steps: int = 5,
    first_seed: int = 1,
    processes: int = 2,
) -> Iterator[Line]:
    """One row per posterior, sampler and number of walkers.

    Parameters
    ----------
    repeats : int
        Runs of each cell.
    families, samplers : tuple of str
        Some of `FAMILIES`, of SMC and TMCMC.
    walkers : tuple of int
    ratios : tuple of float
        Ratios of volumes, for ``two`` and ``three``.
    dimensions : tuple of int
        Of ``growth``.
    steps : int
        Length of the chain.
    first_seed, processes : int
    """
    if unknown := set(families) - set(FAMILIES):
        raise ValueError(f"expected families among {', '.join(FAMILIES)}; got {', '.join(sorted(unknown))}")
    of_family = {"two": ratios, "three": ratios, "growth": dimensions}
    cells = [
        Cell(family, parameter, sampler, n)
        for family in families
        for parameter, n, sampler in itertools.product(of_family.get(family, (0.0,)), walkers, samplers)
    ]
    jobs = [(cell, first_seed + k, steps) for cell in cells for k in range(repeats)]
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        found = pool.map(_run, jobs)
        for cell in cells:
            yield line(cell, list(itertools.islice(found, repeats)))


def _run(job: tuple[Cell, int, int]) -> dict[str, Any]:
    return run(*job)


def line(cell: Cell, runs: Sequence[dict[str, Any]]) -> Line:
    """The runs of one cell as a line of the table."""
    lost = np.array([is_lost(each) for each in runs])
    doubted = np.array([is_doubted(each) for each in runs])
    z = np.array([each["log_evidence_error"] / max(each["stated_error"], 1e-300) for each in runs])
    means = np.array([np.mean(np.abs(each["mean_z"]) < 2.0) for each in runs])
    near = np.abs(z) < 2.0
    # dimensions vary within the families of modes
    same = len({each["ndim"] for each in runs}) == 1
    return Line(
        cell.name,
        cell.sampler,
        cell.walkers,
        len(runs),
        int(lost.sum()),
        int((lost & ~doubted).sum()),
        int(doubted.sum()),
        int((doubted & ~lost).sum()),
        100.0 * float(np.mean(near)),
        100.0 * float(np.mean(means)),
        100.0 * float(min(np.mean(near | doubted), np.mean(np.where(doubted, 1.0, means)))),
        float(np.sqrt(np.mean(z**2))),
        float(np.min(np.median([each["sd_ratio"] for each in runs], axis=0))) if same else None,
        float(np.median([each["evaluations"] for each in runs])),
    )
