"""What simulations do with files: what they read, for the label of their model, and where they write.

One audit hook (`sys.addaudithook`) sees what Python code of this process opens, writes and starts.

* Files, modules, shared libraries and programs that a simulation uses are inputs, apart from those whose content it
  changes, and those of Python and installed packages.
* User code often writes files of fixed names and reads them back: input of a program, output of an OpenSees recorder.
  So a worker process changes into a temporary folder for each simulation, which shows the sender's working folder:
  files as copies, large ones as links, subfolders as folders. If Python code opens a link for writing, a private file
  takes its place first. Threads of one process share its working folder: there, simulations that write are refused.
* So is a file outside of this folder that a simulation writes while others run, unless it has made it exclusively.
  Compiled code and programs write without an event: their files are noticed when Python code reads them.
"""

import contextlib
import functools
import hashlib
import itertools
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from hashlib import blake2b
from importlib.util import source_from_cache
from pathlib import Path
from typing import Any

from samplers.interrupts import process_name

from .failure_reasons import UnusableModel

__all__ = [
    "PLACE",
    "Group",
    "Observer",
    "Observed",
    "Opened",
    "digests_by_name",
    "file_digest",
    "mapped",
    "note",
    "read_again",
    "working_folder",
]

PLACE = "FE_LIKELIHOODS_PLACE"  # environment variable of a worker: the folder of its group
_CLOCK_TICK = 2.0  # [s]; a file changed more recently may change again with the same modification time
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_SYSTEM = ("/proc/", "/sys/", "/dev/", "/run/")
_INSTALLED = ("/usr/", "/lib", "/etc/", "/bin/", "/opt/", "/memfd:", "/SYSV")
_PREFIXES = Path(__file__).parents[1], Path(sys.prefix, "lib"), Path(sys.base_prefix, "lib")
_INSTALLED += tuple(os.path.realpath(each) + os.sep for each in _PREFIXES)
# written once per machine, by installed packages and numba
_CACHES = (*(f"{os.sep}{name}{os.sep}" for name in ("__pycache__", ".cache", ".config")), ".nbi", ".nbc")

_WATCH = 'trap "" TERM; read -r _; kill -TERM 0; rm -rf "$0" || { sleep 1; rm -rf "$0"; }; kill -KILL 0'
_MOST_ENTRIES = 100  # in subfolders that are shown as folders; other subfolders are links. A copy takes 60 us
_MOST_BYTES = 2**20  # of a copy
_OF_SQLITE = "-shm", "-wal", "-journal"  # of a data base in use; closing it here again would release SQLite's locks
_MOST_BESIDE = 3000  # entries beside the working folder, which ``..`` shows

_STARTS = {"os.fork", "os.posix_spawn", "os.system", "subprocess.Popen"}
_CHANGES = {"os.mkdir": 0, "os.truncate": 0, "shutil.rmtree": 0, "os.remove": 0, "os.rmdir": 0}  # places of paths
_CHANGES |= {"os.link": 1, "os.rename": 1, "os.symlink": 1}
_EVENTS = _STARTS | _CHANGES.keys() | {"open", "tempfile.mkdtemp", "sqlite3.connect", "ctypes.dlopen"}

_observers: "list[Observer]" = []
_add_hook = functools.cache(sys.addaudithook)  # for the life of the process
_own = threading.local()
_digests: dict[str, tuple[tuple, float, str]] = {}
_fresh: set[str] = set()  # files that simulations have read and that were written while they ran

Opened = dict[str, str]  # what simulations opened: digests of the contents of files, by path


def digests_by_name(opened: Opened) -> dict[str, str]:
    """Digests by file name, so that the folder does not matter."""
    found: dict[str, list[str]] = {}
    for path, digest in opened.items():
        found.setdefault(f"opened {os.path.basename(path)}", []).append(digest)
    return {name: " ".join(sorted(digests)) for name, digests in found.items()}


def read_again(opened: Opened) -> Opened:
    """The same files with their present digests; files that are not found, as on other machines, keep theirs."""
    found = dict(opened)
    for path in filter(os.path.isfile, opened):
        with contextlib.suppress(OSError):
            found[path] = file_digest(path)
    return found


