"""Simulations of a model and their statistics against measurements: each is run once, counted, cached and verified.

A request first takes what is known: statistics in memory and on disk, then responses in memory and on disk, from which
the statistics are computed with the same bits as from a new simulation. The other simulations are sent to a pool to
which single items can be submitted, and each is cached when it arrives, so that nothing waits for a batch. Without such
a pool they are run in parts, and each part is cached when it has ended: in this process (compiled models on threads),
or by the ``map`` of a pool.
"""

import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Future
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..cache.comparison import VerifyingRun, observed
from ..cache.memory import MemoryCache, ResponseMemory, distinct_keys, thetas_of
from ..cache.simulation_cache import TOLERANCE, SimulationCache
from ..cache.verification import StaleCache
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
    has_jacobian,
    misfit_batch,
    misfit_of_responses,
    most_responses,
    sent_simulation,
    simulate_batch,
)
from .checked_model import CheckedModel
from .failure_log import FailureLog
from .inputs import check_statistic, name_of_statistic

__all__ = ["Simulation", "Simulator", "take_all"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average


class _Request:
    """Distinct simulations that were requested, whose results are filled in.

    For n `keys` (see `distinct_keys`): `thetas` (n, n_structural), `statistics` (n, n_numbers), NaN where not known,
    `reasons` of failures, `responses` (n, n_channels, n_steps) if requested, and whether the statistics are `known`,
    nothing is to be simulated (`done`), and a result was read from the disk (`on_disk`).
    """

    def __init__(self, keys: list[bytes], full: bool, run: VerifyingRun) -> None:
        self.keys, self.run = keys, run
        self.thetas = thetas_of(keys, len(run.model.parameter_names))
        self.finite = np.isfinite(self.thetas).all(axis=1)
        self.reasons = ["" if fine else "the parameters are not finite" for fine in self.finite]
        shape = len(keys), len(run.model.channels), run.model.n_steps
        self.responses = np.full(shape, np.nan) if full else None
        self.statistics = self.known = self.done = np.empty(0)
        self.on_disk = np.zeros(len(keys), bool)

    def fill(self, row: int, statistics: np.ndarray, reason: str, response: np.ndarray | None = None) -> None:
        """Enter the result of one simulation."""
        self.statistics[row], self.reasons[row], self.known[row], self.done[row] = statistics, reason, True, True
        if self.responses is not None:
            self.responses[row] = np.nan if reason or response is None else response


class Simulation:
    """A simulation that runs in the pool of a `Simulator`: row `row` of a request, whose result is filled in there.

    It is `received` when it has ended or was cancelled, and then has an `error` if its result is not known.
    """

    __slots__ = ("error", "future", "received", "request", "row")

    def __init__(self, request: _Request, row: int, future: Future) -> None:
        self.request, self.row = request, row
        self.future: Future | None = future  # until it is received
        self.error: BaseException | None = None
        self.received = False

    @property
    def key(self) -> bytes:
        """Key of the parameters."""
        return self.request.keys[self.row]

    @property
    def statistics(self) -> np.ndarray:
        """Statistics (n_numbers,), when it has been received without an error."""
        return self.request.statistics[self.row]


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
        self.counted_until = 0.0  # time of the last arrival [s]


class Simulator:
    """A model's simulations, compared with measurements in the order of the model's channels; each is run once.

    `run` waits for its simulations. `request`, `receive` and `leave` are for those who go on meanwhile, and need a pool
    that `streams`. Options are those of `FELikelihood`; the statistic is the sums of squares by default. `measured` are
    values (n_channels, n_steps), or a `Comparison` where samples are missing. `simulations`, `cache_hits` and
    `disk_hits` count simulations run by this object in this process, cached rows, and rows from the disk; `failures`
    include known ones from the disk. `chunk_size` simulations are run between two writes to the disk, adapted to their
    duration; `when_simulated` is called with the number that have ended, in this process only. With `responses_only`
    nothing was measured: a cache on disk gets the responses alone.
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
        responses_only: bool = False,
    ) -> None:
        self.failures = FailureLog(model.parameter_names, max_failure_share)
        self._responses_only = responses_only
        self.model, self.measurements, self.statistic = model, measurements, statistic
        self.measured = compare_with(measurements, model.dt, model.n_steps)
        check_statistic(statistic, self.measured)
        self.n_structural = len(model.parameter_names)
        self.n_numbers = statistic_width(self.measured, statistic)
        self.pool = as_executor(pool, model)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self.memory_cache, self.response_memory = MemoryCache(memory_rows), ResponseMemory(memory_bytes)
        self._checked = CheckedModel(model, statistic, self.cache)
        self._key = self.simulation_key
        self.chunk_size = 1
        self.simulations = self.cache_hits = self.disk_hits = 0
        self._seconds = 0.0
        self.when_simulated: Callable[[int], None] | None = None
        self._in_pool: _Running | None = None
        # responses of the last request to a model with derivatives, by its fingerprint and keys: a gradient may follow
        self._latest: list[tuple[str, bytes, np.ndarray | str]] = []

    def __getstate__(self) -> dict:
        return self.__dict__ | {"pool": None, "when_simulated": None, "_in_pool": None, "_latest": []}

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
        names = ("simulations", "verifications", "unverified", "cache_hits", "disk_hits")
        return {name: getattr(self, name) for name in names} | {
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
        self.response_memory = other.response_memory
        self._checked.share_trust(other._checked)

    # requests -----------------------------------------------------------------------------------------------------

    def statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics (n, n_numbers) that the noise needs, at structural parameters (n, n_structural), see `run`."""
        return self.run(as_rows(thetas, self.model.parameter_names))

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) [SI] at structural parameters (n, n_structural), see `run`.

        A point whose statistics are cached without its response is simulated again, unless it failed.
        """
        request, which = self.run(as_rows(thetas, self.model.parameter_names), full=True)
        return SimulationBatch(request.responses[which], [request.reasons[row] for row in which])

    def run(self, thetas: np.ndarray, possible: Callable[[], np.ndarray] | None = None, full: bool = False) -> Any:
        """Statistics (n, n_numbers) at structural parameters (n, n_structural), NaN if failed.

        With `full`, the request with responses, and the row in it of each point. Duplicates are simulated once, results
        are cached, cached ones are reused, and non-finite rows are skipped. Where `possible`, called unless all rows
        are in memory, is False (n,), nothing is simulated and rows may be NaN. Raises `TooManyFailures`, `ChangedModel`
        or `StaleCache`; simulations that have ended are cached, except after the model has changed.
        """
        keys, which = distinct_keys(thetas)
        if not full:
            statistics, known = self.memory_cache.look_up(keys, self.n_numbers)
            if all(known):
                self.cache_hits += len(which)
                return statistics if len(keys) == len(which) else statistics[which]
        if possible is not None and not (wanted := possible()).all():
            statistics = np.full((len(which), self.n_numbers), np.nan)
            if wanted.any():
                statistics[wanted] = self.run(thetas[wanted])
            return statistics
        request = self._look_up(keys, which, full)
        left = (~request.done).nonzero()[0]
        if len(left) and self.streams:
            self._run_in_pool(request, left)
            left = left[:0]
        while len(left):
            self._check_before(request.run)
            some, start = left[: self._chunk(len(left), full)], time.perf_counter()
            with observed(self._checked.label, self.pool):
                if self.pool is None or self._returns_responses(full):
                    values, reasons = simulate_batch(self.model, request.thetas[some], self.pool)
                else:
                    values, reasons = misfit_batch(
                        self.model, request.thetas[some], self.measured, self.pool, self.statistic
                    )
            self._record(request, some, values, reasons, time.perf_counter() - start)
            # the size grows by steps: the first simulations may be failures that took no time
            self.chunk_size = min(
                4 * len(some), 1 + int(_SECONDS_PER_CHUNK * len(some) / (time.perf_counter() - start))
            )
            left = left[len(some) :]
        if full:
            return request, which
        return request.statistics if len(keys) == len(which) else request.statistics[which]

    def recall(self, thetas: np.ndarray, statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache statistics (n, n_numbers) of an earlier run in memory, at structural parameters (n, n_structural).

        Failures (with a reason) are recorded, and all rows count for `max_failure_share`. Rows that are cached already
        are not changed. Nothing is written to the cache on disk.
        """
        keys, which = distinct_keys(thetas)
        known = self.memory_cache.look_up(keys, self.n_numbers)[1]
        last = dict(zip(which, range(len(thetas)), strict=True))
        rows = [row for place, row in last.items() if not known[place] and np.isfinite(thetas[row]).all()]
        new = [reasons[row] for row in rows]
        self.memory_cache.store([keys[which[row]] for row in rows], statistics[rows], new)
        self.failures.count_outcomes(thetas[rows], new)

    # known simulations --------------------------------------------------------------------------------------------

    def _look_up(self, keys: list[bytes], which: list[int], full: bool) -> _Request:
        """What is known of distinct keys, which is counted; `which` has the key of every requested row."""
        request, latest = _Request(keys, full, self._run), self._latest
        self._latest = []
        for fingerprint, key, outcome in latest if full else ():
            self.response_memory.store(fingerprint, [key], [outcome])
        request.statistics, known = self.memory_cache.look_up(keys, self.n_numbers)
        request.known = np.array(known, dtype=bool) | ~request.finite
        request.done = request.known.copy()
        try:
            self._fill(request, full)
        except StaleCache:
            self._clear()
            raise
        counts = np.bincount(which, minlength=len(keys))
        self.cache_hits += int(counts[request.done & request.finite].sum())
        self.disk_hits += int(counts[request.on_disk].sum())
        return request

    def _fill(self, request: _Request, full: bool) -> None:
        """Fill in what caches contain, also in their responses; rows of the disk may be simulated to verify them."""
        if full:
            self._set_done(request, ~request.finite)
            self._fill_from_responses(request)
            self._set_done(request, request.done)
        stored, new = self._checked.rows, (~(request.done | request.known)).nonzero()[0]
        if stored is not None and len(new) and not self._responses_only:
            done = request.done.copy()
            rows = stored.look_up(self._key, request.thetas[new], request.run)
            known, reasons = rows.known.nonzero()[0], rows.reasons
            if len(known):
                self._enter(request, new[known].tolist(), rows.values[known], [reasons[place] for place in known])
                request.on_disk[new[known]] = True
            if full:
                self._set_done(request, done)
        if not full:
            self._fill_from_responses(request)

    def _set_done(self, request: _Request, done: np.ndarray) -> None:
        """Let those rows be done (n,) whose responses are known, and known failures, which need no response."""
        failed = ~np.isfinite(request.statistics).all(axis=1) & request.known
        request.done = done | failed
        for row in failed.nonzero()[0]:
            reason = request.reasons[row] or self.memory_cache.reason(request.keys[row])
            request.reasons[row] = reason or "the simulation failed before"

    def _fill_from_responses(self, request: _Request) -> None:
        """Fill in rows whose responses are cached, and their statistics where these are not known."""
        if self._checked.rows is None and not len(self.response_memory):
            return
        left, size = (~request.done).nonzero()[0].tolist(), most_responses(self.model)
        for start in range(0, len(left), size):
            self._fill_rows_from_responses(request, left[start : start + size])

    def _fill_rows_from_responses(self, request: _Request, rows: list[int]) -> None:
        stored, run, full = self._checked.rows, request.run, request.responses is not None
        in_memory = self.response_memory.look_up(run.fingerprint, [request.keys[row] for row in rows])
        outcomes = {row: outcome for row, outcome in zip(rows, in_memory, strict=True) if outcome is not None}
        left = [row for row in rows if row not in outcomes]
        if stored is not None and left:
            read = zip(left, stored.look_up_responses(request.thetas[left], run), strict=True)
            from_disk = {row: outcome for row, outcome in read if outcome is not None}
            request.on_disk[list(from_disk)] = True
            outcomes |= from_disk
            if full and from_disk:
                keys = [request.keys[row] for row in from_disk]
                self.response_memory.store(run.fingerprint, keys, list(from_disk.values()))
        if full:
            for row, outcome in outcomes.items():
                request.responses[row] = np.nan if isinstance(outcome, str) else outcome
        request.done[list(outcomes)] = True
        if new := [row for row in outcomes if not request.known[row]]:
            nothing = np.full((len(self.model.channels), self.model.n_steps), np.nan)
            failed = [outcomes[row] if isinstance(outcomes[row], str) else "" for row in new]
            responses = [nothing if reason else outcomes[row] for row, reason in zip(new, failed, strict=True)]
            batch = SimulationBatch(np.array(responses), failed)
            statistics, reasons = misfit_of_responses(self.model, batch, self.measured, self.statistic)
            self._enter(request, new, statistics, reasons)
            if stored is not None and not self._responses_only:
                stored.store(self._key, request.thetas[new], statistics, reasons, None, run)

    def _enter(self, request: _Request, rows: list[int], statistics: np.ndarray, reasons: list[str]) -> None:
        """Fill in known statistics (n, n_numbers), cache them in memory, and count failures."""
        for row, values, reason in zip(rows, statistics, reasons, strict=True):
            request.fill(row, values, reason, None if request.responses is None else request.responses[row].copy())
        self._checked.has_results = True
        if self.cache is not None:
            self.cache.repeat_remark(self.model, request.run.fingerprint)
        self.failures.count_outcomes(request.thetas[rows], reasons)
        self.memory_cache.store([request.keys[row] for row in rows], statistics, reasons)

    def _clear(self) -> None:
        """Empty the caches in memory, because their results may belong to another model."""
        self.memory_cache.clear()
        self.response_memory.clear()

    # simulations --------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> bool:
        """Whether simulations can be submitted to the pool one by one, and not for several data sets at once."""
        return bool(getattr(self.pool, "submits", False)) and not hasattr(self.model, "simulate_together")

    def check_failures(self) -> None:
        """Raise `TooManyFailures` if too many simulations have failed, even if all that run succeed."""
        self.failures.check(0 if self._in_pool is None else len(self._running.simulations))

    def _chunk(self, n: int, full: bool) -> int:
        """Number of simulations, of n, between two writes to the cache on disk, or two reports of progress."""
        most = most_responses(self.model) if self.pool is None or self._returns_responses(full) else n
        if self.cache is None and (self.when_simulated is None or self.pool is not None):
            return min(n, most)
        workers = (os.cpu_count() or 1) if self.pool is None else self.pool.n_workers or n
        one_by_one = self.pool is None and not has_batch_method(self.model)
        smallest = 1 if one_by_one else _ROUNDS_PER_CHUNK * workers  # so that all workers are busy
        return min(max(smallest, self.chunk_size), most)

    @interrupts_end_the_run()
    def _run_in_pool(self, request: _Request, rows: Sequence[int]) -> None:
        """Run rows of a request in the pool, and record each as it arrives."""
        arrived: SimpleQueue = SimpleQueue()
        left = dict.fromkeys(self._send(request, rows, arrived))
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

    def request(self, thetas: np.ndarray, full: bool, arrived: SimpleQueue) -> list[Simulation | np.ndarray]:
        """Statistics (n_numbers,) at each of n structural parameters if known, else the simulation that runs for it.

        Simulations will come through the queue `arrived` when they have ended: pass them to `receive`, or to `leave` if
        they are not needed any more. Duplicates are one object. Raises the errors of `run`.
        """
        keys, which = distinct_keys(thetas)
        request = self._look_up(keys, which, full)
        left = (~request.done).nonzero()[0].tolist()
        sent = dict(zip(left, self._send(request, left, arrived), strict=True))
        return [sent.get(row, request.statistics[row]) for row in which]

    def _send(self, request: _Request, rows: Sequence[int], arrived: SimpleQueue) -> list[Simulation]:
        """Submit rows of a request to the pool."""
        if not len(rows):
            return []
        self._check_before(request.run)
        running = self._running
        with running.lock:
            if not running.simulations:
                running.functions.clear()
                running.counted_until = time.perf_counter()
            function = self._sent_function(request.responses is not None)
            futures = self.pool.submit_all(function, list(request.thetas[rows]))
            sent = [Simulation(request, int(row), future) for row, future in zip(rows, futures, strict=True)]
            running.simulations.update(sent)
        for simulation in sent:
            simulation.future.add_done_callback(partial(_arrive, arrived, simulation))
        return sent

    def receive(self, ended: Iterable[Simulation]) -> None:
        """Count and cache simulations that have ended in the pool; sets the `error` of each without a result.

        `ChangedModel` if the model has changed; these simulations, and all since the last comparison, are not stored.
        """
        running = self._running
        with running.lock:
            of_requests: dict[_Request, list[tuple[Simulation, tuple]]] = {}
            for simulation in ended:
                if simulation.received:
                    continue
                simulation.received, future = True, simulation.future
                simulation.future = None  # it holds the simulation: the pool would outlive the likelihood
                running.simulations.discard(simulation)
                try:
                    outcome, opened = unpack(future.result(), self.pool)
                    self._checked.label.add(opened)
                    of_requests.setdefault(simulation.request, []).append((simulation, outcome))
                except CancelledError:
                    simulation.error = RuntimeError("the pool was closed before a simulation had finished")
                except BaseException as error:
                    simulation.error = error
            try:
                for request, pairs in of_requests.items():
                    self._record_arrived(request, *zip(*pairs, strict=True))
            except BaseException as error:
                for pairs in of_requests.values():
                    for simulation, _ in pairs:
                        simulation.error = error
                raise

    def _record_arrived(self, request: _Request, ended: tuple[Simulation, ...], outcomes: tuple[tuple, ...]) -> None:
        """Record simulations of one request that the pool has run."""
        now = time.perf_counter()
        seconds, self._running.counted_until = now - self._running.counted_until, now
        responses = self._returns_responses(request.responses is not None)
        shape = (len(self.model.channels), self.model.n_steps) if responses else (self.n_numbers,)
        values = np.full((len(ended), *shape), np.nan)
        for row, (result, _) in zip(values, outcomes, strict=True):
            if result is not None:
                row[...] = result
        self._record(request, [each.row for each in ended], values, [reason for _, reason in outcomes], seconds)

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
                    each.received, each.future = True, None
                    in_pool.simulations.discard(each)
            self.receive([each for each in left if not each.received and each.future.done()])
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
        return full or has_jacobian(self.model) or (self.cache is not None and self.cache.responses)

    def _record(
        self, request: _Request, rows: Sequence[int], values: np.ndarray, reasons: list[str], seconds: float
    ) -> None:
        """Count new simulations, record failures, compare the model if that is due, and cache the results.

        The values are responses or statistics; responses are kept if they were requested or are stored on disk.
        """
        thetas, keys, full = request.thetas[rows], [request.keys[row] for row in rows], request.responses is not None
        responses, statistics, why = None, values, reasons
        if values.ndim == 3:
            batch, responses = SimulationBatch(values, reasons), values if self._returns_responses(full) else None
            statistics, reasons = misfit_of_responses(self.model, batch, self.measured, self.statistic)
        self._seconds += seconds
        self.simulations += len(thetas)
        self.failures.count_outcomes(thetas, reasons)
        if self.when_simulated is not None:
            self.when_simulated(len(thetas))
        run = request.run if request.run.model is self.model else self._run  # the model may have been replaced
        self._drop_if_changed(self._checked.after, run, thetas, statistics, reasons, self._earlier_point)
        self._checked.has_results = True
        self.memory_cache.store(keys, statistics, reasons)
        if full:
            outcomes = [reason or response for reason, response in zip(why, responses, strict=True)]
            self.response_memory.store(run.fingerprint, keys, outcomes)
        elif has_jacobian(self.model) and len(self._latest) < most_responses(self.model):
            outcomes = [reason or response for reason, response in zip(why, responses, strict=True)]
            self._latest += zip([run.fingerprint] * len(keys), keys, outcomes, strict=True)
        if self.cache is not None:
            kept = None if self._responses_only else statistics
            stored = responses if full or self.cache.responses else None
            self._checked.rows.store(self._key, thetas, kept, reasons, stored, run)
            self.cache.store_remark(self.model)
        for place, row in enumerate(rows):
            request.fill(row, statistics[place], reasons[place], responses[place] if full else None)

    # the model ----------------------------------------------------------------------------------------------------

    @property
    def _run(self) -> VerifyingRun:
        tolerance = TOLERANCE if self.cache is None else self.cache.tolerance
        return VerifyingRun(self.model, self.pool, self.measured, self.statistic, self.n_numbers, tolerance)

    def _check_before(self, run: VerifyingRun) -> None:
        """Check failures and the model before simulations, not after them, so that finished simulations are stored."""
        self.check_failures()
        self._drop_if_changed(self._checked.before, run)

    def _earlier_point(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Parameters and statistics of a successful simulation in memory, if there is one, to be run again."""
        thetas = self.memory_cache.successes(self.n_structural)[:1]
        statistics, _ = self.memory_cache.look_up([each.tobytes() for each in thetas], self.n_numbers)
        return list(zip(thetas, statistics, strict=True))

    def _drop_if_changed(self, compare: Callable[..., Any], run: VerifyingRun, *arguments: Any) -> None:
        """Compare the model; if it has changed, drop what was simulated since the last comparison, on either side."""
        try:
            compare(run, *arguments)
        except ChangedModel:
            self._clear()
            if self.cache is not None and self._checked.unchecked:
                unchecked = np.concatenate(self._checked.unchecked)
                self._checked.rows.discard(unchecked, self._key, run.fingerprint)
            raise


def _arrive(arrived: SimpleQueue, simulation: Simulation, _: Any) -> None:
    arrived.put(simulation)
