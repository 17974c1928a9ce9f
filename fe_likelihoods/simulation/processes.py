"""Processes for simulations, which may hang, crash or use too much memory.

A `ManagedProcess` is killed together with everything it has started, and does not outlive the process that started it
(see `fe_likelihoods.simulation.orphan_reaper`). A `Worker` is a managed Python interpreter that is sent a function once
and then items one by one.

Workers are started with `subprocess`, not with `multiprocessing`, because they must also work inside the workers of any
pool, many of which may not start `multiprocessing` processes. Linux and macOS.
"""

import json
import os
import pickle
import pickletools
import re
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
from .faults import FailedRun, TransientReason, is_transient

__all__ = [
    "ManagedProcess",
    "PickledFunction",
    "RunFailed",
    "TemporaryFolder",
    "Worker",
    "WorkerReply",
    "describe_exit",
    "last_lines",
    "local_definition",
    "serve",
    "without_addresses",
]

_BOOT = (
    "import json, sys; sys.path[:], sys.argv, *settings = json.loads(sys.argv[1]); "
    "from fe_likelihoods.simulation.processes import serve; serve(*settings)"
)
_MARK = "FE_LIKELIHOODS_RUN_"
_SCRIPTS = ("__main__", "__mp_main__")  # names of the user's script as it runs, and as a worker imports it
_importing_script = False


class RunFailed(FailedRun):
    """A run in another process failed.

    Attributes
    ----------
    reason : str
        Why it failed, in words; a `TransientReason` if the process was stopped, was killed or crashed.
    seconds : float or None
        Duration of the run [s], if known.
    """

    def __init__(self, reason: str, seconds: float | None = None) -> None:
        super().__init__(reason, seconds)
        self.reason = reason
        self.seconds = seconds


class _Reaper:
    """The orphan reaper of this process, started when it is first needed."""

    def __init__(self) -> None:
        # reentrant, because the garbage collector may run the finalizer of another process while a message is sent
        self._lock = threading.RLock()
        self._process: subprocess.Popen | None = None
        self._owner = 0

    def send(self, *message: Any) -> None:
        """Send a message of `orphan_reaper.main`."""
        with self._lock:
            if self._owner != os.getpid() or self._process is None or self._process.poll() is not None:
                command = [sys.executable, "-I", "-S", orphan_reaper.__file__]
                self._process = subprocess.Popen(
                    command,
                    env=_without_marks(os.environ),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    start_new_session=True,
                    bufsize=0,
                )
                self._owner = os.getpid()
            with suppress(BrokenPipeError):
                self._process.stdin.write(json.dumps(message).encode() + b"\n")


def _without_marks(variables: Mapping[str, str]) -> dict[str, str]:
    """Environment of a process that cleans up: killing its parent by a mark must not kill it."""
    return {name: value for name, value in variables.items() if not name.startswith(_MARK)}


_REAPER = _Reaper()


def _release_in_child() -> None:
    """In a forked process: a thread of its parent may have held the lock."""
    _REAPER._lock = threading.RLock()


os.register_at_fork(after_in_child=_release_in_child)


class ManagedProcess:
    """A process in its own session, with everything it starts.

    It is killed with its descendants by `kill`, when this object is garbage-collected, or when this process exits.

    Parameters
    ----------
    command : list of str
        Program and arguments; no shell is used.
    environment : mapping, optional
        Environment variables in addition to those of this process.
    grace : float
        Time that the process has to clean up and end after SIGTERM [s], as a process does that starts others; 0 to kill
        it at once.
    **options
        Passed to `subprocess.Popen`.
    """

    def __init__(
        self, command: list[str], environment: Mapping[str, str] | None = None, grace: float = 0.0, **options: Any
    ) -> None:
        self.mark = f"{_MARK}{uuid.uuid4().hex}"
        variables = os.environ | dict(environment or {}) | {self.mark: "1"}
        if grace:
            variables = _without_marks(variables)
        self.process = subprocess.Popen(command, env=variables, start_new_session=True, **options)
        _REAPER.send("group", self.process.pid, self.mark, grace)
        self._kill = weakref.finalize(self, _kill, self.process, self.mark, os.getpid(), grace)

    def ended(self) -> bool:
        """Whether the process has exited; it is not waited for, so that its process id is not reused."""
        if self.process.returncode is not None:
            return True
        if not hasattr(os, "waitid"):  # macOS before Python 3.13
            return self.process.poll() is not None
        with suppress(ChildProcessError):
            return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        return True

    def kill(self) -> int:
        """Kill the process and its descendants; returns its exit code, as in `subprocess`."""
        self._kill()
        return self.process.returncode


