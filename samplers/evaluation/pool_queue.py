"""A queue of evaluations in a pool: points are sent one by one, and their values return as they are finished."""

import logging
import threading
from asyncio import CancelledError
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ..interrupts import Ended, SentFunction, interrupts_end_the_run
from .returned_values import Failed

__all__ = ["PoolQueue", "advise_on_pool", "check_asynchronous", "map_in", "open_queue", "pool_size"]

logger = logging.getLogger(__name__)

# Attributes of pools that contain the number of workers.
SIZES = ("n_workers", "_max_workers", "_processes", "size")
SECONDS_TO_FETCH = 10.0  # longest wait for the value of a point that has ended, when the run ends


def _has_queue(function: Callable, pool: Any) -> bool:
    """Whether a function provides a queue, and no pool is given."""
    return pool is None and callable(getattr(function, "evaluation_queue", None))


def check_asynchronous(function: Callable, pool: Any, vectorize: bool) -> None:
    """Raise ValueError if points cannot be submitted one by one."""
    can_submit = callable(getattr(pool, "submit", None))
    if (_has_queue(function, pool) and vectorize) or (can_submit and not vectorize):
        return
    raise ValueError(
        "asynchronous=True needs points that can be submitted one by one: pass a posterior that has the method "
        "evaluation_queue (Posterior of fe_likelihoods, with its own pool) and vectorize=True, or a function of one "
        "point and a pool with the method submit (an executor of concurrent.futures, mpi4py or loky, a dask client); "
        f"got {type(function).__name__}, pool={type(pool).__name__}, vectorize={vectorize}"
    )


def open_queue(
    function: Callable, captured: Callable, as_items: Callable, queue: Callable[[], Any] | None, pool: Any
) -> Any:
    """The queue of a posterior or of a pool (`samplers.evaluation.asynchronous.EvaluationQueue`).

    `captured` is the user's `function`, but returns `Failed` instead of raising; `as_items` converts points (n, ndim)
    to its arguments; `queue` opens the queue of a posterior in place of its method ``evaluation_queue``.
    """
    if _has_queue(function, pool):
        return function.evaluation_queue() if queue is None else queue()
    if pool is None:
        raise ValueError("this sampler was begun with a pool, which is not stored with it: set its attribute pool")
    return PoolQueue(captured, pool, as_items)


def pool_size(pool: Any) -> int | None:
    """Number of workers in a pool, if the pool states it."""
    threads = getattr(pool, "nthreads", None)  # of a dask client
    if callable(threads):
        return sum(threads().values()) or None
    sizes = (getattr(pool, name, None) for name in SIZES)
    return next((size for size in sizes if isinstance(size, int) and size > 0), None)


def advise_on_pool(pool: Any) -> None:
    """Warn in the log about a dask client whose workers are jobs of a queueing system: ended jobs are not replaced."""
    if hasattr(pool, "gather") and hasattr(getattr(pool, "cluster", None), "job_script"):
        logger.warning(
            "nobody may replace the jobs of this dask client when they end, as by their walltime, and the run would "
            "wait for workers for ever: pass pool=fe_likelihoods.DaskExecutor(client), which replaces them"
        )


def map_in(pool: Any) -> Callable:
    """``pool.map``, or Python's ``map`` without a pool; the futures of a dask client are gathered."""
    if pool is None:
        return map
    if not hasattr(pool, "gather"):
        return pool.map
    return lambda function, items: pool.gather(pool.map(function, list(items), pure=False))


class PoolQueue:
    """A function of one point in a pool (`samplers.evaluation.asynchronous.EvaluationQueue`).

    The function can be sent to the workers, and returns `Failed` instead of raising; `as_items` converts points (n,
    ndim) to its arguments. The pool is a `concurrent.futures.Executor`, as those of mpi4py and loky are, or a client of
    dask.
    """

    def __init__(self, function: Callable, pool: Any, as_items: Callable[[Any], Sequence]):
        self._function, self._pool, self._as_items = SentFunction(function), pool, as_items
        self._futures: dict[int, Any] = {}  # of points that were not collected
        self._ended: dict[int, None] = {}  # tickets in the order of completion
        self._handed: list[int] = []  # what the last `collect` returned: the caller may not have received it
        self._arrived = threading.Event()
        self._submitted = 0

    @property
    def workers(self) -> int | None:
        """Number of points that are evaluated at once, if the pool states it."""
        return pool_size(self._pool)

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
            future.add_done_callback(partial(self._enter, ticket))
        return tickets

    def _enter(self, ticket: int, _: Any) -> None:
        self._ended[ticket] = None
        self._arrived.set()

    @interrupts_end_the_run()
    def collect(self) -> list[tuple[int, Any]]:
        """Wait for a finished point; returns numbers and values of all finished points, in the order of completion.

        Raises KeyboardInterrupt or SystemExit if the function has raised it, and RuntimeError if no point is running or
        the pool cannot continue. Points that finished before are returned first.
        """
        for ticket in self._handed:
            self._ended.pop(ticket, None)  # first: `ended` may be called if Ctrl-C comes between the two
            self._futures.pop(ticket, None)
        self._handed = []
        if not self._futures:
            raise RuntimeError("no point is being evaluated: submit some before they are collected")
        while not self._ended:
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
        for ticket in list(self._ended):
            future, value = self._futures[ticket], None
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
