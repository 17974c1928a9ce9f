"""How busy 16 real dask workers are with runs of unequal length: ``python -m benchmarks busy_workers``.

The model sleeps for a time that is log-normal with a coefficient of variation of 1, and a function of the parameters;
so the processors are free, and the same run on a simulated clock is the reference. The difference is what parent,
scheduler and workers need besides the simulations. Evaluations and lengths of the asynchronous run depend on the order
of arrival, so that its simulated counterpart is another run of the same kind.
"""

import hashlib
import time
import warnings

import numpy as np

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    Prior,
    TruncatedNormal,
)
from samplers import SMCSampler
from tests.simulated_cluster import SimulatedCluster

from .rows import Row

__all__ = ["busy_workers"]

WORKERS, WALKERS = 16, 300
MEAN_SECONDS = 0.25
SPREAD = float(np.sqrt(np.log(2.0)))
TIMES = np.arange(20) * 0.1


def seconds_of(theta: np.ndarray) -> float:
    """Length of a run [s], a fixed function of the parameters that looks random."""
    seed = int.from_bytes(hashlib.blake2b(np.asarray(theta, float).tobytes(), digest_size=4).digest(), "little")
    return float(MEAN_SECONDS * np.random.default_rng(seed).lognormal(-0.5 * SPREAD**2, SPREAD))


def decay(theta: np.ndarray) -> np.ndarray:
    """Response (1, n_steps) of a decaying oscillation with a frequency and a damping, without a wait."""
    frequency, damping = theta
    return (np.exp(-damping * TIMES) * np.cos(2.0 * np.pi * frequency * TIMES))[None]


def slow(theta: np.ndarray) -> np.ndarray:
    """`decay`, after a wait."""
    time.sleep(seconds_of(theta))
    return decay(theta)


def posterior_of(function, pool=None) -> Posterior:
    """The posterior of a synthetic measurement."""
    model = FunctionModel(
        function, ["frequency", "damping"], [Channel("displacement", "displacement", "m")], dt=0.1, n_steps=len(TIMES)
    )
    noise = 0.05 * np.random.default_rng(1).standard_normal((1, len(TIMES)))
    measurements = Measurements(model.channels, model.dt, decay((1.0, 0.5)) + noise)
    prior = Prior(
        {"frequency": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(0.5, 0.3)}
        | {"sigma_displacement": HalfNormal(0.2)}
    )
    return Posterior(FELikelihood(model, measurements, pool=pool), prior)


class Counted:
    """A posterior, and the total length of the runs that were requested of it."""

    def __init__(self, posterior: Posterior):
        self.posterior, self.slept, self._queue = posterior, 0.0, None
        self.ndim, self.log_prior, self.sample_prior = posterior.ndim, posterior.log_prior, posterior.sample_prior

    def _count(self, coords: np.ndarray) -> np.ndarray:
        self.slept += sum(seconds_of(theta[:2]) for theta in coords)
        return coords

    def __call__(self, coords: np.ndarray) -> np.ndarray:
        return self.posterior(self._count(coords))

    def evaluation_queue(self) -> "Counted":
        self._queue = self.posterior.evaluation_queue()
        self.workers, self.collect, self.close = self._queue.workers, self._queue.collect, self._queue.close
        return self

    def submit(self, coords: np.ndarray) -> list[int]:
        return self._queue.submit(self._count(coords))


def busy_workers(repeats: int) -> list[Row]:
    """One row per way of running and question; `repeats` is not used, since a run takes minutes."""
    from distributed import Client, LocalCluster

    rows = []
    warnings.simplefilter("ignore")
    with (
        LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        list(client.gather(client.map(slow, [np.array([1.0, 0.5])] * WORKERS, pure=False)))  # imports of the workers
        for asynchronous in (False, True):
            case = f"{WORKERS} dask workers, {WALKERS} walkers, {'a' if asynchronous else ''}synchronous"
            posterior = Counted(posterior_of(slow, client))
            sampler = SMCSampler(WALKERS, 3, posterior, vectorize=True, seed=1, asynchronous=asynchronous)
            start, processor = time.perf_counter(), time.process_time()
            sampler.run_mcmc(None, 0)
            wall, processor = time.perf_counter() - start, time.process_time() - processor
            runs, share = posterior.posterior.likelihood.simulations, posterior.slept / (WORKERS * wall)
            rows.append(Row("busy: share of the workers' time", case, share, "", f"{runs} runs"))
            quick = posterior_of(decay)
            simulated = SimulatedCluster(quick, WORKERS, lambda x: np.array([seconds_of(theta[:2]) for theta in x]))
            SMCSampler(WALKERS, 3, simulated, vectorize=True, seed=1, asynchronous=asynchronous).run_mcmc(None, 0)
            rows.append(Row("busy: the same on a simulated clock", case, simulated.utilisation, ""))
            rows.append(Row("busy: parent's processor time per run", case, 1e3 * processor / runs, "ms"))
    return rows
