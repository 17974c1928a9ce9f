"""The lock of a file that one process writes: who holds it, for the process that wants it as well.

The lock is advisory, and belongs to the process: the operating system releases it when the process dies, also by a
signal 9, and a forked child does not inherit it. The locked file is ``*.lock`` beside the file that is written. It
contains the process, the host and the time, and is removed when the lock is released. So a lock file that is found and
not locked was left by a process that died. Nothing else opens it, since any close of a file releases the locks of a
process on it.
"""

import atexit
import contextlib
import errno
import json
import logging
import os
import socket
import time
from pathlib import Path

try:
    from fcntl import LOCK_EX, LOCK_NB, lockf
except ImportError:  # without such locks, two runs on one file are not detected
    lockf = None

__all__ = ["FileLock"]

logger = logging.getLogger(__name__)

# open lock files of this process with the number of their owners, by process and path
_held: dict[tuple[int, Path], list[int]] = {}


class FileLock:
    """A lock that this process holds until `release`; several objects of a process share it.

    Parameters
    ----------
    path : Path
        The lock file. Without permission to write it, or on a file system without locks, nothing is locked.

    Attributes
    ----------
    abandoned : bool
        Whether the process that held the lock before died while it held it.

    Raises
    ------
    ValueError
        If another process holds the lock.
    """

    def __init__(self, path: Path):
        self._path, self._key = path, (os.getpid(), path.resolve())
        self._released, self.abandoned = False, False
        if self._key in _held:
            _held[self._key][1] += 1
            return
        descriptor, self.abandoned = _acquire(path)
        if descriptor is None:
            self._released = True
        else:
            _held[self._key] = [descriptor, 1]

    def release(self) -> None:
        """Release the lock, unless another object of this process needs it."""
        if self._released or self._key[0] != os.getpid():
            return
        self._released = True
        held = _held.get(self._key)
        if held is None:  # the process ends
            return
        held[1] -= 1
        if held[1] == 0:
            del _held[self._key]
            with contextlib.suppress(OSError):
                os.unlink(self._path)  # before the lock is released, so that no other process has taken it
            os.close(held[0])

    def __enter__(self) -> "FileLock":
        return self

    def __exit__(self, *error) -> None:
        self.release()

    def __del__(self):
        with contextlib.suppress(Exception):
            self.release()


def _acquire(path: Path) -> tuple[int | None, bool]:
    """The descriptor of the locked file, None without locks; and whether a dead process left the file."""
    if lockf is None:
        return None, False
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            logger.info("%s cannot be opened (%s): other runs on the file are not detected", path, error.strerror)
            return None, False
        try:
            lockf(descriptor, LOCK_EX | LOCK_NB)
        except OSError as error:
            holder = _describe(os.pread(descriptor, 4096, 0))
            os.close(descriptor)
            if error.errno in (errno.EACCES, errno.EAGAIN):
                raise ValueError(
                    f"another run is writing to {path.with_suffix('.journal')} ({holder}): wait for it or stop it, or "
                    "give this run another file"
                ) from None
            logger.info("%s cannot be locked (%s): other runs on the file are not detected", path, error.strerror)
            return None, False
        if _is_current(descriptor, path):
            break
        os.close(descriptor)  # its holder has removed it in the meantime
    text = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
    abandoned = os.fstat(descriptor).st_size > 0
    os.pwrite(descriptor, json.dumps(text).encode().ljust(200), 0)
    return descriptor, abandoned


@atexit.register
def _release_all() -> None:
    """Remove the lock files of a process that ends."""
    for (process, path), (descriptor, _) in list(_held.items()):
        if process == os.getpid():
            with contextlib.suppress(OSError):
                os.unlink(path)
                os.close(descriptor)
    _held.clear()


def _is_current(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def _describe(text: bytes) -> str:
    """The holder of a lock in words."""
    try:
        holder = json.loads(text)
        return f"process {holder['pid']} on {holder['host']}, since {holder['since']}"
    except (ValueError, KeyError, TypeError):  # it is being written
        return "a process that has just started"
