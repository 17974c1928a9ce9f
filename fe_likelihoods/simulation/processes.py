"""Processes for simulations, which may hang, crash or eat their memory.

A `Started` process is killed with all that it has started, and does not outlive the one that started it (see
`fe_likelihoods.simulation.orphan_reaper`). A `Worker` is such a process, an interpreter that is sent a function once and then one item
after the other.

Workers are started by `subprocess`, not by `multiprocessing`: they have to work inside the workers of any pool, many
of which may not have children there. Linux and macOS.
"""

import json
import os
import pickle
import pickletools
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from hashlib import blake2b
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from . import orphan_reaper

__all__ = [
    "Reply",
    "RunFailed",
    "PickledFunction",
    "Started",
    "TemporaryFolder",
    "Worker",
    "ending",
    "last_lines",
    "serve",
]

_BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from fe_likelihoods.simulation.processes import serve; serve(int(sys.argv[2]), int(sys.argv[3]))"
)
_MARK = "FE_LIKELIHOODS_RUN_"
_SCRIPTS = ("__main__", "__mp_main__")  # where a script is itself, and where it was read again in a worker
_reading = False


class RunFailed(RuntimeError):
    """A run in a process of its own did not end well, for a reason in words (attributes `reason` and `seconds`)."""

    def __init__(self, reason: str, seconds: float | None = None) -> None:
        super().__init__(reason, seconds)
        self.reason = reason
        self.seconds = seconds


