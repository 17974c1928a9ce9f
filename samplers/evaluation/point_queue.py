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
        self._arrived, self._submitted = threading.Event(), 0

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

        ValueError for points that cannot be evaluated.
        """
        futures = self._start(coords)
        tickets = list(range(self._submitted, self._submitted + len(futures)))
        self._submitted += len(futures)
        self._futures.update(zip(tickets, futures, strict=True))
        for future in futures:
            future.add_done_callback(lambda _: self._arrived.set())
        return tickets

    @interrupts_end_the_run()
    def collect(self, wait: bool = True) -> list[tuple[int, Any]]:
        """Tickets and values of all finished points, after a `wait` for one.

        RuntimeError if no point is pending. What ends the run, as KeyboardInterrupt of a worker or a pool that cannot
        go on, is raised after the points that were finished before have been returned.
        """
        if wait and not self._futures:
            raise RuntimeError("no point is pending: submit points before collect()")
        while wait and not any(future.done() for future in self._futures.values()):
            self._arrived.wait()
            self._arrived.clear()
        collected, fault, seconds = [], None, None if wait else SECONDS_TO_FETCH
        for ticket, future in [each for each in self._futures.items() if each[1].done()]:
            try:  # `exception` does not raise what the function raised, which may be KeyboardInterrupt
                error = future.exception(seconds)
                value = future.result(seconds) if error is None else None
            except (Exception, CancelledError) as raised:
                error, value = raised, None
                if not wait and isinstance(raised, TimeoutError):
                    break  # nothing can be fetched from this pool any more
            if type(error).__name__ == "KilledWorker":
                error, value = None, Failed("every process that evaluated this point died")
            if isinstance(value, Ended):
                error = value.error
            if error is None:
                collected.append((ticket, value))
            else:
                fault = fault or error
        if wait and not collected and isinstance(fault, CancelledError):
            raise RuntimeError("the pool has cancelled a point: run again with a new pool") from fault
        if wait and not collected:
            raise fault
        for ticket, _ in collected:
            del self._futures[ticket]
        return collected

    def close(self) -> None:
        """Give up the points that have not begun. May be called twice."""
        futures, self._futures = list(self._futures.values()), {}
        self._give_up(futures)


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
