"""Executors: the same ``map`` and ``submit`` for all pools, which run simulations in other processes or machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: a `LocalPool` of that many processes.
* any other object with ``map``: ``list(pool.map(function, items))``, and for single items ``submit`` if it has that.
  This covers the executors of concurrent.futures, loky and mpi4py.futures, the pools of multiprocessing and schwimmbad,
  and clients of dask.distributed, whose futures are used as they are.

The function (model and measurements) is sent by value (`fe_likelihoods.simulation.by_value`): by a `LocalPool` to each
worker once, and again when anything that it uses has changed; by other pools with each item. Workers load it once.
``submit(function, item)`` returns a future; `result_of` gives what ``map`` would return, even if the item kills every
process that runs it. A pool that only has ``map`` cannot submit items: its attribute ``submits`` is False. Results do
not depend on the pool, to the last bit.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache, cached_property, partial
from multiprocessing.pool import Pool, ThreadPool
from typing import Any

from samplers.evaluation.point_queue import workers_of
from samplers.interrupts import SentFunction

from .by_value import Pickled
from .local_pool import LocalPool, Outcome, Submitting, value_of

__all__ = ["LocalPool", "PoolExecutor", "as_executor"]


def as_executor(pool: Any, model: Any = None) -> "LocalPool | PoolExecutor | None":
    """Executor for a pool, by the rule above; None for None.

    Its ``map(function, items)`` returns a list. The functions must return an `Outcome`, also given for an item that
    kills every process that runs it, if the pool survives. ValueError if `pool` is of no such kind, or its workers are
    other processes and the model cannot be sent to them.
    """
    if pool is None or isinstance(pool, LocalPool | PoolExecutor):
        executor = pool
    else:
        executor = PoolExecutor(pool) if hasattr(pool, "map") else LocalPool(pool)
    if executor is not None and executor.other_processes:
        Pickled.of(model)
    return executor


class PoolExecutor(Submitting):
    """Executor for any object with ``map(function, items)``.

    A `multiprocessing.Pool` replaces a process that dies but does not run its item again, so the call never returns.
    Use a `LocalPool` if simulations may crash. Dask runs the items of a worker that dies on other workers, and gives
    up an item after several deaths (``distributed.scheduler.allowed-failures``); see `result_of`.
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool
        self._is_dask = hasattr(pool, "gather")

    @property
    def other_processes(self) -> bool:
        """Whether the pool is known to run its work in other processes."""
        is_known = isinstance(self.pool, Executor | Pool) and not isinstance(self.pool, ThreadPoolExecutor | ThreadPool)
        return is_known or self._is_dask

    @property
    def submits(self) -> bool:
        """Whether the pool can run single items: it has ``submit``."""
        return hasattr(self.pool, "submit")

    @property
    def n_workers(self) -> int | None:
        """Number of items that run at once; None if the pool does not say."""
        return workers_of(self.pool)

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """Outcomes of a function for every item, in order; ValueError if a worker cannot load the function."""
        if self.submits:
            return super().map(function, items)
        return [value_of(outcome) for outcome in self.pool.map(self._by_value(function), list(items))]

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the pool only has ``map``."""
        if not self.submits:
            raise ValueError(
                f"{type(self.pool).__name__} has map and no submit: its items cannot be submitted one by one; use map"
            )
        sent = self._by_value(function)
        if self._is_dask:  # which sends the function once
            return self.pool.map(partial(_run, sent), list(items), pure=False) if len(items) else []
        return [self.pool.submit(sent, item) for item in items]

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items that the pool has not started."""
        for future in futures:
            future.cancel()

    def _by_value(self, function: Callable) -> SentFunction:
        """The function as it is sent to workers, pickled now if they are known to be other processes."""
        by_value = _ByValue(function)
        if self.other_processes:
            by_value.pickled  # noqa: B018
        return SentFunction(by_value)


class _ByValue:
    """A function that is sent to other processes by value, in its state when it is first pickled."""

    def __init__(self, function: Callable) -> None:
        self._function = function

    @cached_property
    def pickled(self) -> Pickled:
        return Pickled.of(self._function)

    def __call__(self, item: Any) -> Any:
        return self._function(item)

    def __reduce__(self) -> tuple:
        return Pickled, tuple(self.pickled)


def _run(function: Callable, item: Any) -> Any:
    """Result of an item, in a worker of dask."""
    _wait_for_nanny()
    return function(item)


@cache
def _wait_for_nanny() -> None:
    """Wait once per process: dask does not replace a worker that dies before its start is reported."""
    time.sleep(0.5)
