"""A local process that calls a function for one item at a time, and may hang, crash or use too much memory.

The function is received by value, so that the user's script is not imported. Workers and programs run in a group of
processes of their own, which is killed with them, and when the process that started them ends, for whatever reason. A
worker is started with `subprocess`: pool processes, in which it must also work, often may not use `multiprocessing`.
"""

import json
import math
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from samplers.interrupts import become_worker

from .by_value import CannotLoad, Pickled, load, without_addresses
from .failure_reasons import SimulationFailed, TransientReason, is_transient
from .files import Group, given_places, kill_group, of_this_library, working_folder

__all__ = ["Died", "Sandbox", "Worker", "describe_exit", "run_program", "serve"]

_BOOT = (
    "import json, sys; sys.path[:], sys.argv, *settings = json.loads(sys.argv[1]); "
    "from fe_likelihoods.simulation.worker import serve; serve(*settings)"
)
_CHECK = 0.5  # [s] between checks that the process lives, while waiting for its answer


class Died(SimulationFailed):
    """A worker process that died, or was stopped, before it answered."""


class Worker:
    """Calls functions in one process after the other. Its methods may be called from one thread, apart from `kill`.

    The process is started for a call, and replaced if it has died or after `most_calls`. It is killed by `kill`, when
    this object is garbage-collected, or when this process ends. `environment` adds variables; with `quiet`,
    its output is not shown.
    """

    def __init__(
        self,
        environment: Mapping[str, str] | None = None,
        quiet: bool = False,
        most_calls: float = math.inf,
    ) -> None:
        self._settings, self._most_calls = (environment, quiet), most_calls
        self._process: subprocess.Popen | None = None

    def run(
        self, function: Pickled, item: Any, seconds: float = math.inf, given_up: Callable[[], bool] = lambda: False
    ) -> Any:
        """Result of a function for an item, or its exception.

        Without an answer, the process is killed: Died if it dies or does not answer within `seconds` after it was given
        the item, CancelledError if it is `given_up` before.
        """
        message = b"\0" + pickle.dumps(item, protocol=5)
        if not self._is_ready():
            self._renew()
        if given_up():  # before, there was no process to kill
            raise CancelledError
        if self._function != function:
            self._ask(b"\1" + pickle.dumps(function, protocol=5), math.inf)
            self._function = function
        self._calls += 1
        return self._ask(message, seconds)

    def _is_ready(self) -> bool:
        is_own = self._process is not None and self._owner == os.getpid()  # not of the process that has forked this one
        return is_own and self._process.poll() is None and self._calls < self._most_calls

    def _renew(self) -> None:
        environment, quiet = self._settings
        self.kill()
        self._connection, theirs = Pipe()
        output = subprocess.DEVNULL if quiet else None
        with theirs:
            self._group = Group()
            texts = [[str(text) for text in texts] for texts in (sys.path, sys.argv)]
            self._process = self._group.start(
                [sys.executable, "-c", _BOOT, json.dumps([*texts, theirs.fileno(), self._group.place])],
                env={**os.environ, **(environment or {})},
                pass_fds=(theirs.fileno(),),
                stdout=output,
                stderr=output,
                cwd=working_folder() or None,
            )
        readable = select.poll()  # kept, since Connection.poll makes one for each call
        readable.register(self._connection, select.POLLIN)
        self._poll = readable.poll
        self._function, self._calls, self._owner = None, 0, os.getpid()

    def _ask(self, message: bytes, seconds: float) -> Any:
        """Answer to a message, a value or an exception; raises `Died` without one, and the process is killed."""
        stop = time.monotonic() + seconds
        try:
            self._connection.send_bytes(message)
            # a program that the function has started may hold the connection open
            while not self._poll(1000.0 * max(0.0, min(_CHECK, stop - time.monotonic()))):
                if self._process.poll() is not None and not self._poll(0):
                    raise EOFError
                if time.monotonic() >= stop:
                    raise Died(TransientReason(f"stopped at the time limit of {seconds:g} s"))
            value, error = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5.0)  # it may end by itself, with its exit code
            self.kill()
            raise Died(TransientReason(describe_exit(self._process.wait(), "the worker process"))) from None
        except BaseException:
            self.kill()
            raise
        if error is not None:
            raise error
        return value

    def kill(self) -> None:
        """Kill the process and its group."""
        if self._process is not None and self._owner == os.getpid():
            self._group.end()


