"""Executors: the same ``map`` and ``submit`` for all pools, which run simulations in other processes or machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: a `LocalPool` of that many processes.
* an object with ``gather`` (a client of dask.distributed): ``map(function, items, pure=False)``.
* any other object with ``map``: ``list(pool.map(function, items))``, and for single items ``submit`` if it has that.
  This covers the executors of concurrent.futures, loky and mpi4py.futures and the pools of
  multiprocessing and schwimmbad.

The function (model and measurements) is sent by value (`fe_likelihoods.simulation.by_value`): by a `LocalPool` to each
worker once, and again when anything that it uses has changed; by other pools with each item. Workers load it once.
``submit(function, item)`` returns a `Future` with the result that ``map`` would return, even if the item kills every
process that runs it. A pool that only has ``map`` cannot submit items: its attribute ``submits`` is False. Results do
not depend on the pool, to the last bit.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache, cached_property, partial
from multiprocessing.pool import Pool, ThreadPool
from typing import Any

from samplers.evaluation.point_queue import workers_of
from samplers.interrupts import SentFunction

from .by_value import Pickled
from .faults import TransientReason
from .local_pool import LocalPool, Outcome, Submitting, value_of

__all__ = ["DaskExecutor", "LocalPool", "PoolExecutor", "as_executor"]

logger = logging.getLogger(__name__)

_DIED = TransientReason("the worker process died in every attempt of dask")


def as_executor(pool: Any, model: Any = None) -> "LocalPool | DaskExecutor | PoolExecutor | None":
    """Executor for a pool, by the rule above; None for None.

    Its ``map(function, items)`` returns a list. The functions must return an `Outcome`, also given for an item that
    kills every process that runs it, if the pool survives. ValueError if `pool` is of no such kind, or its workers are
    other processes and the model cannot be sent to them.
    """
    if pool is None or isinstance(pool, LocalPool | PoolExecutor):
        executor = pool
    elif hasattr(pool, "gather") and hasattr(pool, "map"):
        executor = DaskExecutor(pool)
    elif hasattr(pool, "map"):
        executor = PoolExecutor(pool)
    else:
        executor = LocalPool(pool)
    if executor is not None and executor.other_processes:
        Pickled.of(model)
    return executor


class PoolExecutor(Submitting):
    """Executor for any object with ``map(function, items)``.

    A `multiprocessing.Pool` replaces a process that dies but does not run its item again, so the call never returns.
    Use a `LocalPool` if simulations may crash.
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool

    @property
    def other_processes(self) -> bool:
        """Whether the pool is known to run its work in other processes."""
        return isinstance(self.pool, Executor | Pool) and not isinstance(self.pool, ThreadPoolExecutor | ThreadPool)

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
        sent, futures = self._by_value(function), []
        try:
            for item in items:
                futures.append(self.pool.submit(sent, item))
        except BaseException:
            self.give_up(futures)
            raise
        return futures

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


class DaskExecutor(PoolExecutor):
    """Executor for the cluster of a ``dask.distributed.Client``; ``pool=client`` makes one.

    If a worker dies, dask runs its tasks on other workers, and gives up a task after several deaths
    (``distributed.scheduler.allowed-failures``), whichever task on the worker caused them. So an item that was given up
    is sent once more, apart from the others that were given up. If it is given up again it is the cause, and gets
    ``(None, reason)``. Workers are the cluster's own: ``cluster.adapt(minimum=..., maximum=...)`` replaces lost ones,
    and items wait as long as there is none.

    Parameters
    ----------
    pool : dask.distributed.Client

    Examples
    --------
    The number of workers and cores is chosen on the cluster: see ``docs/clusters.rst``.

    >>> from distributed import Client
    >>> with Client(processes=False, n_workers=1, dashboard_address=":0") as client:
    ...     executor = DaskExecutor(client)
    ...     print(list(executor.map(abs, [-1, 2])))
    [1, 2]
    """

    other_processes = True
    submits = True

    def __init__(self, pool: Any) -> None:
        super().__init__(pool)
        self._tasks: dict[Future, Any] = {}  # dask's future of each item that has not ended
        self._alone = threading.Lock()

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """As `PoolExecutor.submit_all`."""
        if not items:
            return []
        if not self._tasks and not self.n_workers:
            text = "The dask cluster has no worker; %d simulations wait for one. Start workers or scale the cluster"
            logger.warning(text, len(items))
        function = partial(_run, self._by_value(function))
        futures, tasks = [Future() for _ in items], self.pool.map(function, list(items), pure=False)
        self._tasks |= zip(futures, tasks, strict=True)
        # not a thread of dask or a pool, for which Python waits at its end: for ever if the scheduler is lost
        arguments = function, dict(zip(tasks, zip(futures, items, strict=True), strict=True))
        threading.Thread(target=self._receive, args=arguments, name="dask", daemon=True).start()
        return futures

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also those that a worker has received."""
        at_work = set() if running else {key for keys in self.pool.processing().values() for key in keys}
        tasks = {future: self._tasks.get(future) for future in futures if not future.done()}
        given_up = {future: task for future, task in tasks.items() if task is None or task.key not in at_work}
        for future in given_up:
            future.cancel()
        if tasks := [task for task in given_up.values() if task is not None]:
            self.pool.cancel(tasks)

    def _receive(self, function: Callable, items: dict[Any, tuple[Future, Any]]) -> None:
        """Pass on the results of items, by dask's futures, as they arrive, in a thread."""
        from distributed import as_completed

        lost = []
        try:
            for task, result in as_completed(list(items), with_results=True, raise_errors=False):
                if not _is_lost(task, result):
                    self._end(items.pop(task)[0], task, result)
                else:
                    lost.append(items.pop(task))
            while lost:
                (future, item), *lost = lost
                with self._alone:
                    (task,) = self.pool.map(function, [item], pure=False)
                    self._tasks[future] = task
                    ((_, result),) = as_completed([task], with_results=True, raise_errors=False)
                self._end(future, task, result, (None, _DIED) if _is_lost(task, result) else None)
        finally:
            for future, _ in [*items.values(), *lost]:
                self._end(future, None, None)

    def _end(self, future: Future, task: Any, result: Any, outcome: Outcome | None = None) -> None:
        """Set the result of an item, or its error; neither if it was cancelled."""
        self._tasks.pop(future, None)
        if not future.set_running_or_notify_cancel():
            return
        status = getattr(task, "status", "lost")
        if outcome is not None or status == "finished":
            future.set_result(result if outcome is None else outcome)
        elif status == "error" and isinstance(result[1], Exception):
            future.set_exception(result[1])
        else:
            future.set_exception(RuntimeError("dask has cancelled a simulation; run again with a new client"))


def _is_lost(task: Any, result: Any) -> bool:
    """Whether dask has given up a task because workers died."""
    return task.status == "error" and type(result[1]).__name__ == "KilledWorker"


def _run(function: Callable, item: Any) -> Any:
    """Outcome of an item; called in the worker."""
    wait_for_nanny()
    return function(item)


@cache
def wait_for_nanny() -> None:
    """Wait once per process, because dask's nanny does not replace a worker that dies before its start is reported.

    Without this wait, an item that kills every new worker at once could leave a cluster without workers.
    """
    time.sleep(0.5)
