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
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from .by_value import process_name
from .faults import RunFailed, TransientReason, UnusableModel, reason_of, reworded
from .files import (
    Opened,
    RunningSimulation,
    observing,
    of_this_library,
    refuse_shared,
    running_simulation,
)

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

KEEP = "FE_LIKELIHOODS_KEEP_FAILURES"  # environment variable: where the folders of failed simulations are kept
_MOST_KEPT = 20
_MOST_REPEATED = 100  # if more files were opened, a result names the new ones only
_MOST_BELOW = 300  # entries of subfolders that are linked one by one; larger subfolders are links until they are used
_MOST_USED = 3000  # entries of a subfolder that was used, and beside the working folder, which ``..`` shows
_CLOCK_TICK = 20_000_000  # [ns]; a file changed more recently may change again with the same modification time

_mirror: "_Mirror | None" = None
_places: set[str] = set()  # folders for the folders of workers


class Sender(NamedTuple):
    """The process that sends simulations: its name, its working folder, a place for folders, and `KEEP`."""

    process: bytes
    folder: str
    place: str
    keep: str

    @classmethod
    def here(cls) -> "Sender":
        """This process."""
        keep = os.path.abspath(os.environ[KEEP]) if os.environ.get(KEEP) else ""
        return cls(process_name(), working_folder(), _place(os.getpid()), keep)


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

    A call returns the result, and an `Opened` with all files that calls in this process have opened, or with the new
    files if there are more than 100 in all; None if there is nothing to report.
    """

    def __init__(self, function: Callable[[Any], Any], sender: Sender | None = None) -> None:
        self.function, self._sender = function, sender
        if sender is not None:
            _get_ready(sender)
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
        # all files each time, since earlier results may have been lost
        return result, self._known if len(self._known.files) <= _MOST_REPEATED else new


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
    is_main = threading.current_thread() is threading.main_thread()
    is_home = sender is None or sender.process == process_name()
    if running_simulation() is not None or (is_home and is_main):  # one after the other
        return function(item), ""
    thread = 0 if is_main else threading.get_ident()
    if is_home or not (is_main or _is_only_thread_of_dask()):
        simulation = RunningSimulation(thread)
        return simulation.run(function, item), simulation.shared
    try:
        result, error, shared = _run_in_mirror(_mirror_for(sender), function, item, sender, thread)
    except OSError as failure:
        text = f"the working folder of a simulation could not be made: {failure}"
        raise RunFailed(TransientReason(text)) from failure
    if error is not None:
        raise error
    return result, shared


def _get_ready(sender: Sender) -> None:
    """Make the folder for simulations of a sender, so that this does not count as time of the first simulation."""
    is_main = threading.current_thread() is threading.main_thread()
    if sender.process != process_name() and running_simulation() is None and is_main:
        with contextlib.suppress(OSError):
            _mirror_for(sender)


def _mirror_for(sender: Sender) -> "_Mirror":
    global _mirror
    if _mirror is None or _mirror.base != sender.folder or _mirror.owner != os.getpid():
        sys.path[:] = map(os.path.abspath, sys.path)
        _mirror = _Mirror(sender)
    return _mirror


def _run_in_mirror(
    mirror: "_Mirror", function: Callable[[Any], Any], item: Any, sender: Sender, thread: int
) -> tuple[Any, BaseException | None, str]:
    """Result or exception of a simulation, and the first file that it shares with others."""
    is_wanted = True
    while is_wanted:
        mirror.prepare()
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
    reason = reason_of(error) if error is not None else result[1] if _is_failure(result) else ""
    is_kept = reason and sender.keep and mirror.has_changed
    kept = keep_folder(Path(mirror.path), sender.keep, reason) if is_kept else None
    mirror.clean(anew=kept is not None or simulation.has_programs)  # which may still write
    if kept is not None and not isinstance(error, UnusableModel | KeyboardInterrupt):
        reason = reworded(reason, f"{reason} (its folder is {kept})")
        error, result = (None, (None, reason)) if error is None else (RunFailed(reason), None)
    return result, error, simulation.shared


def _is_failure(result: Any) -> bool:
    """Whether a result is an `Outcome` with a reason."""
    return isinstance(result, tuple) and len(result) == 2 and result[0] is None and isinstance(result[1], str)


def _is_only_thread_of_dask() -> bool:
    """Whether this is the thread of a dask worker that runs one task at a time."""
    distributed = sys.modules.get("distributed")
    try:
        distributed.get_worker()
        return [worker.state.nthreads for worker in distributed.Worker._instances] == [1]
    except (AttributeError, ValueError):
        return False


def keep_folder(place: Path, folder: str | Path, reason: str) -> Path | None:
    """Move what a failed simulation has left in `place` into a new folder in `folder`, with a file ``reason.txt``.

    None if 20 folders are there already, or it fails: a full disk must not hide the reason of the failure.
    """
    folder = Path(folder)
    with contextlib.suppress(OSError), of_this_library():
        folder.mkdir(parents=True, exist_ok=True)
        if len(list(folder.glob("failure_*"))) < _MOST_KEPT:
            for link in [path for path in place.rglob("*") if path.is_symlink()]:  # the links of a mirror end with it
                target = os.path.realpath(link)
                link.unlink()
                link.symlink_to(target)
            kept = tempfile.mkdtemp(prefix="failure_", dir=folder)
            for path in place.iterdir():
                shutil.move(path, kept)
            (Path(kept) / "reason.txt").unlink(missing_ok=True)  # a link shows a file of the user
            (Path(kept) / "reason.txt").write_text(reason)
            return Path(kept)
    return None


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


def discard(process: int, reason: str = "") -> str:
    """Remove the folder of a killed worker process; returns what to add to the reason of its simulation.

    With the `reason` of a failure, the folder is kept if `KEEP` says so.
    """
    kept = None
    for place in [os.path.join(place, str(process)) for place in _places]:
        if os.path.isdir(place):
            for run in Path(place).glob("run_*") if reason and os.environ.get(KEEP) else ():
                kept = keep_folder(run, os.environ[KEEP], reason)
            shutil.rmtree(place, ignore_errors=True)
    return "" if kept is None else f" (its folder is {kept})"


Stamp = tuple[int, int, int]
"""Time of modification [ns], size and inode of a file."""


class _Mirror:
    """A folder `path` that shows another folder, `base`, to one simulation after the other.

    Links go through one link, `hop`, whose time of access tells whether any of them was used. A time of modification
    of 0 says that nothing was added or removed in a folder.
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
        self._private: set[str] = set()
        # folders that contain these paths must not be shown: they would be within themselves
        self._above = os.path.join(os.path.realpath(self.base), ""), os.path.join(self._place, "")
        parent = os.path.dirname(self.base)
        for entry in _scan(parent, _MOST_USED) if self.base else ():
            with contextlib.suppress(FileExistsError):
                os.symlink(entry.path, os.path.join(self._place, entry.name))
        self._build()

    def _build(self) -> None:
        self.path = tempfile.mkdtemp(prefix="run_", dir=self._place)
        self._files: dict[str, tuple[str, Stamp | None]] = {}  # linked files: paths and stamps
        self._linked: set[str] = set()  # linked folders
        self._folders: dict[str, Stamp | None] = {}  # folders of `base` that are shown
        self._names: dict[str, set[str]] = {}  # what is shown in each of them, besides private files
        self._left = _MOST_BELOW
        self._fill("", _scan(self.base))
        _mark(self.hop)

    def _fill(self, folder: str, entries: list[os.DirEntry]) -> None:
        """Show entries of a folder of `base`, and those of its subfolders."""
        waiting = [(folder, entries)]
        while waiting:
            folder, entries = waiting.pop(0)
            self._folders.setdefault(folder, _stamp(os.path.join(self.base, folder)))
            names = self._names.setdefault(folder, set())
            for entry in entries:
                name = os.path.join(folder, entry.name)
                if (below := self._entries_of(name, entry)) is not None:
                    os.mkdir(os.path.join(self.path, name))
                    waiting.append((name, below))
                elif entry.is_dir():
                    self._link(name)
                    self._linked.add(name)
                elif name not in self._private:
                    self._link(name)
                    if entry.is_file():
                        self._files[name] = self._stamped(name)
                else:
                    continue
                names.add(entry.name)
        self._settle()

    def _entries_of(self, name: str, entry: os.DirEntry) -> list[os.DirEntry] | None:
        """Entries of a folder that is shown as a folder; None for what is shown as a link."""
        if not self._may_be_folder(entry) or (name not in self._private and entry.name.startswith(".")):
            return None
        most = _MOST_USED if name in self._private else self._left
        entries = _scan(entry.path, most + 1)
        if len(entries) > most:
            return None
        self._left -= 0 if name in self._private else len(entries)
        return entries

    def _settle(self) -> None:
        """Nothing that was added or removed so far was added or removed by a simulation."""
        for name in self._folders:
            os.utime(os.path.join(self.path, name), ns=(0, 0))

    def _may_be_folder(self, entry: os.DirEntry) -> bool:
        """Whether a folder, or a link to one, may be shown as a folder."""
        return entry.is_dir() and not any(
            each.startswith(os.path.realpath(entry.path) + os.sep) for each in self._above
        )

    def _stamped(self, name: str) -> tuple[str, Stamp | None]:
        path = os.path.join(self.base, name)
        return path, _stamp(path)

    def _link(self, name: str) -> None:
        os.symlink(self._through_hop(name), os.path.join(self.path, name))
        _mark(os.path.join(self.path, name))

    def _through_hop(self, name: str) -> str:
        return os.path.join(self.hop, name)

    def prepare(self) -> None:
        """Show what `base` contains now, before a simulation."""
        for name, stamp in list(self._folders.items()):
            folder = os.path.join(self.base, name)
            if stamp is None or _status(folder) != stamp:
                self._folders[name] = _stamp(folder)
                private = {n for n in self._private if os.path.dirname(n) == name and n not in self._folders}
                entries = {entry.name: entry for entry in _scan(folder)}
                gone = {os.path.join(name, each) for each in self._names[name] - entries.keys()}
                if gone & self._folders.keys():
                    self._anew()
                    break
                new = entries.keys() - self._names[name] - set(map(os.path.basename, private))
                for each in gone:
                    os.unlink(os.path.join(self.path, each))
                    self._files.pop(each, None)
                    self._linked.discard(each)
                self._names[name] -= set(map(os.path.basename, gone))
                if gone or new:
                    self._fill(name, [entries[each] for each in sorted(new)])
        for name in self._private.difference(self._folders, self._linked):
            with contextlib.suppress(FileNotFoundError):
                shutil.copy2(os.path.join(self.base, name), os.path.join(self.path, name))

    def was_written_through(self) -> bool:
        """Whether files of `base` have changed whose links were used, or a linked folder was used.

        The files are private from now on, and the folders are shown as folders.
        """
        if self._has_access_times and os.lstat(self.hop).st_atime_ns == 0:
            return False
        changed = [name for name, (path, stamp) in self._files.items() if stamp is None or _status(path) != stamp]
        self._files |= {name: self._stamped(name) for name in changed}
        written = {n for n in changed if not self._has_access_times or _access(os.path.join(self.path, n))}
        if self._has_access_times:
            written |= {n for n in self._linked if _access(os.path.join(self.path, n))} - self._private
        _mark(self.hop)
        if written:
            self._private |= written
            self._anew()
        return bool(written)

    def clean(self, anew: bool) -> None:
        """Remove what a simulation has left; with `anew`, the next simulation gets a folder of another name."""
        if anew or not all(self._mend(name) for name in list(self._folders) if not self._is_untouched(name)):
            self._anew()

    def _mend(self, folder: str) -> bool:
        """Remove what a simulation has added to a folder, and show what it has removed; False if that is too much."""
        place, missing = os.path.join(self.path, folder), set(self._names[folder])
        if os.path.islink(place) or not os.path.isdir(place):
            return False
        for entry in _scan(place):
            name = os.path.join(folder, entry.name)
            is_link, is_folder = entry.is_symlink(), entry.is_dir(follow_symlinks=False)
            if entry.name in missing and (
                is_folder if name in self._folders else is_link and os.readlink(entry.path) == self._through_hop(name)
            ):
                missing.remove(entry.name)
            elif is_folder:
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                os.unlink(entry.path)
        names = {os.path.join(folder, name) for name in missing}
        if names & self._folders.keys():
            return False
        for name in names:
            self._link(name)
        os.utime(place, ns=(0, 0))
        return True

    @property
    def has_changed(self) -> bool:
        """Whether a simulation has added or removed files or folders."""
        return not all(map(self._is_untouched, self._folders))

    def _is_untouched(self, name: str) -> bool:
        """Whether a simulation has added and removed nothing in a folder."""
        with contextlib.suppress(OSError):
            status = os.lstat(os.path.join(self.path, name))
            return stat.S_ISDIR(status.st_mode) and status.st_mtime_ns == 0
        return False

    def _anew(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        self._build()


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
