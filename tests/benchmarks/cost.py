"""What the samplers themselves cost per evaluation, beside a vectorised likelihood that costs next to nothing.

CPU time in process for plain moves, mixtures and recycling; wall time of keeping the run in a file (chain, ladder and
journal), less that of the same run in memory, beside emcee's own.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import emcee
import numpy as np

from samplers import SMCSampler
from samplers.moves import RandomWalkMove
from tests.contract.targets import Gaussian

from .rows import Row

__all__ = ["cost"]

NDIM, STEPS, LIMIT_PLAIN, LIMIT_MIXTURE, LIMIT_STORAGE = 7, 200, 5.0, 150.0, 20.0


def _emcee(nwalkers: int, backend: emcee.backends.Backend | None) -> int:
    posterior = Gaussian(NDIM, sd=0.01)
    sampler = emcee.EnsembleSampler(nwalkers, NDIM, posterior, vectorize=True, backend=backend)
    sampler.run_mcmc(posterior.sample_prior(nwalkers, np.random.default_rng(1)), STEPS)
    return nwalkers * (STEPS + 1)


def _smc(nwalkers: int, backend: emcee.backends.Backend | None, **settings) -> int:
    posterior = Gaussian(NDIM, sd=0.01)
    sampler = SMCSampler(nwalkers, NDIM, posterior, vectorize=True, seed=1, backend=backend, **settings)
    sampler.run_mcmc(None, STEPS)
    return sampler.evaluations


def _walk(nwalkers: int, backend: emcee.backends.Backend | None) -> int:
    return _smc(nwalkers, backend, moves=RandomWalkMove())


def _per_evaluation(run: Callable, nwalkers: int, in_file: bool, clock: Callable[[], float], repeats: int) -> float:
    """Median seconds an evaluation."""
    values = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            backend = emcee.backends.HDFBackend(str(Path(folder) / "run.h5")) if in_file else None
            start = clock()
            evaluations = run(nwalkers, backend)
            values.append((clock() - start) / evaluations)
    return median(values)


def cost(repeats: int) -> list[Row]:
    """Microseconds an evaluation, in process and for storage."""
    rows = []
    kinds = {
        "plain moves (random walk)": (_walk, f"at most {LIMIT_PLAIN:g}"),
        "mixture moves": (lambda n, backend: _smc(n, backend, recycle=False), f"at most {LIMIT_MIXTURE:g}"),
        "default (recycling, then mixture moves)": (_smc, f"at most {LIMIT_MIXTURE:g}"),
        "emcee, stretch move": (_emcee, ""),
    }
    for name, (run, note) in kinds.items():
        value = 1e6 * _per_evaluation(run, 500, False, time.process_time, repeats)
        rows.append(Row("sampler, CPU an evaluation", f"{name}, 500 walkers", value, "us", note))
    for nwalkers in (40, 100, 500):
        for name, run in (("SMC, random walk", _walk), ("emcee", _emcee)):
            kept, memory = (_per_evaluation(run, nwalkers, f, time.perf_counter, repeats) for f in (True, False))
            note = f"at most {LIMIT_STORAGE:g}" if run is _walk else ""
            rows.append(
                Row("storage, wall an evaluation", f"{name}, {nwalkers} walkers", 1e6 * (kept - memory), "us", note)
            )
    return rows
