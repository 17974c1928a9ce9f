"""Pool of local processes that survives the death of its workers.

When a worker dies, the standard library's pools hang or break, and cannot say which item killed it. Here every worker
has a pipe, and a thread in this process sends it one item at a time. So the item that a dead worker was running is
known. Only this item is run again, and it is given up after the third death.
"""

import os
import threading
import weakref
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Future
from concurrent.futures import wait as wait_for
from functools import partial
from numbers import Integral
from queue import SimpleQueue
from typing import Any

from samplers.interrupts import Ended

from .by_value import Pickled
from .faults import SimulationFailed, TransientReason
from .worker import LoadingFailed, Worker

__all__ = ["LocalPool", "Outcome", "Submitting", "Threads", "result_of", "settle", "value_of"]

MAX_ATTEMPTS = 3
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")

Outcome = tuple[Any, str]
"""Result and an empty reason, or None and the reason of a failure; mapped functions return this."""


class Submitting:
    """Base class of executors: `map` and `submit` by `submit_all` and `give_up`."""

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of a function for every item, in order; ``(None, reason)`` for one that kills all its processes.

        ValueError if the function or an item cannot be sent or loaded, RuntimeError if three processes of a `LocalPool`
        in succession die before they are given an item, or the first exception of the function: the other items are
        given up then.
        """
        futures = self.submit_all(function, list(items))
        try:
            return [result_of(future) for future in futures]
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


def result_of(future: Any) -> Any:
    """The result of an item, see `value_of`; one that dask has given up is run once more, apart from the others.

    Whichever item kills a worker, those beside it are given up as well. If it is lost again, it is the cause.
    """
    for is_last in (False, True):
        try:
            return value_of(future.result())
        except Exception as error:
            if type(error).__name__ != "KilledWorker":
                raise
            if not is_last:
                future.retry()
    return None, TransientReason("the worker process died in every attempt of dask")


class Threads:
    """Daemon threads, for which Python does not wait at its end; each has a function of one item from ``make()``.

    They end with `close`, or when this object is garbage-collected.
    """

    def __init__(self, make: Callable[[], Callable[[Any], Any]]) -> None:
        self._make, self._calls, self._lock = make, SimpleQueue(), threading.Lock()
        self._threads: list[threading.Thread] = []
        self.pending: list[Future] = []  # and some that have ended
        weakref.finalize(self, self._calls.put, None)

    def submit_all(self, futures: Sequence[Future], items: Sequence[Any], most: int) -> None:
        """Call a function for each item, in at most `most` threads; `cancel` of its future prevents it before."""
        with self._lock:
            self.pending = [each for each in self.pending if not each.done()] + list(futures)
            while len(self._threads) < min(most, len(self.pending)):
                thread = threading.Thread(target=_work, args=(self._calls, self._make()), daemon=True)
                thread.start()
                self._threads.append(thread)
        for call in zip(futures, items, strict=True):
            self._calls.put(call)

    def close(self) -> None:
        """End the threads after the calls that wait."""
        self._calls.put(None)
        for thread in self._threads:
            thread.join()


def _work(calls: SimpleQueue, function: Callable[[Any], Any]) -> None:
    while (call := calls.get()) is not None:
        settle(call[0], function, call[1])
        call = None  # which must not be kept while this thread waits
    calls.put(None)  # for the other threads


def settle(future: Future, function: Callable[[Any], Any], item: Any) -> None:
    """Set the result of a function for an item, or its error, unless the future was cancelled."""
    if future.set_running_or_notify_cancel():
        try:
            result = function(item)
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)


class _Job(Future):
    """An item with its function; the future of its result. `worker` is the one that has it."""

    def __init__(self, function: Pickled, item: Any) -> None:
        super().__init__()
        self.function, self.item, self.worker, self.given_up = function, item, None, False


def _result(worker: Worker, job: _Job) -> Any:
    """Result of an item, from another process if its process dies."""
    deaths = loads = 0
    job.worker = worker
    try:
        while not job.given_up:
            try:
                answer = worker.run(job.function, job.item, given_up=lambda: job.given_up)
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
    finally:
        job.worker = None


class LocalPool(Submitting):
    """Pool of local processes.

    The processes start with the first items. They end with `close`, when this object is garbage-collected, or when this
    process ends, even if it is killed (on macOS with their items then). A process that dies is replaced and its item
    run again; the other items are not affected. Linear algebra and numba use one thread per process, unless environment
    variables such as OMP_NUM_THREADS are set.

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
        names = [f"{library}_NUM_THREADS" for library in _THREADS]
        self._environment = {name: "1" for name in names if name not in os.environ}
        self._set_up()

    def _set_up(self) -> None:
        environment = self._environment
        self._owner, self._threads = os.getpid(), Threads(lambda: partial(_result, Worker(environment)))

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
        self.give_up(self._threads_here().pending)
        self._threads.close()
        self._set_up()

    def submit_all(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the function cannot be sent to the processes."""
        pickled = Pickled.of(function)  # each time: the values that it uses may have changed
        jobs = [_Job(pickled, item) for item in items]
        self._threads_here().submit_all(jobs, jobs, self.workers)
        return jobs

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also kill the processes that run them. Items with results keep them."""
        started = [job for job in futures if not job.cancel() and running and not job.done()]
        for job in started:
            job.given_up = True  # before the question for its process: one of the two threads sees what the other did
            if (worker := job.worker) is not None:
                worker.kill()
        wait_for(started)

    def _threads_here(self) -> Threads:
        """The threads of this process, not those of the process that has forked it."""
        if self._owner != os.getpid():
            self._set_up()
        return self._threads