class Observer:
    """Context that notes what is opened, written and started, by one `thread` or by all (0).

    A simulation has a thread, or a folder of its own, the `mirror`; `shared` is the first file that it and others may
    write. There must be none unless it runs `alone`: `UnusableModel` at the end of the context.
    """

    def __init__(self, alone: bool = True, thread: int = 0, mirror: "_Mirror | None" = None) -> None:
        self.alone, self.thread, self.mirror, self.shared = alone, thread, mirror, ""
        self.noted = Opened()
        self.used = Opened()  # files at their first use; empty digests of what it has made, and what does not count
        self._made: list[str] = []  # new files and folders, which belong to this simulation
        self._start = time.time_ns()

    def __enter__(self) -> "Observer":
        _add_hook(_hook)
        _observers.append(self)
        return self

    def __exit__(self, kind: type | None, *_: Any) -> None:
        _observers.remove(self)
        if kind is None and self.shared and not self.alone:
            raise UnusableModel(
                f"The simulations write to {self.shared.removesuffix('/*')}, or read there what is written while they "
                "run, as others may do at that moment, so that results would be mixed up. Use a pool of processes "
                "(dask: workers with one thread) and a relative file name, which is private to each simulation, or a "
                "folder from tempfile (docs/parallel.rst); or use one worker, pool=1"
            )

    def result(self, known: Opened) -> Opened:
        """The files that are `known`, and those that were used and have their content still, with new shared libraries.

        They have the names that the code has given to them: folders on the way may be links that change.
        """
        if any(digest and name not in known for name, digest in self.used.items()):
            known = known | {name: now for name, now in mapped(self.used).items() if self.used.get(name, now) == now}
        return known | self.noted

    def sees(self, how: str, path: str) -> None:
        """Note a file that others may write, too, if this simulation changes it, or reads what was just written."""
        if self.mirror is not None and path.startswith(self.mirror.path + os.sep):
            if how in ("writes", "touches") and os.path.islink(path):  # a private file takes its place
                target = os.path.realpath(path)
                os.unlink(path)
                if os.path.isfile(target):
                    shutil.copyfile(target, path)
            return
        is_made = any(path == each or path.startswith(each + os.sep) for each in self._made)
        if is_made or self.shared or any(each in path for each in _CACHES):
            return
        with contextlib.suppress(OSError):
            status = os.stat(path)
            is_file = stat.S_ISREG(status.st_mode)
            if not is_file and (how == "writes" or not stat.S_ISDIR(status.st_mode)):
                return  # a terminal, a pipe, /dev/null, a folder in which tempfile opens a file
            is_new = is_file and self._start <= status.st_mtime_ns <= time.time_ns()
            if how == "reads" and is_new and not path.startswith(_SYSTEM):  # not by Python code of this simulation
                self.shared = path if path in _fresh else ""
                _fresh.add(path)
        if how == "makes" and not os.path.lexists(path):
            self._made.append(path)
        elif how in ("writes", "changes"):
            self.shared = path


def note(opened: Opened) -> None:
    """Tell the observers of this process what another process has opened for it."""
    for observer in list(_observers):
        observer.noted.update(opened)


def running_simulation() -> Observer | None:
    """The simulation that runs in this thread."""
    own = (each for each in list(_observers) if each.thread in (0, threading.get_ident()))
    return next((each for each in own if each.thread or each.mirror is not None), None)


@contextlib.contextmanager
def _of_this_library() -> Iterator[None]:
    """Files in the ``with`` block do not belong to the simulation; the programs count as inputs."""
    before, _own.is_quiet = getattr(_own, "is_quiet", False), True
    try:
        yield
    finally:
        _own.is_quiet = before


