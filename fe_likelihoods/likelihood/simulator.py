"""Simulations of a model and their statistics against measurements: each is run once, counted, cached and verified.

A request first takes what is known: statistics in memory and on disk, then responses in memory and on disk, from which
the statistics are computed with the same bits as from a new simulation. The other simulations are sent to a pool to
which single items can be submitted, and each is cached when it arrives, so that nothing waits for a batch. Without such
a pool they are run in parts, and each part is cached when it has ended: in this process (compiled models on threads),
or by the ``map`` of a pool. Several threads may send requests.
"""

import hashlib
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from functools import cached_property
from queue import SimpleQueue
from typing import Any

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..cache.memory import MemoryCache, ResponseMemory, distinct_keys, statistics_in, thetas_of
from ..cache.simulation_cache import SimulationCache
from ..cache.verification import StaleCache, VerifiedModel
from ..noise.sufficient_statistics import Statistic, check_statistic, name_of_statistic
from ..priors.points import as_rows
from ..signals.channels import Measurements
from ..signals.comparison import Comparison, compare_with
from ..simulation.executors import as_executor, result_of
from ..simulation.files import Observed
from ..simulation.model import (
    Model,
    SimulationBatch,
    gathered,
    has_jacobian,
    most_responses,
    run_each,
    sent_simulation,
    simulate_batch,
    unpack,
)
from .failure_log import FailureLog

