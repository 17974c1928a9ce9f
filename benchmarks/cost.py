"""Overhead of the samplers per evaluation, measured with a vectorised likelihood of negligible cost.

CPU time of the process for plain moves, mixture moves and recycling.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import emcee
import numpy as np

from samplers import SMCSampler
from samplers.moves.population_moves import RandomWalkMove
from tests.contract.targets import Gaussian

from .rows import Row

__all__ = ["STEPS", "cost", "per_evaluation", "run_emcee", "run_smc", "run_walk"]

NDIM, STEPS, LIMIT_PLAIN, LIMIT_MIXTURE = 7, 200, 5.0, 150.0


def run_emcee(nwalkers: int, backend: emcee.backends.Backend | None = None) -> int:
    """Run emcee's stretch move; returns the number of evaluations."""
    posterior = Gaussian(NDIM, sd=0.01)
    sampler = emcee.EnsembleSampler(nwalkers, NDIM, posterior, vectorize=True, backend=backend)
    sampler.run_mcmc(posterior.sample_prior(nwalkers, np.random.default_rng(1)), STEPS)
    return nwalkers * (STEPS + 1)


def run_smc(
    nwalkers: int, backend: emcee.backends.Backend | None = None, ndim: int = NDIM, steps: int = STEPS, **settings
) -> int:
    """Run `SMCSampler`; returns the number of evaluations."""
    posterior = Gaussian(ndim, sd=0.01)
    sampler = SMCSampler(nwalkers, ndim, posterior, vectorize=True, seed=1, backend=backend, **settings)
    sampler.run_mcmc(None, steps)
    return sampler.evaluations


def run_walk(nwalkers: int, backend: emcee.backends.Backend | None = None) -> int:
    """Run `SMCSampler` with random-walk moves; returns the number of evaluations."""
    return run_smc(nwalkers, backend, moves=RandomWalkMove())


def per_evaluation(run: Callable, nwalkers: int, in_file: bool, clock: Callable[[], float], repeats: int) -> float:
    """Median seconds per evaluation."""
    values = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            backend = emcee.backends.HDFBackend(str(Path(folder) / "run.h5")) if in_file else None
            start = clock()
            evaluations = run(nwalkers, backend)
            values.append((clock() - start) / evaluations)
    return median(values)


def cost(repeats: int) -> list[Row]:
    """CPU time per evaluation [µs]."""
    rows = []
    kinds = {
        "plain moves (random walk)": (run_walk, f"at most {LIMIT_PLAIN:g}"),
        "mixture moves": (lambda n, backend: run_smc(n, backend, recycle=False), f"at most {LIMIT_MIXTURE:g}"),
        "default (recycling, then mixture moves)": (run_smc, f"at most {LIMIT_MIXTURE:g}"),
        "emcee, stretch move": (run_emcee, ""),
    }
    for name, (run, note) in kinds.items():
        value = 1e6 * per_evaluation(run, 500, False, time.process_time, repeats)
        rows.append(Row("sampler, CPU time per evaluation", f"{name}, 500 walkers", value, "us", note))
    return rows