def _hook(event: str, arguments: tuple) -> None:
    of_library = getattr(_own, "is_quiet", False)
    if not _observers or event not in (_STARTS if of_library else _EVENTS):
        return
    with _of_this_library():
        simulation, uses = running_simulation(), []
        with contextlib.suppress(Exception):  # never disturb the code that is observed
            uses = [(how, os.path.abspath(os.fsdecode(path))) for how, path in _uses(event, arguments)]
        mirror = None if simulation is None else simulation.mirror
        if mirror is not None and event in _STARTS and not of_library:
            mirror.states = {}  # where the process may still write
        for how, name in uses:
            path = os.path.join(os.path.realpath(os.path.dirname(name)), os.path.basename(name))
            if simulation is not None and not of_library:
                simulation.sees(how, os.path.realpath(path) if how == "reads" else path)
            if mirror is not None and name.startswith(mirror.place):  # the file that it shows, or one beside the folder
                name = os.path.abspath(os.path.join(mirror.base, os.path.relpath(name, mirror.path)))
            for observer in list(_observers) if how != "changes" else ():
                if observer.thread in (0, threading.get_ident()) and name not in observer.used:
                    counts = how in ("reads", "loads") and _counts(name)
                    observer.used[name] = read_again({name: ""})[name] if counts else ""


def _uses(event: str, arguments: tuple) -> list[tuple[str, Any]]:
    """How an event uses files, and their paths."""
    if event == "open":
        path, mode, flags = arguments
        if isinstance(path, int):  # a descriptor
            return []
        if not flags & _WRITING:  # a source is read in its compiled form
            is_cached = str(path).endswith(".pyc") and f".{sys.implementation.cache_tag}." in str(path)
            return [("reads", source_from_cache(path) if is_cached else path)]
        if flags & os.O_EXCL:
            return [("makes", path)]
        # what is appended stays apart, and Path.touch writes nothing
        is_changed = (mode is not None or flags & (os.O_RDWR | os.O_TRUNC)) and not flags & os.O_APPEND
        is_read = flags & os.O_RDWR and not flags & os.O_TRUNC
        return [*([("loads", path)] if is_read else []), ("writes" if is_changed else "touches", path)]
    if event == "subprocess.Popen":
        program, command, folder, _ = arguments
        words = [command] if isinstance(command, str | bytes | os.PathLike) else list(command)
        folder, found = os.fsdecode(folder or ""), [shutil.which(os.fsdecode(program or words[0])), *words]
        names = [os.path.join(folder, os.fsdecode(word)) for word in filter(None, found)]
        return [("changes", os.path.join(folder, "*")), *(("loads", name) for name in names)]
    if event in _STARTS:
        return [] if event == "os.fork" else [("changes", "*")]
    if event in _CHANGES:
        is_within = event in ("os.remove", "os.rmdir") and arguments[1] not in (None, -1)  # a folder that is removed
        changed = [] if is_within else [("changes", arguments[_CHANGES[event]])]
        if event in ("os.rename", "os.link", "os.symlink"):
            folder = os.path.dirname(os.fsdecode(arguments[1])) if event == "os.symlink" else ""
            return [("loads", os.path.join(folder, os.fsdecode(arguments[0]))), ("touches", arguments[1]), *changed]
        return changed
    return [("makes" if event == "tempfile.mkdtemp" else "loads", arguments[0])]


def file_digest(path: str | os.PathLike) -> str:
    """Digest of a file's content; read again only after its size or modification time has changed."""
    name = os.fspath(path)
    stamp, known = _state(name), _digests.get(name)
    if known is not None and known[0] == stamp and known[1] - 1e-9 * stamp[0] > _CLOCK_TICK:
        return known[2]
    now = time.time()
    with open(name, "rb") as file:
        digest = hashlib.file_digest(file, lambda: blake2b(digest_size=16)).hexdigest()
    _digests[name] = stamp, now, digest
    return digest


def mapped(read: Iterable[str] = ()) -> Opened:
    """Files that were read, and those mapped into this process's memory, such as shared libraries (on Linux only)."""
    paths = set(read)
    with contextlib.suppress(OSError):
        lines = [line.split(None, 5)[5:] for line in Path("/proc/self/maps").read_text().splitlines()]
        paths |= {path for (path,) in filter(None, lines) if path.startswith("/") and not path.endswith("(deleted)")}
    found = read_again(dict.fromkeys(filter(_counts, paths), ""))
    return {path: digest for path, digest in found.items() if digest}


@functools.lru_cache(1000)
def _counts(path: str) -> bool:
    """Whether a file counts: it does not belong to the system, Python or an installed package."""
    if path.startswith((*_SYSTEM, *_INSTALLED)) or path.endswith(_OF_SQLITE):
        return False
    return "-packages" + os.sep not in path and os.path.realpath(path) != os.path.realpath(sys.executable)