class _Minder:
    """The minder of this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen | None = None
        self._owner = 0

    def tell(self, *message: Any) -> None:
        with self._lock:
            if self._owner != os.getpid() or self._process is None or self._process.poll() is not None:
                command = [sys.executable, "-I", "-S", orphan_reaper.__file__]
                # without the marks: whoever kills this process by its mark must leave its minder to do its work
                variables = {name: value for name, value in os.environ.items() if not name.startswith(_MARK)}
                self._process = subprocess.Popen(
                    command,
                    env=variables,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    start_new_session=True,
                    bufsize=0,
                )
                self._owner = os.getpid()
            with suppress(BrokenPipeError):
                self._process.stdin.write(json.dumps(message).encode() + b"\n")


_MINDER = _Minder()


class Started:
    """A process in a session of its own, that is killed with all that it started: by `kill`, with this object, with us.

    Parameters
    ----------
    command : list of str
        No shell is involved.
    environment : mapping, optional
        Variables added to this process's own.
    options : of `subprocess.Popen`
    """

    def __init__(self, command: list[str], environment: Mapping[str, str] | None = None, **options: Any) -> None:
        self.mark = f"{_MARK}{uuid.uuid4().hex}"
        variables = os.environ | dict(environment or {}) | {self.mark: "1"}
        self.process = subprocess.Popen(command, env=variables, start_new_session=True, **options)
        _MINDER.tell("group", self.process.pid, self.mark)
        self._kill = weakref.finalize(self, _kill, self.process, self.mark, os.getpid())

    def ended(self) -> bool:
        """Whether the process has ended by itself; it is not waited for, so that its number stays its own."""
        if self.process.returncode is not None:
            return True
        if not hasattr(os, "waitid"):  # macOS before Python 3.13
            return self.process.poll() is not None
        with suppress(ChildProcessError):
            return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        return True

    def kill(self, everywhere: bool = True) -> int:
        """Kill what is left of it and of what it started, also outside its process group if `everywhere` is true.

        The exit code as in `subprocess`.
        """
        if not everywhere and self._kill.detach():
            _kill(self.process, "", os.getpid())
        self._kill()
        return self.process.returncode


def _kill(process: subprocess.Popen, mark: str, owner: int) -> None:
    if owner != os.getpid():  # a copy of this object in a forked process
        return
    if process.returncode is None or not hasattr(os, "waitid"):
        orphan_reaper.kill_tree(process.pid, mark)
        process.wait()
    _MINDER.tell("gone", process.pid)


class TemporaryFolder:
    """A temporary folder, removed at the end of a with statement, with this object, or after this process was killed.

    Attributes
    ----------
    path : Path
    """

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="fe_likelihoods_"))
        _MINDER.tell("folder", str(self.path))
        self._remove = weakref.finalize(self, _remove, str(self.path), os.getpid())

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *exception: object) -> None:
        self._remove()


def _remove(folder: str, owner: int) -> None:
    if owner == os.getpid():
        shutil.rmtree(folder, ignore_errors=True)
        _MINDER.tell("gone", folder)


def ending(exit_code: int, who: str) -> str:
    """How a process ended, in words, such as "the worker process died (signal 11)"."""
    return f"{who} died (signal {-exit_code})" if exit_code < 0 else f"{who} ended with exit code {exit_code}"


class PickledFunction(NamedTuple):
    """A function on its way to workers: the pickled function, `payload`, and its digest, `key`."""

    payload: bytes
    key: bytes

    @classmethod
    def of(cls, function: Any) -> "PickledFunction":
        """Pickle a function; ValueError where that is not possible."""
        try:
            payload = pickle.dumps(function, protocol=5)
        except Exception as error:
            raise ValueError(
                f"{repr(function)[:200]} cannot be sent to another process: {type(error).__name__}: {error}. Define "
                "functions and classes at the top level of a module, and keep open files, locks and connections out "
                "of them"
            ) from error
        return cls(payload, blake2b(payload, digest_size=16).digest())

    def script(self) -> str | None:
        """The script in which parts of the function are defined, None if there are none; ValueError for a notebook."""
        if not any(name.encode() in self.payload for name in _SCRIPTS):
            return None
        if all(argument not in _SCRIPTS for _, argument, _ in pickletools.genops(self.payload)):
            return None
        _refuse_while_reading()
        path = getattr(sys.modules["__main__"], "__file__", None)
        if path is None or not Path(path).is_file():
            raise ValueError(
                "what is defined in a notebook or at a prompt cannot be loaded in another process: put the function or "
                "class into a file and import it"
            )
        return str(Path(path).resolve())


class Reply(NamedTuple):
    """What a worker answers: kind is "loaded", "unusable" (value: why), "done" or "raised" (value: the exception)."""

    kind: str
    value: Any


class Worker:
    """A process that runs a function for one item at a time.

    Send a `PickledFunction`, receive "loaded"; send an item, receive "done" or "raised". Only one of them at a time.

    Parameters
    ----------
    environment : mapping, optional
        Variables added to this process's own.
    memory_limit : int
        The most address space of the process [bytes], beyond which allocations in it fail; 0 for no limit.
    output : open file, optional
        Takes what is written to standard output and error; by default it goes where ours goes.
    """

    def __init__(self, environment: Mapping[str, str] | None = None, memory_limit: int = 0, output: Any = None) -> None:
        _refuse_while_reading()
        self.connection, theirs = Pipe()
        with theirs:
            command = [
                sys.executable,
                "-c",
                _BOOT,
                json.dumps([str(path) for path in sys.path]),
                str(theirs.fileno()),
                str(memory_limit),
            ]
            self._started = Started(
                command,
                environment,
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        self.key = b""
        self._owner = os.getpid()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._started.process.pid

    @property
    def alive(self) -> bool:
        """Whether the process is there and belongs to this one."""
        return self._owner == os.getpid() and not self._started.ended()

    def load(self, shipment: PickledFunction) -> None:
        """Send the function that items are for; ValueError if it is defined where no other process can load it."""
        self._send(("load", shipment.payload, shipment.script()))
        self.key = shipment.key

    def submit(self, item: Any) -> None:
        """Send an item."""
        self._send(("call", item))

    def _send(self, message: tuple) -> None:
        data = pickle.dumps(message, protocol=5)
        with suppress(OSError):  # that it has died is found out by whoever waits for the answer
            self.connection.send_bytes(data)

    def receive(self) -> Reply | None:
        """The answer, None if there is none yet; RunFailed if the process has died."""
        try:
            if self.connection.poll():
                return Reply(*pickle.loads(self.connection.recv_bytes()))
            # a program that it has left behind may hold the connection open: look at the process itself
            if not self._started.ended() or self.connection.poll():
                return None
        except (EOFError, OSError):
            self.wait_briefly()
        raise RunFailed(ending(self.kill(), "the worker process"))

    def wait_briefly(self) -> None:
        """Give a process that has closed its connection the time to end by itself, so that its exit code is its own."""
        give_up = time.monotonic() + 5.0
        while not self._started.ended() and time.monotonic() < give_up:
            time.sleep(0.001)

    def kill(self) -> int:
        """End the process and all that it has started; its exit code."""
        exit_code = self._started.kill()
        self.connection.close()
        return exit_code


def serve(fileno: int, memory_limit: int) -> None:
    """What a worker process does: answer until the connection closes."""
    os.set_inheritable(fileno, False)
    if memory_limit:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory_limit, memory_limit))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ours to end, not the terminal's
    function: Callable = _nothing
    with Connection(fileno) as connection:
        while True:
            try:
                kind, content, *rest = pickle.loads(connection.recv_bytes())
            except (EOFError, OSError):
                return
            except Exception as error:
                connection.send_bytes(_packed("raised", error))
                continue
            if kind == "load":
                try:
                    if rest[0] is not None:
                        _read_script(rest[0])
                    function = pickle.loads(content)
                    answer = _packed("loaded", None)
                except Exception as error:
                    answer = _packed("unusable", f"{type(error).__name__}: {error}")
            else:
                try:
                    answer = _packed("done", function(content))
                except Exception as error:
                    answer = _packed("raised", error)
            connection.send_bytes(answer)


def _nothing(item: Any) -> None:
    raise RuntimeError("no function was sent")


def _refuse_while_reading() -> None:
    if _reading:
        raise RuntimeError(
            "a worker process reads this script again to find what is defined in it, and must not start workers of its "
            'own then: put what the script does under if __name__ == "__main__":'
        )


def _read_script(path: str) -> None:
    """Make what is defined in the script that the other process runs known here under the same name."""
    import runpy
    import types

    global _reading
    _reading = True
    try:
        module = types.ModuleType("__main__")
        module.__file__ = path
        module.__dict__.update(runpy.run_path(path, run_name="__mp_main__"))
        sys.modules["__main__"] = sys.modules["__mp_main__"] = module
    finally:
        _reading = False


def _packed(kind: str, value: Any) -> bytes:
    try:
        data = pickle.dumps((kind, value), protocol=5)
        if kind == "raised":
            pickle.loads(data)  # exceptions with arguments of their own are often written and not read
        return data
    except Exception as error:
        shown = value if kind == "raised" else error
        return pickle.dumps(("raised", RuntimeError(f"{type(shown).__name__}: {shown}")))


def last_lines(file: Any, most: int) -> str:
    """The last lines of an open file that are not empty, at most 300 characters."""
    size = os.fstat(file.fileno()).st_size
    data = os.pread(file.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")
    lines = [line.strip() for line in data.splitlines() if line.strip()]
    return " / ".join(lines[-most:])[-300:]
