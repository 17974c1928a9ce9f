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
from itertools import repeat
from numbers import Integral
from typing import Any

from samplers.interrupts import Ended

from .by_value import Pickled
from .faults import SimulationFailed
from .worker import LoadingFailed, Worker, Workers

__all__ = ["LocalPool", "Outcome", "Submitting", "Threads", "value_of"]

MAX_ATTEMPTS = 3
_LINGER = 0.1  # [s] that a thread waits for another item before it ends; a new thread costs as much as a short item
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")

Outcome = tuple[Any, str]
"""Result and an empty reason, or None and the reason of a failure; mapped functions return this."""


class Submitting:
    """Base class of executors: `map` and `submit` by `submit_all` and `give_up`."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of a function for every item, in order; ``(None, reason)`` for one that kills all its processes.

        ValueError if the function or an item cannot be sent or loaded, RuntimeError if three processes of a `LocalPool`
        in succession die before they are given an item, or the first exception of the function: no further items are
        started then.
        """
        futures = self.submit_all(function, list(items))
        try:
            done, left = wait_for(futures, return_when=FIRST_EXCEPTION)
            for future in done if left else ():
                future.result()
            return [value_of(future.result()) for future in futures]
        except BaseException:
            self.give_up(futures)
            raise

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future:
        """Future with the result of a function for one item, as returned by `map`.

        ``cancel()`` has an effect until the item is sent to a process, if the pool can cancel.
        """
        return self.submit_all(function, [item])[0]


def value_of(result: Any) -> Any:
    """The result of an item; raises KeyboardInterrupt or SystemExit if the function has raised it in a pool."""
    if isinstance(result, Ended):
        raise result.error
    return result


class Threads:
    """Daemon threads that call functions, at most ``most()`` at once; Python does not wait for them at its end.

    With 0 threads, functions are called at once.
    """

    def __init__(self, most: Callable[[], int]) -> None:
        self._most, self._changed = most, threading.Condition()
        self._waiting: deque[tuple[Future, Callable, Any]] = deque()
        self._running: set[Future] = set()
        self._threads: set[threading.Thread] = set()
        self._n_idle = 0

    @property
    def pending(self) -> list[Future]:
        """Futures of calls that have not ended."""
        with self._changed:
            return [*self._running, *(future for future, *_ in self._waiting)]

    def submit_all(
        self,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        futures: Sequence[Future] | None = None,
    ) -> Sequence[Future]:
        """A future for each item, which `cancel` prevents until a thread takes it."""
        futures, most = [Future() for _ in items] if futures is None else futures, self._most()
        calls = list(zip(futures, repeat(function), items))  # noqa: B905
        with self._changed:
            self._waiting.extend(calls)
            self._changed.notify(len(calls))
            for _ in range(min(most - len(self._threads), len(self._waiting) - self._n_idle)):
                thread = threading.Thread(target=self._work, args=(_LINGER,), name="fe_likelihoods", daemon=True)
                self._threads.add(thread)
                thread.start()
        if not most:
            self._work(0.0)
        return futures

    def has_this_one(self) -> bool:
        """Whether the present thread is one of them."""
        return threading.current_thread() in self._threads

    def _work(self, linger: float) -> None:
        """Call functions one after the other, until none has been waiting for a time [s]."""
        future = None
        while True:
            with self._changed:
                self._running.discard(future)
                if not self._waiting:
                    future = None
                    self._n_idle += 1
                    self._changed.wait_for(lambda: self._waiting, linger)
                    self._n_idle -= 1
                if not self._waiting:
                    self._threads.discard(threading.current_thread())
                    return
                future, function, item = self._waiting.popleft()
                self._running.add(future)
            if future.set_running_or_notify_cancel():
                try:
                    result = function(item)
                except BaseException as error:
                    future.set_exception(error)
                else:
                    future.set_result(result)


class _Job(Future):
    """An item with its function; the future of its result. `worker` is the process that has it."""

    def __init__(self, function: Pickled, item: Any) -> None:
        super().__init__()
        self.function, self.item = function, item
        self.worker: Worker | None = None
        self.given_up = False

    def held_by(self, worker: Worker | None) -> None:
        """A process has the item; CancelledError if it was given up."""
        self.worker = worker
        if self.given_up:
            raise CancelledError


class LocalPool(Submitting):
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
        self._owner = os.getpid()
        self._threads = Threads(lambda most=self.workers: most)
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
        self.give_up(self._threads.pending)
        self._workers.close()

    def submit_all(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the function cannot be sent to the processes."""
        self._notice_fork()
        pickled = Pickled.of(function)  # each time: the values that it uses may have changed
        jobs = [_Job(pickled, item) for item in items]
        return list(self._threads.submit_all(self._result, jobs, jobs))

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also kill the processes that run them. Items with results keep them."""
        self._notice_fork()
        started = [job for job in futures if not job.cancel() and running and not job.done()]
        for job in started:
            job.given_up = True  # before the question for its process: one of the two threads sees what the other did
            if (worker := job.worker) is not None:
                worker.kill()
        if not self._threads.has_this_one():
            wait_for(started)

    def _notice_fork(self) -> None:
        """In a forked process: forget the parent's workers and threads."""
        if self._owner != os.getpid():
            self._set_up()

    def _result(self, job: _Job) -> Any:
        """Result of an item, from another process if its process dies."""
        deaths = loads = 0
        while not job.given_up:
            try:
                answer = self._workers.run(job.function, job.item, watch=job.held_by)
            except LoadingFailed as error:
                loads += 1
                if loads == MAX_ATTEMPTS:
                    raise RuntimeError(f"{error.reason} while loading the model; see its output on stderr") from None
            except SimulationFailed as error:
                deaths, loads = deaths + 1, 0
                if deaths == MAX_ATTEMPTS:
                    return None, error.reason
            else:
                if answer.error is not None:
                    raise answer.error
                return answer.value
        raise CancelledError
