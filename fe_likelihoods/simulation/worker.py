"""A local process that calls a function for one item at a time, and may hang, crash or use too much memory.

The function is received by value, so that the user's script is not imported. The process leads a new session, which is
killed with it. On Linux it is also killed when the process that started it ends, for whatever reason
(``PR_SET_PDEATHSIG``); on macOS it ends within a second, unless compiled code keeps the interpreter busy. It is started
with `subprocess`, because pool processes, in which it must also work, often may not use `multiprocessing`.
"""

import ctypes
import json
import math
import os
import pickle
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from samplers.interrupts import become_worker

from .by_value import CannotLoad, Pickled, Recent, without_addresses
from .faults import SimulationFailed, TransientReason, is_transient
from .files import of_this_library
from .folder import discard, working_folder

__all__ = ["Answer", "LoadingFailed", "Sandbox", "Worker", "Workers", "describe_exit", "last_lines", "serve"]

_BOOT = (
    "import json, sys; sys.path[:], sys.argv, *settings = json.loads(sys.argv[1]); "
    "from fe_likelihoods.simulation.worker import serve; serve(*settings)"
)
_LOAD = bytes(16)  # in place of a function's key: the message contains a function to load
_PR_SET_PDEATHSIG = 1
_CHECK = 0.5  # [s] between checks that the process lives, while waiting for its answer
_CHECK_OUTPUT = 0.1  # [s] the same for a process whose output is limited
_START_LIMIT = 120.0  # [s] for starting the process of an isolated function and loading the function
_MOST_OUTPUT = 2**24  # [bytes] that a call of an isolated function may print


class LoadingFailed(SimulationFailed):
    """A worker process that died, or took too long, before it was given an item."""


def _renew_starter() -> None:
    """Make the permanent thread that starts processes: Linux kills a process when the thread that started it ends."""
    global _starter
    _starter = ThreadPoolExecutor(1, "starts workers")


_renew_starter()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_starter)


def _start(start: Callable[[], subprocess.Popen]) -> subprocess.Popen:
    with of_this_library():
        return start()


