"""The HDF5 file of a chain, which another program may hold open.

emcee opens the file for each step. HDF5 refuses this while another program has the file open, such as a notebook that
reads it. So a backend waits for the file. If the file is not free in time, a run goes on in a copy of the file in
memory, and its chain is written when the file is free again.
"""

import contextlib
import io
import logging
import os
import shutil
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import h5py
from emcee.backends import Backend, HDFBackend

from .reports import warn

__all__ = ["FileHeld", "PatientOpen", "change_file", "open_file", "patient_open", "read_object"]

logger = logging.getLogger(__name__)

SECONDS, PAUSE = 5.0, 0.05  # longest wait for a file, and between two trials
TRIALS = 3  # of a file that seems to be truncated


class FileHeld(ValueError):
    """Another program holds a file open."""


class PatientOpen:
    """Takes the place of the method ``open`` of an emcee `HDFBackend`, through which all its methods use the file.

    If `goes_on`, a file that is held open is replaced by its copy in memory; `FileHeld` is raised otherwise.
    `is_behind` says whether the copy has a chain that the file does not have.
    """

    def __init__(self, backend: HDFBackend):
        self._backend, self._copy = backend, None
        self.goes_on = self._has_warned = False

    @property
    def is_behind(self) -> bool:
        return self._copy is not None

    def __call__(self, mode: str = "r") -> h5py.File:
        if self._copy is not None and mode != "r":
            self.write_back(wait=False)
        if self._copy is None:
            try:
                return _wait(self._backend, lambda: type(self._backend).open(self._backend, mode))
            except FileHeld:
                if not self.goes_on or not self._take_copy():
                    raise
        return h5py.File(self._copy, "r" if mode == "r" else "r+")

    def _take_copy(self) -> bool:
        """Copy the file to memory; False if another program is changing it."""
        copy = io.BytesIO(Path(self._backend.filename).read_bytes())
        try:
            with h5py.File(copy, "r") as file:
                file[self._backend.name].visititems(read_object)
        except Exception:  # HDF5 raises nearly anything
            return False
        self._copy = copy
        if not self._has_warned:
            self._has_warned = True
            warn(
                f"{self._backend.filename} is held open by another program: the run goes on, and keeps its chain in "
                "memory until the file is free. Close the file in the other program"
            )
        return True

    def write_back(self, wait: bool) -> bool:
        """Write a chain in memory to the file if it is free, now or after a wait; returns whether the file has it."""
        if self._copy is None:
            return True
        name = self._backend.name

        def change(path: Path) -> None:
            with h5py.File(path, "a") as file, h5py.File(self._copy, "r") as ours:
                file.pop(name, None)
                ours.copy(ours[name], file, name)

        try:
            open_file(self._backend, "r+", wait).close()
            change_file(self._backend, change)
        except (FileHeld, OSError) as error:  # also a full disk: the chain is still in memory
            logger.info("the chain is kept in memory: %s", error)
            return False
        self._copy = None
        return True


def _wait(backend: HDFBackend, opens: Callable[[], h5py.File], wait: bool = True) -> h5py.File:
    """The file that a function opens; `FileHeld` if another program holds it open, now or after a wait."""
    end, truncated = time.monotonic() + (SECONDS if wait else 0.0), 0
    while True:
        try:
            before = _identity(backend)
            file = opens()
            if before in (None, _identity(backend)):
                return file
            file.close()  # another sampler has replaced the file while it was opened
        except OSError as error:
            # HDF5 asks for the size of a file before it locks it, and another sampler may just have written to it
            truncated += (seems_truncated := "truncated file" in str(error))
            is_held = isinstance(error, BlockingIOError) or "already open" in str(error)
            if not is_held and not (seems_truncated and truncated < TRIALS):
                raise
            if is_held and time.monotonic() >= end:
                held = f"{backend.filename} is held open by another program ({error})"
                raise FileHeld(f"{held}: close the file there, and try again") from error
        time.sleep(PAUSE)


def _identity(backend: HDFBackend) -> tuple[int, int] | None:
    """Device and inode of the file of a backend; None if there is no file."""
    try:
        status = os.stat(backend.filename)
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def open_file(backend: HDFBackend, mode: str, wait: bool = True) -> h5py.File:
    """The file of a backend itself, not its copy in memory; `FileHeld` if another program holds it open."""
    return _wait(backend, lambda: h5py.File(backend.filename, mode), wait)


def patient_open(backend: Backend) -> PatientOpen | None:
    """The method ``open`` of a backend with a file that can be written, which waits for the file from now on."""
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return None
    if not isinstance(backend.open, PatientOpen):
        vars(backend)["open"] = PatientOpen(backend)
    return backend.open


def change_file(backend: HDFBackend, change: Callable[[Path], None], damaged: bool = False) -> None:
    """Change a copy of the file of a backend, and put it in its place in one step; other groups are kept.

    No other sampler writes to the file meanwhile. A file that is missing, empty or unreadable is made anew, and so is
    one that is `damaged` so that it cannot be changed.
    """
    path = Path(backend.filename).resolve()
    new, is_new = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.new"), not path.exists()
    with contextlib.ExitStack() as stack:
        stack.callback(new.unlink, missing_ok=True)
        with contextlib.suppress(OSError):  # it is missing or cannot be read
            if path.stat().st_size > 0:
                stack.enter_context(open_file(backend, "r+"))
                shutil.copyfile(path, new)
        try:
            change(new)
        except Exception:  # HDF5 raises nearly anything
            if not damaged:
                raise
            new.unlink()
            change(new)
        if os.name == "nt":  # Windows replaces no open file
            stack.pop_all().close()
        try:
            (os.link if is_new else os.replace)(new, path)
        except FileExistsError:  # another sampler has made the file meanwhile
            change_file(backend, change)


def read_object(_: str, node: h5py.Group | h5py.Dataset) -> None:
    """Read a complete object of a file."""
    dict(node.attrs)
    if isinstance(node, h5py.Dataset):
        node[...]
