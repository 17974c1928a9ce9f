"""Points that are submitted to a pool, and come back in the order in which they end."""

import threading
from asyncio import CancelledError
from collections.abc import Callable, Sequence
from typing import Any

from ..interrupts import Ended, SentFunction, interrupts_end_the_run
from .values import Failed

__all__ = ["PointQueue", "pool_queue", "workers_of"]

SIZES = ("n_workers", "_max_workers", "_processes", "size")  # attributes of pools with the number of workers
SECONDS_TO_FETCH = 10.0  # longest wait for the value of a point that has ended, when the run ends


class PointQueue:
    """Points as futures: `submit` returns tickets, `collect` waits for points that end.

    Its methods are called from one thread. ``start(coords)`` begins points (n, ndim) and returns a future for each,
    ``give_up(futures)`` ends those that have not begun, and ``size()`` is the number of points that are evaluated at
    once, None if it is not known.
    """

    def __init__(
        self,
        start: Callable[[Any], Sequence[Any]],
        size: Callable[[], int | None],
        give_up: Callable[[list], None] | None = None,
    ):
        self._start, self._size, self._give_up = start, size, give_up or _cancel
        self._futures: dict[int, Any] = {}  # of points that were not collected, by ticket
        self._handed: list[int] = []  # what the last `collect` returned: the caller may not have received it
        self._arrived, self._submitted, self._closed = threading.Event(), 0, False

    def __enter__(self) -> "PointQueue":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def workers(self) -> int | None:
        """Number of points that are evaluated at once; None if it is not known."""
        return self._size()

    def submit(self, coords: Any) -> list[int]:
        """Begin to evaluate points (n, ndim); returns n tickets, each of which `collect` returns once.

        RuntimeError if the queue is closed, ValueError for points that cannot be evaluated.
        """
        self._require_open()
        tickets = []
        for future in self._start(coords):
            tickets.append(self._submitted)
            self._futures[self._submitted] = future
            self._submitted += 1
            future.add_done_callback(lambda _: self._arrived.set())
        return tickets

    @interrupts_end_the_run()
    def collect(self) -> list[tuple[int, Any]]:
        """Wait until a point is finished; tickets and values of all finished points.

        RuntimeError if no point is pending, or the queue is closed. What ends the run, as KeyboardInterrupt of a worker
        or a pool that cannot go on, is raised after the points that were finished before have been returned.
        """
        self._require_open()
        if len(self._futures) == len(self._handed):
            raise RuntimeError("no point is pending: submit points before collect()")
        while self._handed:
            self._futures.pop(self._handed.pop(), None)
        while not any(future.done() for future in self._futures.values()):
            self._arrived.wait()
            self._arrived.clear()
        collected, error = self._fetch()
        if not collected and isinstance(error, CancelledError):
            raise RuntimeError("the pool has cancelled a point: run again with a new pool") from error
        if not collected:
            raise error
        self._handed = [ticket for ticket, _ in collected]
        return collected

    def ended(self) -> list[tuple[int, Any]]:
        """Tickets and values of points that have ended, including the last collected ones, without waiting.

        For a run that Ctrl-C ends, before `close`, so that finished points are kept. Errors are raised by `collect`.
        """
        return self._fetch(SECONDS_TO_FETCH)[0]

    def _fetch(self, seconds: float | None = None) -> tuple[list[tuple[int, Any]], BaseException | None]:
        """Tickets and values of the points that have ended, and an error that no point has caused, if any."""
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
        """Give up the points that have not begun. May be called twice."""
        self._closed, futures, self._futures = True, list(self._futures.values()), {}
        self._give_up(futures)

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError("the queue is closed: open another one")


def pool_queue(function: Callable, pool: Any, as_items: Callable[[Any], Sequence]) -> PointQueue:
    """Queue of a function of one point: a `concurrent.futures.Executor`, as mpi4py and loky have, or a dask client.

    The function can be sent to the workers; `as_items` converts points (n, ndim) to its arguments.
    """
    sent = SentFunction(function)

    def start(coords: Any) -> Sequence[Any]:
        if hasattr(pool, "gather"):  # dask sends the function once with all points
            return pool.map(sent, as_items(coords), pure=False)
        return [pool.submit(sent, item) for item in as_items(coords)]

    def give_up(futures: list) -> None:  # of an executor of fe_likelihoods, whose tasks consist of several items
        pool.give_up(futures, running=False)

    return PointQueue(start, lambda: workers_of(pool), give_up if hasattr(pool, "give_up") else None)


def workers_of(pool: Any) -> int | None:
    """Number of items that a pool runs at once; None if it does not say."""
    threads = getattr(pool, "nthreads", None)  # of a dask client
    if callable(threads):
        return sum(threads().values()) or None
    sizes = (getattr(pool, name, None) for name in SIZES)
    return next((size for size in sizes if isinstance(size, int) and size > 0), None)


def _cancel(futures: list) -> None:
    for future in futures:
        future.cancel()
