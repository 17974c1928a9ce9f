"""A working folder of its own for each simulation in a worker process.

User code often writes files of fixed names and reads them back: input of a program, output of an OpenSees recorder. So
a worker process changes into a temporary folder for each simulation, which shows the sender's working folder: files as
copies, large ones as links, subfolders as folders. If Python code opens a link for writing, a private file takes its
place first (`fe_likelihoods.simulation.files`). Threads of one process share its working folder: there, simulations
that write are refused.
"""

import atexit
import contextlib
import functools
import itertools
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

from samplers.interrupts import process_name

from .faults import SimulationFailed, TransientReason
from .files import Opened, RunningSimulation, observing, of_this_library, running_simulation
from .programs import removed_at_end

__all__ = ["Observed", "Sender", "run_in_folder", "working_folder"]

_MOST_ENTRIES = 100  # in subfolders that are shown as folders; other subfolders are links. A copy takes 60 us
_MOST_BYTES = 2**20  # of a copy
_MOST_BESIDE = 3000  # entries beside the working folder, which ``..`` shows

_mirror: "_Mirror | None" = None


class Sender(NamedTuple):
    """The process that sends simulations: its name, and its working folder."""

    process: bytes
    folder: str

    @classmethod
    def here(cls) -> "Sender":
        """This process."""
        return cls(process_name(), working_folder())


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

    A call returns the result, and all files that calls in this process have opened, since earlier results may have been
    lost. It raises `UnusableModel` if it writes a file that other simulations may write too, unless it runs `alone`; by
    default, what holds where it is sent.
    """

    def __init__(self, function: Callable[[Any], Any], alone: bool | None = None, sender: Sender | None = None) -> None:
        self.function, self._alone, self._sender = function, alone, sender
        self.__qualname__ = getattr(function, "__qualname__", type(function).__qualname__)  # for messages
        self._known: Opened = {}

    def __repr__(self) -> str:
        return repr(self.function)

    def __reduce__(self) -> tuple:
        alone, simulation = self._alone, running_simulation()
        if alone is None:
            alone = _is_main() if simulation is None else simulation.alone
        return Observed, (self.function, alone, self._sender or Sender.here())

    def __call__(self, item: Any) -> tuple[Any, Opened]:
        """The result for an item, and what was opened."""
        return run_in_folder(self._observe, item, self._sender, bool(self._alone)), self._known

    def _observe(self, item: Any) -> Any:
        with observing() as observer:
            result = self.function(item)
        with of_this_library():
            self._known = observer.result(self._known)
        return result


def run_in_folder(function: Callable[[Any], Any], item: Any, sender: Sender | None, alone: bool) -> Any:
    """Result of a function for one item; `sender` is the process that has sent the function, None if it was not sent.

    `UnusableModel` if a file that it writes is not its own, unless it runs `alone`.
    """
    is_home = sender is None or sender.process == process_name()
    if running_simulation() is not None or (is_home and _is_main()):  # one after the other
        return function(item)
    if is_home or not (_is_main() or _is_only_thread_of_dask()):
        return RunningSimulation(alone, threading.get_ident()).run(function, item)
    mirror, before = _mirror_for(sender), working_folder()
    simulation = RunningSimulation(alone, 0 if _is_main() else threading.get_ident(), mirror.path, mirror.base)
    os.chdir(mirror.path)
    try:
        return simulation.run(function, item)
    finally:
        mirror.is_new = not simulation.has_programs  # which may still write
        with contextlib.suppress(FileNotFoundError):
            os.chdir(before)


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
    """The folder of this process, which shows what the sender's working folder contains now."""
    global _mirror
    try:
        if _mirror is None or _mirror.base != sender.folder or _mirror.owner != os.getpid():
            sys.path[:] = map(os.path.abspath, sys.path)
            _mirror = _Mirror(sender.folder)
        _mirror.show()
    except OSError as failure:
        text = f"the working folder of a simulation could not be made: {failure}"
        raise SimulationFailed(TransientReason(text)) from failure
    return _mirror


@functools.cache
def _place(pid: int) -> str:
    """A temporary folder for the folders of this process, removed when this process ends, even if it is killed."""
    with of_this_library():
        place = os.path.realpath(tempfile.mkdtemp(prefix="fe_likelihoods_"))
        watcher = removed_at_end(place)
    atexit.register(lambda: pid == os.getpid() and watcher.communicate())  # waits until it is removed
    return place


class _Mirror:
    """A folder `path` that shows another folder, `base`, to one simulation after the other.

    A time of modification of 0 says that nothing was added or removed in one of its folders. If not `is_new`, the next
    simulation gets another folder.
    """

    def __init__(self, base: str) -> None:
        self.base, self.owner, self.path, self.is_new = base, os.getpid(), "", False
        self._shown: dict[str, tuple] = {}  # by path here: path there, and the state of both
        self._folders: list[str] = []
        self._place = os.path.join(_place(os.getpid()), "shown")
        shutil.rmtree(self._place, ignore_errors=True)  # of a mirror of another folder
        os.mkdir(self._place)
        for entry in _scan(os.path.dirname(self.base), _MOST_BESIDE) if self.base else ():
            with contextlib.suppress(FileExistsError):
                os.symlink(entry.path, os.path.join(self._place, entry.name))

    def show(self) -> None:
        """Show what `base` contains now, and nothing that another simulation has left."""
        changed = [own for own, (base, *states) in self._shown.items() if [_state(own), _state(base)] != states]
        if not self.is_new or not set(changed).isdisjoint(self._folders):
            self._make()
        else:
            for own in changed:
                self._copy(self._shown[own][0], own)
                self._seal(os.path.dirname(own))

    def _make(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        self.path, self.is_new = tempfile.mkdtemp(prefix="run_", dir=self._place), True
        self._shown, left = {}, _MOST_ENTRIES
        for base, place in (folders := [(self.base, self.path)]):
            self._shown[place] = base, None, _state(base)
            for entry in _scan(base):
                own = os.path.join(place, entry.name)
                if self._is_folder(entry) and (below := len(_scan(entry.path, left + 1))) <= left:
                    left -= below
                    folders.append((entry.path, own))
                    os.mkdir(own)
                elif entry.is_file() and entry.stat().st_size <= _MOST_BYTES:
                    self._copy(entry.path, own)
                else:
                    os.symlink(entry.path, own)
        self._folders = [place for _, place in folders]
        for place in self._folders:
            self._seal(place)

    def _copy(self, base: str, own: str) -> None:
        state = _state(base)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(own)
        try:
            shutil.copy2(base, own)
        except OSError:  # the user may not read it, or it is not there any more
            os.symlink(base, own)
        self._shown[own] = base, _state(own), state

    def _seal(self, own: str) -> None:
        """Note the state of an own folder as it is now."""
        os.utime(own, ns=(0, 0))
        base, _, state = self._shown[own]
        self._shown[own] = base, _state(own), state

    def _is_folder(self, entry: os.DirEntry) -> bool:
        """Whether an entry is shown as a folder: not if it is hidden, or contains the mirror."""
        if entry.name.startswith(".") or not entry.is_dir():
            return False
        above = os.path.realpath(entry.path) + os.sep
        return not any(os.path.join(os.path.realpath(each), "").startswith(above) for each in (self.base, self._place))


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
