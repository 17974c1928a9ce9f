"""Executor for the cluster of a ``dask.distributed.Client``, for work on several machines."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future
from concurrent.futures import wait as wait_for
from functools import cache, partial
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from .dask_workers import WorkerWatch
from .faults import TransientReason
from .local_pool import Outcome
from .pool_executor import PoolExecutor, resolve
from .sent_functions import FunctionReference, Missing

__all__ = ["DaskExecutor", "wait_for_nanny"]

logger = logging.getLogger(__name__)

MAX_ATTEMPTS = 3  # attempts of dask, each of which ends with the death of a number of workers
SECONDS_FOR_MESSAGES = 0.2  # within which dask reports all tasks that it has given up with a worker
_DIED = TransientReason("the worker process died in every attempt of dask")


class _Item(Future):
    """Future of one item, with the function."""

    def __init__(self, item: Any, reference: FunctionReference) -> None:
        super().__init__()
        self.item, self.reference, self.carried = item, reference, False
        self.deaths = 0  # attempts of dask that ended with the death of the worker

    @property
    def function(self) -> Callable:
        return self.reference.carried() if self.carried else self.reference


class _Group:
    """Items that are one task of dask."""

    def __init__(self, items: list[_Item], losses_before: int) -> None:
        self.items, self.losses_before = items, losses_before
        self.inner: Any = None  # dask's future


class _Answer(NamedTuple):
    """Outcomes of a group of items, and their total duration [s]."""

    outcomes: list
    seconds: float


class DaskExecutor(PoolExecutor):
    """Executor for the cluster of a ``dask.distributed.Client``.

    A task costs dask about 2 ms of all processors, so short simulations are sent in groups. The groups are large at
    first and single items at last, so that the workers finish together. No group takes longer than about a second, by
    the duration of earlier simulations, so that little is repeated if a worker dies. dask retries a group whose worker
    died, and gives up after a number of times (``distributed.scheduler.allowed-failures``). It counts the death also
    against other tasks on that worker, and a job that ends at its walltime kills all of its workers, on which one task
    may be tried in turn. So the items of a group are run again, alone and one after the other, beside those that are
    not suspected. An item is the cause, and gets ``(None, reason)``, if dask gives it up when it runs alone and has
    given up no other task meanwhile, or after the third time. Workers that the cluster has given up are started again,
    and nothing waits for ever (`WorkerWatch`).

    Parameters
    ----------
    pool : dask.distributed.Client
    resources : dict of str to float, optional
        What one simulation takes of the resources that workers were started with, such as ``{"GPU": 1}``.
    longest_wait : float, optional
        How long simulations wait for a cluster without workers before the run ends with an error [s]; one hour by
        default. More is needed where jobs wait in the queue of the machine for longer.

    Raises
    ------
    ValueError
        If `longest_wait` or an amount of `resources` is not positive.
    """

    other_processes = True
    submits = True

    def __init__(
        self, pool: Any, resources: Mapping[str, float] | None = None, longest_wait: float | None = None
    ) -> None:
        super().__init__(pool)
        self.resources = dict(resources or {})
        if longest_wait is not None and not longest_wait > 0:
            raise ValueError(f"longest_wait must be a positive number of seconds, or None; got {longest_wait!r}")
        self._options = {"resources": self.resources} if resources else {}
        if any(not amount > 0 for amount in self.resources.values()):
            raise ValueError(f"resources must be positive amounts by name, such as {{'GPU': 1}}; got {resources}")
        self._seconds: float | None = None  # mean duration of an item in the last map or stream
        self._total, self._done = 0.0, 0
        self._lock = threading.RLock()
        self._sent: set[_Group] = set()
        self._ended: SimpleQueue[_Group | None] = SimpleQueue()  # of which dask has reported the end
        self._suspects: deque[_Item] = deque()
        self._suspect: _Group | None = None  # the one that runs
        self._losses = 0  # tasks that dask has given up
        self._watch = WorkerWatch(self.pool, lambda: [group.inner for group in self._sent], longest_wait)

    @property
    def n_workers(self) -> int | None:
        """Number of simulations that run at once on the workers that the cluster has at present."""
        if self.resources:
            return self.pool.run_on_scheduler(_places, self.resources) or None
        return sum(self.pool.nthreads().values()) or None

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """As `PoolExecutor.map`."""
        futures = self._enqueue(self._reference(function), list(items))
        try:
            for future in wait_for(futures, return_when=FIRST_EXCEPTION).done:
                future.result()
            return [future.result() for future in futures]
        except BaseException:
            self.give_up(futures)
            raise

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """As `PoolExecutor.submit_all`; short simulations of one call may be one task."""
        return self._enqueue(self._reference(function), items)

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also those that a worker has received."""
        with self._lock:
            wanted = set(futures)
            at_work = set() if running else {key for keys in self.pool.processing().values() for key in keys}
            self._suspects = deque(item for item in self._suspects if item not in wanted)
            groups = [
                group
                for group in self._sent
                if wanted.issuperset(group.items) and getattr(group.inner, "key", None) not in at_work
            ]
            left = {item for group in self._sent for item in group.items}
            self._forget(groups)
        if groups:
            self.pool.cancel([group.inner for group in groups])
        cancelled = {item for group in groups for item in group.items}
        for future in futures:
            if future in cancelled or future not in left:
                future.cancel()

    # sending ------------------------------------------------------------------------------------------------------

    def _enqueue(self, reference: FunctionReference, items: Sequence[Any]) -> list[_Item]:
        futures = [_Item(item, reference) for item in items]
        if not futures:
            return futures
        n_workers = self.n_workers if len(items) > 1 or not self._sent else 1
        if not n_workers:
            logger.warning(
                "The dask cluster has no worker; %d simulations wait for one. Start workers or scale the cluster",
                len(items),
            )
        with self._lock:
            if self._done:
                self._seconds = self._total / self._done
            if not self._sent:
                self._total, self._done = 0.0, 0
            largest = 1 if self._seconds is None else int(1.0 / max(self._seconds, 1e-3))
            self._send(_groups(futures, n_workers or 1, largest))
        return futures

    def _send(self, groups: list[list[_Item]]) -> list[_Group]:
        """Send groups of items with the same function; the lock is held."""
        sent = [_Group(items, self._losses) for items in groups]
        if not self._sent:
            self._watch.start()
            self._ended = SimpleQueue()
            # not in the threads of dask, for which Python waits at its end: a lost scheduler sends no result
            threading.Thread(target=self._receive_all, args=(self._ended,), name="results of dask", daemon=True).start()
        self._sent.update(sent)
        function = partial(_run_group, groups[0][0].function)
        try:
            contents = [[item.item for item in items] for items in groups]
            inner = self.pool.map(function, contents, pure=False, **self._options)
        except BaseException:
            self._forget(sent)
            raise
        for group, future in zip(sent, inner, strict=True):
            group.inner = future
        for group in sent:
            group.inner.add_done_callback(partial(self._report, self._ended, group))
        return sent

    def _forget(self, groups: Iterable[_Group]) -> None:
        """Groups have ended; the lock is held."""
        self._sent.difference_update(groups)
        if self._suspect is not None and self._suspect not in self._sent:
            self._suspect = None
        if not self._sent:
            self._watch.stop()
            self._ended.put(None)

    # receiving, in a thread of its own ----------------------------------------------------------------------------

    @staticmethod
    def _report(queue: "SimpleQueue[_Group | None]", group: _Group, inner: Any) -> None:
        """Pass on that a group has ended; in a thread of dask."""
        queue.put(group)

    def _receive_all(self, queue: "SimpleQueue[_Group | None]") -> None:
        """Receive groups as they end, until none is left."""
        while (group := queue.get()) is not None:
            ended = [group]
            with contextlib.suppress(Empty):
                while (group := queue.get_nowait()) is not None:
                    ended.append(group)
            self._receive_groups(ended)
            if group is None:
                return

    def _receive_groups(self, ended: list[_Group]) -> None:
        finished = [group for group in ended if group.inner.status == "finished"]
        try:
            answers = self.pool.gather([group.inner for group in finished]) if finished else []
        except Exception:  # a worker was lost with its results: dask has repeated them, with another end
            answers = [None] * len(finished)
        known = dict(zip(finished, answers, strict=True))
        for group in ended:
            if group in self._sent:
                self._receive(group, known.get(group))

    def _receive(self, group: _Group, answer: _Answer | None) -> None:
        try:
            answer = group.inner.result() if answer is None else answer
        except BaseException as error:
            with self._lock:
                gave_up = self._watch.gave_up
                if type(error).__name__ == "KilledWorker":
                    self._lose(group)
                    return
                self._forget([group])
                self._try_next_suspect()
            if gave_up:
                error = self._watch.error
            elif not isinstance(error, Exception) or type(error).__name__ == "FutureCancelledError":
                error = RuntimeError(f"dask has cancelled a simulation ({error}); run again with a new client")
            for item in group.items:
                resolve(item, error=error)
            return
        with self._lock:
            self._forget([group])
            self._total, self._done = self._total + answer.seconds, self._done + len(answer.outcomes)
            missing = [
                item for item, outcome in zip(group.items, answer.outcomes, strict=True) if _again(item, outcome)
            ]
            if missing:
                for item in missing:
                    item.carried = True
                self._send([[item] for item in missing])
            self._try_next_suspect()
        for item, outcome in zip(group.items, answer.outcomes, strict=True):
            if item not in missing:
                resolve(item, outcome)

    def _lose(self, group: _Group) -> None:
        """Give up the item of a task whose worker died in every attempt, or suspect the items."""
        time.sleep(SECONDS_FOR_MESSAGES)
        others = self._losses > group.losses_before or any(
            other is not group and other.inner is not None and other.inner.status == "error" for other in self._sent
        )
        self._losses += 1
        for item in group.items:
            item.deaths += 1
            if item.deaths == MAX_ATTEMPTS or (item.deaths > 1 and not others):
                resolve(item, (None, _DIED))
            else:
                self._suspects.append(item)
        self._forget([group])
        self._try_next_suspect()

    def _try_next_suspect(self) -> None:
        while self._suspect is None and self._suspects:
            item = self._suspects.popleft()
            if not item.cancelled():
                (self._suspect,) = self._send([[item]])


