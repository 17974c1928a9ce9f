"""A function that runs in another process, with limits of time, memory and output."""

import math
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from .faults import TransientReason, raise_if_refused
from .processes import PickledFunction, RunFailed, Worker, WorkerReply, last_lines, without_addresses

__all__ = ["Sandbox"]

_START_LIMIT = 120.0  # [s] for starting a process and loading the function
_POLL_INTERVAL = 0.1  # [s] between checks of the amount of output


class Sandbox:
    """Callable that runs a function in another process.

    The process is kept for later calls. It is replaced after a call that did not end by itself, and after a number of
    calls, which limits the memory that the function leaks. Concurrent calls of several threads use one process each.
    What the function prints is not shown.

    Parameters
    ----------
    function : callable
        Takes one argument. The function, its argument and its result must be picklable.
    time_limit : float, optional
        Largest duration of a call [s], without the start of the process.
    memory_limit : int
        Limit of the address space of the process [bytes]; 0 for no limit.
    max_output : int
        Largest amount of output of one call [bytes].
    runs_per_process : int, optional
        Number of calls after which a process is replaced; never by default.

    Raises
    ------
    ValueError
        If the function cannot be sent to another process.
    """

    def __init__(
        self,
        function: Callable,
        time_limit: float | None = None,
        memory_limit: int = 0,
        max_output: int = 2**24,
        runs_per_process: int | None = None,
    ) -> None:
        self._settings = function, time_limit, memory_limit, max_output, runs_per_process
        self._function = function
        self._time_limit = math.inf if time_limit is None else time_limit
        self._memory_limit, self._max_output = memory_limit, max_output
        self._most_runs = runs_per_process or math.inf
        self._pickled = PickledFunction.of(function)
        self._pickled.script()  # raises here what would be raised in the first call
        self._free: list[tuple[Worker, Any]] = []

    def __reduce__(self) -> tuple:
        return type(self), self._settings

    def __call__(self, item: Any) -> Any:
        """Result of the function for one item.

        Raises
        ------
        RunFailed
            If the process died, or was killed because it took too long or printed too much.
        Exception
            Any exception that the function raises.
        """
        worker, output = self._take()
        start = time.monotonic()
        try:
            worker.submit(item)
            reply = self._wait(worker, output, self._time_limit)
            if reply is None:
                limit = self._time_limit
                raise RunFailed(TransientReason(f"stopped at the time limit of {limit:g} s", time_limit=limit))
        except RunFailed as error:
            worker.kill()
            raise RunFailed(error.reason, time.monotonic() - start) from None
        except BaseException:
            worker.kill()
            raise
        if worker.runs >= self._most_runs:
            worker.kill()
        else:
            os.ftruncate(output.fileno(), 0)
            os.lseek(output.fileno(), 0, os.SEEK_SET)
            self._free.append((worker, output))
        if reply.kind == "raised":
            raise reply.value
        return reply.value

    def close(self) -> None:
        """End the idle processes."""
        while self._free:
            self._free.pop()[0].kill()

    def _take(self) -> tuple[Worker, Any]:
        """An idle process that has loaded the function, or a new one, and the file with its output."""
        with suppress(IndexError):
            while True:
                worker, output = self._free.pop()
                if worker.alive:
                    return worker, output
        output = tempfile.TemporaryFile()
        worker = Worker(memory_limit=self._memory_limit, output=output)
        try:
            worker.load(self._pickled)
            reply = self._wait(worker, output, _START_LIMIT)
            if reply is None:
                raise RunFailed(TransientReason(f"the worker process did not start within {_START_LIMIT:g} s"))
        except BaseException:
            worker.kill()
            raise
        if reply.kind != "loaded":
            worker.kill()
            raise_if_refused(reply.value)
            reason = f"{self._function!r} cannot be loaded in another process: {reply.value}"
            raise RunFailed(TransientReason(without_addresses(reason)))
        return worker, output

    def _wait(self, worker: Worker, output: Any, limit: float) -> WorkerReply | None:
        """Reply of a worker, None if there is none within the limit [s]; RunFailed if it dies or prints too much."""
        stop = time.monotonic() + limit
        while (left := stop - time.monotonic()) > 0.0:
            with suppress(OSError):
                worker.connection.poll(min(left, _POLL_INTERVAL))
            try:
                reply = worker.receive()
            except RunFailed as error:
                reasons = filter(None, [error.reason, last_lines(output, 1)])
                raise RunFailed(TransientReason("; ".join(reasons))) from None
            if os.fstat(output.fileno()).st_size > self._max_output:
                raise RunFailed(TransientReason(f"stopped because it printed more than {self._max_output} bytes"))
            if reply is not None:
                return reply
        return None
