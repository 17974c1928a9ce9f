"""Simulations of a model and their statistics against measurements: each is run once, counted, cached and verified.

A request first takes what is known (`fe_likelihoods.likelihood.known_simulations`). The other simulations are sent to
a pool to which single items can be submitted, and each is cached when it arrives, so that nothing waits for a batch.
Without such a pool they are run in parts, and each part is cached when it has ended: in this process (compiled models
on threads), or by the ``map`` of a pool.
"""

import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..cache.comparison import VerifyingRun, observed
from ..cache.memory import MemoryCache, ResponseMemory, distinct_keys, thetas_of
from ..cache.simulation_cache import SimulationCache
from ..noise.statistics import Statistic, statistic_width
from ..priors.points import as_rows
from ..signals.channels import Measurements
from ..signals.comparison import Comparison, compare_with
from ..simulation.executors import as_executor
from ..simulation.faults import ChangedModel
from ..simulation.folder import Observed, unpack
from ..simulation.model import (
    Model,
    SimulationBatch,
    has_batch_method,
    misfit_batch,
    misfit_of_responses,
    most_responses,
    sent_simulation,
    simulate_batch,
)
from .checked_model import CheckedModel
from .failure_log import FailureLog
from .inputs import check_statistic, name_of_statistic
from .known_simulations import KnownSimulations, Requested

