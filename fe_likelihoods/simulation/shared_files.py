"""Files that simulations running at once may both write: simulations that write such files run one after the other.

An audit hook (`sys.addaudithook`) sees what Python code is about to write. Before it writes a file outside of its own
folder, which it has not made exclusively, a simulation waits for a lock, which all simulations of this user share on
this machine, and holds it to its end. Compiled code and programs write without an event: a file that they have written
by an absolute path is noticed when Python code reads it, since it has changed since the simulation began. If that
happens twice, the model is refused.
"""

import contextlib
import os
import shutil
import stat
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from .faults import UnusableModel

try:
    import fcntl
except ImportError:  # Windows: simulations that write one file at once are not kept apart there
    fcntl = None

__all__ = [
    "RunningSimulation",
    "UnguardedFile",
    "holds_lock",
    "of_this_library",
    "running_simulation",
    "sender_holds_lock",
    "warn_or_refuse",
    "worse",
]

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_TEMPORARY = getattr(os, "O_TMPFILE", 0)  # a file without a name
_SYSTEM = ("/proc/", "/sys/", "/dev/", "/run/")
_CACHES = {"__pycache__", ".cache", ".config"}  # written once per machine, by installed packages
_CACHES_OF_NUMBA = (".nbi", ".nbc")

_running: "dict[int, RunningSimulation]" = {}  # by thread; 0 for all threads of a process that runs one at a time
_own = threading.local()
when_waiting: Callable[[bool], None] = bool  # called when a simulation begins and ends to wait for the lock
_has_hook = False
_warned: set[str] = set()
_fresh: set[str] = set()  # files that simulations have read and that were written while they ran


class UnguardedFile(str):
    """Path of a file that simulations running at once write without an event, so that they cannot wait."""


def worse(path: str, other: str) -> str:
    """The more important one of two files that simulations share; "" for none."""
    return other if isinstance(other, UnguardedFile) else path or other


class RunningSimulation:
    """A simulation that runs now, in its own folder `place` (without links; "" if it has none).

    `thread` runs it, 0 if all threads of this process belong to it; `is_remote` if another machine has sent it.
    `shared` is the first file that it wrote and other simulations may write too, else ""; `has_programs` if it started
    processes.
    """

    def __init__(self, place: str, thread: int, is_remote: bool) -> None:
        self.place, self._thread, self._is_remote = place, thread, is_remote
        self.shared, self.has_programs, self._process = "", False, os.getpid()
        self._made: set[str] = set()  # files and folders
        self._lock: int | None = None
        self._start = time.time_ns()
        self._refusal: UnusableModel | None = None

    @property
    def locked(self) -> bool:
        """Whether it holds the lock."""
        return self._lock is not None or getattr(_own, "sender_holds_lock", False)

    def run(self, function: Callable[[Any], Any], item: Any) -> Any:
        """Result of the function for an item; `UnusableModel` if it writes a file that cannot be protected."""
        global _has_hook
        if not _has_hook:
            _has_hook = True
            sys.addaudithook(_hook)  # for the life of the process
        _running[self._thread] = self
        try:
            return function(item)
        finally:
            del _running[self._thread]
            if self._lock is not None and self._process == os.getpid():  # not in a copy of the process
                fcntl.flock(self._lock, fcntl.LOCK_UN)  # processes that it has started may have the file open
                os.close(self._lock)
                self._lock = None
            if self._refusal is not None:
                raise self._refusal

    # events of the audit hook ---------------------------------------------------------------------------------------

    def opens(self, path: Any, mode: Any, flags: int) -> None:
        """A link in the own folder is replaced by a private file before it is opened for writing."""
        if not flags & _WRITING:
            self.reads(path)
            return
        if _TEMPORARY and flags & _TEMPORARY == _TEMPORARY:
            return
        if (path := _full(path)) is None or os.path.isdir(path):  # of tempfile, which opens a file in it
            return
        if self._is_own(path):
            if os.path.islink(path) and not flags & os.O_EXCL:
                target = os.path.realpath(path)
                os.unlink(path)
                if not flags & os.O_TRUNC and os.path.isfile(target):
                    shutil.copyfile(target, path)
        elif flags & os.O_EXCL:
            self.makes(path)
        elif mode is None and not flags & (os.O_RDWR | os.O_TRUNC):  # Path.touch
            return
        elif not flags & os.O_APPEND:
            self.writes(path)

    def reads(self, path: Any) -> None:
        """Notice a file that was written while this simulation runs, but not by Python code of this simulation."""
        if self.locked or (path := _full(path)) is None or path.startswith(_SYSTEM) or self._is_own(path):
            return
        with contextlib.suppress(OSError):
            status = os.stat(path)
            if not self._start <= status.st_mtime_ns <= time.time_ns() or not stat.S_ISREG(status.st_mode):
                return
            if _is_cache(path) or self._has_made(path):
                return
            if path in _fresh:
                self.shared = UnguardedFile(path)
            _fresh.add(path)

    def makes(self, path: Any) -> None:
        if (path := _full(path)) is not None and not os.path.lexists(path):
            self._made.add(path)

    def removes(self, path: Any, folder: int | None) -> None:
        if folder in (None, -1):  # else within a folder, whose removal has an event of its own
            self.writes(path)

    def starts(self, folder: Any = None) -> None:
        """A process, or a program that may write in its folder."""
        self.has_programs = True
        self.enters(folder)

    def enters(self, folder: Any) -> None:
        if isinstance(folder, str | bytes | os.PathLike):
            self.writes(os.path.join(os.path.realpath(os.fsdecode(folder)), "*"))

    def writes(self, path: Any) -> None:
        """Wait for the lock before a file is written, unless it belongs to this simulation alone."""
        if path in ("", ":memory:"):  # a database
            return
        if (path := _full(path)) is None or self._is_own(path) or self.locked or _is_cache(path):
            return
        if self._has_made(path):
            return
        with contextlib.suppress(OSError):
            mode = os.stat(path).st_mode
            if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # a terminal, a pipe, /dev/null
                return
        shown = os.path.dirname(path) if path.endswith("/*") else path
        temporary = os.path.realpath(tempfile.gettempdir())
        if self._is_remote and _device(os.path.dirname(path)) != _device(temporary):
            self._refusal = UnusableModel(
                f"A simulation writes to {shown} on another machine than the process that sends it, where simulations "
                "on several machines may write at once: use a relative file name, which is private to each simulation "
                "(docs/parallel.rst)"
            )
            raise self._refusal
        self.shared = worse(shown, self.shared)
        if fcntl is None:
            return
        lock = os.path.join(temporary, f"fe_likelihoods_{os.getuid()}.lock")
        self._lock = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            when_waiting(True)
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            when_waiting(False)

    def _has_made(self, path: str) -> bool:
        return any(path == made or path.startswith(made + os.sep) for made in self._made)

    def _is_own(self, path: str) -> bool:
        return bool(self.place) and path.startswith(self.place + os.sep)