class Worker:
    """A process that calls a function. Its methods may be called from one thread, apart from `kill`.

    It is killed by `kill`, when this object is garbage-collected, or when this process ends. `environment` adds
    variables; `memory_limit` [bytes] of the address space (0: none) makes allocations fail beyond it; `most_output`
    [bytes] is for a call, whose output is not shown then. `keys` are the keys of loaded functions (`Pickled`), `calls`
    counts items sent.
    """

    def __init__(
        self, environment: Mapping[str, str] | None = None, memory_limit: int = 0, most_output: int = 0
    ) -> None:
        self._most, self._output = most_output, tempfile.TemporaryFile() if most_output else None
        self._connection, theirs = Pipe()
        with theirs:
            texts = [[str(text) for text in texts] for texts in (sys.path, sys.argv)]
            settings = json.dumps([*texts, theirs.fileno(), memory_limit, os.getpid()])
            start = partial(
                subprocess.Popen,
                [sys.executable, "-c", _BOOT, settings],
                env={**os.environ, **(environment or {})},
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                start_new_session=True,
                cwd=working_folder() or None,
            )
            self._process = _starter.submit(_start, start).result()
        readable = select.poll()  # kept, since Connection.poll makes one for each call
        readable.register(self._connection, select.POLLIN)
        self._poll = readable.poll
        self.keys, self._key, self.calls, self._owner = Recent(), b"", 0, os.getpid()
        self._end = weakref.finalize(self, _kill, self._process, os.getpid())

    @property
    def alive(self) -> bool:
        """Whether the process runs and is a child of this process (not of the one this was forked from)."""
        return self._owner == os.getpid() and not _ended(self._process)

    def load(self, function: Pickled, seconds: float) -> "Answer | None":
        """Send the function to call, unless it is loaded; an answer with an exception if it cannot be loaded.

        LoadingFailed if the process dies or does not answer within `seconds`.
        """
        self._key = function.key
        if self.keys.use(function.key):
            return None
        slow = "the worker process did not start within {:g} s"
        answer = self._ask(_LOAD + pickle.dumps(function, protocol=5), seconds, slow, LoadingFailed)
        if answer.error is not None:
            return answer
        self.keys.keep(function.key, True, len(function.payload))
        return None

    def call(self, item: Any, seconds: float) -> "Answer":
        """The answer of the function that was loaded last, for an item.

        SimulationFailed if the process dies, prints too much or does not answer within `seconds`.
        """
        self.calls += 1
        if self._output is not None:
            os.ftruncate(self._output.fileno(), 0)
            os.lseek(self._output.fileno(), 0, os.SEEK_SET)
        message = self._key + pickle.dumps(item, protocol=5)
        return self._ask(message, seconds, "stopped at the time limit of {:g} s")

    def _ask(
        self, message: bytes, seconds: float, slow: str, failure: type[SimulationFailed] = SimulationFailed
    ) -> "Answer":
        """Answer to a message; raises `failure` without one, and the process is killed."""
        with suppress(OSError):  # `_receive` notices that the process has died
            self._connection.send_bytes(message)
        try:
            if (answer := self._receive(time.monotonic() + seconds)) is not None:
                return answer
            reason = TransientReason(slow.format(seconds))
        except SimulationFailed as error:
            reason = error.reason
        self.kill()
        raise failure(reason)

    def _receive(self, stop: float) -> "Answer | None":
        """The answer; None if there is none until the time `stop`."""
        pause = _CHECK if self._output is None else _CHECK_OUTPUT
        try:
            while True:
                is_ready = self._poll(1000.0 * max(0.0, min(pause, stop - time.monotonic())))
                if is_ready:
                    return Answer(*pickle.loads(self._connection.recv_bytes()))
                # a program that the function has started may hold the connection open
                if _ended(self._process) and not self._poll(0):
                    raise EOFError
                if self._output is not None and os.fstat(self._output.fileno()).st_size > self._most:
                    raise SimulationFailed(TransientReason(f"stopped because it printed more than {self._most} bytes"))
                if time.monotonic() >= stop:
                    return None
        except (EOFError, OSError):
            give_up = time.monotonic() + 5.0
            while not _ended(self._process) and time.monotonic() < give_up:  # it may end by itself, with its exit code
                time.sleep(0.001)
            self._end()
            said = "" if self._output is None else last_lines(self._output, 1)
            reason = "; ".join(filter(None, [describe_exit(self._process.wait(), "the worker process"), said]))
            raise SimulationFailed(TransientReason(reason)) from None

    def kill(self) -> None:
        """Kill the process and its session."""
        self._end()
        self._process.wait()
        discard(self._process.pid)


class Answer(NamedTuple):
    """Answer of a worker: the result of the function, or the exception that it has raised."""

    value: Any
    error: BaseException | None


class Workers:
    """Processes that are kept for later calls; new ones have the `options` of a `Worker`.

    A process that does not load a function within `start_limit` [s] is killed, and replaced after `most_calls`.
    """

    def __init__(self, start_limit: float = math.inf, most_calls: float = math.inf, **options: Any) -> None:
        self._start_limit, self._most_calls, self._options = start_limit, most_calls, options
        self._idle: list[Worker] = []  # without a lock, which a forked process could find locked

    def run(
        self,
        function: Pickled,
        item: Any,
        seconds: float = math.inf,
        watch: Callable[[Worker | None], None] = lambda worker: None,
    ) -> Answer:
        """Answer of a function for an item, or of a process that cannot load it; SimulationFailed without an answer.

        `watch` is called with the process, and with None when it is idle again.
        """
        worker = self._take()
        try:
            watch(worker)
            answer = worker.load(function, self._start_limit) or worker.call(item, seconds)
            watch(None)
        except BaseException:
            worker.kill()
            raise
        if worker.calls < self._most_calls:
            self._idle.append(worker)
        else:
            worker.kill()
        return answer

    def _take(self) -> Worker:
        """An idle process, or a new one."""
        with suppress(IndexError):  # there is none, or another thread has taken it
            while True:
                if (worker := self._idle.pop()).alive:
                    return worker
        return Worker(**self._options)

    def close(self) -> None:
        """End the idle processes."""
        while self._idle:
            self._idle.pop().kill()


