"""A function that runs in another process, with time, memory and output limits."""

import math
from collections.abc import Callable
from typing import Any

from .by_value import CannotLoad, Pickled
from .faults import RunFailed, TransientReason
from .worker import Workers

__all__ = ["Sandbox"]

_START_LIMIT = 120.0  # [s] for starting a process and loading the function


class Sandbox:
    """Callable that runs a function of one argument in another process, whose output is not shown.

    The process is kept for later calls. It is replaced after a call that did not end by itself, and after
    `runs_per_process` calls (default: never), which limits memory leaks. Concurrent calls from several threads use one
    process each. The function is sent by value, in its state at the call; ValueError if it cannot be sent. `time_limit`
    [s] is for a call, without the start of the process; `memory_limit` [bytes] for
    the address space (0: none), and `max_output` [bytes] for a call.
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
        self._workers = Workers(
            _START_LIMIT, runs_per_process or math.inf, memory_limit=memory_limit, most_output=max_output
        )
        Pickled.of(function)  # an error is raised here instead of in the first call

    def __reduce__(self) -> tuple:
        return Sandbox, (self.function, self.time_limit, self.memory_limit, self.max_output, self.runs_per_process)

    def __call__(self, item: Any) -> Any:
        """Result of the function for one item, or its exception; RunFailed if the process died or passed a limit."""
        limit = math.inf if self.time_limit is None else self.time_limit
        answer = self._workers.run(Pickled.of(self.function), item, limit)
        if isinstance(answer.error, CannotLoad):
            raise RunFailed(TransientReason(str(answer.error))) from answer.error
        if answer.error is not None:
            raise answer.error
        return answer.value

    def close(self) -> None:
        """End the idle processes."""
        self._workers.close()
