"""A working folder of its own for each simulation in a worker process.

User code often writes files of fixed names and reads them back: input of a program, output of an OpenSees recorder. So
a worker process changes into a temporary folder for each simulation, which shows the sender's working folder: files as
links, subfolders as folders with links. If Python code opens a link for writing, a private file takes its place first
(`fe_likelihoods.simulation.files`). If compiled code or a program has written through a link, this name is a private
copy from then on, and the simulation is run again. Threads of one process share its working folder: there, simulations
that write are refused.
"""

import atexit
import contextlib
import copy
import functools
import itertools
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from samplers.interrupts import process_name

from .faults import SimulationFailed, TransientReason
from .files import Opened, RunningSimulation, observing, of_this_library, refuse_shared, running_simulation

__all__ = [
    "KEEP",
    "Observed",
    "Sender",
    "discard",
    "keep_folder",
    "run_in_folder",
    "unpack",
    "working_folder",
]

KEEP = "FE_LIKELIHOODS_KEEP_FAILURES"  # environment variable: where the folders of failed programs are kept
_MOST_KEPT = 20
_MOST_LINKS = 500  # in subfolders; other subfolders are links. A link takes 10 us, 1 ms on slow file systems
_MOST_BESIDE = 3000  # entries beside the working folder, which ``..`` shows
_CLOCK_TICK = 20_000_000  # [ns]; a file changed more recently may change again with the same modification time

_mirror: "_Mirror | None" = None
_places: set[str] = set()  # folders for the folders of workers


class Sender(NamedTuple):
    """The process that sends simulations: its name, its working folder, and a place for folders."""

    process: bytes
    folder: str
    place: str

    @classmethod
    def here(cls) -> "Sender":
        """This process."""
        return cls(process_name(), working_folder(), _place(os.getpid()))


def working_folder() -> str:
    """Working folder of this process, also while a simulation runs in its own folder; "" if it was removed."""
    simulation = running_simulation()
    if simulation is not None and simulation.place:
        return simulation.base
    with contextlib.suppress(FileNotFoundError):
        return os.getcwd()
    return ""


class Observed:
    """A function of one item, whose results include what it opened; other processes call it in a folder of its own.

    A call returns the result, and an `Opened` with all files that calls in this process have opened, since earlier
    results may have been lost.
    """

    def __init__(self, function: Callable[[Any], Any], sender: Sender | None = None) -> None:
        self.function, self._sender = function, sender
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
            observer.shared = observer.shared or shared
        new = observer.result(self._known)
        if new is not None:
            self._known = new if self._known is None else new | self._known
        return result, self._known


def unpack(outcome: tuple, pool: Any) -> tuple[Any, Opened | None]:
    """Simulation result from a pool, and what it opened; for a lost worker, the pool reports a result only.

    `UnusableModel` if simulations write files that other simulations of the pool may write too.
    """
    if isinstance(outcome[1], str):
        return outcome, None
    if outcome[1] is not None:
        refuse_shared(outcome[1].shared, getattr(pool, "n_workers", None))
    return outcome


def run_in_folder(function: Callable[[Any], Any], item: Any, sender: Sender | None) -> tuple[Any, str]:
    """Result of a function for one item, and the first file that the simulation shares with others, or "".

    `sender` is the process that has sent the function; None if it was not sent.
    """
    is_home = sender is None or sender.process == process_name()
    if running_simulation() is not None or (is_home and _is_main()):  # one after the other
        return function(item), ""
    thread = 0 if _is_main() else threading.get_ident()
    if is_home or not (_is_main() or _is_only_thread_of_dask()):
        simulation = RunningSimulation(thread)
        return simulation.run(function, item), simulation.shared
    try:
        result, error, shared = _run_in_mirror(_mirror_for(sender), function, item, thread)
    except OSError as failure:
        text = f"the working folder of a simulation could not be made: {failure}"
        raise SimulationFailed(TransientReason(text)) from failure
    if error is not None:
        raise error
    return result, shared


def _is_main() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_only_thread_of_dask() -> bool:
    """Whether this is the thread of a dask worker that runs one task at a time."""
    distributed = sys.modules.get("distributed")
    try:
        distributed.get_worker()
        return [worker.state.nthreads for worker in distributed.Worker._instances] == [1]
    except (AttributeError, ValueError):
        return False


def _mirror_for(sender: Sender) -> "_Mirror":
    global _mirror
    if _mirror is None or _mirror.base != sender.folder or _mirror.owner != os.getpid():
        sys.path[:] = map(os.path.abspath, sys.path)
        _mirror = _Mirror(sender)
    return _mirror


