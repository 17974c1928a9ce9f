"""Pools of any library: those with ``map``, executors with ``submit``, and dask clients with ``gather``."""

from collections.abc import Callable, Sequence
from typing import Any

from ..interrupts import SentFunction

CLOSED = "the pool was closed, or has cancelled a point, during the run: run again with an open pool"
SIZES = ("n_workers", "_max_workers", "_processes", "size")  # attributes of pools with the number of workers


def map_in(pool: Any) -> Callable:
    """``pool.map``, or Python's ``map`` without a pool; the futures of a dask client are gathered."""
    if pool is None:
        return map
    if not hasattr(pool, "gather"):
        return pool.map
    return lambda function, items: pool.gather(pool.map(function, list(items), pure=False))


def submit_all(pool: Any, function: Callable, items: Sequence[Any]) -> list[Any]:
    """A future for each item, of an executor as in `concurrent.futures`, mpi4py and loky, or of a dask client."""
    sent = SentFunction(function)
    if hasattr(pool, "gather"):  # dask sends the function once with all points
        return pool.map(sent, list(items), pure=False)
    futures: list[Any] = []
    try:
        futures.extend(pool.submit(sent, item) for item in items)
    finally:
        for future in futures if len(futures) < len(items) else ():  # Ctrl-C: nobody else knows these
            future.cancel()
    return futures


def was_cancelled(error: BaseException | None) -> bool:
    """Whether a future was cancelled: `concurrent.futures`, asyncio and dask have a class each."""
    return type(error).__name__.endswith("CancelledError")


def workers_of(pool: Any) -> int | None:
    """Number of items that a pool runs at once; None if it does not say."""
    threads = getattr(pool, "nthreads", None)  # of a dask client
    if callable(threads):
        return sum(threads().values()) or None
    sizes = (getattr(pool, name, None) for name in SIZES)
    return next((size for size in sizes if isinstance(size, int) and size > 0), None)
