"""A queue of evaluations in a pool: points go out one by one, and their values come back as they are finished."""

import logging
import threading
from asyncio import CancelledError
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from .pool_workers import PoolWorkers
from .returned_values import Failed

__all__ = ["PoolQueue", "advise_on_pool", "can_submit", "map_in", "pool_size"]

logger = logging.getLogger(__name__)

# Names under which pools have the number of their workers.
SIZES = ("n_workers", "_max_workers", "_processes", "size")
SECONDS_BETWEEN_CHECKS = 1.0  # of the processes of a multiprocessing.Pool
SECONDS_TO_FETCH = 10.0  # of the value of a point that has ended, after which the run is not held up any longer


def can_submit(pool: Any) -> bool:
    """Whether a pool takes single points: executors of `concurrent.futures`, of mpi4py, dask clients, `Pool`."""
    return callable(getattr(pool, "submit", None)) or callable(getattr(pool, "apply_async", None))


def pool_size(pool: Any) -> int | None:
    """Number of workers of a pool, if it says so."""
    threads = getattr(pool, "nthreads", None)  # of a dask client
    if callable(threads):
        return sum(threads().values()) or None
    sizes = (getattr(pool, name, None) for name in SIZES)
    return next((size for size in sizes if isinstance(size, int) and size > 0), None)


def advise_on_pool(pool: Any) -> None:
    """Warn in the log of a dask client whose workers are jobs of a queueing system: nobody replaces them."""
    if hasattr(pool, "gather") and hasattr(getattr(pool, "cluster", None), "job_script"):
        logger.warning(
            "nobody may replace the jobs of this dask client when they end, as by their walltime, and the run would "
            "wait for workers for ever: pass pool=fe_likelihoods.DaskExecutor(client), which replaces them"
        )


def map_in(pool: Any) -> Callable:
    """``map`` of a pool, whose results are values: those of a dask client are gathered; without a pool Python's."""
    if pool is None:
        return map
    if not hasattr(pool, "gather"):
        workers = PoolWorkers(pool)
        return partial(_watched_map, pool, workers) if workers.are_watched else pool.map
    return lambda function, items: pool.gather(pool.map(function, list(items), pure=False))


def _watched_map(pool: Any, workers: PoolWorkers, function: Callable, items: Sequence) -> list:
    """``map`` of a `multiprocessing.Pool`, which would wait for ever for the item of a process that dies."""
    result = pool.map_async(function, items)
    while not result.ready():
        result.wait(SECONDS_BETWEEN_CHECKS)
        if not result.ready():
            workers.check()
    return result.get()


class PoolQueue:
    """A function of one point in a pool (`samplers.storage.asynchronous.EvaluationQueue`).

    Parameters
    ----------
    function : callable
        Function of a point, which can be sent to the workers and returns `Failed` instead of raising.
    pool : concurrent.futures.Executor, mpi4py.futures.MPIPoolExecutor, dask.distributed.Client or multiprocessing.Pool
        The pool.
    as_items : callable
        Turns points (n, ndim) into a sequence of what the function takes.
    """

    def __init__(self, function: Callable, pool: Any, as_items: Callable[[Any], Sequence]):
        self._function, self._pool, self._as_items = function, pool, as_items
        self._futures: dict[int, Any] = {}  # of points that were not collected
        self._ended: dict[int, tuple[BaseException | None, Any]] = {}  # error and value; those of a future are fetched
        self._handed: list[int] = []  # what the last `collect` returned: the caller may not have received it
        self._arrived = threading.Event()
        self._submitted = 0
        self._pool_workers = PoolWorkers(pool)

    @property
    def workers(self) -> int | None:
        """Number of points that are evaluated at once, if the pool says so."""
        return pool_size(self._pool)

    def submit(self, coords: Any) -> list[int]:
        """Begin to evaluate points (n, ndim) without waiting; returns a number for each."""
        items = self._as_items(coords)
        tickets = list(range(self._submitted, self._submitted + len(items)))
        self._submitted += len(items)
        if hasattr(self._pool, "gather"):  # dask sends the function once with all points
            futures = self._pool.map(self._function, items, pure=False)
        elif hasattr(self._pool, "submit"):
            futures = (self._pool.submit(self._function, item) for item in items)
        else:
            for ticket, item in zip(tickets, items, strict=True):
                self._futures[ticket] = None
                done, failed = partial(self._enter, ticket, None), partial(self._enter, ticket)
                self._pool.apply_async(self._function, (item,), callback=done, error_callback=failed)
            return tickets
        for ticket, future in zip(tickets, futures, strict=True):
            self._futures[ticket] = future
            future.add_done_callback(partial(self._enter_future, ticket))
        return tickets

    def _enter(self, ticket: int, error: BaseException | None, value: Any = None) -> None:
        self._ended[ticket] = error, value
        self._arrived.set()

    def _enter_future(self, ticket: int, _: Any) -> None:
        self._enter(ticket, None)

    def collect(self) -> list[tuple[int, Any]]:
        """Wait until a point is finished; returns numbers and values of all that are, in the order of completion.

        Raises
        ------
        RuntimeError
            If no point is running, or the pool cannot go on. Points that were finished before are returned first.
        """
        for ticket in self._handed:
            self._ended.pop(ticket, None)  # first: `ended` may be called if Ctrl-C comes between the two
            self._futures.pop(ticket, None)
        self._handed = []
        if not self._futures:
            raise RuntimeError("no point is being evaluated: submit some before they are collected")
        while not self._ended:
            self._arrived.wait(SECONDS_BETWEEN_CHECKS if self._pool_workers.are_watched else None)
            self._arrived.clear()
            if not self._ended:
                self._pool_workers.check()
        collected, error = self._fetch()
        if not collected:
            raise RuntimeError(
                f"the pool cannot go on: {type(error).__name__}: {error}. Evaluations that have arrived are kept where "
                "the sampler has a file: start the same script again with a new pool"
            ) from error
        self._handed = [ticket for ticket, _ in collected]
        return collected

    def ended(self) -> list[tuple[int, Any]]:
        """Numbers and values of the points that have ended, without waiting, also of those last collected."""
        return self._fetch(SECONDS_TO_FETCH)[0]

    def _fetch(self, seconds: float | None = None) -> tuple[list[tuple[int, Any]], BaseException | None]:
        """Numbers and values of the points that have ended, and an error for which no point can be blamed, if any."""
        fetched, fault = [], None
        for ticket in list(self._ended):
            error, value = self._ended[ticket]
            if (future := self._futures[ticket]) is not None:
                try:  # `exception` does not raise what the function raised, which may be KeyboardInterrupt
                    error = future.exception(seconds)
                    value = future.result(seconds) if error is None else None
                except (Exception, CancelledError) as raised:
                    error = raised
                    if seconds is not None and isinstance(raised, TimeoutError):
                        break  # nothing can be fetched from this pool any more
            if type(error).__name__ == "KilledWorker":
                error, value = None, Failed("every process that evaluated this point died")
            if error is None:
                fetched.append((ticket, value))
            else:
                fault = fault or error
        return fetched, fault

    def close(self) -> None:
        """Cancel the points that have not been started."""
        futures, self._futures = [future for future in self._futures.values() if future is not None], {}
        if hasattr(self._pool, "give_up"):  # an executor of fe_likelihoods, whose items are not tasks of their own
            self._pool.give_up(futures, running=False)
            return
        for future in futures:
            future.cancel()
