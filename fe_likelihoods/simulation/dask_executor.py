"""Executor for the cluster of a ``dask.distributed.Client``, for work on several machines."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cache, partial
from queue import Empty, SimpleQueue
from typing import Any

from .faults import TransientReason
from .local_pool import Outcome
from .pool_executor import PoolExecutor

__all__ = ["DaskExecutor", "wait_for_nanny"]

logger = logging.getLogger(__name__)

SECONDS_BETWEEN_CHECKS = 5.0  # of the workers
CHECKS_UNTIL_LOST = 3  # in which a job has no worker: a nanny restarts a worker process within 15 s
LONGEST_WITHOUT_WORKER = 3600.0  # [s] that simulations wait while a cluster has no worker
_NO_WORKERS = (
    "the dask cluster has had no worker for {:g} s: start workers or scale the cluster, or wait longer by "
    "DaskExecutor(client, longest_wait=...), and run again. Evaluations that are stored are not repeated"
)
_DIED = TransientReason("the worker process died in every attempt of dask")


class _Item(Future):
    """Future of one item; `was_lost` says that dask has given it up, because workers died that had received it."""

    def __init__(self, function: Callable, item: Any) -> None:
        super().__init__()
        self.function, self.item, self.was_lost = function, item, False


class DaskExecutor(PoolExecutor):
    """Executor for the cluster of a ``dask.distributed.Client``.

    If a worker dies, dask runs its tasks on other workers, and gives up a task after several deaths
    (``distributed.scheduler.allowed-failures``), whichever task on the worker caused them. So items that were given up
    are run again when nothing else runs, one after the other. An item that is given up again is the cause, and gets
    ``(None, reason)``. Workers that the cluster has given up are started again.

    Parameters
    ----------
    pool : dask.distributed.Client
    longest_wait : float, optional
        How long simulations wait for a cluster without workers before the run ends with an error [s]. Increase it if
        jobs wait longer in the queue of the machine.

    Raises
    ------
    ValueError
        If `longest_wait` is not positive.

    Examples
    --------
    The number of workers and cores is chosen on the cluster: see ``docs/clusters.rst``.

    >>> from distributed import Client
    >>> with Client(processes=False, n_workers=1, dashboard_address=":0") as client:
    ...     executor = DaskExecutor(client, longest_wait=60.0)
    ...     print(list(executor.map(abs, [-1, 2])))
    [1, 2]
    """

    other_processes = True
    submits = True

    def __init__(self, pool: Any, longest_wait: float = LONGEST_WITHOUT_WORKER) -> None:
        super().__init__(pool)
        if not longest_wait > 0:
            raise ValueError(f"longest_wait must be a positive number of seconds; got {longest_wait!r}")
        self._longest_wait = longest_wait
        self._lock = threading.RLock()
        self._sent: dict[Any, _Item] = {}  # by dask's future
        self._lost: deque[_Item] = deque()
        self._ended: SimpleQueue | None = None  # dask's futures that have ended; None while no item is sent
        self._no_workers: RuntimeError | None = None
        self._absent: dict[Any, int] = {}  # checks in which a job that has started had no worker

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """As `PoolExecutor.submit_all`."""
        sent = partial(_run, self._by_value(function))
        futures = [_Item(sent, item) for item in items]
        if not futures:
            return futures
        if not self._sent and not self.n_workers:
            text = "The dask cluster has no worker; %d simulations wait for one. Start workers or scale the cluster"
            logger.warning(text, len(items))
        with self._lock:
            starts = self._ended is None
            self._ended = SimpleQueue() if starts else self._ended
            self._send(futures)
            if starts:
                self._no_workers = None
                # not in dask's threads, which Python joins at exit: it would wait for ever if the scheduler is lost
                for target in (self._receive, self._watch):
                    threading.Thread(target=target, args=(self._ended,), name="dask", daemon=True).start()
        return futures

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also those that a worker has received."""
        wanted = set(futures)
        with self._lock:
            at_work = set() if running else {key for keys in self.pool.processing().values() for key in keys}
            inner = [each for each, item in self._sent.items() if item in wanted and each.key not in at_work]
            for each in inner:
                del self._sent[each]
            wanted -= set(self._sent.values())
            self._lost = deque(item for item in self._lost if item not in wanted)
            if self._ended is not None:
                self._ended.put(None)
        if inner:
            self.pool.cancel(inner)
        for future in wanted:
            future.cancel()

    def _send(self, items: list[_Item]) -> None:
        """Send items with the same function. The lock is held."""
        inner = self.pool.map(items[0].function, [each.item for each in items], pure=False)
        self._sent |= zip(inner, items, strict=True)
        for each in inner:
            each.add_done_callback(self._ended.put)

    # in separate threads ------------------------------------------------------------------------------------------

    def _receive(self, ended: SimpleQueue) -> None:
        """Receive results, several at once if possible, until no item is left."""
        while True:
            with self._lock:
                if not self._sent and self._lost:
                    self._send([self._lost.popleft()])
                if not self._sent:
                    self._ended = None
                    return
            inner = [ended.get()]
            with contextlib.suppress(Empty):
                while True:
                    inner.append(ended.get_nowait())
            finished = [each for each in inner if each is not None and each.status == "finished"]
            results: dict = {}
            with contextlib.suppress(Exception):  # a worker was lost with its results: dask has repeated them
                results = dict(zip(finished, self.pool.gather(finished), strict=True))
            for each in inner:
                with self._lock:
                    item = self._sent.pop(each, None)
                if item is not None:  # else it was given up meanwhile
                    self._receive_one(each, item, results)

    def _receive_one(self, inner: Any, item: _Item, results: dict[Any, Any]) -> None:
        """Pass on an item's result or error."""
        try:
            resolve(item, results[inner] if inner in results else inner.result())
        except BaseException as error:
            if type(error).__name__ == "KilledWorker" and item.was_lost:
                resolve(item, (None, _DIED))
            elif type(error).__name__ == "KilledWorker":
                item.was_lost = True
                self._lost.append(item)
            elif self._no_workers or not isinstance(error, Exception) or type(error).__name__ == "FutureCancelledError":
                text = f"dask has cancelled a simulation ({error}); run again with a new client"
                resolve(item, error=self._no_workers or RuntimeError(text))
            else:
                resolve(item, error=error)

    def _watch(self, ended: SimpleQueue) -> None:
        """Until all items have ended: start lost workers again; cancel all items after too long without workers.

        Apart from `_receive`, which waits for workers where results were lost.
        """
        last_seen = time.monotonic()
        while ended is self._ended:
            with contextlib.suppress(Exception):  # the cluster is closing, or there is no cluster object
                last_seen = time.monotonic() if self.pool.nthreads() else last_seen
                self._start_lost_workers(self.pool.cluster)
            if time.monotonic() - last_seen > self._longest_wait:
                self._no_workers = RuntimeError(_NO_WORKERS.format(self._longest_wait))
                with contextlib.suppress(Exception):
                    self.pool.cancel(list(self._sent), force=True)
                return
            time.sleep(SECONDS_BETWEEN_CHECKS)

    def _start_lost_workers(self, cluster: Any) -> None:
        """Start workers and jobs again that the cluster has lost.

        If a worker is absent 15 s after it was lost (``distributed.deploy.lost-worker-timeout``), dask closes its nanny
        and never starts the worker again, until it is scaled. A dask-jobqueue cluster never notices that a job with
        several workers has ended, for example at its walltime. Queued jobs are left alone.
        """
        wanted = dict(cluster.worker_spec)
        here = {worker["name"] for worker in cluster.scheduler_info["workers"].values()}
        jobs = {name: spec["group"] for name, spec in wanted.items() if "group" in spec}
        running = {name for name, group in jobs.items() if any(f"{name}{suffix}" in here for suffix in group)}
        started = (self._absent.keys() | running) & jobs.keys()
        self._absent = {name: 0 if name in running else self._absent[name] + 1 for name in started}
        if ended := {name for name, checks in self._absent.items() if checks == CHECKS_UNTIL_LOST}:
            cluster.sync(cluster.scale_down, ended)
        cluster.scale(sum(len(spec.get("group", " ")) for spec in wanted.values()))


def resolve(future: Future, result: Any = None, error: BaseException | None = None) -> None:
    """Set the result or the exception of a future, unless it is cancelled."""
    if future.cancelled() or not future.set_running_or_notify_cancel():
        return
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)


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