class Sandbox:
    """Callable that runs a function of one argument in another process, whose output is not shown.

    The process is replaced after a call that did not end by itself, and after `runs_per_process` calls. Each thread has
    a process of its own. The function is sent by value, in its state at the call; ValueError if it cannot be sent.
    `time_limit` [s] is for a call, without the start of the process.
    """

    def __init__(
        self,
        function: Callable[[Any], Any],
        time_limit: float | None = None,
        runs_per_process: int | None = None,
    ) -> None:
        self._arguments = function, time_limit, runs_per_process
        self._of_thread = threading.local()
        Pickled.of(function)  # an error is raised here instead of in the first call

    def __reduce__(self) -> tuple:
        return Sandbox, self._arguments

    def __call__(self, item: Any) -> Any:
        """Result of the function for an item, or its exception; SimulationFailed if the process died or was stopped."""
        function, limit, most_calls = self._arguments
        if (worker := getattr(self._of_thread, "worker", None)) is None:
            worker = self._of_thread.worker = Worker(None, True, most_calls or math.inf)
        try:
            return worker.run(Pickled.of(function), item, math.inf if limit is None else limit)
        except CannotLoad as error:
            raise SimulationFailed(TransientReason(str(error))) from error


def describe_exit(exit_code: int, who: str) -> str:
    """Description of an exit code, such as "the worker process died (signal 11)"."""
    return f"{who} died (signal {-exit_code})" if exit_code < 0 else f"{who} ended with exit code {exit_code}"


# programs -----------------------------------------------------------------------------------------------------------


def run_program(
    group: Group, command: Sequence[str], folder: Path, stdout: Path, stderr: Path, watch: Callable[[float], float]
) -> int:
    """Run a program in a group to its end, kill the group, and return the exit code, as in `subprocess`.

    The command has an absolute path; no shell is used, standard input is empty. `watch` is called with the time since
    the start [s] and returns the time until the next call [s], or raises an exception, which stops the program and is
    passed on. OSError if the program cannot be started.
    """
    try:
        with of_this_library(), open(stdout, "wb") as out, open(stderr, "wb") as error:
            program = group.start(command, cwd=folder, stdout=out, stderr=error)
        start = time.monotonic()
        waiter = threading.Thread(target=program.wait, daemon=True)  # without the pauses of a wait with a limit
        waiter.start()
        while waiter.is_alive():
            waiter.join(watch(time.monotonic() - start))
        return program.returncode
    finally:
        for process in group.processes[1:]:  # and what a program has started in other groups, while it waits for it
            for pid in _descendants(process.pid) if process.poll() is None else ():
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
        kill_group(group.processes)


def _descendants(pid: int) -> list[int]:
    """Process ids of a process's descendants, from /proc; none on other systems than Linux."""
    parents = {}
    for name in filter(str.isdigit, os.listdir("/proc") if os.path.isdir("/proc") else ()):
        with suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    found, new = [], [pid]
    while new:
        new = [child for child, parent in parents.items() if parent in new]
        found += new
    return found


# in the worker ------------------------------------------------------------------------------------------------------


def serve(fileno: int, place: str) -> None:
    """Main loop of a worker process: answer messages until the connection with a file descriptor closes.

    A message is a function to load, or an item for it. `place` is a folder for this process.
    """
    given_places[os.getpid()] = place
    os.set_inheritable(fileno, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which ends this process
    become_worker()
    function, me = None, os.getpid()
    with Connection(fileno) as connection:
        while True:
            try:
                message = memoryview(connection.recv_bytes())
            except (EOFError, OSError):
                return
            try:
                if message[0]:
                    function = load(pickle.loads(message[1:]))
                answer = _packed(None if message[0] else function(pickle.loads(message[1:])))
            except BaseException as error:
                answer = _packed(None, error)
            if os.getpid() != me:  # the function has forked, and its copy has returned as well
                os._exit(0)
            connection.send_bytes(answer)


def _packed(value: Any, error: BaseException | None = None) -> bytes:
    """Pickled value and error; if they cannot be pickled, a `SimulationFailed` with the text of the error, or why."""
    try:
        data = pickle.dumps((value, error), protocol=5)
        if error is not None:
            pickle.loads(data)  # exceptions with custom constructors can often be pickled but not unpickled
        if error is None or isinstance(error, Exception | KeyboardInterrupt):  # which ends the run
            return data
    except Exception as failure:
        error = error or failure
    text = without_addresses(f"{type(error).__name__}: {error}")
    return pickle.dumps((None, SimulationFailed(TransientReason(text) if is_transient(error) else text)), protocol=5)