def _run_in_mirror(
    mirror: "_Mirror", function: Callable[[Any], Any], item: Any, thread: int
) -> tuple[Any, BaseException | None, str]:
    """Result or exception of a simulation, and the first file that it shares with others."""
    is_wanted = True
    while is_wanted:
        mirror.show()
        simulation = RunningSimulation(thread, mirror.path, mirror.hop, mirror.base)
        argument, result, error, before = copy.deepcopy(item), None, None, working_folder()
        os.chdir(mirror.path)
        try:
            result = simulation.run(function, argument)
        except BaseException as raised:
            error = raised
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.chdir(before)
        if mirror.owner != os.getpid():  # the simulation has forked, and its copy has returned as well
            return result, error, ""
        is_wanted = mirror.was_written_through() and not isinstance(error, KeyboardInterrupt)
    mirror.is_new = not simulation.has_programs  # which may still write
    return result, error, simulation.shared


def keep_folder(place: Path, folder: str, reason: str) -> None:
    """Move what a failed program has left in `place` into a new folder in `folder`, with a file ``reason.txt``.

    Not if 20 folders are there already, or it fails: a full disk must not hide the reason of the failure.
    """
    folder = Path(working_folder(), folder)
    with contextlib.suppress(OSError), of_this_library():
        folder.mkdir(parents=True, exist_ok=True)
        if len(list(folder.glob("failure_*"))) < _MOST_KEPT:
            kept = Path(tempfile.mkdtemp(prefix="failure_", dir=folder))
            for path in place.iterdir():
                shutil.move(path, kept)
            (kept / "reason.txt").write_text(reason)


# places -------------------------------------------------------------------------------------------------------------


@functools.cache
def _place(pid: int) -> str:
    """A temporary folder for the workers of this process, removed when this process ends, even if it is killed."""
    with of_this_library():
        place = os.path.realpath(tempfile.mkdtemp(prefix="fe_likelihoods_"))
        # standard input closes when this process ends, and workers end a little later
        remove = 'cat; for i in 1 2 3 4 5 6 7 8 9; do rm -rf "$0"; [ -e "$0" ] || exit; sleep 1; done'
        process = subprocess.Popen(
            ["/bin/sh", "-c", remove, place],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            start_new_session=True,
        )
    atexit.register(_remove, process, pid)
    _places.add(place)
    return place


def _remove(process: subprocess.Popen, owner: int) -> None:
    process.stdin.close()
    if owner == os.getpid():
        process.wait()


def discard(process: int) -> None:
    """Remove the folder of a killed worker process."""
    for place in _places:
        with of_this_library():  # which may run in a simulation's thread
            shutil.rmtree(os.path.join(place, str(process)), ignore_errors=True)


