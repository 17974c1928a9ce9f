"""Executor for the cluster of a ``dask.distributed.Client``, for work on several machines."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cache, partial
from typing import Any

from .faults import TransientReason
from .local_pool import Outcome
from .pool_executor import PoolExecutor

__all__ = ["DaskExecutor", "wait_for_nanny"]

logger = logging.getLogger(__name__)

_DIED = TransientReason("the worker process died in every attempt of dask")


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
