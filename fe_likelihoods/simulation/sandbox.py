"""A function that runs in a process of its own, within limits, and is called as if it ran here."""

import math
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from .processes import PickledFunction, Reply, RunFailed, Worker, last_lines

__all__ = ["Sandbox"]

_START_LIMIT = 120.0
_LOOK = 0.1


class Sandbox:
    """A function that runs in a process of its own.

    The process stays for the next call, and is replaced after one that did not end by itself. Threads that call at the
    same time have a process each. What the function prints is not shown.

    Parameters
    ----------
    function : callable of one argument
        It, its argument and its result must be picklable.
    time_limit : float, optional
        The longest that a call may take [s], without the start of the process.
    memory_limit : int
        See `Worker`; 0 for no limit.
    max_output : int
        The most that one call may print [bytes].

    Raises
    ------
    ValueError
        If the function cannot be sent to another process.
    """

    def __init__(
        self, function: Callable, time_limit: float | None = None, memory_limit: int = 0, max_output: int = 2**24
    ) -> None:
        self._settings = function, time_limit, memory_limit, max_output
        self._function = function
        self._time_limit = math.inf if time_limit is None else time_limit
        self._memory_limit, self._max_output = memory_limit, max_output
        self._shipment = PickledFunction.of(function)
        self._shipment.script()  # refused here, not in the first call
        self._free: list[tuple[Worker, Any]] = []

    def __reduce__(self) -> tuple:
        return type(self), self._settings

    def __call__(self, item: Any) -> Any:
        """Result for one item.

        Raises
        ------
        RunFailed
            If the process died, or was killed because it took too long or printed too much.
        Exception
            What the function raises.
        """
        worker, output = self._take()
        start = time.monotonic()
        try:
            worker.submit(item)
            reply = self._wait(worker, output, self._time_limit)
        except RunFailed as error:
            worker.kill()
            raise RunFailed(error.reason, time.monotonic() - start) from None
        except BaseException:
            worker.kill()
            raise
        os.ftruncate(output.fileno(), 0)
        os.lseek(output.fileno(), 0, os.SEEK_SET)
        self._free.append((worker, output))
        if reply.kind == "raised":
            raise reply.value
        return reply.value

    def close(self) -> None:
        """End the processes that wait for calls."""
        while self._free:
            self._free.pop()[0].kill()

    def _take(self) -> tuple[Worker, Any]:
        """A process that waits, or a new one."""
        with suppress(IndexError):
            while True:
                worker, output = self._free.pop()
                if worker.alive:
                    return worker, output
        output = tempfile.TemporaryFile()
        worker = Worker(memory_limit=self._memory_limit, output=output)
        try:
            worker.load(self._shipment)
            reply = self._wait(worker, output, _START_LIMIT)
        except BaseException:
            worker.kill()
            raise
        if reply.kind != "loaded":
            worker.kill()
            raise ValueError(f"{self._function!r} cannot be loaded in a process of its own: {reply.value}")
        return worker, output

    def _wait(self, worker: Worker, output: Any, limit: float) -> Reply:
        stop = time.monotonic() + limit
        while (left := stop - time.monotonic()) > 0.0:
            with suppress(OSError):
                worker.connection.poll(min(left, _LOOK))
            try:
                reply = worker.receive()
            except RunFailed as error:
                raise RunFailed("; ".join(filter(None, [error.reason, last_lines(output, 1)]))) from None
            if os.fstat(output.fileno()).st_size > self._max_output:
                raise RunFailed(f"stopped because it printed more than {self._max_output} bytes")
            if reply is not None:
                return reply
        raise RunFailed(f"stopped at the time limit of {limit:g} s")
