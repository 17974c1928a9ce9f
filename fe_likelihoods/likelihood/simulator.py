"""Simulations of a model and their statistics against measurements: each is run once, counted, cached and verified.

A request first takes what is known (`fe_likelihoods.likelihood.known_simulations`). The other simulations are run in a
pool to which single items can be submitted, where each is cached when it arrives and nothing waits for a batch.
Otherwise they are run in parts, and each part is cached when it has ended: in this process (compiled models on
threads), or by the ``map`` of a pool. Callers use the same methods for both: `start`, `wait`, `leave`.
"""

import hashlib
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from queue import SimpleQueue
from typing import Any

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
from ..simulation.opened import Observed, unpack
from .checked_model import CheckedModel
from .failure_log import FailureLog
from .inputs import check_statistic, name_of_statistic
from .known_simulations import KnownSimulations, Requested
from .running_simulations import RunningRequests, RunningSimulation, Simulated, take_all

__all__ = ["COUNTS", "Simulator", "reported"]

COUNTS = (  # numbers of the report, which are added for several simulators
    "simulations",
    "verifications",
    "unverified",
    "cache_hits",
    "disk_hits",
    "failure_count",
    "transient_failures",
    "seconds",
)

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average


def reported(likelihood: Any, name: str) -> Any:
    """An entry of the report that is read as an attribute of a likelihood; AttributeError for any other name."""
    if name not in (*COUNTS, "failures", "failure_reasons"):
        moved = name[0] != "_" and hasattr(vars(likelihood).get("simulator"), name)
        hint = f": it belongs to the simulator, as likelihood.simulator.{name}" if moved else ""
        raise AttributeError(f"{type(likelihood).__name__!r} object has no attribute {name!r}{hint}")
    return likelihood.report()[name]


class _Pool:
    """What runs in a pool for one simulator, in one process."""

    def __init__(self) -> None:
        self.owner, self.lock = os.getpid(), threading.RLock()
        self.running: dict[tuple[bytes, bool], RunningSimulation] = {}
        self.function: tuple[Any, bool, Callable] | None = None  # model, whether responses are returned, what is sent
        self.counted_until = self.compared_at = 0.0  # of the wall time [s]


