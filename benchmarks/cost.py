"""Overhead of the samplers per evaluation, and memory of a simulation that is kept in RAM.

CPU time of the process for plain moves, mixture moves and recycling, with a vectorised likelihood of negligible cost.
"""

import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from statistics import median

import emcee
import numpy as np

from fe_likelihoods import problems
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


def memory_per_simulation(posterior: Callable, rows: int = 400) -> float:
    """Memory that stays allocated for one more simulation [kB], after as many others."""
    thetas = posterior.sample_prior(2 * rows, 1)
    tracemalloc.start()
    posterior(thetas[:rows])
    before, _ = tracemalloc.get_traced_memory()
    posterior(thetas[rows:])
    kept = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return kept / rows / 1e3


def cost(repeats: int) -> list[Row]:
    """CPU time per evaluation [µs], and memory per simulation [kB]."""
    rows = [
        Row(
            "memory of a simulation in RAM", name, memory_per_simulation(getattr(problems, name)()), "kB", "at most 0.6"
        )
        for name in ("bridge_column", "isolated_bridge")
    ]
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
