"""A queue of evaluations in a pool: points go out one by one, and their values come back as they are finished."""

from collections.abc import Callable, Sequence
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any

from .returned_values import Failed

__all__ = ["PoolQueue", "can_submit", "map_in", "pool_size"]

# Names under which pools have the number of their workers.
SIZES = ("n_workers", "_max_workers", "_processes", "size")


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


def map_in(pool: Any) -> Callable:
    """``map`` of a pool, whose results are values: those of a dask client are gathered; without a pool Python's."""
    if pool is None:
        return map
    if not hasattr(pool, "gather"):
        return pool.map
    return lambda function, items: pool.gather(pool.map(function, list(items), pure=False))


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
        self._finished: SimpleQueue = SimpleQueue()
        self._futures: dict[int, Any] = {}
        self._submitted = 0

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
            futures = [self._pool.submit(self._function, item) for item in items]
        else:
            for ticket, item in zip(tickets, items, strict=True):
                self._futures[ticket] = None
                done, failed = partial(self._enter, ticket, None), partial(self._enter, ticket)
                self._pool.apply_async(self._function, (item,), callback=done, error_callback=failed)
            return tickets
        self._futures.update(zip(tickets, futures, strict=True))
        for ticket, future in zip(tickets, futures, strict=True):
            future.add_done_callback(partial(self._enter_future, ticket))
        return tickets

    def _enter(self, ticket: int, error: BaseException | None, value: Any = None) -> None:
        self._finished.put((ticket, error, value))

    def _enter_future(self, ticket: int, _: Any) -> None:
        self._finished.put((ticket, None, None))

    def collect(self) -> list[tuple[int, Any]]:
        """Wait until a point is finished; returns numbers and values of all that are, in the order of completion.

        Raises
        ------
        RuntimeError
            If no point is running, or the pool cannot go on.
        """
        if not self._futures:
            raise RuntimeError("no point is being evaluated: submit some before they are collected")
        finished = [self._finished.get()]
        while True:
            try:
                finished.append(self._finished.get_nowait())
            except Empty:
                break
        return [(ticket, self._value(self._futures.pop(ticket), error, value)) for ticket, error, value in finished]

    @staticmethod
    def _value(future: Any, error: BaseException | None, value: Any) -> Any:
        """What the function returned; `Failed` where every worker that evaluated a point died."""
        if future is not None:
            error = future.exception()
            value = None if error is not None else future.result()
        if error is None:
            return value
        if type(error).__name__ == "KilledWorker":
            return Failed("every process that evaluated this point died")
        raise RuntimeError(
            f"the pool cannot go on: {type(error).__name__}: {error}. Evaluations that have arrived are kept where the "
            "sampler has a file: start the same script again with a new pool"
        ) from error

    def close(self) -> None:
        """Cancel the points that have not been started."""
        futures, self._futures = list(self._futures.values()), {}
        for future in futures:
            if future is not None:
                future.cancel()