# working folders ----------------------------------------------------------------------------------------------------


def working_folder() -> str:
    """Working folder of this process, also while a simulation runs in its own folder; "" if it was removed."""
    simulation = running_simulation()
    if simulation is not None and simulation.mirror is not None:
        return simulation.mirror.base
    with contextlib.suppress(FileNotFoundError):
        return os.getcwd()
    return ""


class Observed:
    """A function of one item, whose results include what it opened; other processes call it in a folder of its own.

    A call returns the result, and all files that calls in this process have opened, since earlier results may have been
    lost. `alone` as for an `Observer`, by default what holds where it is sent; `sender` is the name and the working
    folder of the process that has sent it.
    """

    def __init__(
        self, function: Callable[[Any], Any], alone: bool | None = None, sender: tuple[bytes, str] | None = None
    ) -> None:
        self.function, self._alone, self._sender = function, alone, sender
        self.__qualname__ = getattr(function, "__qualname__", type(function).__qualname__)  # for messages
        self._known: Opened = {}

    def __reduce__(self) -> tuple:
        alone, simulation = self._alone, running_simulation()
        if alone is None:
            is_main = threading.current_thread() is threading.main_thread()
            alone = is_main if simulation is None else simulation.alone
        return Observed, (self.function, alone, self._sender or (process_name(), working_folder()))

    def __call__(self, item: Any) -> tuple[Any, Opened]:
        """The result for an item, and what was opened."""
        is_main, before, mirror = threading.current_thread() is threading.main_thread(), working_folder(), None
        alone, thread = bool(self._alone), 0 if is_main else threading.get_ident()
        is_home = self._sender is None or self._sender[0] == process_name()
        if running_simulation() is not None or (is_home and is_main):  # one after the other
            alone, thread = True, 0
        elif not is_home and (is_main or _is_only_thread_of_dask()):
            with _of_this_library():
                mirror = _mirror_of(self._sender[1], os.getpid())
                os.chdir(mirror.shown())
        try:
            with Observer(alone, thread, mirror) as observer:
                result = self.function(item)
        finally:
            if mirror is not None:
                with contextlib.suppress(FileNotFoundError):
                    os.chdir(before)
        self._known = observer.result(self._known)
        return result, self._known


def _is_only_thread_of_dask() -> bool:
    """Whether this is the thread of a dask worker that runs one task at a time."""
    distributed = sys.modules.get("distributed")
    try:
        distributed.get_worker()
        return [worker.state.nthreads for worker in distributed.Worker._instances] == [1]
    except (AttributeError, ValueError):
        return False


class Group:
    """A group of processes with a temporary folder, `place`; the first process is a shell that removes both.

    It does so at `end`, when this object is garbage-collected, and when this process ends, even if it is killed.
    """

    def __init__(self) -> None:
        self.place, nothing = os.path.realpath(tempfile.mkdtemp(prefix="fe_likelihoods_")), subprocess.DEVNULL
        with _of_this_library():
            options = {"stdin": subprocess.PIPE, "stdout": nothing, "stderr": nothing, "process_group": 0}
            self.processes = [subprocess.Popen(["/bin/sh", "-c", _WATCH, self.place], **options)]
        self.end = weakref.finalize(self, _end, self.processes, self.place, os.getpid())
        _groups.add(self)

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen:
        """A new process of the group, without standard input; `options` are for `subprocess.Popen`."""
        with _of_this_library():
            options |= {"stdin": subprocess.DEVNULL, "process_group": self.processes[0].pid}
            self.processes.append(subprocess.Popen(command, **options))
        if not self.end.alive:  # another thread ends the group, and may wait for this process
            _kill(self.processes)
        return self.processes[-1]

    def run(self, command: Sequence[str], watch: Callable[[float], float], **options: Any) -> int:
        """Run a program to its end, kill the group, and return the exit code; the folder stays.

        `watch` is called with the time since the start [s] and returns the time until the next call [s], or raises an
        exception, which stops the program and is passed on.
        """
        try:
            program, start = self.start(command, **options), time.monotonic()
            waiter = threading.Thread(target=program.wait, daemon=True)  # without the pauses of a wait with a limit
            waiter.start()
            while waiter.is_alive():
                waiter.join(watch(time.monotonic() - start))
            return program.returncode
        finally:
            _kill(self.processes)


