"""emcee's HDF5 backend with files that other processes read, disks that are full, and a view of earlier steps."""

import contextlib
import errno
import os
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import h5py
import numpy as np
from emcee.backends import HDFBackend

from .lenient_file import LenientFile, deferred_interrupts

__all__ = ["FAULTS", "GuardedBackend"]

T = TypeVar("T")

# How long to wait for a process that reads the file, which locks it
PATIENCE = 30.0
# What HDF5 raises for a file that it cannot use; other errors of it contain "Unable to"
FAULTS = (OSError, RuntimeError, KeyError)


def _when_unlocked(opened: Callable[[], T], patience: float) -> T:
    """The result of a function that opens a file, once no other process locks it by reading, or BlockingIOError.

    Parameters
    ----------
    opened : callable
        The function.
    patience : float
        How long to wait [s].
    """
    end = time.monotonic() + patience
    while True:
        try:
            return opened()
        except BlockingIOError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


class GuardedBackend(HDFBackend):
    """emcee's HDF5 backend, for a file that can be rebuilt.

    A file that could not be written, as on a full disk, is rebuilt before it is used again, under a new name that
    replaces it.
    """

    _is_broken = False  # whether the file must be rebuilt
    _view: tuple[int, np.ndarray] | None = None  # number of steps that are visible, and accepted proposals until then

    def flush(self) -> None:
        """Write what is pending; subclasses have something."""

    def rebuild_file(self) -> None:
        """Rebuild the file; subclasses know from what. OSError if that is not possible."""
        self._is_broken = False

    def advice(self) -> str:
        """What to do after an error, for its message."""
        return "Free some disk space and run again; if the file is then reported as damaged, restore it from a copy"

    # ------------------------------------------------------------------ access to the file

    def open(self, mode: str = "r") -> "h5py.File | contextlib.AbstractContextManager[h5py.File]":
        """emcee's: the open HDF5 file, after pending steps have been written.

        Raises
        ------
        OSError
            If the file cannot be written, for example because the disk is full.
        """
        self.flush()
        if self._is_broken:
            self.rebuild_file()
        return self._open() if mode == "r" else self._writing()

    @property
    def initialized(self) -> bool:
        """emcee's: whether the file has the group. An error is raised, where emcee would clear the chain."""
        if not os.path.exists(self.filename):
            return False
        with self.open() as file:
            return self.name in file

    def _open(self) -> h5py.File:
        """The file, open for reading."""
        return _when_unlocked(super().open, PATIENCE)

    @contextlib.contextmanager
    def _writing(self, patience: float = PATIENCE) -> Iterator[h5py.File]:
        """The file, open for writing."""
        with (
            deferred_interrupts(),
            self._guarded(),
            contextlib.closing(_when_unlocked(lambda: LenientFile(self.filename), patience)) as raw,
        ):
            with h5py.File(raw, "r+") as file:
                yield file
            if raw.error is not None:
                raise raw.error

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn an error of HDF5 into one that says what is kept and how to go on."""
        try:
            yield
        except BlockingIOError:
            raise
        except BaseException as error:
            of_hdf5 = isinstance(error, FAULTS) or "nable to" in str(error)
            self._is_broken = self._is_broken or of_hdf5 or not isinstance(error, Exception)  # the latter: Ctrl-C
            if not of_hdf5:
                raise
            number = getattr(error, "errno", None) or errno.EIO
            raise OSError(
                number,
                f"the chain could not be written ({os.strerror(number)}). {self.advice()}",
                str(self.filename),
            ) from error

    # ------------------------------------------------------------------ earlier steps

    def show(self, length: int | None, accepted: np.ndarray | None = None) -> None:
        """Show the chain as it was when it had `length` steps; None: all of it."""
        self._view = None if length is None else (length, accepted)

    @property
    def iteration(self) -> int:
        """emcee's: the number of steps in the chain."""
        return super().iteration if self._view is None else self._view[0]

    @property
    def accepted(self) -> np.ndarray:
        """emcee's: the number of accepted proposals of each walker."""
        return super().accepted if self._view is None else self._view[1].copy()
