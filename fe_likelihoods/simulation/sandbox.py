"""A function that runs in another process, with limits of time, memory and output."""

import math
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from .by_value import Pickled
from .faults import ChangedModel, RunFailed, TransientReason
from .worker import Answer, Worker, WorkerDied, last_lines

__all__ = ["Sandbox"]

_START_LIMIT = 120.0  # [s] for starting a process and loading the function
_POLL_INTERVAL = 0.1  # [s] between checks of the amount of output


class Sandbox:
    """Callable that runs a function in another process.

    The process is kept for later calls. It is replaced after a call that did not end by itself, and after a number of
    calls, which limits the memory that the function leaks. Concurrent calls of several threads use one process each.
    The function is sent by value, as it is when it is called. What it prints is not shown.

    Parameters
    ----------
    function : callable
        Takes one argument.
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
        self.function, self.time_limit, self.memory_limit = function, time_limit, memory_limit
        self.max_output, self.runs_per_process = max_output, runs_per_process
        self._free: list[tuple[Worker, Any]] = []
        Pickled.of(function)  # raises here what would be raised in the first call

    def __getstate__(self) -> dict:
        return vars(self) | {"_free": []}

    def __call__(self, item: Any) -> Any:
        """Result of the function for one item.

        Raises
        ------
        RunFailed
            If the process died, or was killed because it took too long or printed too much.
        Exception
            Any exception that the function raises.
        """
        worker, output = self._take(Pickled.of(self.function))
        start = time.monotonic()
        try:
            worker.send(item)
            answer = self._receive(worker, output)
        except RunFailed as error:
            worker.kill()
            raise RunFailed(error.reason, time.monotonic() - start) from None
        except BaseException:
            worker.kill()
            raise
        if worker.calls >= (self.runs_per_process or math.inf):
            worker.kill()
        else:
            os.ftruncate(output.fileno(), 0)
            os.lseek(output.fileno(), 0, os.SEEK_SET)
            self._free.append((worker, output))
        if answer.error is not None:
            raise answer.error
        return answer.value

    def close(self) -> None:
        """End the idle processes."""
        while self._free:
            self._free.pop()[0].kill()

    def _take(self, function: Pickled) -> tuple[Worker, Any]:
        """A process that has loaded the function, and the file with its output."""
        worker = None
        with suppress(IndexError):
            while worker is None or not worker.alive:
                worker, output = self._free.pop()
        if worker is None or not worker.alive:
            output = tempfile.TemporaryFile()
            worker = Worker(memory_limit=self.memory_limit, output=output)
        try:
            worker.load(function, _START_LIMIT)
        except BaseException as error:
            worker.kill()
            if isinstance(error, WorkerDied):
                raise _with_output(error, output) from None
            if isinstance(error, ValueError) and not isinstance(error, ChangedModel):  # it cannot be loaded there
                raise RunFailed(TransientReason(str(error))) from error
            raise
        return worker, output

    def _receive(self, worker: Worker, output: Any) -> Answer:
        """Answer of a worker; RunFailed if there is none within the limit, or it dies or prints too much."""
        limit = math.inf if self.time_limit is None else self.time_limit
        stop = time.monotonic() + limit
        while (left := stop - time.monotonic()) > 0.0:
            try:
                answer = worker.receive(min(left, _POLL_INTERVAL))
            except WorkerDied as error:
                raise _with_output(error, output) from None
            if os.fstat(output.fileno()).st_size > self.max_output:
                raise RunFailed(TransientReason(f"stopped because it printed more than {self.max_output} bytes"))
            if answer is not None:
                return answer
        raise RunFailed(TransientReason(f"stopped at the time limit of {limit:g} s", time_limit=limit))


def _with_output(error: WorkerDied, output: Any) -> RunFailed:
    """The death of a process with the last line that it has printed."""
    return RunFailed(TransientReason("; ".join(filter(None, [error.reason, last_lines(output, 1)]))))