__all__ = ["Simulated", "Simulation", "Simulator", "take_all"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average


class Simulated(NamedTuple):
    """Result of one simulation: its statistics, the reason of a failure, and its response if it was requested."""

    statistics: np.ndarray
    reason: str
    response: np.ndarray | None


class Simulation:
    """A simulation that was requested of a `Simulator`, by the key of its parameters (see `distinct_keys`).

    A known one has a `result` at once. One that was sent to a pool has a `future`; it is `received` when it has ended
    or was cancelled, and then has a `result`, or an `error` for which the model is not to blame. `full` ones return
    their response.
    """

    __slots__ = ("error", "full", "future", "key", "received", "result")

    def __init__(self, key: bytes, full: bool, future: Future | None = None, result: Simulated | None = None) -> None:
        self.key, self.full, self.future, self.result = key, full, future, result
        self.error: BaseException | None = None
        self.received = False


def take_all(arrived: SimpleQueue, wait: bool) -> list[Simulation]:
    """All items of a queue; with `wait`, at least one."""
    items = [arrived.get()] if wait else []
    try:
        while True:
            items.append(arrived.get_nowait())
    except Empty:
        return items


class _Running:
    """What runs in a pool for one simulator, in one process."""

    def __init__(self) -> None:
        self.owner, self.lock = os.getpid(), threading.RLock()
        self.simulations: set[Simulation] = set()
        self.functions: dict[bool, tuple[Model, Callable]] = {}  # that are sent, so that each is pickled once
        self.since = self.counted_until = 0.0  # wall time of the first of them, and of the last arrival [s]


class Simulator:
    """A model's simulations, compared with measurements in the order of the model's channels; each is run once.

    `statistics` and, where responses are needed, `simulate` wait for their simulations. `request`, `receive` and
    `leave` are for those who go on meanwhile, and need a pool that `streams`. Options are those of `FELikelihood`; the
    statistic is the sums of squares by default. `measured` are values (n_channels, n_steps), or a `Comparison` where
    samples are missing. `simulations`, `cache_hits` and `disk_hits` count simulations run by this object in this
    process, cached rows, and rows from the disk; `failures` include known ones from the disk. `chunk_size` simulations
    are run between two writes to the disk, adapted to their duration; `when_simulated` is called with the number that
    have ended, in this process only.
    """

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
        max_failure_share: float = 1.0,
    ) -> None:
        self.failures = FailureLog(model.parameter_names, max_failure_share)
        self.model, self.measurements, self.statistic = model, measurements, statistic
        self.measured = compare_with(measurements, model.dt, model.n_steps)
        check_statistic(statistic, self.measured)
        self.n_structural = len(model.parameter_names)
        self.n_numbers = statistic_width(self.measured, statistic)
        self.pool = as_executor(pool, model)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self.memory_cache, self.response_memory = MemoryCache(memory_rows), ResponseMemory(memory_bytes)
        self._checked = CheckedModel(model, statistic, self.cache, self.pool)
        self._key = self.simulation_key
        self._known = KnownSimulations(self._key, self.memory_cache, self.response_memory, self._checked, self.failures)
        self.chunk_size = 1
        self.simulations = self.cache_hits = self.disk_hits = 0
        self._seconds = 0.0
        self.when_simulated: Callable[[int], None] | None = None
        self._in_pool: _Running | None = None

    def __getstate__(self) -> dict:
        return self.__dict__ | {"pool": None, "when_simulated": None, "_in_pool": None}

    # counts and identity ------------------------------------------------------------------------------------------

    @property
    def seconds(self) -> float:
        """Wall time of the simulations [s], including verification."""
        rows = self._checked.rows
        return self._seconds + (0.0 if rows is None else rows.seconds)

    @property
    def verifications(self) -> int:
        """Number of earlier simulations that were compared with a new one, besides `simulations`."""
        return self._checked.compared

    @property
    def unverified(self) -> int:
        """Number of rows that could not be compared, because the new simulation was stopped (`TransientReason`)."""
        return 0 if self._checked.rows is None else self._checked.rows.unverified

    def report(self) -> dict:
        """Summary of the simulations that were requested in this process, see `Posterior.report`."""
        return {
            "simulations": self.simulations,
            "verifications": self.verifications,
            "unverified": self.unverified,
            "cache_hits": self.cache_hits,
            "disk_hits": self.disk_hits,
            "failures": list(self.failures.records),
            "failure_count": self.failures.count,
            "transient_failures": self.failures.transient,
            "failure_reasons": dict(self.failures.reasons),
            "seconds": self.seconds,
        }

    @property
    def fingerprint(self) -> str:
        """Hex digest of all that the statistics depend on: `simulation_key`, and the code when this object was made."""
        text = f"{self.simulation_key} {self._checked.label.identity}"
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

    def share(self, other: "Simulator") -> None:
        """Use the responses in memory of another simulator, and trust the rows that it has verified."""
        self.response_memory = self._known.responses = other.response_memory
        self._checked.share_trust(other._checked)

    # requests -----------------------------------------------------------------------------------------------------

    def misfit(self, thetas: np.ndarray) -> np.ndarray:
        """Sums of squared residuals (n, n_channels) [SI unit squared]; NaN for failures."""
        return self.statistics(thetas)[:, : self.measurements.n_channels]

    def statistics(self, thetas: np.ndarray, possible: Callable[[], np.ndarray] | None = None) -> np.ndarray:
        """Statistics (n, n_numbers) that the noise needs, at structural parameters (n, n_structural); NaN if failed.

        Duplicates are simulated once, cached rows are reused, and non-finite rows are skipped. Where `possible`, called
        unless all rows are in memory, is False (n,), nothing is simulated and rows may be NaN. Raises
        `TooManyFailures`, `ChangedModel` or `StaleCache`; simulations that have ended are cached, except after the
        model has changed.
        """
        keys, which = distinct_keys(as_rows(thetas, self.model.parameter_names))
        statistics, known = self.memory_cache.look_up(keys, self.n_numbers)
        if all(known):
            self.cache_hits += len(which)
        elif possible is not None and not (wanted := possible()).all():
            statistics = np.full((len(which), self.n_numbers), np.nan)
            if wanted.any():
                statistics[wanted] = self.statistics(thetas[wanted])
            return statistics
        else:
            requested, run = self._look_up(keys, which, False)
            left = np.flatnonzero(~requested.done)
            statistics = requested.statistics
            if len(left):
                statistics[left] = [new.statistics for new in self._new([keys[row] for row in left], False, run)]
        return statistics if len(keys) == len(which) else statistics[which]

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) [SI] at structural parameters (n, n_structural); NaN and reason if failed.

        They and their statistics are cached. Duplicates are simulated once, and cached responses are reused. A point
        whose statistics are cached without its response is simulated again, unless it failed. Raises the errors of
        `statistics`.
        """
        keys, which = distinct_keys(as_rows(thetas, self.model.parameter_names))
        requested, run = self._look_up(keys, which, True)
        left = np.flatnonzero(~requested.done)
        for row, new in zip(left, self._new([keys[row] for row in left], True, run), strict=True):
            requested.responses[row], requested.reasons[row] = new.response, new.reason
        if len(keys) == len(which):
            return SimulationBatch(requested.responses, requested.reasons)
        return SimulationBatch(requested.responses[which], [requested.reasons[row] for row in which])

    def request(self, thetas: np.ndarray, full: bool, arrived: SimpleQueue) -> list[Simulation]:
        """Simulations at n structural parameters, sent to the pool unless they are known; duplicates are one object.

        Those that have a `future` will come through the queue `arrived` when they have ended: pass them to `receive`,
        or to `leave` if they are not needed any more. Raises the errors of `statistics`.
        """
        keys, which = distinct_keys(thetas)
        requested, run = self._look_up(keys, which, full)
        found: dict[int, Simulation] = {}
        for row in np.flatnonzero(requested.done).tolist():
            response = requested.responses[row] if full else None
            result = Simulated(requested.statistics[row], requested.reasons[row], response)
            found[row] = Simulation(keys[row], full, result=result)
        left = np.flatnonzero(~requested.done).tolist()
        found |= dict(zip(left, self._send([keys[row] for row in left], full, arrived, run), strict=True))
        return [found[row] for row in which]

    def are_stored(self, thetas: np.ndarray) -> np.ndarray:
        """Whether a response in memory or any result on disk exists (n,); it is neither read nor verified."""
        keys = [row.tobytes() for row in thetas + 0.0]
        run = self._run
        outcomes = self.response_memory.look_up(run.fingerprint, keys)
        stored = np.array([outcome is not None for outcome in outcomes], dtype=bool)
        if self._checked.rows is not None:
            stored |= self._checked.rows.are_stored(self._key, thetas, run)
        return stored

    def recall(self, thetas: np.ndarray, statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache statistics (n, n_numbers) of an earlier run in memory, unsimulated; ValueError for another shape.

        Failures (with a reason) are recorded, and all rows count for `max_failure_share`. Rows that are cached already
        are not changed. Nothing is written to the cache on disk.
        """
        thetas, statistics = as_rows(thetas, self.model.parameter_names), np.asarray(statistics, dtype=float)
        if statistics.shape != (len(thetas), self.n_numbers) or len(reasons) != len(thetas):
            raise ValueError(
                f"recall: expected statistics of shape ({len(thetas)}, {self.n_numbers}) and {len(thetas)} reasons; "
                f"got {statistics.shape} and {len(reasons)}. Pass what statistics() returned for the same noise"
            )
        keys, which = distinct_keys(thetas)
        known = self.memory_cache.look_up(keys, self.n_numbers)[1]
        for place, row in dict(zip(which, range(len(thetas)), strict=True)).items():
            if not known[place] and np.isfinite(thetas[row]).all():
                self.memory_cache.store([keys[place]], statistics[[row]])
                self.failures.count_outcomes(thetas[[row]], [reasons[row]])

    def _look_up(self, keys: list[bytes], which: list[int], full: bool) -> tuple[Requested, VerifyingRun]:
        """What is known of distinct keys, which is counted; `which` has the key of every requested row."""
        run = self._run
        requested = self._known.look_up(keys, full, run)
        counts = np.bincount(which, minlength=len(keys))
        self.cache_hits += int(counts[requested.done & requested.finite].sum())
        self.disk_hits += int(counts[requested.on_disk].sum())
        return requested, run

    # simulations --------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> bool:
        """Whether simulations can be submitted to the pool one by one, and not for several data sets at once."""
        return bool(getattr(self.pool, "submits", False)) and not hasattr(self.model, "simulate_together")

    def check_failures(self) -> None:
        """Raise `TooManyFailures` if too many simulations have failed, even if all that run succeed."""
        self.failures.check(len(self._running.simulations))

    def _new(self, keys: list[bytes], full: bool, run: VerifyingRun) -> list[Simulated]:
        """Results of new simulations of distinct keys: one by one as they arrive from the pool, or in parts."""
        if self.streams and keys:
            return self._new_in_pool(keys, full, run)
        results: list[Simulated] = []
        while len(results) < len(keys):
            self._check_before(run)
            left = keys[len(results) :]
            some = left[: self._chunk(len(left), full)]
            thetas, start = thetas_of(some, self.n_structural), time.perf_counter()
            with observed(self._checked.label, self.pool, self._checked.complete):
                if self._returns_responses(full):
                    values, reasons = simulate_batch(self.model, thetas, self.pool)
                else:
                    values, reasons = misfit_batch(self.model, thetas, self.measured, self.pool, self.statistic)
            results += self._record(some, thetas, full, values, reasons, time.perf_counter() - start, run)
            # the size grows by steps: the first simulations may be failures that took no time
            seconds = time.perf_counter() - start
            self.chunk_size = min(4 * len(some), 1 + int(_SECONDS_PER_CHUNK * len(some) / seconds))
        return results

    def _chunk(self, n: int, full: bool) -> int:
        """Number of simulations, of n, between two writes to the cache on disk, or two reports of progress."""
        if self.cache is None and (self.when_simulated is None or self.pool is not None):
            return n
        workers = (os.cpu_count() or 1) if self.pool is None else self.pool.n_workers or n
        one_by_one = self.pool is None and not has_batch_method(self.model)
        smallest = 1 if one_by_one else _ROUNDS_PER_CHUNK * workers  # so that all workers are busy
        return min(max(smallest, self.chunk_size), most_responses(self.model) if self._returns_responses(full) else n)

    @interrupts_end_the_run()
    def _new_in_pool(self, keys: list[bytes], full: bool, run: VerifyingRun) -> list[Simulated]:
        arrived: SimpleQueue = SimpleQueue()
        simulations = self._send(keys, full, arrived, run)
        left = dict.fromkeys(simulations)
        try:
            while left:
                ended = take_all(arrived, wait=True)
                self.receive(ended)
                for simulation in ended:
                    if simulation.error is not None:
                        raise simulation.error
                    del left[simulation]
                if left:
                    self.check_failures()
        except BaseException:
            self.leave(left, running=True)
            raise
        return [simulation.result for simulation in simulations]

    def _send(self, keys: list[bytes], full: bool, arrived: SimpleQueue, run: VerifyingRun) -> list[Simulation]:
        """Submit simulations of n distinct keys to the pool."""
        if not keys:
            return []
        self._check_before(run)
        running = self._running
        with running.lock:
            if not running.simulations:
                running.functions.clear()
                running.since = running.counted_until = time.perf_counter()
            thetas = list(thetas_of(keys, self.n_structural))
            futures = self.pool.submit_all(self._sent_function(full), thetas)
            sent = [Simulation(key, full, future) for key, future in zip(keys, futures, strict=True)]
            running.simulations.update(sent)
        for simulation in sent:
            simulation.future.add_done_callback(partial(_arrive, arrived, simulation))
        return sent

    def receive(self, ended: Iterable[Simulation]) -> None:
        """Count and cache simulations of one request that have ended in the pool; sets `result` or `error` of each.

        `ChangedModel` if the model has changed; these simulations, and all since the last comparison, are not stored.
        """
        running = self._running
        with running.lock:
            some, outcomes = [], []
            for simulation in ended:
                if simulation.received:
                    continue
                simulation.received = True
                running.simulations.discard(simulation)
                try:
                    outcome, opened = unpack(simulation.future.result(), self.pool)
                    self._checked.complete(opened)
                    outcomes.append(outcome)
                    some.append(simulation)
                except CancelledError:
                    simulation.error = RuntimeError("the pool was closed before a simulation had finished")
                except BaseException as error:
                    simulation.error = error
            if some:
                self._record_outcomes(some, outcomes)

    def leave(self, simulations: Iterable[Simulation], running: bool) -> list[Simulation]:
        """Stop waiting: ended simulations are cached, others are cancelled; with `running`, also those that have begun.

        Returns the simulations that go on.
        """
        in_pool = self._running
        with in_pool.lock:
            left = [each for each in simulations if not each.received]
            if unended := [each.future for each in left if not each.future.done()]:
                self.pool.give_up(unended, running)
            for each in left:
                if each.future.cancelled():
                    each.received = True
                    in_pool.simulations.discard(each)
            self.receive([each for each in left if each.future.done()])
            return [each for each in left if not each.received]

    @property
    def _running(self) -> _Running:
        if self._in_pool is None or self._in_pool.owner != os.getpid():  # or in a process that was forked
            self._in_pool = _Running()
        return self._in_pool

    def _sent_function(self, full: bool) -> Callable:
        """What is sent to the workers: the same object while simulations run, so that it is pickled once."""
        functions, with_response = self._running.functions, self._returns_responses(full)
        if with_response not in functions or functions[with_response][0] is not self.model:
            measured = () if with_response else (self.measured, self.statistic)
            functions[with_response] = self.model, Observed(sent_simulation(self.model, *measured))
        return functions[with_response][1]

    def _returns_responses(self, full: bool) -> bool:
        return full or (self.cache is not None and self.cache.responses)

    def _record_outcomes(self, ended: list[Simulation], outcomes: list[tuple]) -> None:
        """Record simulations that the pool has run."""
        running, now, full = self._running, time.perf_counter(), ended[0].full
        seconds, running.counted_until = now - running.counted_until, now
        shape = (len(self.model.channels), self.model.n_steps) if self._returns_responses(full) else (self.n_numbers,)
        values = np.full((len(ended), *shape), np.nan)
        for row, (result, _) in zip(values, outcomes, strict=True):
            if result is not None:
                row[...] = result
        keys, reasons = [each.key for each in ended], [reason for _, reason in outcomes]
        try:
            results = self._record(keys, thetas_of(keys, self.n_structural), full, values, reasons, seconds, self._run)
        except BaseException as error:
            for each in ended:
                each.error = error
            raise
        for each, result in zip(ended, results, strict=True):
            each.result = result

    def _record(
        self,
        keys: list[bytes],
        thetas: np.ndarray,
        full: bool,
        values: np.ndarray,
        reasons: list[str],
        seconds: float,
        run: VerifyingRun,
    ) -> list[Simulated]:
        """Count new simulations, record failures, compare the model if that is due, and cache the results.

        The values are responses if these were requested or are stored on disk, else statistics.
        """
        batch, misfit = None, values
        if self._returns_responses(full):
            batch = SimulationBatch(values, reasons)
            misfit, reasons = misfit_of_responses(self.model, batch, self.measured, self.statistic)
        self._seconds += seconds
        self.simulations += len(thetas)
        self.failures.count_outcomes(thetas, reasons)
        if self.when_simulated is not None:
            self.when_simulated(len(thetas))
        self._check_after(thetas, misfit, reasons, seconds, run)
        self._checked.has_results = True
        self.memory_cache.store(keys, misfit)
        if full:
            outcomes = [reason or response for reason, response in zip(batch.reasons, batch.response, strict=True)]
            self.response_memory.store(run.fingerprint, keys, outcomes)
        if self.cache is not None:
            response = None if batch is None else batch.response
            self._checked.rows.store(self._key, thetas, misfit, reasons, response, seconds, run)
            self.cache.store_remark(self.model)
        if not full:
            return [Simulated(row, reason, None) for row, reason in zip(misfit, reasons, strict=True)]
        batch.response[[bool(reason) for reason in reasons]] = np.nan
        return [Simulated(*each) for each in zip(misfit, reasons, batch.response, strict=True)]

    # the model ----------------------------------------------------------------------------------------------------

    @property
    def _run(self) -> VerifyingRun:
        tolerance = None if self.cache is None else self.cache.tolerance
        return VerifyingRun(self.model, self.pool, self.measured, self.statistic, self.n_numbers, tolerance)

    def _check_before(self, run: VerifyingRun) -> None:
        """Check failures and the model before simulations, not after them, so that finished simulations are stored."""
        self.check_failures()
        try:
            self._checked.before(run, lambda: self._known.earlier_points(run))
        except ChangedModel:
            self._drop_unchecked(run)
            raise

    def _check_after(
        self, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], seconds: float, run: VerifyingRun
    ) -> None:
        """Compare the model after simulations, if that is due."""
        if self.streams:
            seconds = time.perf_counter() - self._running.since
        last = not self._running.simulations
        try:
            self._checked.after(run, thetas, misfit, reasons, seconds, last)
        except ChangedModel:
            self._drop_unchecked(run)
            raise

    def _drop_unchecked(self, run: VerifyingRun) -> None:
        """Drop the simulations since the last comparison, which may be from before or after a change of the model."""
        self._known.clear()
        if self.cache is not None and self._checked.unchecked:
            unchecked = np.concatenate(self._checked.unchecked)
            self._checked.rows.discard(unchecked, self._key, run.fingerprint)


def _arrive(arrived: SimpleQueue, simulation: Simulation, _: Any) -> None:
    arrived.put(simulation)
