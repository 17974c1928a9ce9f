"""Log-likelihood of the parameters of a model and of the noise, given measurements.

The steps are: structural parameters to the response of the model, response to the sums of squared residuals J per
channel, J and the parameters of the noise to the log-likelihood. (A noise may need more numbers than J, its statistic
of the residuals, see `fe_likelihoods.probability.noise`.) `FELikelihood.statistics` is the only place where simulations
are requested: it selects the rows to simulate, counts them, records failures and caches the results. The equations are
on the page ``docs/theory/likelihood.rst``.
"""

import hashlib
import os
import time
from collections import Counter
from typing import Any

import numpy as np

from ..signals.channels import Measurements
from ..simulation.disk_cache import SimulationCache
from ..simulation.executors import as_executor
from ..simulation.fingerprint import simulation_fingerprint
from ..simulation.memory_cache import MemoryCache, distinct_keys
from ..simulation.model import (
    Model,
    SimulationFailed,
    has_batch_method,
    misfit_batch,
    misfit_of_responses,
    simulate_batch,
)
from .failures import FailureLog
from .inputs import as_points, check_model, check_noise_channels, match_measurements
from .noise import GaussianNoise, Noise, noise_statistic

__all__ = ["FELikelihood"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average
_RESPONSE_VALUES = 2**23  # responses held at once where they are cached: 64 MiB


class FELikelihood:
    """Log-likelihood of structural parameters and noise parameters, given measurements.

    Calling the object is `log_likelihood`.

    Parameters
    ----------
    model : Model
        Computes the response from structural parameters (see `fe_likelihoods.simulation.model`).
    measurements : Measurements
        The model's channels (matched by name, in any order) at the model's time step and length.
    noise : Noise, optional
        A noise of `fe_likelihoods.probability.noise` or any object with that protocol; by default `GaussianNoise` of
        the model's channels.
    pool : int, or object with ``map(function, items)``, optional
        Runs the simulations in parallel: a number of processes of this machine, a client of dask.distributed, an
        executor or a pool (see `fe_likelihoods.simulation.executors`). Without it, simulations run in this process:
        compiled models on threads, others one after the other. It is not pickled with the likelihood.
    memory_rows : int
        Number of simulations whose statistics are cached in memory (about 250 bytes each), failures included, so that
        they are not simulated again; 0 for none. The contents are not pickled with the likelihood: every process caches
        its own simulations.
    cache : SimulationCache or path, optional
        Cache on disk, used after the one in memory: simulations of earlier runs and of other processes are not run
        again, and a killed run loses only its last few seconds. A batch is then simulated in chunks of a few seconds
        that are stored one by one; with a pool of unknown size, in one chunk.
    max_failure_share : float
        Largest share of failed simulations, in [0, 1]. If more have failed, of 20 or more, the next request for a
        simulation raises `TooManyFailures`.

    Attributes
    ----------
    parameter_names : tuple of str
        Names of the structural parameters, then of the noise parameters.
    fast_parameters : tuple of int
        Indices of the parameters whose change needs no simulation: those of the noise.
    simulations : int
        Simulations run by this object in this process.
    cache_hits : int
        Rows whose statistics were cached, in memory or on disk.
    disk_hits : int
        Rows among them that came from the cache on disk.
    seconds : float
        Wall time of the simulations [s].
    memory_cache : MemoryCache
        The statistics that are cached in memory.
    chunk_size : int
        Number of simulations after which the next results are stored on disk; adapted to their duration.

    Raises
    ------
    ValueError
        If a member of `Model` is missing, if the channels, time step or length of model and measurements differ, or the
        channels of the noise, if parameter names repeat, if `pool` is neither a number nor has ``map`` or ``gather``,
        if the model cannot be sent to its processes, or if the file of the cache cannot be used.
    """

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        noise: Noise | None = None,
        pool: Any = None,
        *,
        memory_rows: int = 100_000,
        cache: SimulationCache | str | os.PathLike | None = None,
        max_failure_share: float = 1.0,
    ) -> None:
        check_model(model)
        self._failures = FailureLog(model.parameter_names, max_failure_share)
        self.model = model
        self.measurements = match_measurements(model, measurements)
        self.noise = GaussianNoise(model.channels) if noise is None else noise
        check_noise_channels(model, self.noise)
        self._statistic = noise_statistic(self.noise)
        n_channels = self.measurements.n_channels
        self._width = n_channels if self._statistic is None else len(self._statistic(self.measurements.values))
        self.pool = as_executor(pool, model)
        self.max_failure_share = max_failure_share
        self.parameter_names = tuple(model.parameter_names) + tuple(self.noise.parameter_names)
        if len(set(self.parameter_names)) != len(self.parameter_names):
            raise ValueError(f"the names of model and noise must differ; got {', '.join(self.parameter_names)}")
        self._n_structural = len(model.parameter_names)
        self.fast_parameters = tuple(range(self._n_structural, len(self.parameter_names)))
        self.memory_cache = MemoryCache(memory_rows)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self._model_fingerprint = None if cache is None else model.fingerprint
        self._key = None if cache is None else self.simulation_key
        self.chunk_size = 1
        self.simulations = 0
        self.cache_hits = 0
        self.disk_hits = 0
        self.seconds = 0.0

    def __getstate__(self) -> dict:
        return self.__dict__ | {"pool": None}

    def __call__(self, x: Any) -> np.ndarray | float:
        """Same as `log_likelihood`."""
        return self.log_likelihood(x)

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)

    @property
    def failure_count(self) -> int:
        """Number of failed simulations, those known from the cache on disk included."""
        return self._failures.count

    @property
    def failures(self) -> list[dict]:
        """The first 1000 failures: ``{"parameters": {name: value}, "reason": str}``, with ``"seconds"`` if known."""
        return self._failures.records

    @property
    def failure_reasons(self) -> Counter[str]:
        """Number of failures per reason."""
        return self._failures.reasons

    @property
    def fingerprint(self) -> str:
        """Hex digest of everything the cached statistics depend on: model, measurements, statistic of the noise.

        The source files of the library are not part of it; they are part of `simulation_key`.
        """
        text = f"{self.model.fingerprint} {self.measurements.fingerprint}"
        if self._statistic is not None:
            text += f" {self._statistic.__module__}.{self._statistic.__qualname__}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def simulation_key(self) -> str:
        """Key under which a `SimulationCache` stores the statistics: `fingerprint` and digest of the source files."""
        return f"{self.fingerprint} {simulation_fingerprint(self.model, self._statistic)}"

    @property
    def data_fingerprint(self) -> str:
        """Hex digest of the measurements: equal for likelihoods of the same data, in any order of the channels."""
        names = sorted(channel.name for channel in self.measurements.channels)
        return self.measurements.select(names).fingerprint

    def misfit(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared residuals: the first columns of `statistics`.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters only.

        Returns
        -------
        (n, n_channels) float
            [SI unit of the channel, squared]; NaN where there is no usable simulation.
        """
        return self.statistics(thetas)[:, : self.measurements.n_channels]

    def statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics of the residuals that the noise needs: for white noise the sums of squares.

        Duplicates are simulated once, cached rows are reused, and non-finite rows are skipped.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters only.

        Returns
        -------
        (n, n_numbers) float
            NaN where there is no usable simulation.
        """
        thetas = as_points(thetas, self.model.parameter_names)
        thetas = thetas if thetas.ndim == 2 else thetas[None]
        if np.isfinite(thetas).all():
            return self._statistics(thetas)
        result = np.full((len(thetas), self._width), np.nan)
        finite = np.isfinite(thetas).all(axis=1)
        if finite.any():
            result[finite] = self._statistics(thetas[finite])
        return result

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Measured minus simulated response at one point: one simulation, which is neither counted nor cached.

        Parameters
        ----------
        theta : (n_structural,) or (ndim,) float
            Structural parameters; the noise parameters may follow.

        Returns
        -------
        (n_channels, n_steps) float
            [SI], in the order of the model's channels.

        Raises
        ------
        ValueError
            For a wrong number of parameters.
        SimulationFailed
            If the simulation fails.
        """
        theta = np.asarray(theta, dtype=float)
        if theta.shape not in ((self._n_structural,), (self.ndim,)):
            raise ValueError(
                f"expected one point, of shape ({self._n_structural},), or ({self.ndim},) with the noise parameters; "
                f"got shape {theta.shape}"
            )
        response, (reason,) = simulate_batch(self.model, theta[None, : self._n_structural])
        if reason:
            raise SimulationFailed(reason)
        return self.measurements.values - response[0]

    def _statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics of finite rows; few calls of numpy, because a cached row has to cost less than 10 microseconds."""
        keys, distinct = distinct_keys(thetas)
        misfit, known = self.memory_cache.look_up(keys, self._width)
        if all(known):
            self.cache_hits += len(thetas)
        else:
            known = np.array(known)
            new, on_disk = ~known, np.zeros(len(keys), dtype=bool)
            misfit[new], on_disk[new] = self._obtain([key for key, is_new in zip(keys, new, strict=True) if is_new])
            self.disk_hits += int(on_disk[distinct].sum())
            self.cache_hits += int((known | on_disk)[distinct].sum())
        return misfit if len(keys) == len(thetas) else misfit[distinct]

    def log_likelihood(self, x: Any) -> np.ndarray | float:
        """Log-likelihood of structural parameters followed by noise parameters.

        Parameters
        ----------
        x : array_like (ndim,) or (n, ndim), or mapping
            A mapping has a value, or n values, for every parameter name.

        Returns
        -------
        float or (n,) float
            -inf where a simulation fails, where the noise parameters are impossible (nothing is simulated there) and
            where x is not finite; never NaN.
        """
        points = as_points(x, self.parameter_names)
        rows = np.atleast_2d(points)
        thetas, noise = np.split(rows, [self._n_structural], axis=1)
        n_steps = self.measurements.n_steps
        possible = np.isfinite(rows).all(axis=1)
        if self.fast_parameters:
            # statistics of zero (a perfect fit) show before any simulation which noise parameters are possible
            perfect = np.zeros((len(rows), self._width))
            possible &= ~np.isneginf(self.noise.log_likelihood(perfect, n_steps, noise))
        result = np.full(len(rows), -np.inf)
        if possible.any():
            misfit = self.statistics(thetas[possible])
            values = self.noise.log_likelihood(misfit, n_steps, noise[possible])
            usable = values < np.inf  # neither NaN nor infinite
            simulated = np.isfinite(misfit).all(axis=1)
            for row in np.flatnonzero(simulated & ~usable):
                self._failures.add(thetas[possible][row], f"the log-likelihood of the noise is {values[row]}")
            result[possible] = np.where(simulated & usable, values, -np.inf)
        return result if points.ndim == 2 else float(result[0])

    def with_noise(self, noise: Noise) -> "FELikelihood":
        """The same likelihood with another noise.

        Model, measurements, pool, cache on disk and limits are kept; counts and the cache in memory start empty.
        """
        other = FELikelihood(
            self.model,
            self.measurements,
            noise,
            memory_rows=self.memory_cache.rows,
            cache=self.cache,
            max_failure_share=self.max_failure_share,
        )
        other.pool = self.pool
        return other

    def _obtain(self, keys: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
        """Statistics of rows that are not in memory, simulated or from disk, and which of them came from disk."""
        thetas = np.frombuffer(b"".join(keys), dtype=float).reshape(len(keys), -1).copy()
        shape = len(keys), self._width
        misfit, on_disk = np.full(shape, np.nan), np.zeros(len(keys), dtype=bool)
        if self.cache is not None:
            misfit, reasons, on_disk = self.cache.look_up(self._key, thetas, shape[1], self.measurements.n_steps)
            for row in np.flatnonzero(on_disk):
                if reasons[row]:
                    self._failures.add(thetas[row], reasons[row])
            self.memory_cache.store([keys[row] for row in np.flatnonzero(on_disk)], misfit[on_disk])
        left = np.flatnonzero(~on_disk)
        smallest, largest = self._chunk_limits(len(left)) if len(left) else (0, 0)
        while len(left):
            size = max(smallest, min(largest, self.chunk_size))
            rows, left = left[:size], left[size:]
            start = time.perf_counter()
            misfit[rows] = self._simulate(thetas[rows])
            # the size grows by steps: the first simulations may be failures that took no time
            self.chunk_size = min(4 * size, 1 + int(_SECONDS_PER_CHUNK * len(rows) / (time.perf_counter() - start)))
            self.memory_cache.store([keys[row] for row in rows], misfit[rows])
        return misfit, on_disk

    def _chunk_limits(self, n: int) -> tuple[int, int]:
        """Smallest (all workers are busy) and largest number of simulations, of n, between two writes to disk."""
        if self.cache is None:
            return n, n
        largest = max(1, _RESPONSE_VALUES // self.measurements.values.size) if self.cache.responses else n
        if self.pool is not None:
            workers = self.pool.n_workers or n
        elif has_batch_method(self.model):
            workers = os.cpu_count() or 1
        else:
            return 1, largest
        return min(_ROUNDS_PER_CHUNK * workers, largest), largest

    def _simulate(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics of new simulations, which are counted, recorded if they fail, and stored on disk."""
        # checked before a batch and not after it, so that finished simulations are stored
        self._failures.check(self.simulations + self.disk_hits)
        start = time.perf_counter()
        measured = self.measurements.values
        batch = None
        if self.cache is not None and self.cache.responses:
            batch = simulate_batch(self.model, thetas, self.pool)
            misfit, reasons = misfit_of_responses(self.model, batch, measured, self._statistic)
        else:
            misfit, reasons = misfit_batch(self.model, thetas, measured, self.pool, self._statistic)
        seconds = time.perf_counter() - start
        self.seconds += seconds
        self.simulations += len(thetas)
        for theta, reason in zip(thetas, reasons, strict=True):
            if reason:
                self._failures.add(theta, reason)
        if self.cache is not None:
            if self.model.fingerprint != self._model_fingerprint:
                raise ValueError(
                    "the model has changed since the likelihood was made (its fingerprint differs), so its simulations "
                    "cannot be stored with the earlier ones; make a new likelihood"
                )
            self.cache.store(self._key, thetas, self.measurements.n_steps, misfit, reasons, seconds)
            if batch is not None:
                self.cache.store_responses(self.model, thetas, batch.response)
        return misfit
