"""Points that arrive in any order, so that no worker waits for the slowest point of a batch.

The record of the run contains the finished points and, for each decision of the sampler (`AsynchronousEvaluator.wait`),
which points had arrived before it, so that an interrupted run, when repeated, makes the same decisions. Points that
were running when the process ended are submitted again.

A queue, ``posterior.evaluation_queue()`` or `PoolQueue`, has the methods ``submit(coords)``, which returns a ticket for
each point, ``collect()``, which waits for a finished point and returns tickets and values of all finished ones,
``close()``, and perhaps ``ended()``, which returns those of all that have ended without waiting. ``workers`` is the
number of points that are evaluated at once, None if it is not known.
"""

import hashlib
import logging
import threading
from asyncio import CancelledError
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..interrupts import Ended, SentFunction, deferred_interrupts, interrupts_end_the_run
from ..record import Remember, merge_batches
from ..tempering.pending_points import PendingPoints
from .evaluator import Evaluator
from .user_target import Target
from .values import Failed

__all__ = ["AsynchronousEvaluator", "PoolQueue", "check_asynchronous"]

logger = logging.getLogger(__name__)

SIZES = ("n_workers", "_max_workers", "_processes", "size")  # attributes of pools with the number of workers
SECONDS_TO_FETCH = 10.0  # longest wait for the value of a point that has ended, when the run ends


def _has_queue(target: Target, pool: Any) -> bool:
    """Whether the function provides a queue, and no pool is given."""
    return pool is None and callable(getattr(target.function, "evaluation_queue", None))


def check_asynchronous(target: Target, pool: Any) -> None:
    """Raise ValueError if points cannot be submitted one by one."""
    can_submit = callable(getattr(pool, "submit", None))
    if not (target.vectorize if _has_queue(target, pool) else can_submit and not target.vectorize):
        raise ValueError(
            "asynchronous=True needs points that can be submitted one by one: pass a posterior that has the method "
            "evaluation_queue (Posterior of fe_likelihoods, with its own pool) and vectorize=True, or a function of "
            "one point and a pool with the method submit (an executor of concurrent.futures, mpi4py or loky, a dask "
            f"client); got {type(target.function).__name__}, pool={type(pool).__name__}, vectorize={target.vectorize}"
        )


class AsynchronousEvaluator(Evaluator):
    """An evaluator whose `submit` returns without waiting; `queue` opens the queue of a guide, if it has one."""

    asynchronous = True

    def __init__(self, *args: Any, queue: Callable[[], Any] | None = None):
        self._open_queue, self._remember = queue, None
        super().__init__(*args)
        self._forget_running()

    def __getstate__(self) -> dict:
        return super().__getstate__() | {"_queue": None, "_running": {}, "_tickets": {}, "_remember": None}

    def _forget_running(self) -> None:
        self._queue: Any = None
        self._submitted = 0
        self._running: dict[int, tuple[PendingPoints, int]] = {}  # points not yet arrived at a decision, by number
        self._tickets: dict[int, int] = {}  # number of the point by ticket of the queue

    def _opened(self) -> Any:
        if self._queue is None and _has_queue(self.target, self.pool):
            self._queue = (self._open_queue or self.target.function.evaluation_queue)()
        elif self._queue is None:
            if self.pool is None:
                raise ValueError(
                    "this sampler was begun with a pool, which is not stored with it: set its attribute pool"
                )
            self._queue = PoolQueue(self.target.caught, self.pool, self.target.as_points)
        return self._queue

    @property
    def workers(self) -> int:
        """Number of points that are evaluated at once."""
        return self._opened().workers or 1

    def begin(self) -> Remember:
        """An annealing begins."""
        self._remember = super().begin()
        return self._remember

    def submit(self, coords: np.ndarray) -> PendingPoints:
        """Begin to evaluate points (n, ndim); the limit of simulations may allow only the first points."""
        log_prior, inside = self._prior_of(coords)
        asked, known, _ = self._look_up(coords, inside)
        refused = len(asked) < sum(inside)
        end = int(np.flatnonzero(inside)[len(asked)]) if refused else len(coords)
        self.budget.submitted(coords[asked])
        self.evaluations += len(asked)
        pending = PendingPoints(coords[:end], log_prior[:end], refused)
        outside = np.flatnonzero(~inside[:end])
        if len(outside) > 0:
            pending.arrive(outside, pending.base[outside])
        numbers = range(self._submitted, self._submitted + len(asked))
        self._submitted += len(asked)
        self._running.update((number, (pending, int(row))) for number, row in zip(numbers, asked, strict=True))
        if not known.all():
            if self.observer is not None:
                self.observer.submitted(int(sum(~known)))
            tickets = self._opened().submit(coords[asked[~known]])
            self._tickets.update(zip(tickets, np.array(numbers)[~known].tolist(), strict=True))
        return pending

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""
        if not self._running:
            return
        # by the points, since a search that goes on under a larger limit leads to other points
        points = self._points(self._running)
        key = f"arrived of {hashlib.blake2b(points.tobytes(), digest_size=16).hexdigest()}"
        by_batch: dict[int, list[int]] = {}
        for number in self._remember(key, lambda: [self._gather(most)])[0].tolist():
            by_batch.setdefault(id(self._running[number][0]), []).append(number)
        for numbers in by_batch.values():
            self._arrive(numbers)

    def _points(self, numbers: Any) -> np.ndarray:
        """Running points (m, ndim) by their numbers."""
        return np.array([pending.coords[row] for pending, row in map(self._running.__getitem__, numbers)])

    def _gather(self, most: int) -> np.ndarray:
        """Numbers (m,) of the points that have arrived when `most` other points are running."""
        while len(self._tickets) > most:
            self._take(self._opened().collect())
        return np.array(sorted(set(self._running) - set(self._tickets.values())), dtype=np.int64)

    def _take(self, collected: list[tuple[int, Any]]) -> None:
        """Enter values of the queue that are not known yet in the record."""
        new = {self._tickets[ticket]: (ticket, value) for ticket, value in collected if ticket in self._tickets}
        if not new:
            return
        batch = self.as_batch(self._points(new), [value for _, value in new.values()])
        with deferred_interrupts():
            self.enter(batch)
            for ticket, _ in new.values():
                del self._tickets[ticket]
        if self.observer is not None:
            self.observer.finished(len(new))

    def _arrive(self, numbers: list[int]) -> None:
        """Let points that were submitted together arrive, and check how many have failed."""
        _, batches = self.record.find(self._points(numbers))
        pending = self._running[numbers[0]][0]
        rows = np.array([self._running.pop(number)[1] for number in numbers])
        failed, whole = sum(len(batch.reasons) for batch in batches), len(numbers) == len(pending.coords)
        counts = self.record.count - len(numbers), len(self.record.failed) - failed
        self.check_failures(merge_batches(batches), *counts, len(self._running), whole)
        log_prior = pending.base["log_prior"][rows]
        pending.arrive(rows, self._pack(log_prior, np.arange(len(rows)), batches))

    def close(self) -> None:
        """End the evaluation of running points; points that have ended are entered in the record."""
        queue, self._queue = self._queue, None
        try:
            if hasattr(queue, "ended"):
                self._take(queue.ended())
        except Exception as error:  # another error or Ctrl-C is the reason why the run ends
            logger.warning("evaluations that have ended are not stored: %s", error)
        finally:
            self._forget_running()
            self.budget.closed()
            if queue is not None:
                queue.close()