def _kill(process: subprocess.Popen, mark: str, owner: int, grace: float) -> None:
    """Kill a process with its descendants, unless the calling process has only a forked copy of its object."""
    if owner != os.getpid():
        return
    if process.returncode is None or not hasattr(os, "waitid"):
        if grace and process.returncode is None:
            orphan_reaper.terminate(
                process.pid, grace, None if hasattr(os, "waitid") else lambda _: process.poll() is None
            )
        orphan_reaper.kill_tree(process.pid, mark)
        process.wait()
    _REAPER.send("gone", process.pid)


class TemporaryFolder:
    """Temporary folder.

    It is removed at the end of a with statement, when this object is garbage-collected, or after this process was
    killed.

    Attributes
    ----------
    path : Path
    """

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="fe_likelihoods_"))
        _REAPER.send("folder", str(self.path))
        self._remove = weakref.finalize(self, _remove, str(self.path), os.getpid())

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *exception: object) -> None:
        self._remove()


def _remove(folder: str, owner: int) -> None:
    if owner == os.getpid():
        shutil.rmtree(folder, ignore_errors=True)
        _REAPER.send("gone", folder)


def describe_exit(exit_code: int, who: str) -> str:
    """Description of an exit code, such as "the worker process died (signal 11)"."""
    return f"{who} died (signal {-exit_code})" if exit_code < 0 else f"{who} ended with exit code {exit_code}"


def local_definition(thing: Any) -> str:
    """What prevents a function, or an instance of a class, from being found by its name; empty if nothing does."""
    if not hasattr(thing, "__qualname__"):
        return "an object of a local class" if "<locals>" in type(thing).__qualname__ else ""
    if "<lambda>" in thing.__qualname__:
        return "a lambda"
    return "a local function or class" if "<locals>" in thing.__qualname__ else ""


def without_addresses(message: str) -> str:
    """A message without the addresses of objects, which differ between runs."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", message)


def _digest(payload: bytes) -> bytes:
    return blake2b(payload, digest_size=16).digest()


class PickledFunction(NamedTuple):
    """A function as it is sent to workers.

    Attributes
    ----------
    payload : bytes
        The pickled function.
    key : bytes
        Digest of the payload.
    """

    payload: bytes
    key: bytes

    @classmethod
    def of(cls, function: Any) -> "PickledFunction":
        """Pickle a function; ValueError if that is impossible."""
        try:
            payload = pickle.dumps(function, protocol=5)
        except Exception as error:
            name = getattr(function, "__qualname__", type(function).__qualname__)
            local = local_definition(function)
            why = f"it is {local}" if local else f"{type(error).__name__}: {without_addresses(str(error))}"
            raise ValueError(
                f"{name} cannot be sent to another process ({why}). Define functions and classes at the top level of a "
                "module, without open files, locks and connections"
            ) from error
        return cls(payload, _digest(payload))

    def load(self) -> Any:
        """Unpickle the function; ValueError, before anything is unpickled, if the payload does not match its digest."""
        if _digest(self.payload) != self.key:
            raise ValueError("the pickled function has been changed after it was sent: its digest differs")
        return pickle.loads(self.payload)

    def script(self) -> str | None:
        """Path of the user's script if the function uses definitions in it, else None; ValueError for a notebook."""
        if not any(name.encode() in self.payload for name in _SCRIPTS):
            return None
        if all(argument not in _SCRIPTS for _, argument, _ in pickletools.genops(self.payload)):
            return None
        _refuse_while_importing_script()
        path = getattr(sys.modules["__main__"], "__file__", None)
        if path is None or not Path(path).is_file():
            raise ValueError(
                "a function or class that is defined in a notebook or at a prompt cannot be loaded in another process: "
                "put it into a file and import it"
            )
        return str(Path(path).resolve())


class WorkerReply(NamedTuple):
    """Reply of a worker.

    Attributes
    ----------
    kind : {"loaded", "unusable", "done", "raised"}
    value : object
        None, the reason, the result, or the exception.
    """

    kind: str
    value: Any


