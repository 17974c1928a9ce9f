"""Executor for the cluster of a ``dask.distributed.Client``, for work on several machines."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from functools import cache, partial
from queue import Empty, SimpleQueue
from typing import Any

from .faults import TransientReason
from .local_pool import Outcome, results_of
from .pool_executor import PoolExecutor, resolve
from .sent_functions import FunctionReference, Missing

__all__ = ["DaskExecutor", "wait_for_nanny"]

logger = logging.getLogger(__name__)

MAX_ATTEMPTS = 3  # submissions of an item to dask, each of which may cost several workers
SECONDS_FOR_MESSAGES = 0.2  # until dask has reported all tasks that it has given up with a worker
SECONDS_BETWEEN_CHECKS = 5.0  # of the workers
SECONDS_TO_RETURN = 15.0  # until a nanny has restarted a worker process
LONGEST_WITHOUT_WORKER = 3600.0  # [s] that simulations wait while a cluster has no worker
_NO_WORKERS = (
    "the dask cluster has had no worker for {:g} s: start workers or scale the cluster, or wait longer by "
    "DaskExecutor(client, longest_wait=...), and run again. Evaluations that are stored are not repeated"
)
_DIED = TransientReason("the worker process died in every attempt of dask")


class _Item(Future):
    """Future of one item; `deaths` counts the submissions that dask gave up because the workers died."""

    def __init__(self, item: Any, reference: FunctionReference) -> None:
        super().__init__()
        self.item, self.function, self.deaths = item, reference, 0


class DaskExecutor(PoolExecutor):
    """Executor for the cluster of a ``dask.distributed.Client``.

    A task costs dask about 2 ms of processor time, so short simulations are sent in groups of about one second,
    estimated from earlier simulations. The last groups are single items, so that the workers finish together.

    If a worker dies, dask retries its tasks on other workers, and gives up a task after several deaths
    (``distributed.scheduler.allowed-failures``), whichever task on the worker caused them. So the items of a group that
    was given up are run again, alone and one after the other, while other groups continue. An item is the cause, and
    gets ``(None, reason)``, if dask gives it up again while it gives up no other task, or for the third time. Workers
    that the cluster has given up are started again.

    Parameters
    ----------
    pool : dask.distributed.Client
    resources : dict of str to float, optional
        Worker resources that one simulation needs, such as ``{"GPU": 1}``.
    longest_wait : float, optional
        How long simulations wait for a cluster without workers before the run ends with an error [s]; one hour by
        default. Increase it if jobs wait longer in the queue of the machine.

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
        if any(not amount > 0 for amount in self.resources.values()):
            raise ValueError(f"resources must be positive amounts by name, such as {{'GPU': 1}}; got {resources}")
        self._longest_wait = longest_wait
        self._seconds: float | None = None  # mean duration of an item in the last map or stream
        self._total, self._done = 0.0, 0
        self._lock = threading.RLock()
        self._sent: dict[Any, tuple[list[_Item], int]] = {}  # by dask's future: items, and losses before
        self._ended: SimpleQueue = SimpleQueue()  # futures that dask has reported as ended; None at the end
        self._suspects: deque[_Item] = deque()
        self._suspect: Any = None  # future of the suspect that runs
        self._losses = 0  # tasks that dask has given up
        self._no_workers: RuntimeError | None = None
        self._workers = _Workers()

    @property
    def n_workers(self) -> int | None:
        """Number of simulations that run at once on the present workers."""
        if self.resources:
            return self.pool.run_on_scheduler(_places, self.resources) or None
        return sum(self.pool.nthreads().values()) or None

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """As `PoolExecutor.map`."""
        return results_of(self.submit_all(function, list(items)), self)

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """As `PoolExecutor.submit_all`; one task may contain several short simulations of one call."""
        reference = self._reference(function)
        futures = [_Item(item, reference) for item in items]
        if not futures:
            return futures
        n_workers = self.n_workers if len(items) > 1 or not self._sent else 1
        if not n_workers:
            text = "The dask cluster has no worker; %d simulations wait for one. Start workers or scale the cluster"
            logger.warning(text, len(items))
        with self._lock:
            if self._done:
                self._seconds = self._total / self._done
            if not self._sent:
                self._total, self._done = 0.0, 0
            largest = 1 if self._seconds is None else int(1.0 / max(self._seconds, 1e-3))
            self._send(_groups(futures, n_workers or 1, largest))
        return futures

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also those that a worker has received."""
        with self._lock:
            wanted = set(futures)
            at_work = set() if running else {key for keys in self.pool.processing().values() for key in keys}
            self._suspects = deque(item for item in self._suspects if item not in wanted)
            left = {item for items, _ in self._sent.values() for item in items}
            inner = [each for each, (items, _) in self._sent.items() if wanted.issuperset(items)]
            inner = [each for each in inner if getattr(each, "key", None) not in at_work]
            left -= {item for each in inner for item in self._sent[each][0]}
            self._forget(inner)
        if inner:
            self.pool.cancel(inner)
        for future in wanted - left:
            future.cancel()

    def _send(self, groups: list[list[_Item]]) -> list[Any]:
        """Send groups of items with the same function; returns dask's futures. The lock is held."""
        function = partial(_run_group, groups[0][0].function)
        options = {"resources": self.resources} if self.resources else {}
        starts = not self._sent
        if starts:
            self._start_lost_workers()
        inner = self.pool.map(function, [[each.item for each in items] for items in groups], pure=False, **options)
        self._sent |= {each: (items, self._losses) for each, items in zip(inner, groups, strict=True)}
        if starts:
            self._ended, self._no_workers = SimpleQueue(), None
            # not in dask's threads, which Python joins at exit: it would wait for ever if the scheduler is lost
            for target in (self._receive_all, self._watch):
                threading.Thread(target=target, args=(self._ended,), name="results of dask", daemon=True).start()
        for each in inner:
            each.add_done_callback(self._ended.put)
        return inner

    def _start_lost_workers(self) -> None:
        with contextlib.suppress(Exception):  # there is no cluster object, or it is closing
            self._workers.start_lost(self.pool.cluster)

    def _forget(self, inner: Iterable[Any], goes_on: bool = False) -> None:
        """Forget groups that have ended; with `goes_on`, start the next suspect. The lock is held."""
        for each in inner:
            self._sent.pop(each, None)
        if self._suspect not in self._sent:
            self._suspect = None
        if not self._sent:
            self._ended.put(None)
        while goes_on and self._suspect is None and self._suspects:
            item = self._suspects.popleft()
            if not item.cancelled():
                (self._suspect,) = self._send([[item]])

    # in separate threads ------------------------------------------------------------------------------------------

    def _receive_all(self, ended: SimpleQueue) -> None:
        """Receive groups as they end, several at once if possible, until none is left."""
        inner: list = []
        while None not in inner:
            inner = [ended.get()]
            with contextlib.suppress(Empty):
                while True:
                    inner.append(ended.get_nowait())
            finished = [each for each in inner if each is not None and each.status == "finished"]
            answers: dict = {}
            with contextlib.suppress(Exception):  # a worker was lost with its results: dask has repeated them
                answers = dict(zip(finished, self.pool.gather(finished), strict=True))
            for each in inner:
                self._receive(each, self._sent.get(each, ((), 0))[0], answers.get(each))

    def _receive(self, inner: Any, items: Sequence[_Item], answer: tuple[list, float] | None) -> None:
        """Pass on a group's outcomes or error; there are no items if they were given up meanwhile."""
        if not items:
            return
        try:
            (outcomes, seconds), failure = answer or inner.result(), None
            self._total, self._done = self._total + seconds, self._done + len(outcomes)
        except BaseException as error:
            if type(error).__name__ == "KilledWorker":
                self._lose(inner)
                return
            outcomes, failure = [None] * len(items), self._no_workers or error
            if not isinstance(failure, Exception) or type(failure).__name__ == "FutureCancelledError":
                failure = RuntimeError(f"dask has cancelled a simulation ({error}); run again with a new client")
        pairs = list(zip(items, outcomes, strict=True))
        again = [item for item, outcome in pairs if isinstance(outcome, Missing) and not item.cancelled()]
        with self._lock:
            for item in again:
                item.function = item.function.carried()
            if again:
                self._send([[item] for item in again])
            self._forget([inner], goes_on=True)
        for item, outcome in pairs:
            if item not in again:
                resolve(item, outcome, failure)

    def _lose(self, inner: Any) -> None:
        """A task was given up because its workers died: its item has failed, or its items become suspects."""
        time.sleep(SECONDS_FOR_MESSAGES)
        with self._lock:
            items, losses_before = self._sent.get(inner, ((), 0))
            others = any(other is not inner and other.status == "error" for other in self._sent)
            others, self._losses = others or self._losses > losses_before, self._losses + 1
            for item in items:
                item.deaths += 1
                if item.deaths == MAX_ATTEMPTS or (item.deaths > 1 and not others):
                    resolve(item, (None, _DIED))
                else:
                    self._suspects.append(item)
            self._forget([inner], goes_on=True)

    def _watch(self, ended: SimpleQueue) -> None:
        """Until all items have ended: request lost workers again; cancel all items after too long without workers."""
        last_seen = time.monotonic()
        while True:
            time.sleep(SECONDS_BETWEEN_CHECKS)
            if not self._sent or ended is not self._ended:
                return
            self._start_lost_workers()
            with contextlib.suppress(Exception):
                last_seen = time.monotonic() if self.pool.nthreads() else last_seen
            longest = LONGEST_WITHOUT_WORKER if self._longest_wait is None else self._longest_wait
            if time.monotonic() - last_seen > longest and ended is self._ended:
                self._no_workers = RuntimeError(_NO_WORKERS.format(longest))
                with contextlib.suppress(Exception):
                    self.pool.cancel(list(self._sent), force=True)
                return