class PoolQueue:
    """A function of one point in a pool: a `concurrent.futures.Executor`, as mpi4py and loky have, or a dask client.

    The function can be sent to the workers; `as_items` converts points (n, ndim) to its arguments.
    """

    def __init__(self, function: Callable, pool: Any, as_items: Callable[[Any], Sequence]):
        self._function, self._pool, self._as_items = SentFunction(function), pool, as_items
        self._futures: dict[int, Any] = {}  # of points that were not collected, by ticket
        self._handed: list[int] = []  # what the last `collect` returned: the caller may not have received it
        self._arrived = threading.Event()
        self._submitted = 0

    @property
    def workers(self) -> int | None:
        """Number of points that are evaluated at once, if the pool states it."""
        threads = getattr(self._pool, "nthreads", None)  # of a dask client
        if callable(threads):
            return sum(threads().values()) or None
        sizes = (getattr(self._pool, name, None) for name in SIZES)
        return next((size for size in sizes if isinstance(size, int) and size > 0), None)

    def submit(self, coords: Any) -> list[int]:
        """Begin to evaluate points (n, ndim) without waiting; returns a number for each."""
        items = self._as_items(coords)
        tickets = list(range(self._submitted, self._submitted + len(items)))
        self._submitted += len(items)
        if hasattr(self._pool, "gather"):  # dask sends the function once with all points
            futures = self._pool.map(self._function, items, pure=False)
        else:
            futures = (self._pool.submit(self._function, item) for item in items)
        for ticket, future in zip(tickets, futures, strict=True):
            self._futures[ticket] = future
            future.add_done_callback(lambda _: self._arrived.set())
        return tickets

    @interrupts_end_the_run()
    def collect(self) -> list[tuple[int, Any]]:
        """Wait for a finished point; returns numbers and values of all finished points.

        Raises KeyboardInterrupt or SystemExit if the function has raised it, and RuntimeError if the pool cannot
        continue. Points that finished before are returned first.
        """
        while self._handed:
            self._futures.pop(self._handed.pop(), None)
        while not any(future.done() for future in self._futures.values()):
            self._arrived.wait()
            self._arrived.clear()
        collected, error = self._fetch()
        if not collected and isinstance(error, KeyboardInterrupt | SystemExit):
            raise error
        if not collected:
            raise RuntimeError(
                f"the pool cannot go on: {type(error).__name__}: {error}. Evaluations that have arrived are kept where "
                "the sampler has a file: start the same script again with a new pool"
            ) from error
        self._handed = [ticket for ticket, _ in collected]
        return collected

    def ended(self) -> list[tuple[int, Any]]:
        """Numbers and values of all points that have ended, without waiting, including the last collected points."""
        return self._fetch(SECONDS_TO_FETCH)[0]

    def _fetch(self, seconds: float | None = None) -> tuple[list[tuple[int, Any]], BaseException | None]:
        """Numbers and values of the points that have ended, and an error that no point has caused, if any."""
        fetched, fault = [], None
        for ticket, future in list(self._futures.items()):
            if not future.done():
                continue
            value = None
            try:  # `exception` does not raise what the function raised, which may be KeyboardInterrupt
                error = future.exception(seconds)
                value = future.result(seconds) if error is None else None
            except (Exception, CancelledError) as raised:
                error = raised
                if seconds is not None and isinstance(raised, TimeoutError):
                    break  # nothing can be fetched from this pool any more
            if type(error).__name__ == "KilledWorker":
                error, value = None, Failed("every process that evaluated this point died")
            if isinstance(value, Ended):
                error = value.error
            if error is None:
                fetched.append((ticket, value))
            else:
                fault = fault or error
        return fetched, fault

    def close(self) -> None:
        """Cancel the points that have not been started."""
        futures, self._futures = list(self._futures.values()), {}
        if hasattr(self._pool, "give_up"):  # an executor of fe_likelihoods, whose tasks consist of several items
            self._pool.give_up(futures, running=False)
            return
        for future in futures:
            future.cancel()