def _places(resources: dict[str, float], dask_scheduler: Any) -> int:
    """Number of simulations that fit on the workers; called in the scheduler."""
    return sum(
        min(worker.nthreads, *(int(worker.resources.get(name, 0.0) // amount) for name, amount in resources.items()))
        for worker in dask_scheduler.workers.values()
    )


def _again(item: _Item, outcome: Any) -> bool:
    """Whether an item has to be sent again, together with the function."""
    return isinstance(outcome, Missing) and not item.carried and not item.cancelled()


def _run_group(function: Callable, items: list) -> _Answer:
    """Run the items of a group one after the other; called in the worker."""
    wait_for_nanny()
    start = time.perf_counter()
    return _Answer([function(item) for item in items], time.perf_counter() - start)


@cache
def wait_for_nanny() -> None:
    """Wait once per process, because dask's nanny does not replace a worker that dies before its start is reported.

    An item that kills every new worker at once would otherwise leave a cluster without workers, and the run would hang.
    """
    time.sleep(0.5)


def _groups(items: list, n_workers: int, largest: int) -> list[list]:
    """Groups of items: each is half of a worker's share of the remaining items, at least one and at most `largest`."""
    groups, start = [], 0
    while start < len(items):
        size = min(max(1, (len(items) - start) // (2 * n_workers)), max(1, largest))
        groups.append(items[start : start + size])
        start += size
    return groups
