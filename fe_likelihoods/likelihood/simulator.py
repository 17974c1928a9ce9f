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
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..cache.memory import MemoryCache, ResponseMemory, distinct_keys, thetas_of
from ..cache.simulation_cache import SimulationCache
from ..cache.verification import StaleCache, VerifiedModel
from ..noise.statistics import Statistic
from ..priors.points import as_rows
from ..signals.channels import Measurements
from ..signals.comparison import Comparison, compare_with
from ..simulation.executors import as_executor
from ..simulation.faults import ChangedModel
from ..simulation.folder import Observed, unpack
from ..simulation.local_pool import value_of
from ..simulation.model import (
    Model,
    SimulationBatch,
    has_batch_method,
    has_jacobian,
    misfit_batch,
    most_responses,
    sent_simulation,
    simulate_batch,
)
from .failure_log import FailureLog
from .inputs import check_statistic, name_of_statistic

__all__ = ["Simulator"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average


class _Request:
    """Distinct simulations that were requested, whose results are filled in.

    For n `keys` (see `distinct_keys`): `thetas` (n, n_structural), `statistics` (n, n_numbers), NaN where not known,
    `reasons` of failures, `responses` (n, n_channels, n_steps) if requested, and whether the statistics are `known`,
    and nothing is to be simulated (`done`). The model has one `fingerprint` for all of them.
    """

    def __init__(self, keys: list[bytes], full: bool, model: Model, statistics: np.ndarray, known: Any) -> None:
        self.keys, self.model, self.statistics = keys, model, statistics
        self.thetas = thetas_of(keys, len(model.parameter_names))
        self.finite = np.isfinite(self.thetas).all(axis=1)
        self.reasons = ["" if fine else "the parameters are not finite" for fine in self.finite]
        self.known = np.array(known, dtype=bool) | ~self.finite
        self.done = self.known & ~np.isfinite(statistics).all(axis=1) if full else self.known.copy()
        self.responses = np.full((len(keys), len(model.channels), model.n_steps), np.nan) if full else None

    @cached_property
    def fingerprint(self) -> str:
        return self.model.fingerprint

    @property
    def left(self) -> np.ndarray:
        """Rows that are to be simulated."""
        return (~self.done).nonzero()[0]


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
    measured: a cache on disk gets the responses alone.
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

    def share(self, other: "Simulator") -> None:
        """Use the responses in memory of another simulator, and trust the rows that it has verified."""
        self.response_memory = other.response_memory
        self.share_trust(other)

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
        request = self._run_in_pool(keys, which, full) if self.streams else self._look_up(keys, which, full)
        left = request.left
        while len(left):
            self._check_model()
            some, start = left[: self._chunk(len(left), full)], time.perf_counter()
            with self._observed():
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
        statistics = request.statistics if len(keys) == len(which) else request.statistics[which]
        if not full:
            return statistics
        return statistics, SimulationBatch(request.responses[which], [request.reasons[row] for row in which])

    def recall(self, thetas: np.ndarray, statistics: np.ndarray | None, reasons: Sequence[str]) -> None:
        """Cache statistics (n, n_numbers) of an earlier run in memory, at structural parameters (n, n_structural).

        Failures (with a reason) are recorded. Rows that are cached already are not changed. Nothing is written to the
        cache on disk. Without statistics, only failures are cached.
        """
        keys, which = distinct_keys(thetas)
        known = self.memory_cache.look_up(keys, self.n_numbers)[1]
        last = dict(zip(which, range(len(thetas)), strict=True))
        rows = [row for place, row in last.items() if not known[place] and np.isfinite(thetas[row]).all()]
        new = [row for row in rows if keys[which[row]] not in self._recalled]
        self._recalled.update(keys[which[row]] for row in new)
        self.failures.count_outcomes(thetas[new], [reasons[row] for row in new])
        if statistics is None:
            rows = [row for row in rows if reasons[row]]
            statistics = np.full((len(thetas), self.n_numbers), np.nan)
        self.memory_cache.store([keys[which[row]] for row in rows], statistics[rows], [reasons[row] for row in rows])

    # known simulations --------------------------------------------------------------------------------------------

    def _look_up(self, keys: list[bytes], which: Sequence[int], full: bool) -> _Request:
        """What is known of distinct keys, which is counted; `which` has the key of every requested row."""
        with self._running.lock:
            request = _Request(keys, full, self.model, *self.memory_cache.look_up(keys, self.n_numbers))
            for row in (request.done & request.finite).nonzero()[0] if full else ():
                request.reasons[row] = self.memory_cache.reason(keys[row]) or "the simulation failed before"
            try:
                on_disk = self._take_statistics(request) + self._take_responses(request)
            except StaleCache:  # results in memory may belong to another model
                self._clear()
                raise
            counts = np.bincount(which, minlength=len(keys))
            self.cache_hits += int(counts[request.done & request.finite].sum())
            self.disk_hits += int(counts[on_disk].sum())
        return request

    def _take_statistics(self, request: _Request) -> list[int]:
        """Fill in stored statistics, unless responses are wanted, and return their rows; some are verified by runs."""
        if self.cache is None or request.responses is not None or self._responses_only:
            return []
        if not len(new := request.left):
            return []
        rows = self._stored_statistics(request.thetas[new], request.fingerprint)
        found, reasons = rows.known.nonzero()[0], rows.reasons
        if len(found):
            self._enter_known(request, new[found], rows.values[found], [reasons[place] for place in found])
        return new[found].tolist()

    def _take_responses(self, request: _Request) -> list[int]:
        """Fill in rows whose responses are cached, and statistics that are not known; returns rows from the disk."""
        memory, full, on_disk = self.response_memory, request.responses is not None, []
        if self.cache is None and not len(memory):
            return []
        left, size = request.left.tolist(), most_responses(self.model)
        for start in range(0, len(left), size):
            rows, fingerprint = left[start : start + size], request.fingerprint
            known = dict(zip(rows, memory.look_up([(fingerprint, request.keys[row]) for row in rows]), strict=True))
            missing = [row for row in rows if known[row] is None]
            if self.cache is not None and missing:
                read = dict(zip(missing, self._stored_responses(request.thetas[missing], fingerprint), strict=True))
                known |= read
                new = [row for row in missing if read[row] is not None]
                on_disk += new
                if full:
                    memory.store([(fingerprint, request.keys[row]) for row in new], [read[row] for row in new])
            known = {row: outcome for row, outcome in known.items() if outcome is not None}
            for row, outcome in known.items() if full else ():
                request.responses[row] = np.nan if isinstance(outcome, str) else outcome
            request.done[list(known)] = True
            if new := [row for row in known if not request.known[row]]:
                nothing = np.full((len(self.model.channels), self.model.n_steps), np.nan)
                failed = [known[row] if isinstance(known[row], str) else "" for row in new]
                responses = [nothing if reason else known[row] for row, reason in zip(new, failed, strict=True)]
                statistics, reasons = self.statistics_of(np.array(responses), failed)
                self._enter_known(request, new, statistics, reasons)
                if self.cache is not None and not self._responses_only:
                    self._store(request.thetas[new], statistics, reasons, None, fingerprint)
        return on_disk

    def _enter_known(self, request: _Request, rows: Sequence[int], statistics: np.ndarray, reasons: list[str]) -> None:
        """Enter known statistics, and log the remark that is stored with them."""
        if self.cache is not None:
            self.cache.repeat_remark(self.model, request.fingerprint)
        self.failures.count_outcomes(request.thetas[rows], reasons)
        self._enter(request, rows, statistics, reasons)

    def _enter(self, request: _Request, rows: Sequence[int], statistics: np.ndarray, reasons: list[str]) -> None:
        """Fill in statistics (n, n_numbers) and reasons of failures, and cache them in memory."""
        request.statistics[rows], request.known[rows], request.done[rows] = statistics, True, True
        for row, reason in zip(rows, reasons, strict=True):
            request.reasons[row] = reason
            if reason and request.responses is not None:
                request.responses[row] = np.nan
        self.memory_cache.store([request.keys[row] for row in rows], statistics, reasons)
        self.has_results = True

    def _clear(self) -> None:
        self.memory_cache.clear()
        self.response_memory.clear()

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
        one_by_one = self.pool is None and not has_batch_method(self.model)
        smallest = 1 if one_by_one else _ROUNDS_PER_CHUNK * workers  # so that all workers are busy
        return min(max(smallest, self.chunk_size), most)

    @interrupts_end_the_run()
    def _run_in_pool(self, keys: list[bytes], which: Sequence[int], full: bool) -> _Request:
        """Run what is not known in the pool, and record each as it arrives, after what runs for another request."""
        running, arrived = self._running, SimpleQueue()
        with running.lock:  # so that nothing arrives between the two
            running.lock.wait_for(lambda: running.keys.isdisjoint(keys))
            request = self._look_up(keys, which, full)
            left = self._send(request, request.left.tolist(), arrived)
        try:
            while left:
                self._receive(request, left, take_all(arrived))
        except BaseException:
            self.pool.give_up(list(left))
            with suppress(Exception):  # simulations that have ended are cached
                self._receive(request, left, [each for each in left if each.done() and not each.cancelled()])
            raise
        finally:
            with running.lock:
                running.keys -= {keys[row] for row in left.values()}
                running.lock.notify_all()
        return request

    def _send(self, request: _Request, rows: Sequence[int], arrived: SimpleQueue) -> dict[Future, int]:
        """Submit rows of a request to the pool; their futures will come through a queue."""
        if not rows:
            return {}
        self._check_model()
        running = self._running
        if not running.keys:
            running.counted_until = time.perf_counter()
        measured = () if self._returns_responses(request.responses is not None) else (self.measured, self.statistic)
        function = Observed(sent_simulation(self.model, *measured))
        futures = self.pool.submit_all(function, list(request.thetas[rows]))
        running.keys |= {request.keys[row] for row in rows}
        for future in futures:
            future.add_done_callback(arrived.put)
        return dict(zip(futures, rows, strict=True))

    def _receive(self, request: _Request, left: dict[Future, int], ended: Sequence[Future]) -> None:
        """Record simulations that have ended, which are taken from those that are `left`; raises the error of one.

        `ChangedModel` if the model has changed; these simulations, and all since the last comparison, are not stored.
        """
        rows, results, reasons, error = [], [], [], None
        with self._running.lock:
            for future in ended:
                row = left.pop(future)
                self._running.keys.discard(request.keys[row])
                try:
                    (result, reason), opened = unpack(value_of(future.result()), self.pool)
                    self.label.add(opened)
                    rows, results, reasons = [*rows, row], [*results, result], [*reasons, reason]
                except CancelledError:
                    error = error or RuntimeError("the pool was closed before a simulation had finished")
                except BaseException as raised:
                    error = error or raised
            if rows:
                now = time.perf_counter()
                seconds, self._running.counted_until = now - self._running.counted_until, now
                responses = self._returns_responses(request.responses is not None)
                shape = (len(self.model.channels), self.model.n_steps) if responses else (self.n_numbers,)
                values = np.array([np.full(shape, np.nan) if each is None else each for each in results])
                self._record(request, rows, values, reasons, seconds)
            self._running.lock.notify_all()
        if error is not None:
            raise error

    def _returns_responses(self, full: bool) -> bool:
        return full or has_jacobian(self.model) or (self.cache is not None and self.cache.responses)

    def _record(
        self, request: _Request, rows: Sequence[int], values: np.ndarray, reasons: list[str], seconds: float
    ) -> None:
        """Count new simulations, record failures, compare the model if that is due, and cache the results.

        The values are responses or statistics; responses are kept if they were requested, if a gradient may follow, or
        if they are stored on disk.
        """
        thetas, full = request.thetas[rows], request.responses is not None
        responses, statistics, why = None, values, reasons
        if values.ndim == 3:
            responses = values
            statistics, why = self.statistics_of(values, reasons)
        with self._running.lock:
            self.seconds += seconds
            self.simulations += len(thetas)
            self.failures.count_outcomes(thetas, why)
            if self.when_simulated is not None:
                self.when_simulated(len(thetas))
            self._drop_if_changed(self._check_after, thetas, statistics, why, self._earlier_point)
            if full:
                request.responses[rows] = responses
            self._enter(request, rows, statistics, why)
            if full or has_jacobian(self.model) or self.cache is not None:  # the model may have been replaced
                fingerprint = request.fingerprint if request.model is self.model else self.model.fingerprint
            if full or has_jacobian(self.model):
                outcomes = [reason or response for reason, response in zip(reasons, responses, strict=True)]
                self.response_memory.store([(fingerprint, request.keys[row]) for row in rows], outcomes)
            if self.cache is not None:
                kept = None if self._responses_only else statistics
                stored = responses if full or self.cache.responses else None
                self._store(thetas, kept, why, stored, fingerprint)
                self.cache.store_remark(self.model)

    # the model ----------------------------------------------------------------------------------------------------

    def _check_model(self) -> None:
        """Look at the model before simulations, so that finished simulations are stored."""
        with self._running.lock:
            self._drop_if_changed(self._check_before)

    def _earlier_point(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Parameters and statistics of a successful simulation in memory, if there is one, to be run again."""
        thetas = self.memory_cache.successes(self.n_structural)[:1]
        statistics, _ = self.memory_cache.look_up([each.tobytes() for each in thetas], self.n_numbers)
        return list(zip(thetas, statistics, strict=True))

    def _drop_if_changed(self, compare: Callable[..., None], *arguments: Any) -> None:
        """Compare the model; if it has changed, drop what was simulated since the last comparison, on either side."""
        try:
            compare(*arguments)
        except ChangedModel:
            self._clear()
            self._discard_unchecked(self.model.fingerprint)
            raise


def take_all(arrived: SimpleQueue) -> list[Future]:
    """All items of a queue, at least one."""
    items = [arrived.get()]
    with suppress(Empty):
        while True:
            items.append(arrived.get_nowait())
    return items