_EVENTS: dict[str, Callable[[RunningSimulation, tuple], Any]] = {
    "open": lambda simulation, arguments: simulation.opens(*arguments),
    "os.chdir": lambda simulation, arguments: simulation.enters(arguments[0]),
    "os.fork": lambda simulation, _: simulation.starts(),
    "os.posix_spawn": lambda simulation, _: simulation.starts("."),
    "os.system": lambda simulation, _: simulation.starts("."),
    "subprocess.Popen": lambda simulation, arguments: simulation.starts(arguments[2] or "."),
    "tempfile.mkdtemp": lambda simulation, arguments: simulation.makes(arguments[0]),
}
for _event in ("os.mkdir", "os.truncate", "shutil.rmtree", "sqlite3.connect"):
    _EVENTS[_event] = lambda simulation, arguments: simulation.writes(arguments[0])
for _event in ("os.link", "os.rename", "os.symlink"):
    _EVENTS[_event] = lambda simulation, arguments: simulation.writes(arguments[1])
for _event in ("os.remove", "os.rmdir"):
    _EVENTS[_event] = lambda simulation, arguments: simulation.removes(*arguments)


def _hook(event: str, arguments: tuple) -> None:
    if not _running or event not in _EVENTS or getattr(_own, "is_quiet", False):
        return
    if (simulation := running_simulation()) is not None:
        with of_this_library():
            _EVENTS[event](simulation, arguments)


def running_simulation() -> RunningSimulation | None:
    """The simulation that runs in this thread."""
    return _running.get(threading.get_ident()) or _running.get(0)


@contextlib.contextmanager
def of_this_library() -> Iterator[None]:
    """Files and programs in the ``with`` block do not belong to the simulation."""
    before, _own.is_quiet = getattr(_own, "is_quiet", False), True
    try:
        yield
    finally:
        _own.is_quiet = before


def holds_lock() -> bool:
    """Whether the simulation of this thread holds the lock."""
    simulation = running_simulation()
    return simulation is not None and simulation.locked


def sender_holds_lock(locked: bool) -> None:
    """Tell that a simulation which holds the lock waits for the next simulation of this thread."""
    _own.sender_holds_lock = locked


def warn_or_refuse(path: str, n_workers: int | None) -> None:
    """Warn, once for each folder, that simulations run one after the other, since they may write the same file.

    `UnusableModel` for an `UnguardedFile`. Nothing if there is one worker only, or `path` is "".
    """
    if not path or n_workers == 1:
        return
    advice = "a relative file name, which is private to each simulation (docs/parallel.rst)"
    if isinstance(path, UnguardedFile):
        raise UnusableModel(
            f"The simulations read {path}, which a program or compiled code writes while they run, so that simulations "
            f"in other workers may write it too: use {advice}, or pool=1"
        )
    if os.path.dirname(path) not in _warned:
        _warned.add(os.path.dirname(path))
        warnings.warn(
            f"The simulations write to {path}, where simulations in other workers may write too, so they run one after "
            f"the other from their first write on. Use a pool of processes and {advice}",
            stacklevel=2,
        )


def _full(path: Any) -> str | None:
    """Absolute path, without links among its folders; None for file descriptors."""
    if not isinstance(path, str | bytes | os.PathLike):
        return None
    folder, name = os.path.split(os.path.abspath(os.fsdecode(path)))
    return os.path.join(os.path.realpath(folder), name)


def _is_cache(path: str) -> bool:
    folder, name = os.path.split(path)
    return not _CACHES.isdisjoint(folder.split(os.sep)) or any(suffix in name for suffix in _CACHES_OF_NUMBA)


def _device(folder: str) -> int | None:
    with contextlib.suppress(OSError):
        return os.stat(folder).st_dev
    return None