class Worker:
    """Process that runs a function for one item at a time.

    Send a `PickledFunction` with `load` and receive "loaded" or "unusable"; send an item with `submit` and receive
    "done" or "raised". Only one message may be unanswered.

    Parameters
    ----------
    environment : mapping, optional
        Environment variables in addition to those of this process.
    memory_limit : int
        Limit of the address space of the process [bytes], beyond which its allocations fail; 0 for no limit.
    output : open file, optional
        Receives standard output and standard error, which are otherwise those of this process.

    Attributes
    ----------
    key : bytes
        Digest of the function that was sent last.
    runs : int
        Number of items that were sent.
    """

    def __init__(self, environment: Mapping[str, str] | None = None, memory_limit: int = 0, output: Any = None) -> None:
        _refuse_while_importing_script()
        self.connection, theirs = Pipe()
        with theirs:
            # the arguments as well, because a script that is imported may read them
            texts = [[str(text) for text in texts] for texts in (sys.path, sys.argv)]
            command = [sys.executable, "-c", _BOOT, json.dumps([*texts, theirs.fileno(), memory_limit])]
            self._process = ManagedProcess(
                command,
                environment,
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        self.key = b""
        self.runs = 0
        self._owner = os.getpid()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs and is a child of this process (not of the one this was forked from)."""
        return self._owner == os.getpid() and not self._process.ended()

    def load(self, function: PickledFunction) -> None:
        """Send the function to call; ValueError if it is defined where no other process can load it."""
        self._send(("load", function.payload, function.script()))
        self.key = function.key

    def submit(self, item: Any) -> None:
        """Send an item."""
        self.runs += 1
        self._send(("call", item))

    def _send(self, message: tuple) -> None:
        data = pickle.dumps(message, protocol=5)
        with suppress(OSError):  # `receive` reports that the process has died
            self.connection.send_bytes(data)

    def receive(self) -> WorkerReply | None:
        """The reply, or None if there is none yet; RunFailed if the process has died."""
        try:
            if self.connection.poll():
                return WorkerReply(*pickle.loads(self.connection.recv_bytes()))
            # a program that the process started may hold the connection open: check the process itself
            if not self._process.ended() or self.connection.poll():
                return None
        except (EOFError, OSError):
            self.wait_briefly()
        raise RunFailed(TransientReason(describe_exit(self.kill(), "the worker process")))

    def wait_briefly(self) -> None:
        """Wait for a process that has closed its connection to exit by itself, to get its own exit code."""
        give_up = time.monotonic() + 5.0
        while not self._process.ended() and time.monotonic() < give_up:
            time.sleep(0.001)

    def kill(self) -> int:
        """Kill the process and everything it has started; returns its exit code."""
        exit_code = self._process.kill()
        self.connection.close()
        return exit_code


def serve(fileno: int, memory_limit: int) -> None:
    """Main loop of a worker process: answer messages until the connection closes.

    Parameters
    ----------
    fileno : int
        File descriptor of the connection.
    memory_limit : int
        As for `Worker`.
    """
    os.set_inheritable(fileno, False)
    if memory_limit:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory_limit, memory_limit))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which ends this process
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
                        _import_script(rest[0])
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
    """The function of a worker before it is sent one."""
    raise RuntimeError("no function was sent")


def _refuse_while_importing_script() -> None:
    """Raise RuntimeError if this process is a worker that imports the user's script."""
    if _importing_script:
        raise RuntimeError(
            "a worker process imports this script to find the functions and classes that are defined in it, and must "
            'not start workers meanwhile: put the code that runs under if __name__ == "__main__":'
        )


def _import_script(path: str) -> None:
    """Import the script that the parent runs, so that functions and classes defined in it can be unpickled."""
    import runpy
    import types

    global _importing_script
    _importing_script = True
    try:
        module = types.ModuleType("__main__")
        module.__file__ = path
        module.__dict__.update(runpy.run_path(path, run_name="__mp_main__"))
        sys.modules["__main__"] = sys.modules["__mp_main__"] = module
    finally:
        _importing_script = False


def _packed(kind: str, value: Any) -> bytes:
    """Pickled reply; what cannot be pickled is replaced by an exception with its message, or that of the error."""
    try:
        data = pickle.dumps((kind, value), protocol=5)
        if kind == "raised":
            pickle.loads(data)  # exceptions with constructors of their own can often be pickled but not unpickled
        return data
    except Exception as error:
        shown = value if kind == "raised" else error
        text = f"{type(shown).__name__}: {shown}"
        return pickle.dumps(
            ("raised", RunFailed(TransientReason(text)) if is_transient(shown) else RuntimeError(text)), protocol=5
        )


def last_lines(file: Any, most: int) -> str:
    """The last non-empty lines of an open file, at most `most` lines and 300 characters."""
    size = os.fstat(file.fileno()).st_size
    data = os.pread(file.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")
    lines = [line.strip() for line in data.splitlines() if line.strip()]
    return " / ".join(lines[-most:])[-300:]
