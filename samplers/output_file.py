"""The HDF5 file of a chain, which is replaced as a whole.

emcee opens the file for each step and writes in place. A kill then leaves half of a step, and HDF5 refuses the file
while another program has it open. So during a call a backend works on a copy of its group in memory, which takes its
place in the file about every second and at the end, in one step: a reader always finds a whole chain.
"""

import contextlib
import io
import logging
import os
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
from emcee.backends import Backend, HDFBackend

from .interrupts import deferred_interrupts
from .reports import warn

try:
    from fcntl import LOCK_EX, flock
except ImportError:  # Windows has no such locks
    flock = None

__all__ = ["FileHeld", "WholeFile", "open_file", "replace_group", "whole_file"]

logger = logging.getLogger(__name__)

SECONDS, PAUSE = 5.0, 0.05  # longest wait for a file, and between two trials
SECONDS_BETWEEN, SHARE = 1.0, 0.1  # shortest time between two replacements, and their largest share of the time


class FileHeld(ValueError):
    """Another program holds a file open to write to it."""


class WholeFile:
    """Takes the place of the method ``open`` of an emcee `HDFBackend`, through which all its methods use the file.

    It is a context in which they use a copy in memory; `seal` is called with the group before it replaces the stored
    one. A copy that cannot be written stays.
    """

    def __init__(self, backend: HDFBackend):
        self._backend, self.seal = backend, _nothing
        self._copy: io.BytesIO | None = None
        self._depth, self._next = 0, 0.0

    def __call__(self, mode: str = "r") -> h5py.File:
        if self._copy is None:
            return type(self._backend).open(self._backend, mode)
        return h5py.File(self._copy, "r" if mode == "r" else "r+")

    def __enter__(self) -> "WholeFile":
        if self._copy is None:
            copy, name = io.BytesIO(), self._backend.name
            with open_file(self._backend) as file, h5py.File(copy, "w") as ours:
                file.copy(file[name], ours, name)
            self._copy = copy
        self._depth += 1
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._depth -= 1
        if self._depth > 0:
            return
        try:
            self.save()
            self._copy = None
        except FileHeld as held:
            warn(
                f"{held}: the last steps are in this sampler only. Call run_mcmc(None, 0) later, which writes them. A "
                "new process makes them again from the record beside the file, without a simulation"
            )
        except OSError:
            if error is None:
                raise
            logger.warning("%s cannot be written: the chain is in this sampler only", self._backend.filename)

    def save(self) -> None:
        """Put the copy in its place in the file; OSError if it cannot be written, `FileHeld` if it is held."""
        start = time.monotonic()
        with deferred_interrupts():
            with h5py.File(self._copy, "r+") as ours:
                self.seal(ours[self._backend.name])
            with h5py.File(self._copy, "r") as ours:
                replace_group(self._backend, ours)
        now = time.monotonic()
        self._next = now + max(SECONDS_BETWEEN, (now - start) / SHARE)

    def save_what_is_left(self) -> None:
        """Write a copy that could not be written before; `FileHeld` or OSError if it still cannot."""
        if self._copy is not None and self._depth == 0:
            self.save()
            self._copy = None

    def save_now_and_then(self) -> None:
        """Put the copy in its place if that has not been done for a second; later if that fails now."""
        if time.monotonic() >= self._next:
            try:
                self.save()
            except (OSError, FileHeld) as error:
                logger.info("the chain is in memory: %s", error)
                self._next = time.monotonic() + SECONDS


def _nothing(group: h5py.Group) -> None:
    """Seal nothing."""


def whole_file(backend: Backend) -> "WholeFile | None":
    """The method ``open`` of a backend with a file that can be written, from now on a `WholeFile`."""
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return None
    if not isinstance(backend.open, WholeFile):
        vars(backend)["open"] = WholeFile(backend)
    return backend.open


def open_file(backend: HDFBackend) -> h5py.File:
    """The file of a backend itself, to be read; `FileHeld` if another program writes to it, also after a wait."""
    end = time.monotonic() + SECONDS
    while True:
        try:
            return h5py.File(backend.filename, "r")
        except OSError as error:
            if not (isinstance(error, BlockingIOError) or "already open" in str(error)):
                raise
            if time.monotonic() >= end:
                held = f"{backend.filename} is held open by another program ({error})"
                raise FileHeld(f"{held}: close the file there, and try again") from error
        time.sleep(PAUSE)


def replace_group(backend: HDFBackend, ours: h5py.File, anew: bool = False) -> None:
    """Replace the group of a backend in its file by the group of a file, in one step; what else is there is kept.

    A file that is missing, empty or, if `anew`, cannot be read is made.
    """
    path, name = Path(backend.filename).resolve(), backend.name
    new = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.new")
    with _locked(path.parent), contextlib.ExitStack() as stack:
        stack.callback(new.unlink, missing_ok=True)

        def write(others: h5py.File | None) -> None:
            with h5py.File(new, "w") as file:
                if others is not None:
                    file.attrs.update(others.attrs)
                    for key in others:
                        if key != name:
                            others.copy(key, file)
                    file.pop(name, None)  # of a name such as "a/b"
                ours.copy(ours[name], file, name)

        if path.exists() and path.stat().st_size > 0:
            try:
                with open_file(backend) as others:
                    write(others)
            except FileHeld:
                raise
            except Exception:  # HDF5 raises nearly anything
                if not anew:
                    raise
                write(None)
        else:
            write(None)
        os.replace(new, path)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Context in which no other sampler replaces a file in a folder."""
    if flock is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            flock(descriptor, LOCK_EX)
        yield
    finally:
        os.close(descriptor)
