"""Simulations of a model and their statistics against measurements: counted, cached, and run in chunks.

`CachedSimulations.statistics` and, where responses are needed, `CachedSimulations.simulate` are the only places where a
likelihood requests simulations. Both select the rows to simulate, count them, record failures and cache the statistics
in memory and on disk.
"""

import hashlib
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..signals.channels import Measurements
from ..simulation.cache_rows import CachedRows
from ..simulation.disk_cache import SimulationCache
from ..simulation.executors import as_executor
from ..simulation.fingerprint import simulation_fingerprint
from ..simulation.memory_cache import MemoryCache, distinct_keys
from ..simulation.model import (
    Model,
    SimulationBatch,
    Statistic,
    has_batch_method,
    misfit_batch,
    misfit_of_responses,
    simulate_batch,
)
from .failures import FailureLog
from .inputs import as_points, match_measurements

__all__ = ["CachedSimulations"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average
_RESPONSE_VALUES = 2**23  # responses held at once where they are cached: 64 MiB


class _Simulated(NamedTuple):
    """Statistics and reasons of new simulations, and their responses if these were requested."""

    misfit: np.ndarray
    reasons: list[str]
    response: np.ndarray | None


def _in_single_precision(response: np.ndarray) -> np.ndarray:
    """Responses (n, n_channels, n_steps) as the cache on disk returns them; unchanged where it does not store them."""
    with np.errstate(over="ignore"):
        single = response.astype(np.float32)
    return np.where(np.isfinite(single).all(axis=(1, 2), keepdims=True), single, response)


class CachedSimulations:
    """Statistics of the residuals of a model, each simulation of which is run once.

    Parameters
    ----------
    model : Model
    measurements : Measurements
        The model's channels, in any order, at the model's time step and length.
    statistic : Statistic or None
        Statistic of the residuals; None for the sums of squares.
    pool, memory_rows, cache, max_failure_share
        As for `FELikelihood`.

    Attributes
    ----------
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
    """

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        statistic: Statistic | None,
        pool: Any,
        memory_rows: int,
        cache: SimulationCache | str | os.PathLike | None,
        max_failure_share: float,
    ) -> None:
        self._failures = FailureLog(model.parameter_names, max_failure_share)
        self.model = model
        self.measurements = match_measurements(model, measurements)
        self._statistic = statistic
        self._n_structural = len(model.parameter_names)
        n_channels = self.measurements.n_channels
        self._width = n_channels if statistic is None else len(statistic(self.measurements.values))
        self.pool = as_executor(pool, model)
        self.max_failure_share = max_failure_share
        self.memory_cache = MemoryCache(memory_rows)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self._model_fingerprint = None if cache is None else model.fingerprint
        self._key = None if cache is None else self.simulation_key
        self.chunk_size = 1
        self.simulations = 0
        self.cache_hits = 0
        self.disk_hits = 0
        self.seconds = 0.0
        self._outcomes = 0  # simulations of which is known whether they failed: run here, read from disk, or recalled

    def __getstate__(self) -> dict:
        return self.__dict__ | {"pool": None}

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
        thetas = self._as_rows(thetas)
        if np.isfinite(thetas).all():
            return self._statistics(thetas)
        result = np.full((len(thetas), self._width), np.nan)
        finite = np.isfinite(thetas).all(axis=1)
        if finite.any():
            result[finite] = self._statistics(thetas[finite])
        return result

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses of the model; their statistics are cached, so that `log_likelihood` needs no further simulation.

        Duplicates are simulated once. The statistics of a point may be cached without its response. Such a point is
        simulated again, unless its simulation failed.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters only.

        Returns
        -------
        SimulationBatch
            Responses (n, n_channels, n_steps) [SI], NaN where there is no usable simulation, and the reasons.

        Raises
        ------
        TooManyFailures
            As for `statistics`: the finished simulations are cached.

        Notes
        -----
        The responses are in double precision. With ``SimulationCache(..., responses=True)`` they are all rounded to
        single precision, as the cache stores them, so that they do not depend on what was stored. The statistics are
        those of the responses in double precision in either case.
        """
        thetas = self._as_rows(thetas)
        finite = np.flatnonzero(np.isfinite(thetas).all(axis=1))
        keys, distinct = distinct_keys(thetas[finite])
        batch = self._responses(keys, distinct)
        if len(keys) == len(thetas):
            return batch
        response = np.full((len(thetas), *batch.response.shape[1:]), np.nan)
        reasons = ["the parameters are not finite"] * len(thetas)
        for row, place in zip(finite, distinct, strict=True):
            response[row], reasons[row] = batch.response[place], batch.reasons[place]
        return SimulationBatch(response, reasons)

    def recall(self, thetas: np.ndarray, statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache statistics that are known from an earlier run in memory, without a simulation.

        Failures are recorded, and all rows count for `max_failure_share`. Rows that are cached already are not changed.
        Nothing is written to the cache on disk.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters only.
        statistics : (n, n_numbers) float
            What `statistics` returned for them.
        reasons : sequence of n str
            Reasons of failures; empty where the simulation succeeded.

        Raises
        ------
        ValueError
            If the numbers of rows differ, or the statistics are of another noise.
        """
        thetas, statistics = self._as_rows(thetas), np.asarray(statistics, dtype=float)
        if statistics.shape != (len(thetas), self._width) or len(reasons) != len(thetas):
            raise ValueError(
                f"recall: expected statistics of shape ({len(thetas)}, {self._width}) and {len(thetas)} reasons; got "
                f"{statistics.shape} and {len(reasons)}. Pass what statistics() returned for the same noise"
            )
        keys, distinct = distinct_keys(thetas)
        known = self.memory_cache.look_up(keys, self._width)[1]
        for place, row in dict(zip(distinct, range(len(thetas)), strict=True)).items():
            if not known[place] and np.isfinite(thetas[row]).all():
                self.memory_cache.store([keys[place]], statistics[[row]])
                self._outcomes += 1
                if reasons[row]:
                    self._failures.add(thetas[row], reasons[row])

    def _as_rows(self, thetas: np.ndarray) -> np.ndarray:
        """Structural parameters in an array (n, n_structural)."""
        thetas = as_points(thetas, self.model.parameter_names)
        return thetas if thetas.ndim == 2 else thetas[None]

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

    def _obtain(self, keys: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
        """Statistics of rows that are not in memory, simulated or from disk, and which of them came from disk."""
        thetas = self._thetas(keys)
        misfit, _, on_disk = self._read(keys, thetas)
        left = np.flatnonzero(~on_disk)
        for rows, batch in self._chunks(keys, thetas, left):
            misfit[rows] = batch.misfit
        return misfit, on_disk

    def _responses(self, keys: list[bytes], distinct: list[int]) -> SimulationBatch:
        """Responses of distinct keys; `distinct` has the key of every row that was requested, for the counts."""
        thetas, shape = self._thetas(keys), self.measurements.values.shape
        response, reasons = np.full((len(keys), *shape), np.nan), [""] * len(keys)
        misfit, known = self.memory_cache.look_up(keys, self._width)
        cached = np.array(known, dtype=bool) & ~np.isfinite(misfit).all(axis=1)  # failures need no response
        for row in np.flatnonzero(cached):
            reasons[row] = "the simulation failed before"
        left = np.flatnonzero(~cached)
        on_disk = np.zeros(len(keys), dtype=bool)
        single = self.cache is not None and self.cache.responses
        if self.cache is not None and len(left):
            _, stored, on_disk[left] = self._read([keys[row] for row in left], thetas[left])
            responses = self.cache.look_up_responses(self.model, thetas[left]) if single else [None] * len(left)
            for row, reason, values in zip(left, stored, responses, strict=True):
                cached[row] = bool(reason) or (on_disk[row] and values is not None)
                reasons[row] = reason
                if cached[row] and not reason:
                    response[row] = values
        for rows, batch in self._chunks(keys, thetas, np.flatnonzero(~cached), responses=True):
            response[rows] = _in_single_precision(batch.response) if single else batch.response
            for row, reason in zip(rows, batch.reasons, strict=True):
                reasons[row] = reason
        self.disk_hits += int((on_disk & cached)[distinct].sum())
        self.cache_hits += int(cached[distinct].sum())
        return SimulationBatch(response, reasons)

    def _thetas(self, keys: list[bytes]) -> np.ndarray:
        """Structural parameters of keys, (n, n_structural)."""
        return np.frombuffer(b"".join(keys), dtype=float).reshape(len(keys), self._n_structural).copy()

    def _read(self, keys: list[bytes], thetas: np.ndarray) -> CachedRows:
        """Rows of the cache on disk, which are then cached in memory; failures among them are recorded."""
        if self.cache is None:
            nothing = np.full((len(keys), self._width), np.nan)
            return CachedRows(nothing, [""] * len(keys), np.zeros(len(keys), dtype=bool))
        stored = self.cache.look_up(self._key, thetas, self._width, self.measurements.n_steps)
        self._outcomes += int(stored.known.sum())
        for row in np.flatnonzero(stored.known):
            if stored.reasons[row]:
                self._failures.add(thetas[row], stored.reasons[row])
        self.memory_cache.store([keys[row] for row in np.flatnonzero(stored.known)], stored.misfit[stored.known])
        return stored

    def _chunks(
        self, keys: list[bytes], thetas: np.ndarray, left: np.ndarray, responses: bool = False
    ) -> Iterator[tuple[np.ndarray, _Simulated]]:
        """Simulate the rows `left` in chunks that are stored one by one; yields their indices and results."""
        smallest, largest = self._chunk_limits(len(left)) if len(left) else (0, 0)
        while len(left):
            size = max(smallest, min(largest, self.chunk_size))
            rows, left = left[:size], left[size:]
            start = time.perf_counter()
            batch = self._simulate(thetas[rows], responses)
            # the size grows by steps: the first simulations may be failures that took no time
            self.chunk_size = min(4 * size, 1 + int(_SECONDS_PER_CHUNK * len(rows) / (time.perf_counter() - start)))
            self.memory_cache.store([keys[row] for row in rows], batch.misfit)
            yield rows, batch

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

    def _simulate(self, thetas: np.ndarray, responses: bool) -> _Simulated:
        """Results of new simulations, which are counted, recorded if they fail, and stored on disk."""
        # checked before a batch and not after it, so that finished simulations are stored
        self._failures.check(self._outcomes)
        start = time.perf_counter()
        measured = self.measurements.values
        batch = None
        if responses or (self.cache is not None and self.cache.responses):
            batch = simulate_batch(self.model, thetas, self.pool)
            misfit, reasons = misfit_of_responses(self.model, batch, measured, self._statistic)
        else:
            misfit, reasons = misfit_batch(self.model, thetas, measured, self.pool, self._statistic)
        seconds = time.perf_counter() - start
        self.seconds += seconds
        self.simulations += len(thetas)
        self._outcomes += len(thetas)
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
            if self.cache.responses:
                self.cache.store_responses(self.model, thetas, batch.response)
        if responses:
            batch.response[[bool(reason) for reason in reasons]] = np.nan
        return _Simulated(misfit, reasons, batch.response if responses else None)