class _Mirror:
    """A folder `path` that shows another folder, `base`, to one simulation after the other.

    Links go through one link, `hop`, whose time of access tells whether any of them was used. A time of modification
    of 0 says that nothing was added or removed in a folder. If not `is_new`, the next simulation gets another folder.
    """

    def __init__(self, sender: Sender) -> None:
        self.base, self.owner = sender.folder, os.getpid()
        place = sender.place if os.path.isdir(sender.place) else _place(os.getpid())  # on another machine
        _places.add(place)
        self._place = os.path.join(place, str(os.getpid()))
        shutil.rmtree(self._place, ignore_errors=True)  # of a mirror of another folder
        os.mkdir(self._place)
        self.hop = os.path.join(self._place, ".from")
        os.symlink(self.base or "/", self.hop)
        _mark(self.hop)
        with contextlib.suppress(FileNotFoundError):
            os.stat(self.hop)
        self._has_access_times = os.lstat(self.hop).st_atime_ns != 0  # not on every file system
        self._private: set[str] = set()  # files that were written through their links
        for entry in _scan(os.path.dirname(self.base), _MOST_BESIDE) if self.base else ():
            with contextlib.suppress(FileExistsError):
                os.symlink(entry.path, os.path.join(self._place, entry.name))
        self.path, self.is_new = "", False
        self.show()

    def show(self) -> None:
        """Show what `base` contains now, and nothing that another simulation has left."""
        if not self.is_new:
            shutil.rmtree(self.path, ignore_errors=True)
            self.path, self.is_new = tempfile.mkdtemp(prefix="run_", dir=self._place), True
            self._shown: dict[str, tuple[Stamp | None, dict[str, bool]]] = {}  # folders; whether entries are folders
            self._files: dict[str, Stamp | None] = {}  # that are linked
            self._left = _MOST_LINKS
        folders = [""]
        for folder in folders:
            folders += self._show_folder(folder)
        for name in self._private:
            with contextlib.suppress(FileNotFoundError):
                shutil.copy2(os.path.join(self.base, name), os.path.join(self.path, name))
                os.utime(os.path.join(self.path, os.path.dirname(name)), ns=(0, 0))
        _mark(self.hop)

    def _show_folder(self, folder: str) -> list[str]:
        """Show the entries of a folder of `base`; returns those that are shown as folders."""
        place, source = os.path.join(self.path, folder), os.path.join(self.base, folder)
        before, names = self._shown.get(folder, (None, {}))
        if before is None or _status(source) != before or not self._is_untouched(folder):
            stamp, entries = _stamp(source), _scan(source)
            for each in names.keys() - {entry.name for entry in entries}:
                self._drop(os.path.join(folder, each))
            names = {entry.name: names.get(entry.name) or self._is_folder(entry) for entry in entries}
            self._shown[folder] = stamp, names
            missing = dict(names)
            for entry in _scan(place):
                name = os.path.join(folder, entry.name)
                is_link, is_folder = entry.is_symlink(), entry.is_dir(follow_symlinks=False)
                if entry.name in names and (
                    is_folder if names[entry.name] else is_link and os.readlink(entry.path) == self._target(name)
                ):
                    del missing[entry.name]
                elif is_folder:
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)
            for name, is_folder in ((os.path.join(folder, each), shown) for each, shown in missing.items()):
                if is_folder:
                    os.mkdir(os.path.join(self.path, name))
                elif name not in self._private:
                    os.symlink(self._target(name), os.path.join(self.path, name))
                    _mark(os.path.join(self.path, name))
                    self._files[name] = _stamp(os.path.join(self.base, name))
            os.utime(place, ns=(0, 0))
        return [os.path.join(folder, name) for name, is_folder in names.items() if is_folder]

    def _is_folder(self, entry: os.DirEntry) -> bool:
        """Whether an entry of `base` is shown as a folder, not as a link.

        Hidden folders are not, many files, and folders that contain the mirror, which would be within itself.
        """
        if not entry.is_dir() or entry.name.startswith("."):
            return False
        above = os.path.realpath(entry.path) + os.sep
        if any(os.path.join(each, "").startswith(above) for each in (os.path.realpath(self.base), self._place)):
            return False
        below = len(_scan(entry.path, self._left + 1))
        if below <= self._left:
            self._left -= below
            return True
        return False

    def _drop(self, name: str) -> None:
        """Forget a file or folder that is not in `base` any more."""
        for known in (self._shown, self._files):
            for each in [each for each in known if each == name or each.startswith(name + os.sep)]:
                del known[each]

    def _target(self, name: str) -> str:
        return os.path.join(self.hop, name)

    def was_written_through(self) -> bool:
        """Whether files of `base` have changed whose links were used; they are private from now on."""
        if self._has_access_times and os.lstat(self.hop).st_atime_ns == 0:
            return False
        paths = {name: os.path.join(self.base, name) for name in self._files}
        changed = [name for name, stamp in self._files.items() if stamp is None or _status(paths[name]) != stamp]
        self._files |= {name: _stamp(paths[name]) for name in changed}
        written = {n for n in changed if not self._has_access_times or _access(os.path.join(self.path, n))}
        written = {name for name in written if not os.path.isdir(paths[name])}
        self._private |= written
        self.is_new = self.is_new and not written
        return bool(written)

    def _is_untouched(self, folder: str) -> bool:
        """Whether a simulation has added and removed nothing in a folder."""
        with contextlib.suppress(OSError):
            return os.lstat(os.path.join(self.path, folder)).st_mtime_ns == 0
        return False


Stamp = tuple[int, int, int]
"""Time of modification [ns], size and inode of a file."""


def _mark(link: str) -> None:
    """Set the time of access of a link to 0."""
    os.utime(link, ns=(0, 0), follow_symlinks=False)


def _access(link: str) -> int:
    """Time of access of a link; 1 if it is not there any more."""
    with contextlib.suppress(FileNotFoundError):
        return os.lstat(link).st_atime_ns
    return 1


def _scan(folder: str, most: int | None = None) -> list[os.DirEntry]:
    """Entries of a folder, the first `most`; none if it cannot be read."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return list(itertools.islice(entries, most))
    return []


def _status(path: str) -> Stamp | None:
    """Stamp of a file; None if there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _stamp(path: str) -> Stamp | None:
    """Stamp of a file; None if there is none, or if the file may still change with the same time of modification."""
    stamp = _status(path)
    return None if stamp is None or stamp[0] > time.time_ns() - _CLOCK_TICK else stamp
