"""What a simulation opens while it runs: files, modules, shared libraries and programs.

An audit hook (`sys.addaudithook`) sees every file that Python code opens. It listens while a simulation runs, in this
process, in a pool's worker or in the process of an isolated function. Not counted are files that the simulation writes
itself, and files of Python and installed packages.
"""

import contextlib
import functools
import os
import shutil
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

from .folder import Sender, get_ready, run_in_folder, shown
from .shared_files import warn_or_refuse, worse

__all__ = ["Observed", "Opened", "file_digest", "note", "observing", "unpack"]

_MOST_REPEATED = 100  # if more files were opened, a result names the new ones only
_CLOCK_TICK = 2.0  # [s]; a file changed more recently may change again with the same modification time
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_SYSTEM = ("/proc/", "/sys/", "/dev/", "/usr/", "/lib", "/etc/", "/bin/", "/opt/", "/memfd:", "/SYSV", "/run/")

_observers: "list[_Observer]" = []
_lock = threading.Lock()
_has_hook = False
_digests: dict[str, tuple[tuple, float, str]] = {}


class Opened(NamedTuple):
    """What one simulation opened: digests of the contents of files, by path."""

    files: dict[str, str]
    shared: str = ""  # a file that it has written and other simulations may write too

    def items(self) -> dict[str, str]:
        """Digests by file name, so that the folder does not matter."""
        found: dict[str, list[str]] = {}
        for path, digest in self.files.items():
            found.setdefault(f"opened {os.path.basename(path)}", []).append(digest)
        return {name: " ".join(sorted(digests)) for name, digests in found.items()}

    def __or__(self, other: "Opened") -> "Opened":
        return Opened(self.files | other.files, worse(self.shared, other.shared))

    def read_again(self) -> "Opened":
        """The same files with their present digests; files that are not found, as on other machines, keep theirs."""
        return Opened({path: _digest_or(path, digest) for path, digest in self.files.items()})


class _Observer:
    """Records what is opened while it is in the list of observers."""

    def __init__(self) -> None:
        self.read: set[str] = set()
        self.written: set[str] = set()
        self.noted: dict[str, str] = {}
        self.shared = ""
        self.modules = set(sys.modules)

    def result(self, known: Opened | None = None) -> Opened | None:
        """Files that were read and not written, including new modules and shared libraries; None if all are known."""
        files, shared = ({}, "") if known is None else known
        if known is not None and self.noted.keys() <= files.keys() and len(sys.modules) == len(self.modules):
            if not any(path not in files and _counts(path) for path in self.read - self.written):
                if worse(shared, self.shared) is shared:
                    return None
        new = [getattr(sys.modules[name], "__file__", None) for name in set(sys.modules) - self.modules]
        read = self.read | {file for file in new if isinstance(file, str)} | set(_mapped())
        files = {path: _digest_or(path, "") for path in read - self.written if _counts(path)}
        return Opened({path: digest for path, digest in files.items() if digest} | self.noted, self.shared)


class Observed:
    """A function of one item, whose results include what it opened; other processes call it in a folder of its own.

    A call returns the result, and an `Opened` with all files that calls in this process have opened, or with the new
    files if there are more than 100 in all; None if there is nothing to report.
    """

    def __init__(self, function: Callable[[Any], Any], sender: Sender | None = None) -> None:
        self.function, self._sender = function, sender
        if sender is not None:
            get_ready(sender)
        self.__qualname__ = getattr(function, "__qualname__", type(function).__qualname__)  # for messages
        self._known: Opened | None = None

    def __repr__(self) -> str:
        return repr(self.function)

    def __reduce__(self) -> tuple:
        return Observed, (self.function, self._sender or Sender.here())

    def __call__(self, item: Any) -> tuple[Any, Opened | None]:
        """The result for an item, and what was opened."""
        with observing() as observer:
            result, shared = run_in_folder(self.function, item, self._sender)
            observer.shared = worse(observer.shared, shared)
        new = observer.result(self._known)
        if new is not None:
            self._known = new if self._known is None else new | self._known
        # all files each time, since earlier results may have been lost
        return result, self._known if len(self._known.files) <= _MOST_REPEATED else new