class Sandbox:
    """Callable that runs a function of one argument in another process, whose output is not shown.

    The process is replaced after a call that did not end by itself, and after `runs_per_process` calls (default:
    never), which limits memory leaks. Concurrent calls from several threads use one process each. The function is sent
    by value, in its state at the call; ValueError if it cannot be sent. `time_limit` [s] is for a call, without the
    start of the process; `memory_limit` [bytes] for the address space (0: none).
    """

    def __init__(
        self,
        function: Callable[[Any], Any],
        time_limit: float | None = None,
        memory_limit: int = 0,
        runs_per_process: int | None = None,
    ) -> None:
        self._arguments = function, time_limit, memory_limit, runs_per_process
        options = {"memory_limit": memory_limit, "most_output": _MOST_OUTPUT}
        self._workers = Workers(_START_LIMIT, runs_per_process or math.inf, **options)
        Pickled.of(function)  # an error is raised here instead of in the first call

    def __reduce__(self) -> tuple:
        return Sandbox, self._arguments

    def __call__(self, item: Any) -> Any:
        """Result of the function for an item, or its exception; SimulationFailed if the process died or was stopped."""
        function, limit, *_ = self._arguments
        answer = self._workers.run(Pickled.of(function), item, math.inf if limit is None else limit)
        if isinstance(answer.error, CannotLoad):
            raise SimulationFailed(TransientReason(str(answer.error))) from answer.error
        if answer.error is not None:
            raise answer.error
        return answer.value


def _ended(process: subprocess.Popen) -> bool:
    """Whether a process has ended; its exit status is not collected, so that its process id is not reused."""
    if process.returncode is not None:
        return True
    if not hasattr(os, "waitid"):  # macOS before Python 3.13
        return process.poll() is not None
    try:
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return True


def _kill(process: subprocess.Popen, owner: int) -> None:
    """Kill a process with its session, unless the calling process has only a forked copy of its object."""
    if owner == os.getpid():
        if process.returncode is None or not hasattr(os, "waitid"):
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def describe_exit(exit_code: int, who: str) -> str:
    """Description of an exit code, such as "the worker process died (signal 11)"."""
    return f"{who} died (signal {-exit_code})" if exit_code < 0 else f"{who} ended with exit code {exit_code}"


def last_lines(file: Any, most: int) -> str:
    """The last non-empty lines of an open file, at most `most` lines and 300 characters."""
    size = os.fstat(file.fileno()).st_size
    data = os.pread(file.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")
    lines = [line.strip() for line in data.splitlines() if line.strip()]
    return " / ".join(lines[-most:])[-300:]


# in the worker ------------------------------------------------------------------------------------------------------


def serve(fileno: int, memory_limit: int, parent: int) -> None:
    """Main loop of a worker process: answer messages until the connection with a file descriptor closes.

    `memory_limit` is as for `Worker`, `parent` the id of the process that has started this process.
    """
    _end_with(parent)
    os.set_inheritable(fileno, False)
    if memory_limit:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory_limit, memory_limit))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which ends this process
    become_worker()
    functions, me = Recent(), os.getpid()  # the same functions as in `Worker.keys`, used in the same order
    with Connection(fileno) as connection:
        while True:
            try:
                message = memoryview(connection.recv_bytes())
            except (EOFError, OSError):
                return
            try:
                if message[:16] == _LOAD:
                    pickled = pickle.loads(message[16:])
                    functions.keep(pickled.key, pickled.load(), len(pickled.payload))
                    answer = _packed(None)
                else:
                    function = functions.use(bytes(message[:16]))
                    function.prepare()
                    answer = _packed(function(pickle.loads(message[16:])))
            except BaseException as error:
                answer = _packed(None, error)
            if os.getpid() != me:  # the function has forked, and its copy has returned as well
                os._exit(0)
            connection.send_bytes(answer)


def _end_with(parent: int) -> None:
    """Let this process end when the parent ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended before
            os._exit(1)
        return

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _packed(value: Any, error: BaseException | None = None) -> bytes:
    """Pickled `Answer`; a `SimulationFailed` with the text of `error`, or why it cannot be pickled, if it cannot be."""
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