class Simulator:
    """A model's simulations, compared with measurements in the order of the model's channels; each is run once.

    `statistics` and, where responses are needed, `simulate` are the only places where a likelihood requests
    simulations; samplers without barriers and guides use `start`, `wait` and `leave`. Options are those of
    `FELikelihood`; the statistic is the sums of squares by default, and `time_shifts` are the largest unknown ones [s].
    `measured` are values (n_channels, n_steps), or a `Comparison` where samples are missing. `simulations`,
    `cache_hits` and `disk_hits` count simulations run by this object in this process, cached rows, and rows from the
    disk; `failures` include known ones from the disk. `chunk_size` simulations are run between two writes to the disk,
    adapted to their duration; `when_simulated` is called with the number that have ended, in this process only.
    """

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        statistic: Statistic | None = None,
        time_shifts: Mapping[str, float] | None = None,
        *,
        pool: Any = None,
        cache: SimulationCache | str | os.PathLike | None = None,
        memory_rows: int = 100_000,
        memory_bytes: int = 2**28,
        max_failure_share: float = 1.0,
    ) -> None:
        self.failures = FailureLog(model.parameter_names, max_failure_share)
        self.model, self.measurements, self.statistic = model, measurements, statistic
        self.measured = compare_with(measurements, model.dt, model.n_steps, time_shifts)
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
        self._in_pool: _Pool | None = None

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
        """Sums of squared residuals (n, n_channels) [SI unit squared], without time shifts; NaN for failures."""
        return self.statistics(thetas)[:, : self.measurements.n_channels]

    def statistics(self, thetas: np.ndarray, is_possible: Callable[[], bool] | None = None) -> np.ndarray:
        """Statistics (n, n_numbers) that the noise needs, at structural parameters (n, n_structural); NaN if failed.

        Duplicates are simulated once, cached rows are reused, and non-finite rows are skipped. If `is_possible`, called
        before simulations, returns False, nothing is simulated, and rows that are not cached are NaN. Raises
        `TooManyFailures`, `ChangedModel` or `StaleCache`; simulations that have ended are cached, except after the
        model has changed.
        """
        thetas = as_rows(thetas, self.model.parameter_names)
        if not np.isfinite(thetas).all():
            result = np.full((len(thetas), self.n_numbers), np.nan)
            finite = np.isfinite(thetas).all(axis=1)
            if finite.any():
                result[finite] = self.statistics(thetas[finite], is_possible)
            return result
        keys, distinct = distinct_keys(thetas)
        misfit, cached = self.look_up(keys, distinct, on_disk=True)
        left = np.flatnonzero(~cached)
        if len(left) and (is_possible is None or is_possible()):
            misfit[left] = [new.misfit for new in self._results([keys[row] for row in left], responses=False)]
        return misfit if len(keys) == len(thetas) else misfit[distinct]

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) [SI] at structural parameters (n, n_structural); NaN and reason if failed.

        They and their statistics are cached. Duplicates are simulated once, and cached responses are reused. A point
        whose statistics are cached without its response is simulated again, unless it failed. Raises the errors of
        `statistics`.
        """
        thetas = as_rows(thetas, self.model.parameter_names)
        finite = np.flatnonzero(np.isfinite(thetas).all(axis=1))
        keys, distinct = distinct_keys(thetas[finite])
        requested = self._requested_responses(keys)
        self._known.fill(requested, self._run)
        left = np.flatnonzero(~requested.cached)
        for row, new in zip(left, self._results([keys[row] for row in left], responses=True), strict=True):
            requested.reasons[row], requested.response[row] = new.reason, new.response
        counts = np.bincount(distinct, minlength=len(keys))
        self.disk_hits += int(counts[requested.on_disk].sum())
        self.cache_hits += int(counts[requested.cached].sum())
        batch = SimulationBatch(requested.response, requested.reasons)
        if len(keys) == len(thetas):
            return batch
        response = np.full((len(thetas), *batch.response.shape[1:]), np.nan)
        reasons = ["the parameters are not finite"] * len(thetas)
        for row, place in zip(finite, distinct, strict=True):
            response[row], reasons[row] = batch.response[place], batch.reasons[place]
        return SimulationBatch(response, reasons)

    def has_responses(self, keys: list[bytes]) -> np.ndarray:
        """Whether `simulate` needs no simulation for each distinct key (n,); responses on disk are read into memory.

        Some may be simulated again for verification.
        """
        requested = self._requested_responses(keys)
        self._known.fill(requested, self._run)
        return requested.cached

    def are_stored(self, thetas: np.ndarray) -> np.ndarray:
        """Whether a response in memory or any result on disk exists (n,); it is neither read nor verified."""
        stored = np.zeros(len(thetas), dtype=bool)
        if len(self.response_memory):
            keys = [row.tobytes() for row in thetas + 0.0]
            outcomes = self.response_memory.look_up(self.model.fingerprint, keys)
            stored |= [outcome is not None for outcome in outcomes]
        if self._checked.rows is not None:
            stored |= self._checked.rows.are_stored(self.cache_keys, thetas, self.model)
        return stored

    def in_memory(self, theta: np.ndarray) -> np.ndarray | None:
        """Statistics (1, n_numbers) at one point (n_structural,), if a successful simulation is cached in memory."""
        misfit, (known,) = self.memory_cache.look_up([(theta + 0.0).tobytes()], self.n_numbers)
        if not known or misfit[0, 0] != misfit[0, 0]:  # NaN
            return None
        self.cache_hits += 1
        return misfit

    def look_up(self, keys: list[bytes], distinct: list[int], on_disk: bool) -> tuple[np.ndarray, np.ndarray]:
        """Cached statistics (n, n_numbers) of distinct keys, and whether they are cached (n,), without new simulations.

        `distinct` has the index of the key of every requested row, for the counts. With `on_disk`, some rows of the
        cache may be simulated again for verification.
        """
        misfit, known = self.memory_cache.look_up(keys, self.n_numbers)
        if all(known):
            self.cache_hits += len(distinct)
            return misfit, np.ones(len(keys), dtype=bool)
        known, counts = np.array(known), np.bincount(distinct, minlength=len(keys))
        if on_disk:
            left = [key for key, is_known in zip(keys, known, strict=True) if not is_known]
            requested = Requested.of(left, self.n_structural, misfit[~known], np.zeros(len(left), dtype=bool))
            self._known.fill(requested, self._run)
            self.disk_hits += int(counts[~known][requested.on_disk].sum())
            misfit[~known], known[~known] = requested.misfit, requested.cached
        self.cache_hits += int(counts[known].sum())
        return misfit, known

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
        keys, distinct = distinct_keys(thetas)
        known = self.memory_cache.look_up(keys, self.n_numbers)[1]
        for place, row in dict(zip(distinct, range(len(thetas)), strict=True)).items():
            if not known[place] and np.isfinite(thetas[row]).all():
                self.memory_cache.store([keys[place]], statistics[[row]])
                self.failures.count_outcomes(thetas[[row]], [reasons[row]])

    def _requested_responses(self, keys: list[bytes]) -> Requested:
        misfit, known = self.memory_cache.look_up(keys, self.n_numbers)
        response = np.full((len(keys), len(self.model.channels), self.model.n_steps), np.nan)
        return Requested.of(keys, self.n_structural, misfit, np.array(known, dtype=bool), response)

    @interrupts_end_the_run()
    def _results(self, keys: list[bytes], responses: bool) -> list[Simulated]:
        """Results of new simulations."""
        arrived: SimpleQueue = SimpleQueue()
        started = self.start(keys, responses, arrived) if keys else []
        waiting = dict.fromkeys(started)
        try:
            while waiting:
                for running in self.wait(waiting, arrived):
                    if running.error is not None:
                        raise running.error
                    del waiting[running]
                if waiting:
                    self.check_failures()
        except BaseException:
            self.leave(list(waiting), arrived, running=True)
            raise
        return [running.result for running in started]

    # simulations --------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> bool:
        """Whether simulations can be submitted to the pool one by one."""
        return bool(getattr(self.pool, "submits", False))

    def check_failures(self) -> None:
        """Raise `TooManyFailures` if too many simulations have failed, even if all that run succeed."""
        self.failures.check(len(self._submitted.running))

    def running_requests(self) -> RunningRequests:
        """Requests for responses, several at once; `simulate` then finds the responses in the cache."""
        return RunningRequests(self)

    def start(self, keys: Sequence[bytes], responses: bool, arrived: SimpleQueue) -> list[RunningSimulation]:
        """Submit simulations of n distinct keys to the pool, unless they run already; returns without waiting for them.

        Without a pool that takes single items, they are run by `wait`. `arrived` receives each simulation that has
        ended in the pool, for `wait` or `receive`; pass those that are no longer needed to `leave`. Raises
        `TooManyFailures` and `ChangedModel`.
        """
        thetas = thetas_of(keys, self.n_structural)
        if not self.streams:
            return [RunningSimulation(key, theta, responses) for key, theta in zip(keys, thetas, strict=True)]
        self._check_before()
        pool = self._submitted
        with pool.lock:
            if not pool.running:
                pool.function = None
                pool.counted_until = pool.compared_at = time.perf_counter()
            wanted, new = [], []
            for key, theta in zip(keys, thetas, strict=True):
                running = pool.running.get((key, responses))
                if running is None:
                    running = pool.running[key, responses] = RunningSimulation(key, theta, responses)
                    new.append(running)
                wanted.append(running)
            if new:
                try:
                    futures = self.pool.submit_all(self._sent_function(responses), [running.theta for running in new])
                except BaseException:
                    for running in new:
                        del pool.running[running.key, responses]
                    raise
                for running, future in zip(new, futures, strict=True):
                    running.future = future
            for running in wanted:  # with the lock: another thread that leaves must not cancel what is wanted here
                if arrived not in running.users:
                    running.users.add(arrived)
                    running.future.add_done_callback(partial(_arrive, arrived, running))
        return wanted

    def wait(self, waiting: Collection[RunningSimulation], arrived: SimpleQueue) -> list[RunningSimulation]:
        """Wait until some simulations have ended, which are then counted and cached; each has a `result` or an `error`.

        Unless they run in a pool, a first part of `waiting`, all simulations of one `start`, is run here, with its
        errors.
        """
        if self.streams:
            ended = take_all(arrived, wait=True)
            self.receive(ended)
            return ended
        self._check_before()
        waiting = list(waiting)
        smallest, largest = self._chunk_limits(len(waiting), waiting[0].responses)
        chosen = waiting[: max(smallest, min(largest, self.chunk_size))]
        thetas, start = np.array([each.theta for each in chosen]), time.perf_counter()
        with observed(self._checked.label, self.pool, self._checked.complete):
            if self._runs_responses(chosen[0].responses):
                values, reasons = simulate_batch(self.model, thetas, self.pool)
            else:
                values, reasons = misfit_batch(self.model, thetas, self.measured, self.pool, self.statistic)
        self._record(chosen, thetas, values, reasons, time.perf_counter() - start)
        # the size grows by steps: the first simulations may be failures that took no time
        seconds = time.perf_counter() - start
        self.chunk_size = min(4 * len(chosen), 1 + int(_SECONDS_PER_CHUNK * len(chosen) / seconds))
        return chosen

    def receive(self, ended: Sequence[RunningSimulation]) -> None:
        """Count and cache simulations that have ended in the pool, and record failures; sets `result` or `error`.

        `ChangedModel` if the model has changed; these simulations, and all since the last comparison, are not stored.
        """
        pool = self._submitted
        with pool.lock:
            new = [running for running in dict.fromkeys(ended) if not running.received]
            for responses in (False, True):
                some, outcomes = [], []
                for running in new:
                    if running.responses is not responses:
                        continue
                    running.received = True
                    pool.running.pop((running.key, responses), None)
                    try:
                        outcome, opened = unpack(running.future.result(), self.pool)
                        self._checked.complete(opened)
                        outcomes.append(outcome)
                        some.append(running)
                    except CancelledError:
                        running.error = RuntimeError("the pool was closed before a simulation had finished")
                    except BaseException as error:
                        running.error = error
                if some:
                    self._record_outcomes(some, outcomes)

    def leave(
        self, waiting: Sequence[RunningSimulation], arrived: SimpleQueue, running: bool
    ) -> list[RunningSimulation]:
        """Stop waiting: ended simulations are cached, others are cancelled if nobody else waits for them.

        With `running`, started simulations are cancelled too. Returns the simulations that go on.
        """
        pool = self._submitted
        with pool.lock:
            left = [each for each in waiting if not each.received and each.future is not None]
            unused = []
            for each in left:
                each.users.discard(arrived)
                if not each.users and not each.future.done():
                    unused.append(each)
            if unused:
                self.pool.give_up([each.future for each in unused], running)
            for each in unused:
                if each.future.cancelled():
                    each.received = True
                    pool.running.pop((each.key, each.responses), None)
            self.receive([each for each in left if each.future.done()])
            return [each for each in left if not each.received]

    @property
    def _submitted(self) -> _Pool:
        if self._in_pool is None or self._in_pool.owner != os.getpid():  # or in a process that was forked
            self._in_pool = _Pool()
        return self._in_pool

    def _sent_function(self, responses: bool) -> Callable:
        """What is sent to the workers: the same object while simulations run, so that it is pickled once."""
        pool, full = self._submitted, self._runs_responses(responses)
        if pool.function is None or pool.function[0] is not self.model or pool.function[1] != full:
            sent = sent_simulation(self.model, *(() if full else (self.measured, self.statistic)))
            pool.function = self.model, full, Observed(sent)
        return pool.function[2]

    def _runs_responses(self, responses: bool) -> bool:
        return responses or (self.cache is not None and self.cache.responses)

    def _chunk_limits(self, n: int, responses: bool) -> tuple[int, int]:
        """Smallest (all workers are busy) and largest number of simulations, of n, between two writes or reports."""
        if self.cache is None and (self.when_simulated is None or self.pool is not None):
            return n, n
        largest = most_responses(self.model) if self._runs_responses(responses) else n
        if self.pool is not None:
            workers = self.pool.n_workers or n
        elif has_batch_method(self.model):
            workers = os.cpu_count() or 1
        else:
            return 1, largest
        return min(_ROUNDS_PER_CHUNK * workers, largest), largest

    def _record_outcomes(self, ended: list[RunningSimulation], outcomes: list[tuple]) -> None:
        """Record simulations of one kind, which the pool has run."""
        pool, now = self._submitted, time.perf_counter()
        seconds, pool.counted_until = now - pool.counted_until, now
        full = self._runs_responses(ended[0].responses)
        shape = (len(self.model.channels), self.model.n_steps) if full else (self.n_numbers,)
        values = np.full((len(ended), *shape), np.nan)
        for row, (result, _) in zip(values, outcomes, strict=True):
            if result is not None:
                row[...] = result
        thetas = np.array([each.theta for each in ended])
        try:
            self._record(ended, thetas, values, [reason for _, reason in outcomes], seconds)
        except BaseException as error:
            for each in ended:
                each.error = error
            raise

    def _record(
        self,
        ended: list[RunningSimulation],
        thetas: np.ndarray,
        values: np.ndarray,
        reasons: list[str],
        seconds: float,
    ) -> None:
        """Count new simulations, record failures, compare the model if that is due, and cache the results.

        The values are responses if these were requested or are stored on disk, else statistics.
        """
        responses = ended[0].responses
        batch = SimulationBatch(values, reasons) if self._runs_responses(responses) else None
        misfit = values
        if batch is not None:
            misfit, reasons = misfit_of_responses(self.model, batch, self.measured, self.statistic)
        self._seconds += seconds
        self.simulations += len(thetas)
        self.failures.count_outcomes(thetas, reasons)
        if self.when_simulated is not None:
            self.when_simulated(len(thetas))
        self._check_after(thetas, misfit, reasons, seconds)
        self._checked.has_results = True
        keys = [each.key for each in ended]
        self.memory_cache.store(keys, misfit)
        if responses:
            outcomes = [reason or response for reason, response in zip(batch.reasons, batch.response, strict=True)]
            self.response_memory.store(self.model.fingerprint, keys, outcomes)
        if self.cache is not None:
            response = None if batch is None else batch.response
            self._checked.rows.store(self._key, thetas, misfit, reasons, response, seconds, self._run)
            self.cache.store_remark(self.model)
        for row, each in enumerate(ended):
            if responses and reasons[row]:
                batch.response[row] = np.nan
            each.received = True
            each.result = Simulated(misfit[row], reasons[row], batch.response[row] if responses else None)

    # the model ----------------------------------------------------------------------------------------------------

    @property
    def _run(self) -> VerifyingRun:
        tolerance = None if self.cache is None else self.cache.tolerance
        return VerifyingRun(self.model, self.pool, self.measured, self.statistic, self.n_numbers, tolerance)

    def _check_before(self) -> None:
        """Check failures and the model before simulations, not after them, so that finished simulations are stored."""
        self.check_failures()
        with self._dropping_rows_of_a_changed_model():
            self._checked.before(self._run, lambda: self._known.earlier_points(self._run))

    def _check_after(self, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], seconds: float) -> None:
        """Compare the model after simulations, if that is due."""
        pool = self._submitted
        if self.streams:
            seconds = time.perf_counter() - pool.compared_at
        with self._dropping_rows_of_a_changed_model():
            if self._checked.after(self._run, thetas, misfit, reasons, seconds, last=not pool.running):
                pool.compared_at = time.perf_counter()

    @contextmanager
    def _dropping_rows_of_a_changed_model(self) -> Iterator[None]:
        """Where `ChangedModel` is raised, drop the simulations since the last comparison."""
        try:
            yield
        except ChangedModel:
            self._known.clear()
            if self.cache is not None and self._checked.unchecked:
                unchecked = np.concatenate(self._checked.unchecked)
                self._checked.rows.discard(unchecked, self._key, self.model.fingerprint)
            raise


def _arrive(arrived: SimpleQueue, running: RunningSimulation, _: Any) -> None:
    arrived.put(running)
