"""Simulations of a model and their statistics against measurements: counted and cached.

`CachedSimulations.statistics` and, where responses are needed, `CachedSimulations.simulate` are the only places where a
likelihood requests simulations. Both look for results in this order: statistics in memory, statistics on disk,
responses in memory, responses on disk. From a response, which is cached in double precision, the statistics are
computed; they have the same bits as those of a new simulation. What is left is simulated by the base class.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..cache.guard import ModelGuard
from ..cache.memory import MemoryCache, ResponseMemory, distinct_keys
from ..cache.simulation_cache import SimulationCache
from ..cache.verification import StaleCache, VerifiedCache
from ..noise.sample_counts import count_samples
from ..signals.channels import Measurements
from ..signals.comparison import Comparison, compare_with
from ..simulation.executors import as_executor
from ..simulation.label import ModelLabel
from ..simulation.model import Model, SimulationBatch, misfit_of_responses
from ..simulation.residual_statistics import Statistic, statistic_width
from .failures import FailureLog
from .inputs import as_rows, check_statistic, name_of_statistic
from .new_simulations import NewSimulations
from .requested_simulations import Requested
from .running_requests import RunningRequests

__all__ = ["CachedSimulations"]

_OF_PROCESS = ("_running", "_has_results", "when_simulated")  # not pickled


class CachedSimulations(NewSimulations):
    """Base of `FELikelihood`, which documents the attributes: a model's simulations, each of which is run once.

    Parameters
    ----------
    model, measurements, pool, memory_rows, memory_bytes, cache, max_failure_share
        As for `FELikelihood`; measurements in the order of the model's channels.
    statistic : Statistic or None
        Statistic of the residuals; None for the sums of squares.
    time_shifts : mapping of str to float, optional
        Largest unknown time shifts of channels [s].
    """

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        statistic: Statistic | None,
        pool: Any,
        memory_rows: int,
        memory_bytes: int,
        cache: SimulationCache | str | os.PathLike | None,
        max_failure_share: float,
        time_shifts: Mapping[str, float] | None = None,
    ) -> None:
        self._failures = FailureLog(model.parameter_names, max_failure_share)
        self.model = model
        self.measurements = measurements
        self._statistic = statistic
        self._n_structural = len(model.parameter_names)
        # what responses are compared with: the measured values, or a Comparison where samples are missing
        self.measured = compare_with(self.measurements, model.dt, model.n_steps, time_shifts)
        self.n_samples = count_samples(getattr(self.measured, "values", self.measured))
        self._response_shape = (len(model.channels), model.n_steps)
        self._width = statistic_width(self.measured, statistic)
        check_statistic(statistic, self.measured)
        self.pool = as_executor(pool, model)
        self.max_failure_share = max_failure_share
        self.memory_cache = MemoryCache(memory_rows)
        self.response_memory = ResponseMemory(memory_bytes)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self._own_label = label = ModelLabel(model, statistic)
        self._verified_cache = None if self.cache is None else VerifiedCache(self.cache, model, self.pool, label)
        if self._verified_cache is not None:
            self._own_label = label = self._verified_cache.label  # an equal one
        self._guard = ModelGuard(model, label)
        self._key = None if cache is None else self.simulation_key
        self.chunk_size = 1
        self.simulations = self.cache_hits = self.disk_hits = 0
        self.seconds = 0.0
        self._outcomes, self._has_repeated_remark = 0, False
        self.shortened: list[CachedSimulations] = []  # likelihoods of the first parts of the measurements

    def __getstate__(self) -> dict:
        kept = {name: value for name, value in self.__dict__.items() if name not in _OF_PROCESS}
        return kept | {"pool": None, "shortened": []}

    @property
    def verifications(self) -> int:
        """Number of earlier simulations that were compared with a new one, besides `simulations`."""
        stored = 0 if self._verified_cache is None else self._verified_cache.compared
        return stored + self._guard.compared

    @property
    def unverified(self) -> int:
        """Number of rows that could not be compared, because the new simulation was stopped (`TransientReason`)."""
        return 0 if self._verified_cache is None else self._verified_cache.unverified

    @property
    def failure_count(self) -> int:
        """Number of failed simulations, those known from the cache on disk included."""
        return self._failures.count

    @property
    def transient_failure_count(self) -> int:
        """Number of failures whose cause is not the model; a likelihood made later simulates these points again."""
        return self._failures.transient

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
        """Hex digest of everything that is known of what the statistics depend on: `simulation_key` and code.

        The code and values of the user are those at the time when the likelihood was made.
        """
        return hashlib.blake2b(f"{self.simulation_key} {self._label.identity}".encode(), digest_size=16).hexdigest()

    @property
    def simulation_key(self) -> str:
        """Declared identity under which a `SimulationCache` stores the statistics: model, measurements, statistic."""
        text = f"{self.model.fingerprint} {self.measurements.fingerprint}{name_of_statistic(self._statistic)}"
        if isinstance(self.measured, Comparison):
            text += self.measured.description
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def cache_keys(self) -> tuple[str, str]:
        """Keys under which a `SimulationCache` stores the statistics and the responses, as `forget` takes them."""
        return self.simulation_key, self.model.fingerprint

    def misfit(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared residuals, without unknown time shifts: the first columns of `statistics`.

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
        thetas = as_rows(thetas, self.model.parameter_names)
        if np.isfinite(thetas).all():
            return self._statistics(thetas)
        result = np.full((len(thetas), self._width), np.nan)
        finite = np.isfinite(thetas).all(axis=1)
        if finite.any():
            result[finite] = self._statistics(thetas[finite])
        return result

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses of the model; they and their statistics are cached.

        Duplicates are simulated once, and cached responses are reused. The statistics of a point may be cached without
        its response. Such a point is simulated again, unless its simulation failed.

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
        """
        thetas = as_rows(thetas, self.model.parameter_names)
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

    def running_requests(self) -> RunningRequests:
        """Requests for responses of which several run at once; `simulate` then finds the responses in the cache."""
        return RunningRequests(self)

    def has_responses(self, keys: list[bytes]) -> np.ndarray:
        """Whether `simulate` needs no simulation for each of the distinct keys: (n,) bool, see `distinct_keys`.

        Responses of the cache on disk are read into memory. Some may be simulated again for verification.
        """
        misfit, known = self.memory_cache.look_up(keys, self._width)
        response = np.full((len(keys), *self._response_shape), np.nan)
        requested = self._requested(keys, misfit, np.array(known, dtype=bool), response)
        self._read(requested)
        return requested.cached

    def are_stored(self, thetas: np.ndarray) -> np.ndarray:
        """Whether the cache on disk has a simulation, a response or a failure (n,), which is not read or verified."""
        if self.cache is None:
            return np.zeros(len(thetas), dtype=bool)
        return self._verified_cache.are_stored(self.cache_keys, thetas, self.model)

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
        thetas, statistics = as_rows(thetas, self.model.parameter_names), np.asarray(statistics, dtype=float)
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

    def look_up(self, keys: list[bytes], distinct: list[int], on_disk: bool) -> tuple[np.ndarray, np.ndarray]:
        """Statistics that are cached, without a new simulation of others.

        Parameters
        ----------
        keys : list of n bytes
            Distinct, see `distinct_keys`.
        distinct : list of int
            Index of the key of every row that was requested, for the counts.
        on_disk : bool
            Whether to look in the cache on disk as well. Some of its rows may be simulated again for verification.

        Returns
        -------
        misfit : (n, n_numbers) float
            NaN where nothing is cached and where the simulation failed.
        cached : (n,) bool
        """
        misfit, known = self.memory_cache.look_up(keys, self._width)
        known, counts = np.array(known, dtype=bool), np.bincount(distinct, minlength=len(keys))
        if on_disk and not known.all():
            requested = self._requested([key for key, is_known in zip(keys, known, strict=True) if not is_known])
            self._read(requested)
            self.disk_hits += int(counts[~known][requested.on_disk].sum())
            misfit[~known], known[~known] = requested.misfit, requested.cached
        self.cache_hits += int(counts[known].sum())
        return misfit, known

    def _statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics of finite rows; few calls of numpy, because a cached row has to cost less than 10 microseconds."""
        keys, distinct = distinct_keys(thetas)
        misfit, known = self.memory_cache.look_up(keys, self._width)
        if all(known):
            self.cache_hits += len(thetas)
        else:
            new = ~np.array(known)
            requested = self._requested([key for key, is_new in zip(keys, new, strict=True) if is_new])
            self._obtain(requested)
            misfit[new] = requested.misfit
            counts = np.bincount(distinct)  # of the rows that were requested
            self.disk_hits += int(counts[new][requested.on_disk].sum())
            self.cache_hits += int(counts[~new].sum() + counts[new][requested.cached].sum())
        return misfit if len(keys) == len(thetas) else misfit[distinct]

    def _responses(self, keys: list[bytes], distinct: list[int]) -> SimulationBatch:
        """Responses of distinct keys; `distinct` has the key of every row that was requested, for the counts."""
        misfit, known = self.memory_cache.look_up(keys, self._width)
        response = np.full((len(keys), *self._response_shape), np.nan)
        requested = self._requested(keys, misfit, np.array(known, dtype=bool), response)
        self._obtain(requested)
        counts = np.bincount(distinct, minlength=len(keys))
        self.disk_hits += int(counts[requested.on_disk].sum())
        self.cache_hits += int(counts[requested.cached].sum())
        return SimulationBatch(response, requested.reasons)

    def _requested(
        self,
        keys: list[bytes],
        misfit: np.ndarray | None = None,
        known: np.ndarray | None = None,
        response: np.ndarray | None = None,
    ) -> Requested:
        """Arrays to be filled in by `_obtain`."""
        n = len(keys)
        thetas = np.frombuffer(b"".join(keys), dtype=float).reshape(n, self._n_structural).copy()
        if misfit is None:
            misfit, known = np.full((n, self._width), np.nan), np.zeros(n, dtype=bool)
        return Requested(keys, thetas, misfit, known, [""] * n, response, np.zeros(n, bool), np.zeros(n, bool))

    def _obtain(self, requested: Requested) -> None:
        """Fill in what was requested, from the caches or by simulation."""
        self._read(requested)
        for rows, batch in self._run(requested, np.flatnonzero(~requested.cached)):
            requested.misfit[rows] = batch.misfit
            for row, reason in zip(np.atleast_1d(rows), batch.reasons, strict=True):
                requested.reasons[row] = reason
            if requested.response is not None:
                requested.response[rows] = batch.response

    def _read(self, requested: Requested) -> None:
        """Fill in what the caches have."""
        self._read_statistics(requested)
        failed = requested.known & ~np.isfinite(requested.misfit).all(axis=1)
        # a failure needs no response
        requested.cached[:] = requested.known if requested.response is None else failed
        self._name_failures(requested, np.flatnonzero(failed))
        left = np.flatnonzero(~requested.cached)
        size = self._most_responses
        for start in range(0, len(left), size):
            self._read_responses(requested, left[start : start + size])
        self._read_failures(requested, np.flatnonzero(~requested.cached & ~requested.known))

    def _read_statistics(self, requested: Requested) -> None:
        """Fill in statistics from the cache on disk; they are then cached in memory, and failures recorded."""
        new = np.flatnonzero(~requested.known)
        if self.cache is None or not len(new):
            return
        stored = self._verified(self._verified_cache.look_up, self._key, requested.thetas[new])
        rows = new[stored.known]
        requested.misfit[rows] = stored.misfit[stored.known]
        requested.known[rows] = requested.on_disk[rows] = True
        for row, reason in zip(new, stored.reasons, strict=True):
            requested.reasons[row] = reason
        self._add_outcomes(requested, rows)

    def _verified(self, look_up: Callable, *arguments: Any) -> Any:
        """Rows from the disk, of which some are simulated again; if these differ, the caches in memory are emptied."""
        earlier = self._verified_cache.seconds
        try:
            return look_up(*arguments, self._verifying_run)
        except StaleCache:
            self.memory_cache.clear()
            self.response_memory.clear()
            raise
        finally:
            self.seconds += self._verified_cache.seconds - earlier

    def _read_responses(self, requested: Requested, rows: np.ndarray) -> None:
        """Fill in rows whose responses are cached, and their statistics where these are not known."""
        outcomes: list[np.ndarray | str | None] = [None] * len(rows)
        keys = [requested.keys[row] for row in rows]
        if len(self.response_memory):
            outcomes = self.response_memory.look_up(self.model.fingerprint, keys)
        left = [place for place, outcome in enumerate(outcomes) if outcome is None]
        if self.cache is not None and left:
            stored = self._verified(self._verified_cache.look_up_responses, requested.thetas[rows[left]])
            found = [(place, response) for place, response in zip(left, stored, strict=True) if response is not None]
            for place, response in found:
                outcomes[place] = response
                requested.on_disk[rows[place]] = True
            if requested.response is not None and found:
                found_keys = [keys[place] for place, _ in found]
                self.response_memory.store(self.model.fingerprint, found_keys, [response for _, response in found])
        places = [place for place, outcome in enumerate(outcomes) if outcome is not None]
        if not places:
            return
        rows, outcomes = rows[places], [outcomes[place] for place in places]
        nothing = np.full(self._response_shape, np.nan)
        reasons = [outcome if isinstance(outcome, str) else "" for outcome in outcomes]
        response = np.array([nothing if isinstance(outcome, str) else outcome for outcome in outcomes])
        if requested.response is not None:
            requested.response[rows] = response
        new = np.flatnonzero(~requested.known[rows])
        if len(new):
            batch = SimulationBatch(response[new], [reasons[place] for place in new])
            misfit, reasons_of_new = misfit_of_responses(self.model, batch, self.measured, self._statistic)
            requested.misfit[rows[new]], requested.known[rows[new]] = misfit, True
            for row, reason in zip(rows[new], reasons_of_new, strict=True):
                requested.reasons[row] = reason
                if reason and requested.response is not None:
                    requested.response[row] = np.nan
            self._add_outcomes(requested, rows[new])
            if self.cache is not None:
                run = self._verifying_run
                self._verified_cache.store(
                    self._key, requested.thetas[rows[new]], misfit, reasons_of_new, None, 0.0, run
                )
        requested.cached[rows] = True

    def _read_failures(self, requested: Requested, rows: np.ndarray) -> None:
        """Fill in rows whose simulation is known to fail for any measurements."""
        if self.cache is None or not len(rows):
            return
        reasons = self._verified(self._verified_cache.look_up_failures, requested.thetas[rows])
        for row, reason in zip(rows, reasons, strict=True):
            requested.reasons[row] = reason
        rows = rows[[bool(reason) for reason in reasons]]
        requested.known[rows] = requested.cached[rows] = requested.on_disk[rows] = True
        self._add_outcomes(requested, rows)

    def _add_outcomes(self, requested: Requested, rows: np.ndarray) -> None:
        """Count simulations whose statistics came from the disk or from a response, and cache these in memory."""
        self._outcomes += len(rows)
        self._has_results = self._has_results or len(rows) > 0
        if len(rows) and not self._has_repeated_remark:
            self._has_repeated_remark = True
            if self.cache is not None:
                self.cache.repeat_remark(self.model)
        for row in rows:
            if requested.reasons[row]:
                self._failures.add(requested.thetas[row], requested.reasons[row])
        self.memory_cache.store([requested.keys[row] for row in rows], requested.misfit[rows])

    def _name_failures(self, requested: Requested, rows: np.ndarray) -> None:
        """Fill in reasons of failures of which only the statistics were cached."""
        rows = [row for row in rows if not requested.reasons[row]]
        if not rows or requested.response is None:
            return
        outcomes = self.response_memory.look_up(self.model.fingerprint, [requested.keys[row] for row in rows])
        for row, outcome in zip(rows, outcomes, strict=True):
            requested.reasons[row] = outcome if isinstance(outcome, str) else "the simulation failed before"
