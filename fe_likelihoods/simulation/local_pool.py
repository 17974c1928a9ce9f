"""Pool of local processes that survives the death of its workers.

When a worker dies, the standard library's pools hang or break, and cannot say which item killed it. Here every worker
has a pipe, and a thread in this process sends it one item at a time. So the item that a dead worker was running is
known. Only this item is run again, and it is given up after the third death.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_EXCEPTION, CancelledError, Future
from concurrent.futures import wait as wait_for
from numbers import Integral
from typing import Any

from .by_value import Pickled
from .faults import RunFailed
from .worker import LoadingFailed, Worker, Workers

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
    """An item with its function; the future of its result. `worker` is the process that has it."""

    def __init__(self, function: Pickled, item: Any) -> None:
        super().__init__()
        self.function, self.item = function, item
        self.worker: Worker | None = None
        self.given_up = False


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
        if not isinstance(workers, Integral) or isinstance(workers, bool) or workers < 1:
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
        self._running: set[_Job] = set()
        self._threads: set[threading.Thread] = set()
        self._n_idle = 0  # threads that wait for an item
        self._workers = Workers(environment=self._environment)

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
            left = [*self._waiting, *self._running]
        self.give_up(left)
        self._workers.close()

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
        started = [job for job in futures if not job.cancel() and running and not job.done()]
        for job in started:
            with self._changed:
                job.given_up, worker = True, job.worker
            if worker is not None:
                worker.kill()
        if threading.current_thread() not in self._threads:
            wait_for(started)

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
            for _ in range(min(self.workers - len(self._threads), len(self._waiting) - self._n_idle)):
                thread = threading.Thread(target=self._work, name="LocalPool", daemon=True)
                self._threads.add(thread)
                thread.start()
        return jobs

    # in a thread per worker -----------------------------------------------------------------------------------------

    def _work(self) -> None:
        """Run items one after the other, until none is waiting."""
        while (job := self._next()) is not None:
            try:
                result, error = self._result(job), None
            except BaseException as raised:
                result, error = None, raised
            with self._changed:
                self._running.discard(job)
                job.worker = None
            if error is None:
                job.set_result(result)
            else:
                job.set_exception(error)

    def _next(self) -> _Job | None:
        """The next item; None if the thread ends."""
        with self._changed:
            while True:
                self._n_idle += 1
                self._changed.wait_for(lambda: self._waiting, _LINGER)
                self._n_idle -= 1
                if not self._waiting:
                    self._threads.discard(threading.current_thread())
                    return None
                job = self._waiting.popleft()
                if job.set_running_or_notify_cancel():
                    self._running.add(job)
                    return job

    def _result(self, job: _Job) -> Any:
        """Result of an item, from another process if its process dies."""

        def watch(worker: Worker | None) -> None:
            with self._changed:
                job.worker = worker
            if job.given_up:
                raise CancelledError

        deaths = loads = 0
        while not job.given_up:
            try:
                answer = self._workers.run(job.function, job.item, watch=watch)
            except LoadingFailed as error:
                loads += 1
                if loads == MAX_ATTEMPTS:
                    raise RuntimeError(f"{error.reason} while loading the model; see its output on stderr") from None
            except RunFailed as error:
                deaths, loads = deaths + 1, 0
                if deaths == MAX_ATTEMPTS:
                    return None, error.reason
            else:
                if answer.error is not None:
                    raise answer.error
                return answer.value
        raise CancelledError