__all__ = ["Simulator"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average


class _Request:
    """Distinct simulations that were requested, and what is known of them, by key (see `distinct_keys`).

    `outcomes` are statistics in bytes, `responses` arrays (n_channels, n_steps) if `full` ones were requested; failures
    have their reasons in both. The model has one `fingerprint` for all of them.
    """

    def __init__(self, keys: list[bytes], full: bool, model: Model) -> None:
        self.keys, self.full, self.model = keys, full, model
        self.outcomes: dict[bytes, bytes | str] = {}
        self.responses: dict[bytes, np.ndarray | str] = {}

    @cached_property
    def fingerprint(self) -> str:
        return self.model.fingerprint

    @property
    def left(self) -> list[bytes]:
        """Keys that are to be simulated."""
        done = self.responses if self.full else self.outcomes
        return [key for key in self.keys if key not in done]

    def enter(self, outcomes: dict[bytes, bytes | str]) -> None:
        """Fill in outcomes."""
        self.outcomes |= outcomes
        self.responses |= {key: reason for key, reason in outcomes.items() if isinstance(reason, str)}


class _Running:
    """What runs in a pool for one simulator, in one process: the keys of the simulations."""

    def __init__(self) -> None:
        self.owner, self.lock = os.getpid(), threading.Condition()
        self.keys: set[bytes] = set()
        self.counted_until = 0.0  # time of the last arrival [s]


class Simulator(VerifiedModel):
    """A model's simulations, compared with measurements in the order of the model's channels; each is run once.

    Options are those of `FELikelihood`; the statistic is the sums of squares by default. `measured` are values
    (n_channels, n_steps), or a `Comparison` where samples are missing. `simulations`, `cache_hits` and `disk_hits`
    count simulations run by this object in this process, cached rows, and rows from the disk; `failures` include known
    ones from the disk. `chunk_size` simulations are run between two writes to the disk, adapted to their duration;
    `when_simulated` is called with the number that have ended, in this process only. With `responses_only` nothing was
    measured: a cache on disk gets the responses alone. A subclass keeps all responses, in memory and on disk, if they
    are small (`stores_responses`).
    """

    stores_responses = False

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        statistic: Statistic | None = None,
        *,
        pool: Any = None,
        cache: SimulationCache | str | os.PathLike | None = None,
        memory_rows: int = 100_000,
        memory_bytes: int = 2**28,
        responses_only: bool = False,
    ) -> None:
        self.failures = FailureLog(model.parameter_names)
        self.memory_cache, self.response_memory = MemoryCache(memory_rows), ResponseMemory(memory_bytes)
        self.measurements, self._responses_only = measurements, responses_only
        measured = compare_with(measurements, model.dt, model.n_steps)
        check_statistic(statistic, measured)
        super().__init__(model, measured, statistic, as_executor(pool, model), cache)
        self._key, self.n_structural = self.simulation_key, len(model.parameter_names)
        self.chunk_size = 1
        self.simulations = self.cache_hits = self.disk_hits = 0
        self._recalled: set[bytes] = set()
        self.when_simulated: Callable[[int], None] | None = None
        self._in_pool: _Running | None = None

    def __getstate__(self) -> dict:
        return super().__getstate__() | {"when_simulated": None, "_in_pool": None}

    # counts and identity ------------------------------------------------------------------------------------------

    def report(self) -> dict:
        """Summary of the simulations that were requested in this process, see `Posterior.report`."""
        names = ("simulations", "verifications", "unverified", "cache_hits", "disk_hits", "seconds")
        return {name: getattr(self, name) for name in names} | self.failures.report()

    @property
    def fingerprint(self) -> str:
        """Hex digest of all that the statistics depend on: `simulation_key`, and the code when this object was made."""
        text = f"{self.simulation_key} {self.label.identity}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def simulation_key(self) -> str:
        """Declared identity under which a `SimulationCache` stores the statistics: model, measurements, statistic."""
        text = f"{self.model.fingerprint} {self.measurements.fingerprint}{name_of_statistic(self.statistic)}"
        if isinstance(self.measured, Comparison):
            text += self.measured.description
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def cache_keys(self) -> tuple[str, str]:
        """Keys under which a `SimulationCache` stores the statistics and the responses, as `forget` takes them."""
        return self.simulation_key, self.model.fingerprint

    # requests -----------------------------------------------------------------------------------------------------

    def statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics (n, n_numbers) that the noise needs, at structural parameters (n, n_structural), see `run`."""
        return self.run(as_rows(thetas, self.model.parameter_names))

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) [SI] at structural parameters (n, n_structural), see `run`.

        A point whose statistics are cached without its response is simulated again, unless it failed.
        """
        return self.run(as_rows(thetas, self.model.parameter_names), full=True)[1]

    def run(self, thetas: np.ndarray, possible: Callable[[], np.ndarray] | None = None, full: bool = False) -> Any:
        """Statistics (n, n_numbers) at structural parameters (n, n_structural), NaN if failed.

        With `full`, also a `SimulationBatch` of the responses. Duplicates are simulated once, results are cached,
        cached ones are reused, and non-finite rows are skipped. Where `possible`, called unless all rows are in memory,
        is False (n,), nothing is simulated and rows may be NaN. Raises `ChangedModel` or `StaleCache`;
        simulations that have ended are cached, except after the model has changed.
        """
        keys, which = distinct_keys(thetas)
        if not full and None not in (outcomes := self.memory_cache.look_up(keys)):
            self.cache_hits += len(which)
            return self._rows(outcomes, which)
        if possible is not None and not (wanted := possible()).all():
            statistics = np.full((len(which), self.n_numbers), np.nan)
            if wanted.any():
                statistics[wanted] = self.run(thetas[wanted])
            return statistics
        request = self._run_in_pool(keys, which, full) if self.streams else self._look_up(keys, which, full)
        left = request.left
        while left:
            with self._running.lock:
                self._check_before()  # so that finished simulations are stored
            some, start = left[: self._chunk(len(left), full)], time.perf_counter()
            with self._observed():
                if self.pool is None or self._returns_responses(full):
                    values, reasons = simulate_batch(self.model, self._thetas(some), self.pool)
                else:
                    run = sent_simulation(self.model, self.measured, self.statistic)
                    values, reasons = run_each(run, self._thetas(some), (self.n_numbers,), self.pool)
            self._record(request, some, values, reasons, time.perf_counter() - start)
            # the size grows by steps: the first simulations may be failures that took no time
            rate = len(some) / (time.perf_counter() - start)
            self.chunk_size = min(4 * len(some), 1 + int(_SECONDS_PER_CHUNK * rate))
            left = left[len(some) :]
        outcomes = [request.outcomes[key] for key in keys]
        if not full:
            return self._rows(outcomes, which)
        return self._rows(outcomes, which), self._as_batch([request.responses[keys[place]] for place in which])

    def _rows(self, outcomes: Sequence[bytes | str], which: Sequence[int]) -> np.ndarray:
        """Statistics (n, n_numbers) of n rows, each of which has one of the outcomes."""
        statistics = statistics_in(outcomes, self.n_numbers)
        return statistics if len(outcomes) == len(which) else statistics[which]

    def _as_batch(self, found: Sequence[np.ndarray | str]) -> SimulationBatch:
        """Responses or reasons of failures as a batch."""
        responses = np.full((len(found), len(self.model.channels), self.model.n_steps), np.nan)
        for row, each in zip(responses, found, strict=True):
            row[...] = np.nan if isinstance(each, str) else each
        return SimulationBatch(responses, list(map(_reason, found)))

    def _thetas(self, keys: Sequence[bytes]) -> np.ndarray:
        return thetas_of(keys, self.n_structural)

    def recall(self, thetas: np.ndarray, statistics: np.ndarray | None, reasons: Sequence[str]) -> None:
        """Cache statistics (n, n_numbers) of an earlier run in memory, at structural parameters (n, n_structural).

        Failures (with a reason) are recorded. Rows that are cached already are not changed. Nothing is written to the
        cache on disk. Without statistics, only failures are cached.
        """
        keys, which = distinct_keys(thetas)
        known = self.memory_cache.look_up(keys)
        for place, row in dict(zip(which, range(len(thetas)), strict=True)).items():
            if known[place] is None and np.isfinite(thetas[row]).all():
                if keys[place] not in self._recalled:
                    self._recalled.add(keys[place])
                    self.failures.count_outcomes(thetas[[row]], [reasons[row]])
                if reasons[row] or statistics is not None:
                    self.memory_cache.store([keys[place]], [reasons[row] or statistics[row].tobytes()])

    def reason(self, point: np.ndarray) -> str:
        """Reason of a failure that is cached at parameters (n,), the structural ones first; empty for others."""
        return _reason(*self.memory_cache.look_up([(point[: self.n_structural] + 0.0).tobytes()]))

    # known simulations --------------------------------------------------------------------------------------------

    def _look_up(self, keys: list[bytes], which: Sequence[int], full: bool) -> _Request:
        """What is known of distinct keys, which is counted; `which` has the key of every requested row.

        Some stored statistics are verified by runs.
        """
        finite = np.isfinite(self._thetas(keys)).all(axis=1)
        with self._running.lock:
            request, known = _Request(keys, full, self.model), zip(keys, self.memory_cache.look_up(keys), strict=True)
            skipped = [key for key, fine in zip(keys, finite, strict=True) if not fine]
            outcomes = {key: outcome for key, outcome in known if outcome is not None}
            request.enter(outcomes | dict.fromkeys(skipped, "the parameters are not finite"))
            on_disk: set[bytes] = set()
            try:
                if self.cache is not None and not full and not self._responses_only and (left := request.left):
                    rows = self._stored(self._key, self._thetas(left), request.fingerprint, self.n_numbers)
                    found = {key: row.outcome for key, row in zip(left, rows, strict=True) if row is not None}
                    self._enter(request, found)
                    on_disk.update(found)
                on_disk.update(self._take_responses(request))
            except StaleCache:  # results in memory may belong to another model
                self._clear()
                raise
            if found := set(keys).difference(skipped, request.left):
                self.cache_hits += sum(keys[place] in found for place in which)
                self.disk_hits += sum(keys[place] in on_disk for place in which)
        return request

    def _take_responses(self, request: _Request) -> list[bytes]:
        """Fill in stored responses, and statistics that are not known; returns keys of responses from the disk."""
        on_disk, left, size = [], request.left, most_responses(self.model)
        if self.cache is None and not len(self.response_memory):
            return []
        for start in range(0, len(left), size):
            keys, fingerprint = left[start : start + size], request.fingerprint
            in_memory = self.response_memory.look_up([(fingerprint, key) for key in keys])
            found = {key: each for key, each in zip(keys, in_memory, strict=True) if each is not None}
            missing = [key for key in keys if key not in found]
            if self.cache is not None and missing:
                read = zip(missing, self._stored_responses(self._thetas(missing), fingerprint), strict=True)
                found |= (read := {key: each for key, each in read if each is not None})
                on_disk += read
                if request.full:
                    self.response_memory.store([(fingerprint, key) for key in read], read.values())
            if request.full:
                request.responses |= found
            if new := [key for key in found if key not in request.outcomes]:
                statistics, reasons = self.statistics_of(*self._as_batch([found[key] for key in new]))
                self._enter(request, _outcomes(new, statistics, reasons))
                if self.cache is not None and not self._responses_only:
                    self._store(self._thetas(new), statistics, reasons, None, fingerprint)
        return on_disk

    def _enter(self, request: _Request, outcomes: dict[bytes, bytes | str]) -> None:
        """Fill in statistics and reasons of failures, count these, and cache both in memory."""
        if not outcomes:
            return
        self.failures.outcomes += len(outcomes)
        for key, outcome in outcomes.items():
            if isinstance(outcome, str):
                self.failures.add(np.frombuffer(key), outcome)
        request.enter(outcomes)
        self.memory_cache.store(outcomes, outcomes.values())
        self.has_results = True

    # simulations --------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> bool:
        """Whether simulations can be submitted to the pool one by one, and not for several data sets at once."""
        return bool(getattr(self.pool, "submits", False)) and not hasattr(self.model, "simulate_together")

    @property
    def _running(self) -> _Running:
        if self._in_pool is None or self._in_pool.owner != os.getpid():  # or in a process that was forked
            self._in_pool = _Running()
        return self._in_pool

    def _chunk(self, n: int, full: bool) -> int:
        """Number of simulations, of n, between two writes to the cache on disk, or two reports of progress."""
        most = most_responses(self.model) if self.pool is None or self._returns_responses(full) else n
        if self.cache is None and (self.when_simulated is None or self.pool is not None):
            return min(n, most)
        workers = (os.cpu_count() or 1) if self.pool is None else self.pool.n_workers or n
        together = self.pool is not None or hasattr(self.model, "simulate_batch")  # then all workers are to be busy
        return min(max(_ROUNDS_PER_CHUNK * workers if together else 1, self.chunk_size), most)

    @interrupts_end_the_run()
    def _run_in_pool(self, keys: list[bytes], which: Sequence[int], full: bool) -> _Request:
        """Run what is not known in the pool, and record each as it arrives, after what runs for another request."""
        running, arrived, left = self._running, SimpleQueue(), {}
        with running.lock:  # so that nothing arrives between the two
            running.lock.wait_for(lambda: running.keys.isdisjoint(keys))
            request = self._look_up(keys, which, full)
            if new := request.left:
                self._check_before()
                if not running.keys:
                    running.counted_until = time.perf_counter()
                measured = () if self._returns_responses(full) else (self.measured, self.statistic)
                function = Observed(sent_simulation(self.model, *measured), self.pool.n_workers == 1)
                left = dict(zip(self.pool.submit_all(function, list(self._thetas(new))), new, strict=True))
                running.keys |= set(new)
        for future in list(left):
            future.add_done_callback(arrived.put)
        try:
            while left:  # all that have ended, which are stored together
                self._receive(request, left, [arrived.get() for _ in range(max(1, arrived.qsize()))])
        except BaseException:
            self.pool.give_up(list(left))
            with suppress(Exception):  # simulations that have ended are cached
                self._receive(request, left, [each for each in left if each.done() and not each.cancelled()])
            raise
        finally:
            with running.lock:
                running.keys -= set(left.values())
                running.lock.notify_all()
        return request

    def _receive(self, request: _Request, left: dict[Future, bytes], ended: Sequence[Future]) -> None:
        """Record simulations that have ended, which are taken from those that are `left`; raises the error of one.

        `ChangedModel` if the model has changed; these simulations, and all since the last comparison, are not stored.
        """
        done: dict[bytes, tuple[np.ndarray | None, str]] = {}
        error = None
        with self._running.lock:
            for future in ended:
                key = left.pop(future)
                self._running.keys.discard(key)
                try:
                    done[key], opened = unpack(result_of(future))
                    self.label.add(opened)
                except CancelledError:
                    error = error or RuntimeError("the pool was closed before a simulation had finished")
                except BaseException as raised:
                    error = error or raised
            if done:
                now = time.perf_counter()
                seconds, self._running.counted_until = now - self._running.counted_until, now
                responses = self._returns_responses(request.full)
                shape = (len(self.model.channels), self.model.n_steps) if responses else (self.n_numbers,)
                self._record(request, list(done), *gathered(list(done.values()), shape), seconds)
            self._running.lock.notify_all()
        if error is not None:
            raise error

    def _returns_responses(self, full: bool) -> bool:
        is_kept = self._keeps_responses(full) or (self.cache is not None and self.cache.responses)
        return is_kept or hasattr(self.model, "simulate_together")

    def _keeps_responses(self, full: bool) -> bool:
        """Whether responses are kept in memory: they were requested, or gradients or predictions may follow."""
        return full or self.stores_responses or has_jacobian(self.model)

    def _record(
        self, request: _Request, keys: Sequence[bytes], values: np.ndarray, reasons: list[str], seconds: float
    ) -> None:
        """Count new simulations, record failures, compare the model if that is due, and cache the results.

        The values are responses or statistics; responses are kept if they were requested, if a gradient may follow, or
        if they are stored on disk.
        """
        thetas, statistics, why = self._thetas(keys), values, reasons
        keeps = self._keeps_responses(request.full)
        if values.ndim == 3:
            statistics, why = self.statistics_of(values, reasons)
        with self._running.lock:
            self.seconds += seconds
            self.simulations += len(thetas)
            if self.when_simulated is not None:
                self.when_simulated(len(thetas))
            self._check_after(thetas, statistics, why)
            if keeps or self.cache is not None:  # the model may have been replaced
                fingerprint = request.fingerprint if request.model is self.model else self.model.fingerprint
            if keeps:
                outcomes = [reason or response.copy() for reason, response in zip(reasons, values, strict=True)]
                self.response_memory.store([(fingerprint, key) for key in keys], outcomes)
            if request.full:
                request.responses |= zip(keys, values, strict=True)
            self._enter(request, _outcomes(keys, statistics, why))
            if self.cache is not None:
                kept = None if self._responses_only else statistics
                stored = values if request.full or self.stores_responses or self.cache.responses else None
                self._store(thetas, kept, why, stored, fingerprint)


def _outcomes(keys: Sequence[bytes], statistics: np.ndarray, reasons: Sequence[str]) -> dict[bytes, bytes | str]:
    """Outcomes of simulations with statistics (n, n_numbers), and reasons of failures; empty for others."""
    return {key: reason or row.tobytes() for key, row, reason in zip(keys, statistics, reasons, strict=True)}


def _reason(outcome: Any) -> str:
    """The reason of a failure; empty for others."""
    return outcome if isinstance(outcome, str) else ""
