"""A pool of processes of this machine.

The standard library's pools hang for ever when a worker dies, or end with it, and cannot say which item it was that
killed it. Here each worker has a pipe of its own, so that it is known what every process was doing when it died: that
item alone is tried again, and is given up after the third time.
"""

import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from multiprocessing.connection import wait
from typing import Any

from .processes import PickledFunction, RunFailed, Worker

__all__ = ["LocalPool", "Outcome"]

TRIES = 3
_THREADS = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA")

Outcome = tuple[Any, str]
"""Result and an empty reason, or None and the reason of a failure: what functions return that are mapped."""


class LocalPool:
    """Processes of this machine that survive what is run in them.

    They start with the first `map`, and end with `close`, with this object or with this process, even if that is
    killed. A process that dies is replaced and its item tried again, the other items are not touched. Linear algebra
    and numba use one thread in each, unless the environment (OMP_NUM_THREADS and the like) says otherwise.

    It can be shared: by several likelihoods, and as ``pool=`` of samplers.

    Parameters
    ----------
    workers : int
        Number of processes.

    Raises
    ------
    ValueError
        If the number is not a positive whole number.
    """

    other_processes = True

    def __init__(self, workers: int) -> None:
        try:
            whole = not isinstance(workers, bool) and int(workers) == workers and workers >= 1
        except (TypeError, ValueError):
            whole = False
        if not whole:
            raise ValueError(
                "pool must be None, a positive number of processes, or an object with map(function, items); "
                f"got {workers!r}"
            )
        self.workers = int(workers)
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
        return type(self), (self.workers,)

    @property
    def n_workers(self) -> int:
        """How many items run at once."""
        return self.workers

    def close(self) -> None:
        """End the processes; the next `map` would start others."""
        with self._lock:
            while self._free:
                self._free.pop().kill()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> list[Any]:
        """Results of `function` for every item, in their order.

        An item whose process died three times gets the `Outcome` ``(None, reason)``.

        Raises
        ------
        ValueError
            If the function or an item cannot be sent to the processes, or not be loaded there.
        RuntimeError
            If processes die, three times, before they were given an item.
        Exception
            The first that `function` raises; nothing further is started then.
        """
        shipment, items = PickledFunction.of(function), list(items)
        results: list[Any] = [None] * len(items)
        waiting, deaths = deque(range(len(items))), Counter()
        running: dict[Worker, int | None] = {}  # item of each worker, None while it loads the function
        with self._lock:
            try:
                while waiting or running:
                    while len(running) < self.workers and len(running) < len(waiting) + sum(
                        index is not None for index in running.values()
                    ):
                        worker = self._take()
                        running[worker] = None
                        if worker.key == shipment.key:
                            self._next(worker, running, waiting, items)
                        else:
                            worker.load(shipment)
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
                            raise ValueError(f"{function!r} cannot be loaded in a worker process: {reply.value}")
                        if reply.kind == "raised":
                            raise reply.value
                        if index is not None:
                            results[index] = reply.value
                        self._next(worker, running, waiting, items)
            except BaseException:
                for worker in running:
                    worker.kill()
                raise
        return results

    def _take(self) -> Worker:
        """A process that waits, or a new one."""
        while self._free:
            worker = self._free.pop()
            if worker.alive:
                return worker
        return Worker(self._environment)

    def _next(self, worker: Worker, running: dict, waiting: deque, items: list) -> None:
        """Give a worker that has loaded the function its next item, or let it rest."""
        if waiting:
            running[worker] = index = waiting.popleft()
            worker.submit(items[index])
        else:
            del running[worker]
            self._free.append(worker)

    @staticmethod
    def _died(index: int | None, reason: str, deaths: Counter, waiting: deque, results: list) -> None:
        deaths[index] += 1
        if index is None:
            if deaths[index] == TRIES:
                raise RuntimeError(f"{reason} while it was loading the model; what it wrote to stderr tells more")
        elif deaths[index] == TRIES:
            results[index] = None, reason
        else:
            waiting.appendleft(index)
