"""Pool of local processes that survives the death of its workers.

When a worker dies, the standard library's pools hang or break, and cannot say which item killed it. Here every worker
has a pipe and a thread in this process, which sends it one item at a time. So the item that a dead worker was running
is known. Only this item is run again, and it is given up after the third death.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, Future
from concurrent.futures import wait as wait_for
from typing import Any

from .by_value import Pickled
from .worker import Worker, WorkerDied

__all__ = ["LocalPool", "Outcome", "results_of"]

MAX_ATTEMPTS = 3
_LINGER = 0.1  # [s] that a thread waits for another item before it ends; a new thread costs as much as a short item
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")

Outcome = tuple[Any, str]
"""Result and an empty reason, or None and the reason of a failure; mapped functions return this."""


def results_of(futures: Sequence[Future], executor: Any) -> list[Any]:
    """Results of futures; at the first exception, which is raised, and at Ctrl-C, the other futures are given up."""
    try:
        for future in wait_for(futures, return_when=FIRST_EXCEPTION).done:
            future.result()
        return [future.result() for future in futures]
    except BaseException:
        executor.give_up(futures)
        raise


class _Job(Future):
    """An item with its function; the future of its result."""

    def __init__(self, function: Pickled, item: Any) -> None:
        super().__init__()
        self.function, self.item = function, item
        self.deaths = 0
        self.given_up = False

    def start(self) -> bool:
        """Whether the job is to be run, for the first time or again; ends the job if it was given up."""
        if self.given_up:
            self.set_exception(CancelledError())
            return False
        return self.running() or self.set_running_or_notify_cancel()


def _is_positive_whole(value: Any) -> bool:
    try:
        return not isinstance(value, bool) and int(value) == value and value >= 1
    except (TypeError, ValueError, OverflowError):
        return False


class LocalPool:
    """Pool of local processes.

    The processes start with the first item. They end with `close`, when this object is garbage-collected, or when this
    process ends, even if it is killed (on macOS within a second, unless compiled code keeps the process busy). A
    process that dies is replaced and its item run again; the other items are not affected. Linear algebra and numba use
    one thread per process, unless environment variables such as OMP_NUM_THREADS are set.

    Functions are sent by value, with the present values of their modules (`fe_likelihoods.simulation.by_value`), so
    lambdas and functions of a script or notebook can be used.

    A pool can be shared by several likelihoods, and can be the ``pool=`` of samplers. Its methods may be called from
    several threads.

    Parameters
    ----------
    workers : int
        Number of processes; ValueError if it is not a positive whole number.
    """

    other_processes = True
    submits = True

    def __init__(self, workers: int) -> None:
        if not _is_positive_whole(workers):
            raise ValueError(
                "pool must be None, a positive number of processes, or an object with map(function, items); "
                f"got {workers!r}"
            )
        self.workers = int(workers)
        self._environment = {
            f"{library}_NUM_THREADS": "1" for library in _THREADS if f"{library}_NUM_THREADS" not in os.environ
        }
        self._set_up()

    def _set_up(self) -> None:
        self._owner, self._changed = os.getpid(), threading.Condition(threading.RLock())
        self._waiting: deque[_Job] = deque()
        self._busy: dict[Worker, _Job | None] = {}  # each worker's job, None while it loads a function
        self._free: list[Worker] = []
        self._threads: set[threading.Thread] = set()
        self._idle = 0  # threads that wait for an item
        self._closed = 0  # how often

    def __enter__(self) -> "LocalPool":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __reduce__(self) -> tuple:
        return type(self), (self.workers,)

    @property
    def n_workers(self) -> int:
        """Number of items that run at once."""
        return self.workers

    def close(self) -> None:
        """Give up all items and end the processes; a later item starts new processes."""
        self._notice_fork()
        with self._changed:
            self._closed += 1
            self._changed.notify_all()
            loading = [worker for worker, job in self._busy.items() if job is None]
            left = [*self._waiting, *filter(None, self._busy.values())]
        for worker in loading:
            worker.kill()
        self.give_up(left)
        with self._changed:
            self._changed.wait_for(lambda: not self._threads - {threading.current_thread()})
            while self._free:
                self._free.pop().kill()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of a function for every item, in order; these items run before items that were submitted.

        An item whose process died three times gets the `Outcome` ``(None, reason)``.

        Raises
        ------
        ValueError
            If the function or an item cannot be sent to the processes, or the function cannot be loaded there.
        RuntimeError
            If three processes in succession die before they are given an item.
        Exception
            The first exception that `function` raises; no further items are started.
        """
        return results_of(self._enqueue(function, list(items), first=True), self)

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future:
        """Future with the result of a function for one item, as returned by `map`.

        ``cancel()`` has an effect until the item is sent to a process.
        """
        return self.submit_all(function, [item])[0]

    def submit_all(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the function cannot be sent to the processes."""
        return self._enqueue(function, items)

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also kill the processes that run them. Items with results keep them."""
        self._notice_fork()
        for job in futures:
            if not job.cancel() and running:
                job.given_up = True
        with self._changed:
            killed = [worker for worker, job in self._busy.items() if job is not None and job.given_up]
            me = threading.current_thread() in self._threads
        for worker in killed:
            worker.kill()
        if not me:
            wait_for([job for job in futures if job.given_up])

    def _notice_fork(self) -> None:
        """In a forked process: forget the parent's workers and threads."""
        if self._owner != os.getpid():
            self._set_up()

    def _enqueue(self, function: Any, items: Sequence[Any], first: bool = False) -> list[_Job]:
        self._notice_fork()
        pickled = Pickled.of(function)  # each time: the values that it uses may have changed
        jobs = [_Job(pickled, item) for item in items]
        with self._changed:
            if first:
                self._waiting.extendleft(reversed(jobs))
            else:
                self._waiting.extend(jobs)
            self._changed.notify_all()
            for _ in range(min(self.workers - len(self._threads), len(self._waiting) - self._idle)):
                thread = threading.Thread(target=self._work, name="LocalPool", daemon=True)
                self._threads.add(thread)
                thread.start()
        return jobs

    # in a thread per worker -----------------------------------------------------------------------------------------

    def _work(self) -> None:
        """Run items one after the other in this thread's process, until none is waiting."""
        worker, job = self._first_job(None)
        while job is not None:
            try:
                worker = self._loaded(worker, job.function)
                job = self._next_job(worker, job.function)
                worker = worker if job is None else self._run(worker, job)
            except BaseException as error:
                worker = None
                self._drop(job.function, error)
            worker, job = self._first_job(worker)

    def _first_job(self, worker: Worker | None) -> tuple[Worker | None, _Job | None]:
        """The first waiting item; None if the thread ends. The process is free while there is no item."""
        closed = self._closed
        with self._changed:
            while True:
                while self._waiting and (self._waiting[0].cancelled() or self._waiting[0].given_up):
                    self._waiting.popleft().start()
                if self._waiting:
                    return worker, self._waiting[0]
                if worker is not None:
                    del self._busy[worker]
                    self._free.append(worker)
                    worker = None
                self._idle += 1
                has_items = self._changed.wait_for(lambda: self._waiting or self._closed != closed, _LINGER)
                self._idle -= 1
                if not has_items or not self._waiting:
                    self._threads.discard(threading.current_thread())
                    self._changed.notify_all()
                    return None, None

    def _loaded(self, worker: Worker | None, function: Pickled) -> Worker | None:
        """A process that has loaded a function; None if the pool was closed meanwhile."""
        closed = self._closed
        for _ in range(MAX_ATTEMPTS):
            worker = worker or self._take(function) or Worker(self._environment)
            with self._changed:
                self._busy[worker] = None
                if closed != self._closed:
                    worker.kill()
            try:
                worker.load(function)
                return worker
            except BaseException as error:
                self._end(worker)
                worker = None
                if closed != self._closed:
                    return None
                if not isinstance(error, WorkerDied):
                    raise
                reason = error.reason
        raise RuntimeError(f"{reason} while loading the model; see its output on stderr")

    def _take(self, function: Pickled) -> Worker | None:
        """A free process, preferably one that has loaded the function."""
        with self._changed:
            self._free.sort(key=lambda worker: function.key in worker.keys)
            while self._free:
                worker = self._free.pop()
                if worker.alive:
                    return worker
        return None

    def _next_job(self, worker: Worker | None, function: Pickled) -> _Job | None:
        """Take the next waiting item of a function, for a process."""
        with self._changed:
            for place, job in enumerate(self._waiting if worker is not None else ()):
                if job.function.key == function.key and not job.cancelled() and not job.given_up:
                    del self._waiting[place]
                    if job.start():
                        self._busy[worker] = job
                        return job
                    break
        return None

    def _run(self, worker: Worker, job: _Job) -> Worker | None:
        """Run an item; returns the process if it can go on."""
        try:
            worker.send(job.item)
            answer = worker.receive()
        except WorkerDied as error:
            self._end(worker)
            job.deaths += 1
            if job.deaths == MAX_ATTEMPTS:
                job.set_result((None, error.reason))
            elif job.given_up:
                job.set_exception(CancelledError())
            else:
                with self._changed:
                    self._waiting.appendleft(job)
            return None
        except BaseException as error:  # the item cannot be pickled, or the answer cannot be unpickled
            self._end(worker)
            job.set_exception(error)
            return None
        with self._changed:
            self._busy[worker] = None
        if answer.error is None:
            job.set_result(answer.value)
        else:
            job.set_exception(answer.error)
        return worker

    def _end(self, worker: Worker) -> None:
        with self._changed:
            self._busy.pop(worker, None)
        worker.kill()

    def _drop(self, function: Pickled, error: BaseException) -> None:
        """Remove the waiting items of a function that cannot be used."""
        with self._changed:
            dropped = [job for job in self._waiting if job.function.key == function.key]
            self._waiting = deque(job for job in self._waiting if job.function.key != function.key)
        for job in dropped:
            if job.start():
                job.set_exception(error)