_groups: weakref.WeakSet[Group] = weakref.WeakSet()
# a forked process must not keep the groups alive
os.register_at_fork(after_in_child=lambda: [each.processes[0].stdin.close() for each in list(_groups)])


def _end(processes: Sequence[subprocess.Popen], place: str, owner: int) -> None:
    if owner == os.getpid():  # else it has only a forked copy of the objects
        _kill(processes)
        with _of_this_library():
            shutil.rmtree(place, ignore_errors=True)


def _kill(processes: Sequence[subprocess.Popen]) -> None:
    """Kill a group, whose first process is its shell, and what the others have started in other groups."""
    for process in processes[1:]:
        for pid in _family(process.pid) if process.poll() is None else ():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
    if processes[0].returncode is None:  # else its number may be another process's
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(processes[0].pid, signal.SIGKILL)
    for process in processes:
        process.communicate()


def _family(pid: int) -> list[int]:
    """Ids of a process and, from /proc, its descendants; on other systems than Linux of the process only."""
    parents, found = {}, [pid]
    for name in filter(str.isdigit, os.listdir("/proc") if os.path.isdir("/proc") else ()):
        with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    for each in found:
        found += [child for child, parent in parents.items() if parent == each]
    return found


_own_group = functools.cache(Group)


class _Mirror:
    """A folder `path` that shows another folder, `base`, to one simulation after the other.

    It is made anew for the next one if a file or folder, here or there, is not in one of the `states` that it was in.
    """

    def __init__(self, base: str, _pid: int) -> None:
        self.base, self.path = base, ""
        self.states: dict[str, tuple | None] = {}
        sys.path[:] = map(os.path.abspath, sys.path)
        self.place = tempfile.mkdtemp(prefix="shown_", dir=os.environ.get(PLACE) or _own_group().place)
        for entry in _scan(os.path.dirname(base), _MOST_BESIDE) if base else ():
            with contextlib.suppress(FileExistsError):
                os.symlink(entry.path, os.path.join(self.place, entry.name))

    def shown(self) -> str:
        """The folder, which shows what `base` contains now, and nothing that another simulation has left."""
        if not self.states or self.states != {path: _state(path) for path in self.states}:
            shutil.rmtree(self.path, ignore_errors=True)
            self.path = tempfile.mkdtemp(prefix="run_", dir=self.place)
            self.states, self._left = {self.path: None}, _MOST_ENTRIES  # not shown until it has another state
            self._show(self.base, self.path)
        return self.path

    def _show(self, base: str, own: str) -> None:
        """Show a folder in another one; folders that are hidden, too large, or contain the mirror, are links."""
        self.states[base] = _state(base)
        for entry in _scan(base):
            place, inside = os.path.join(own, entry.name), os.path.realpath(entry.path) + os.sep
            is_shown = entry.is_dir() and not entry.name.startswith(".") and not self.place.startswith(inside)
            if is_shown and (below := len(_scan(entry.path, self._left + 1))) <= self._left:
                self._left -= below
                os.mkdir(place)
                self._show(entry.path, place)
                continue
            with contextlib.suppress(PermissionError, FileNotFoundError):
                in_use = any(os.path.exists(entry.path.removesuffix(each) + each) for each in _OF_SQLITE)
                if entry.is_file() and entry.stat().st_size <= _MOST_BYTES and not in_use:
                    self.states[entry.path] = _state(entry.path)
                    shutil.copy2(entry.path, place)
                    self.states[place] = _state(place)
                    continue
            os.symlink(entry.path, place)
        os.utime(own, ns=(0, 0))  # so that whatever is added or removed changes it
        self.states[own] = _state(own)


_mirror_of = functools.cache(_Mirror)


def _scan(folder: str, most: int | None = None) -> list[os.DirEntry]:
    """Entries of a folder, the first `most`; none if it cannot be read."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return list(itertools.islice(entries, most))
    return []


def _state(path: str) -> tuple | None:
    """Time of modification [ns], size and inode of a file; None if there is none."""
    with contextlib.suppress(OSError):
        status = os.stat(path)
        return status.st_mtime_ns, status.st_size, status.st_ino
    return None
