"""Pool of processes of this machine that survives the death of its workers.

When a worker dies, the standard library's pools hang or break, and cannot say which item killed it. Here each worker
has a pipe of its own, so it is known which item every process was running. Only that item is run again, and it is given
up after the third time.
"""

import math
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from multiprocessing.connection import wait
from typing import Any

from .faults import raise_if_refused
from .processes import PickledFunction, RunFailed, Worker

__all__ = ["LocalPool", "Outcome"]

MAX_ATTEMPTS = 3
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")

Outcome = tuple[Any, str]
"""Result and an empty reason, or None and the reason of a failure; mapped functions return this."""


def _is_positive_whole(value: Any) -> bool:
    try:
        return not isinstance(value, bool) and int(value) == value and value >= 1
    except (TypeError, ValueError, OverflowError):
        return False


class LocalPool:
    """Pool of processes of this machine.

    The processes start with the first `map`. They end with `close`, when this object is garbage-collected, or when this
    process exits, even if it is killed. A process that dies is replaced and its item run again; the other items are not
    affected. Linear algebra and numba use one thread per process, unless environment variables such as
    OMP_NUM_THREADS say otherwise.

    A pool can be shared by several likelihoods, and can be the ``pool=`` of samplers.

    Parameters
    ----------
    workers : int
        Number of processes.
    runs_per_process : int, optional
        Number of items after which a process is replaced by a new one, which limits the memory that leaks in compiled
        code of a model; never by default.

    Raises
    ------
    ValueError
        If `workers` or `runs_per_process` is not a positive whole number.
    """

    other_processes = True

    def __init__(self, workers: int, runs_per_process: int | None = None) -> None:
        if not _is_positive_whole(workers):
            raise ValueError(
                "pool must be None, a positive number of processes, or an object with map(function, items); "
                f"got {workers!r}"
            )
        if runs_per_process is not None and not _is_positive_whole(runs_per_process):
            raise ValueError(
                f"LocalPool: runs_per_process must be None or a positive whole number; got {runs_per_process!r}"
            )
        self.workers = int(workers)
        self.runs_per_process = None if runs_per_process is None else int(runs_per_process)
        self._environment = {
            f"{library}_NUM_THREADS": "1" for library in _THREADS if f"{library}_NUM_THREADS" not in os.environ
        }
        self._free: list[Worker] = []
        self._lock = threading.Lock()

    def __enter__(self) -> "LocalPool":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __reduce__(self) -> tuple:
        return type(self), (self.workers, self.runs_per_process)

    @property
    def n_workers(self) -> int:
        """Number of items that run at once."""
        return self.workers

    def close(self) -> None:
        """End the processes; another `map` starts new ones."""
        with self._lock:
            while self._free:
                self._free.pop().kill()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of a function for every item, in their order.

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
        pickled, items = PickledFunction.of(function), list(items)
        results: list[Any] = [None] * len(items)
        waiting, deaths = deque(range(len(items))), Counter()
        running: dict[Worker, int | None] = {}  # index of each worker's item, None while it loads the function
        with self._lock:
            try:
                while waiting or running:
                    while len(running) < self.workers and len(running) < len(waiting) + sum(
                        index is not None for index in running.values()
                    ):
                        worker = self._take()
                        running[worker] = None
                        if worker.key == pickled.key:
                            self._next(worker, running, waiting, items)
                        else:
                            worker.load(pickled)
                    wait([worker.connection for worker in running], timeout=1.0)
                    for worker, index in list(running.items()):
                        try:
                            reply = worker.receive()
                        except RunFailed as error:
                            del running[worker]
                            self._died(index, error.reason, deaths, waiting, results)
                            continue
                        if reply is None:
                            continue
                        if reply.kind == "unusable":
                            raise_if_refused(reply.value)
                            raise ValueError(f"{function!r} cannot be loaded in a worker process: {reply.value}")
                        if reply.kind == "raised":
                            raise reply.value
                        if index is None:
                            deaths[None] = 0  # the function can be loaded
                        else:
                            results[index] = reply.value
                        if worker.runs >= (self.runs_per_process or math.inf):
                            del running[worker]
                            worker.kill()  # another one is started if items are waiting
                        else:
                            self._next(worker, running, waiting, items)
            except BaseException:
                for worker in running:
                    worker.kill()
                raise
        return results

    def _take(self) -> Worker:
        """An idle process, or a new one."""
        while self._free:
            worker = self._free.pop()
            if worker.alive:
                return worker
        return Worker(self._environment)

    def _next(self, worker: Worker, running: dict, waiting: deque, items: list) -> None:
        """Send the next item to a worker that has loaded the function, or make it idle."""
        if waiting:
            running[worker] = index = waiting.popleft()
            worker.submit(items[index])
        else:
            del running[worker]
            self._free.append(worker)

    @staticmethod
    def _died(index: int | None, reason: str, deaths: Counter, waiting: deque, results: list) -> None:
        """Count the death of a worker: put its item first in the queue, or give it up."""
        deaths[index] += 1
        if index is None:
            if deaths[index] == MAX_ATTEMPTS:
                raise RuntimeError(f"{reason} while loading the model; see its output on stderr")
        elif deaths[index] == MAX_ATTEMPTS:
            results[index] = None, reason
        else:
            waiting.appendleft(index)
