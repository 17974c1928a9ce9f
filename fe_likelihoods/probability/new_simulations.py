"""New simulations of a likelihood: run, counted, compared with the fingerprint, recorded if they fail, and cached.

With a pool whose items can be submitted one by one, every simulation is cached when it arrives, and nothing waits for a
batch (`start_simulations`, `receive_simulations`). Otherwise a batch is run in chunks that are cached one by one.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from ..cache.comparison import VerifyingRun, observed_batch
from ..cache.guard import EarlierPoint, ModelGuard
from ..cache.memory import FinishedRows, MemoryCache, ResponseMemory, RowBuffer
from ..cache.simulation_cache import SimulationCache
from ..cache.verification import VerifiedCache
from ..signals.channels import Measurements
from ..signals.comparison import Comparison
from ..simulation.faults import ChangedModel
from ..simulation.label import ModelLabel
from ..simulation.model import (
    Model,
    SimulationBatch,
    has_batch_method,
    misfit_of_responses,
    sent_simulation,
    simulate_batch,
)
from ..simulation.opened import Observed, Opened, observing, unpack
from ..simulation.residual_statistics import Statistic
from .failures import FailureLog
from .requested_simulations import Requested, Simulated

__all__ = ["NewSimulations", "RunningSimulation", "take_all"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average
_RESPONSE_VALUES = 2**23  # responses held at once where they are cached: 64 MiB


class RunningSimulation:
    """A simulation that was submitted to a pool.

    Attributes
    ----------
    key : bytes
        Of the structural parameters, see `distinct_keys`.
    theta : (n_structural,) float
        Structural parameters.
    responses : bool
        Whether its response was requested.
    future : Future
        Of the pool.
    users : set of SimpleQueue
        Those of the requests that wait for it.
    result : Simulated or None
        Set when it was received: one row.
    error : BaseException or None
        What went wrong instead, for which no simulation can be blamed.
    """

    __slots__ = ("error", "future", "key", "received", "responses", "result", "theta", "users")

    def __init__(self, key: bytes, theta: np.ndarray, responses: bool) -> None:
        self.key, self.theta, self.responses = key, theta, responses
        self.future: Future = Future()
        self.users: set[SimpleQueue] = set()
        self.received = False
        self.result: Simulated | None = None
        self.error: BaseException | None = None


class _Stream:
    """What runs in the pool for one likelihood."""

    def __init__(self) -> None:
        self.owner, self.lock = os.getpid(), threading.RLock()
        self.running: dict[tuple[bytes, bool], RunningSimulation] = {}
        self.function: tuple[Any, bool, Callable] | None = None  # model, whether responses are returned, what is sent
        self.unwritten = RowBuffer()
        self.counted_until = self.compared_at = 0.0  # of the wall time [s]


def take_all(arrived: SimpleQueue, wait: bool) -> list:
    """All items of a queue; with `wait`, at least one."""
    items = [arrived.get()] if wait else []
    try:
        while True:
            items.append(arrived.get_nowait())
    except Empty:
        return items


class NewSimulations:
    """Base of `CachedSimulations`, which sets the attributes."""

    model: Model
    measurements: Measurements
    measured: np.ndarray | Comparison
    pool: Any
    memory_cache: MemoryCache
    response_memory: ResponseMemory
    cache: SimulationCache | None
    chunk_size: int
    simulations: int
    seconds: float
    _statistic: Statistic | None
    _width: int
    _n_structural: int
    _response_shape: tuple[int, int]
    _failures: FailureLog
    _guard: ModelGuard
    _own_label: ModelLabel
    _verified_cache: VerifiedCache | None
    _key: str | None
    _outcomes: int  # simulations of which is known whether they failed: run here, read from disk, or recalled

    # called with the number of simulations that have ended, in this process only
    # whether there are results in memory, of this process
    _has_results: bool = False
    when_simulated: Callable[[int], None] | None = None
    _running: _Stream | None = None  # not pickled

    # one by one ---------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> bool:
        """Whether simulations can be submitted to the pool one by one."""
        return bool(getattr(self.pool, "submits", False))

    def start_simulations(
        self, keys: Sequence[bytes], thetas: np.ndarray, responses: bool, arrived: SimpleQueue
    ) -> list[RunningSimulation]:
        """Submit simulations to the pool, unless they run already; returns without waiting for them.

        Parameters
        ----------
        keys : sequence of n bytes
            Distinct, see `distinct_keys`.
        thetas : (n, n_structural) float
            Structural parameters.
        responses : bool
            Whether the responses are requested.
        arrived : SimpleQueue
            Receives each `RunningSimulation` when it has ended. Pass it on to `receive_simulations`, and those that are
            no longer waited for to `leave_simulations`.

        Returns
        -------
        list of n RunningSimulation

        Raises
        ------
        TooManyFailures, ChangedModel
            As for `CachedSimulations.statistics`.
        """
        # checked before simulations and not after them, so that finished ones are stored
        self.check_failures()
        self._check_model(self._guard.before)
        stream = self._stream
        with stream.lock:
            if not stream.running:
                stream.function = None
                stream.counted_until = stream.compared_at = time.perf_counter()
            wanted, new = [], []
            for key, theta in zip(keys, thetas, strict=True):
                running = stream.running.get((key, responses))
                if running is None:
                    running = stream.running[key, responses] = RunningSimulation(key, theta, responses)
                    new.append(running)
                wanted.append(running)
            if new:
                try:
                    futures = self.pool.submit_all(self._sent_function(responses), [running.theta for running in new])
                except BaseException:
                    for running in new:
                        del stream.running[running.key, responses]
                    raise
                for running, future in zip(new, futures, strict=True):
                    running.future = future
        for running in wanted:
            if arrived not in running.users:
                running.users.add(arrived)
                running.future.add_done_callback(partial(_arrive, arrived, running))
        return wanted

    def receive_simulations(self, ended: Sequence[RunningSimulation]) -> None:
        """Count and cache simulations that have ended, and record those that failed; sets `result` or `error`.

        Raises
        ------
        ChangedModel
            If the model has changed; these simulations and those since the last comparison are not stored.
        """
        stream = self._stream
        with stream.lock:
            new = [running for running in dict.fromkeys(ended) if not running.received]
            for responses in (False, True):
                some, outcomes = [], []
                for running in new:
                    if running.responses is not responses:
                        continue
                    running.received = True
                    stream.running.pop((running.key, responses), None)
                    try:
                        outcome, opened = unpack(running.future.result())
                        self._complete_label(opened)
                        outcomes.append(outcome)
                        some.append(running)
                    except CancelledError:
                        running.error = RuntimeError("the pool was closed before a simulation had finished")
                    except BaseException as error:
                        running.error = error
                if some:
                    self._receive(some, outcomes, responses)

    def leave_simulations(
        self, waiting: Sequence[RunningSimulation], arrived: SimpleQueue, running: bool
    ) -> list[RunningSimulation]:
        """No longer wait for simulations: those that have ended are cached, others cancelled if nobody else waits.

        Parameters
        ----------
        waiting : sequence of RunningSimulation
        arrived : SimpleQueue
            As for `start_simulations`.
        running : bool
            Whether those that have started are cancelled too.

        Returns
        -------
        list of RunningSimulation
            Those that go on.
        """
        stream = self._stream
        with stream.lock:
            left = [each for each in waiting if not each.received]
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
                    stream.running.pop((each.key, each.responses), None)
            try:
                self.receive_simulations([each for each in left if each.future.done()])
            finally:
                stream.unwritten.flush()
            return [each for each in left if not each.received]

    def write_simulations(self) -> None:
        """Write rows that wait to the cache on disk."""
        self._stream.unwritten.flush()

    def check_failures(self) -> None:
        """Raise `TooManyFailures` if too many simulations have failed, even if all that run succeed."""
        self._failures.check(self._outcomes, len(self._stream.running))

    @property
    def _stream(self) -> _Stream:
        if self._running is None or self._running.owner != os.getpid():  # or in a process that was forked
            self._running = _Stream()
        return self._running

    def _sent_function(self, responses: bool) -> Callable:
        """What is sent to the workers: the same object while simulations run, so that it is pickled once."""
        stream, full = self._stream, self._runs_responses(responses)
        if stream.function is None or stream.function[0] is not self.model or stream.function[1] != full:
            sent = sent_simulation(self.model, *(() if full else (self.measured, self._statistic)))
            stream.function = self.model, full, Observed(sent)
        return stream.function[2]

    def _runs_responses(self, responses: bool) -> bool:
        return responses or (self.cache is not None and self.cache.responses)

    def _receive(self, ended: list[RunningSimulation], outcomes: list[tuple], responses: bool) -> None:
        """Record simulations of one kind, which the pool has run."""
        stream, now = self._stream, time.perf_counter()
        seconds, stream.counted_until = now - stream.counted_until, now
        full = self._runs_responses(responses)
        values = np.full((len(ended), *(self._response_shape if full else (self._width,))), np.nan)
        for row, (result, _) in zip(values, outcomes, strict=True):
            if result is not None:
                row[...] = result
        reasons = [reason for _, reason in outcomes]
        batch = SimulationBatch(values, reasons) if full else None
        misfit = values
        if batch is not None:
            misfit, reasons = misfit_of_responses(self.model, batch, self.measured, self._statistic)
        thetas = np.array([each.theta for each in ended])
        try:
            result = self._record([each.key for each in ended], thetas, misfit, reasons, batch, responses, seconds)
        except BaseException as error:
            for each in ended:
                each.error = error
            raise
        for row, each in enumerate(ended):
            response = result.response[row] if responses else None
            each.result = Simulated(result.misfit[row], [result.reasons[row]], response)

    def _stream_rows(self, requested: Requested, left: np.ndarray) -> Iterator[tuple[Any, Simulated]]:
        """Simulate the rows `left`, each of which is stored when it arrives; yields indices and results."""
        if not len(left):
            return
        arrived: SimpleQueue = SimpleQueue()
        keys, thetas = [requested.keys[row] for row in left], requested.thetas[left]
        started = self.start_simulations(keys, thetas, requested.response is not None, arrived)
        waiting = dict(zip(started, left, strict=True))
        try:
            while waiting:
                ended = take_all(arrived, wait=True)
                self.receive_simulations(ended)
                for running in ended:
                    if running.error is not None:
                        raise running.error
                    yield waiting.pop(running), running.result
                if waiting:
                    self.check_failures()
        except BaseException:
            self.leave_simulations(list(waiting), arrived, running=True)
            raise
        self.write_simulations()

    # in chunks ----------------------------------------------------------------------------------------------------

    def _run(self, requested: Requested, left: np.ndarray) -> Iterator[tuple[Any, Simulated]]:
        """Simulate the rows `left`; yields indices and results as they are stored."""
        return self._stream_rows(requested, left) if self.streams else self._chunks(requested, left)

    def _chunks(self, requested: Requested, left: np.ndarray) -> Iterator[tuple[np.ndarray, Simulated]]:
        """Simulate the rows `left` in chunks that are stored one by one; yields their indices and results."""
        responses = requested.response is not None
        smallest, largest = self._chunk_limits(len(left), responses) if len(left) else (0, 0)
        while len(left):
            size = max(smallest, min(largest, self.chunk_size))
            rows, left = left[:size], left[size:]
            start = time.perf_counter()
            batch = self._simulate([requested.keys[row] for row in rows], requested.thetas[rows], responses)
            # the size grows by steps: the first simulations may be failures that took no time
            self.chunk_size = min(4 * size, 1 + int(_SECONDS_PER_CHUNK * len(rows) / (time.perf_counter() - start)))
            yield rows, batch

    @property
    def _most_responses(self) -> int:
        """Number of responses that are held at once where they are cached."""
        return max(1, _RESPONSE_VALUES // (self._response_shape[0] * self._response_shape[1]))

    def _chunk_limits(self, n: int, responses: bool) -> tuple[int, int]:
        """Smallest (all workers are busy) and largest number of simulations, of n, between two writes or reports."""
        if self.cache is None and (self.when_simulated is None or self.pool is not None):
            return n, n
        largest = self._most_responses if self._runs_responses(responses) else n
        if self.pool is not None:
            workers = self.pool.n_workers or n
        elif has_batch_method(self.model):
            workers = os.cpu_count() or 1
        else:
            return 1, largest
        return min(_ROUNDS_PER_CHUNK * workers, largest), largest

    def _simulate(self, keys: list[bytes], thetas: np.ndarray, responses: bool) -> Simulated:
        """Results of new simulations of one batch, which are recorded and cached."""
        # checked before a batch and not after it, so that finished simulations are stored
        self._failures.check(self._outcomes)
        self._check_model(self._guard.before)
        start = time.perf_counter()
        batch = None
        if self._runs_responses(responses):
            with observing() as observer:
                batch = simulate_batch(self.model, thetas, self.pool)
            if self._label.observes and self.pool is None:
                self._complete_label(observer.result(self._label.known))
            misfit, reasons = misfit_of_responses(self.model, batch, self.measured, self._statistic)
        else:
            misfit, reasons, opened = observed_batch(self._verifying_run, thetas, self._label)
            self._complete_label(opened)
        result = self._record(keys, thetas, misfit, reasons, batch, responses, time.perf_counter() - start)
        self.write_simulations()
        return result

    # both ---------------------------------------------------------------------------------------------------------

    def _record(
        self,
        keys: list[bytes],
        thetas: np.ndarray,
        misfit: np.ndarray,
        reasons: list[str],
        batch: SimulationBatch | None,
        responses: bool,
        seconds: float,
    ) -> Simulated:
        """Count new simulations, record failures, compare the model if that is due, and cache the results."""
        self.seconds += seconds
        self.simulations += len(thetas)
        self._outcomes += len(thetas)
        for theta, reason in zip(thetas, reasons, strict=True):
            if reason:
                self._failures.add(theta, reason)
        if self.when_simulated is not None:
            self.when_simulated(len(thetas))
        self._compare_model(thetas, misfit, reasons, seconds)
        self._has_results = True
        self.memory_cache.store(keys, misfit)
        if responses:
            outcomes = [reason or response for reason, response in zip(batch.reasons, batch.response, strict=True)]
            self.response_memory.store(self.model.fingerprint, keys, outcomes)
        if self.cache is not None:
            response = None if batch is None else batch.response.copy() if responses else batch.response
            rows = FinishedRows(thetas, misfit, reasons, response, seconds)
            self._stream.unwritten.add(rows, self._write_rows)
        if responses:
            batch.response[[bool(reason) for reason in reasons]] = np.nan
        return Simulated(misfit, reasons, batch.response if responses else None)

    def _write_rows(self, rows: FinishedRows) -> None:
        """Write simulations to the cache on disk."""
        self._verified_cache.store(
            self._key, rows.thetas, rows.misfit, rows.reasons, rows.response, rows.seconds, self._verifying_run
        )
        self.cache.store_remark(self.model)

    @property
    def _verifying_run(self) -> VerifyingRun:
        tolerance = None if self.cache is None else self.cache.tolerance
        return VerifyingRun(self.model, self.pool, self.measured, self._statistic, self._width, tolerance)

    @property
    def _label(self) -> ModelLabel:
        """Label of the model, which likelihoods of one model and file share."""
        return self._own_label if self._verified_cache is None else self._verified_cache.label

    def _complete_label(self, opened: Opened | None) -> None:
        """Add to the label of the model what simulations opened."""
        if self._verified_cache is None:
            self._own_label.add(opened)
        else:
            self._verified_cache.complete(opened)

    def _label_again(self) -> None:
        """Label the model as it is now, if it has changed since the likelihood was made and nothing was used yet."""
        changed = self._guard.known.changed(self.model)
        if changed <= self._guard.changing:
            self._guard.known.renew(self.model)
        else:
            label = ModelLabel(self.model, self._statistic)
            if self.cache is not None:
                self._verified_cache = VerifiedCache(self.cache, self.model, self.pool, label)
                label = self._verified_cache.label
            self._own_label, self._guard = label, ModelGuard(self.model, label)

    def _compare_model(self, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], seconds: float) -> None:
        """Compare the model after simulations, if that is due."""
        stream, last = self._stream, not self._stream.running
        if self.streams:
            seconds = time.perf_counter() - stream.compared_at
        if self._check_model(self._guard.after, thetas, misfit, reasons, seconds, last):
            stream.compared_at = time.perf_counter()

    def _check_model(self, check: Callable, *arguments: Any) -> Any:
        """Raise `ChangedModel` if the model has changed; simulations since the last check are then dropped."""
        self._guard.known.add(self._label.opened)
        self._guard.changing |= self._label.changing
        if not self._guard.points and check == self._guard.before:
            if not self._has_results:
                self._label_again()
                check = self._guard.before
            else:  # only rows of the disk are known
                known = self.memory_cache.successes(self._n_structural)[:1]
                statistics, _ = self.memory_cache.look_up([theta.tobytes() for theta in known], self._width)
                self._guard.points += map(EarlierPoint, known, statistics)
        try:
            return check(self._verifying_run, *arguments)
        except ChangedModel:
            self.memory_cache.clear()
            self.response_memory.clear()
            if self.cache is not None and self._guard.unchecked:
                self.write_simulations()
                unchecked = np.concatenate(self._guard.unchecked)
                self._verified_cache.discard(unchecked, self._key, self.model.fingerprint)
            raise


def _arrive(arrived: SimpleQueue, running: RunningSimulation, _: Future) -> None:
    arrived.put(running)