def unpack(outcome: tuple, pool: Any) -> tuple[Any, Opened | None]:
    """Simulation result from a pool, and what it opened; for a lost worker, the pool reports a result only.

    Warns if simulations write files that they share; `UnusableModel` if that cannot be done one after the other.
    """
    if isinstance(outcome[1], str):
        return outcome, None
    if outcome[1] is not None:
        warn_or_refuse(outcome[1].shared, getattr(pool, "n_workers", None))
    return outcome


@contextlib.contextmanager
def observing() -> Iterator[_Observer]:
    """Observe what this process opens."""
    global _has_hook
    observer = _Observer()
    with _lock:
        if not _has_hook:
            sys.addaudithook(_hook)  # for the life of the process
            _has_hook = True
        _observers.append(observer)
    try:
        yield observer
    finally:
        with _lock:
            _observers.remove(observer)


def note(opened: Opened | None) -> None:
    """Tell the observers of this process what another process has opened for it."""
    if opened is not None:
        for observer in list(_observers):
            observer.noted.update(opened.files)
            observer.shared = worse(observer.shared, opened.shared)


def file_digest(path: str | os.PathLike) -> str:
    """Digest of a file's content; read again only after its size or modification time has changed."""
    name = os.fspath(path)
    status = os.stat(name)
    stamp = status.st_size, status.st_mtime_ns, status.st_ino
    known = _digests.get(name)
    if known is not None and known[0] == stamp and known[1] - status.st_mtime > _CLOCK_TICK:
        return known[2]
    now = time.time()
    digest = blake2b(digest_size=16)
    with open(name, "rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    _digests[name] = stamp, now, digest.hexdigest()
    return digest.hexdigest()


def _hook(event: str, arguments: tuple) -> None:
    if not _observers:
        return
    try:
        if event == "open":
            path, mode, flags = arguments
            writes = any(letter in mode for letter in "wax+") if isinstance(mode, str) else bool(flags & _WRITING)
            _add(path, writes)
        elif event in ("ctypes.dlopen", "sqlite3.connect"):
            _add(arguments[0], False)
        elif event == "subprocess.Popen":
            program, command, folder, _ = arguments
            words = [command] if isinstance(command, str | bytes | os.PathLike) else list(command)
            for word in filter(None, [shutil.which(os.fsdecode(program or words[0])), *words]):
                _add(os.path.join(folder or "", os.fsdecode(word)), False)
    except Exception:  # never disturb the code that is observed
        pass


def _add(path: Any, writes: bool) -> None:
    if isinstance(path, str | bytes | os.PathLike):
        if (path := shown(os.path.abspath(os.fsdecode(path)))) is None:
            return
        for observer in list(_observers):
            (observer.written if writes else observer.read).add(path)


def _mapped() -> list[str]:
    """Files mapped into this process's memory, such as shared libraries; on Linux only."""
    try:
        lines = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return []
    paths = [line.split(None, 5)[5:] for line in lines]
    return [path for (path,) in filter(None, paths) if path.startswith("/") and not path.endswith("(deleted)")]


def _counts(path: str) -> bool:
    """Whether a file counts: it does not belong to the system, Python or an installed package."""
    if path.startswith(_SYSTEM) or path.endswith((".pyc", "-shm", "-wal")) or "-packages" + os.sep in path:
        return False
    return not path.startswith(_installed()) and os.path.realpath(path) != os.path.realpath(sys.executable)


@functools.cache
def _installed() -> tuple[str, ...]:
    library = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    prefixes = [os.path.join(prefix, "lib") for prefix in (sys.prefix, sys.base_prefix)]
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    return tuple(os.path.realpath(folder) + os.sep for folder in (library, *prefixes, *map(sysconfig.get_path, names)))


def _digest_or(path: str, otherwise: str) -> str:
    try:
        return file_digest(path) if os.path.isfile(path) else otherwise
    except OSError:
        return otherwise
