"""The HDF5 file of a chain, which is replaced as a whole.

emcee opens the file for each step and writes in place. A kill then leaves half of a step, and HDF5 refuses the file
while another program has it open. So during a call a backend works on a copy of its group in memory, which takes its
place in the file about every second and at the end, in one step: a reader always finds a whole chain. The attribute
``checksum`` of a chain tells whether something else has changed it.
"""

import contextlib
import io
import logging
import os
import time
import uuid
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .emcee_names import Backend, HDFBackend
from .interrupts import deferred_interrupts
from .locks import locked_folder

__all__ = ["DAMAGED", "WholeFile", "run_of_file", "whole_file"]

logger = logging.getLogger(__name__)

SECONDS, PAUSE = 5.0, 0.05  # longest wait for a file, and between two trials
SECONDS_BETWEEN, SHARE = 1.0, 0.1  # shortest time between two replacements, and their largest share of the time
DAMAGED = "damaged"
CHECKSUM = "checksum"
# attributes and datasets of every chain of emcee
OF_EVERY_CHAIN = {"version", "nwalkers", "ndim", "has_blobs", "iteration", "chain", "log_prob", "accepted"}


class FileHeld(ValueError):
    """Another program holds a file open to write to it."""


class WholeFile:
    """Takes the place of the method ``open`` of an emcee `HDFBackend`, through which all its methods use the file.

    It is a context in which they use a copy in memory. A copy that cannot be written stays.
    """

    def __init__(self, backend: HDFBackend):
        self._backend, self._copy = backend, None
        self._depth, self._next = 0, 0.0

    def __call__(self, mode: str = "r") -> h5py.File:
        if self._copy is None:
            return type(self._backend).open(self._backend, mode)
        return h5py.File(self._copy, "r" if mode == "r" else "r+")

    def __enter__(self) -> "WholeFile":
        if self._copy is None:
            copy, name = io.BytesIO(), self._backend.name
            with _opened(self._backend) as file, h5py.File(copy, "w") as ours:
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
        except (OSError, FileHeld):
            if error is None:
                raise
            logger.warning("%s cannot be written: the chain is in this sampler only", self._backend.filename)

    def make(self, nwalkers: int, ndim: int, run: str, anew: bool = False) -> None:
        """Make the file with an empty chain in one step; what else a readable file holds is kept, or not if `anew`."""
        self._copy = io.BytesIO()
        h5py.File(self._copy, "w").close()
        self._backend.reset(nwalkers, ndim)
        with self("a") as file:
            file[self._backend.name].attrs["run"] = run
        self.save(anew)
        self._copy = None

    def save(self, anew: bool = False) -> None:
        """Put the copy in its place in the file; OSError if it cannot be written, `FileHeld` if it is held."""
        start = time.monotonic()
        with deferred_interrupts():
            with h5py.File(self._copy, "r+") as ours:
                group = ours[self._backend.name]
                group.attrs[CHECKSUM] = _checksum(group)
            with h5py.File(self._copy, "r") as ours:
                _replace_group(self._backend, ours, anew)
        now = time.monotonic()
        self._next = now + max(SECONDS_BETWEEN, (now - start) / SHARE)

    def save_now_and_then(self) -> None:
        """Put the copy in its place if that has not been done for a second; later if that fails now."""
        if time.monotonic() >= self._next:
            try:
                self.save()
            except (OSError, FileHeld) as error:
                logger.info("the chain is in memory: %s", error)
                self._next = time.monotonic() + SECONDS_BETWEEN


def whole_file(backend: Backend) -> WholeFile | None:
    """The method ``open`` of a backend with a file that can be written, from now on a `WholeFile`."""
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return None
    if not isinstance(backend.open, WholeFile):
        vars(backend)["open"] = WholeFile(backend)
    return backend.open


def _opened(backend: HDFBackend) -> h5py.File:
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
                raise FileHeld(f"{held}: close the file there, and call run_mcmc again") from error
        time.sleep(PAUSE)


def _checksum(group: h5py.Group) -> int:
    """CRC-32 of all datasets and attributes of a chain, apart from this number."""
    found = 0

    def add(name: str, node: h5py.Group | h5py.Dataset) -> None:
        nonlocal found
        for key in sorted(node.attrs):
            if key != CHECKSUM:
                found = zlib.crc32(f"{name} {key}".encode() + np.asarray(node.attrs[key]).tobytes(), found)
        if isinstance(node, h5py.Dataset):
            found = zlib.crc32(name.encode() + node[...].tobytes(), found)

    add("", group)
    group.visititems(add)
    return found


def run_of_file(backend: HDFBackend) -> str | None:
    """The run that the file of a backend belongs to; the empty string for a chain without a run.

    It is "damaged" for a chain that cannot be read completely, or is not as it was stored. It is None if there is no
    file, the file is empty, or it has no chain with this name, or an incomplete one that never had a step.
    """
    if not os.path.exists(backend.filename) or os.path.getsize(backend.filename) == 0:
        return None
    try:
        with _opened(backend) as file:
            if backend.name not in file:
                return None
            group = file[backend.name]
            if not group.attrs.get("iteration", 0) and "run" not in group.attrs and "log_prob" not in group:
                return None  # emcee was killed while it made the group
            whole = OF_EVERY_CHAIN <= {*group.attrs, *group}
            if "run" in group.attrs or "tempering" in group:  # else a chain of emcee
                whole &= group.attrs.get(CHECKSUM) == _checksum(group)
            return group.attrs.get("run", "") if whole else DAMAGED
    except FileHeld:
        raise
    except Exception:  # HDF5 raises nearly anything
        return DAMAGED


def _replace_group(backend: HDFBackend, ours: h5py.File, anew: bool) -> None:
    """Replace the group of a backend in its file by the group of a file, in one step; what else is there is kept.

    A file that is missing, empty or, if `anew`, cannot be read is made.
    """
    path, name = Path(backend.filename).resolve(), backend.name
    new = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.new")
    with locked_folder(path.parent), contextlib.ExitStack() as stack:
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

        try:
            with _opened(backend) if path.exists() and path.stat().st_size > 0 else contextlib.nullcontext() as others:
                write(others)
        except FileHeld:
            raise
        except Exception:  # HDF5 raises nearly anything
            if not anew:
                raise
            write(None)
        os.replace(new, path)