class _Workers:
    """Starts workers of a cluster again that were present, and are absent although the cluster wants them.

    If a worker is absent 15 s after it was lost (``distributed.deploy.lost-worker-timeout``), dask closes its nanny and
    never starts the worker again, although on a busy machine the new process may need longer, or a simulation may have
    killed it once more. A dask-jobqueue cluster never notices that a job with several workers has ended, for example at
    its walltime, so such a job is submitted again. Queued jobs are left alone.
    """

    def __init__(self) -> None:
        self._seen: dict[Any, float] = {}  # when a worker or a job that has started was last present

    def start_lost(self, cluster: Any) -> None:
        """Note which workers and jobs are present, and start those again that the cluster has lost."""
        wanted, known = dict(getattr(cluster, "worker_spec", {})), set(getattr(cluster, "workers", ()))
        jobs = {name: spec["group"] for name, spec in wanted.items() if "group" in spec}
        names = {worker["name"] for worker in cluster.scheduler_info["workers"].values()} if jobs else set()
        here = {n for n in known if n not in jobs or any(f"{n}{suffix}" in names for suffix in jobs[n])}
        now = time.monotonic()
        self._seen = {name: now if name in here else seen for name, seen in self._seen.items() if name in wanted}
        self._seen |= {name: now for name in here & wanted.keys()}
        absent = self._seen.keys() - here
        ended = {n for n in absent & jobs.keys() & known if now - self._seen[n] > SECONDS_TO_RETURN}
        lost = ended | (absent - jobs.keys())
        if lost:
            what = f"{len(lost)} of its {len(wanted)} {'jobs' if ended else 'workers'}"
            logger.warning("The dask cluster has given up %s: starting them again", what)
            for name in lost:
                del self._seen[name]
            if ended:
                cluster.sync(cluster.scale_down, ended)
            cluster.scale(sum(len(spec.get("group", " ")) for spec in wanted.values()))


def _places(resources: dict[str, float], dask_scheduler: Any) -> int:
    """Number of simulations that fit on the workers; called in the scheduler."""
    return sum(
        min(worker.nthreads, *(int(worker.resources.get(name, 0.0) // amount) for name, amount in resources.items()))
        for worker in dask_scheduler.workers.values()
    )


def _run_group(function: Callable, items: list) -> tuple[list, float]:
    """Outcomes of a group's items, and their total duration [s]; called in the worker."""
    wait_for_nanny()
    start = time.perf_counter()
    return [function(item) for item in items], time.perf_counter() - start


@cache
def wait_for_nanny() -> None:
    """Wait once per process, because dask's nanny does not replace a worker that dies before its start is reported.

    Without this wait, an item that kills every new worker at once could leave a cluster without workers.
    """
    time.sleep(0.5)


def _groups(items: list, n_workers: int, largest: int) -> list[list]:
    """Groups of items: each has half a worker's share of the remaining items, at least one and at most `largest`."""
    groups = []
    while items:
        size = min(max(1, len(items) // (2 * n_workers)), max(1, largest))
        groups.append(items[:size])
        items = items[size:]
    return groups
