"""Locks of files and folders, where the system and the file system have them."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

try:
    from fcntl import LOCK_EX, LOCK_NB
    from fcntl import flock as _lock
except ImportError:  # Windows has no such locks: two programs on one file are not detected there
    _lock = None

PAUSE = 0.002  # [s] between two trials


def lock_now(file: Any) -> None:
    """Lock an open file or its descriptor; BlockingIOError if another process has, OSError if it cannot be locked."""
    if _lock is not None:
        _lock(file, LOCK_EX | LOCK_NB)


@contextlib.contextmanager
def locked_folder(folder: Path, seconds: float) -> Iterator[None]:
    """Context that one process at a time enters, or any after a time [s]; any at once where there are no locks."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a folder with search permission only, a file system without locks
            descriptor = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            stop = time.monotonic() + seconds
            while time.monotonic() <= stop:
                try:
                    lock_now(descriptor)
                    break
                except BlockingIOError:
                    time.sleep(PAUSE)
        yield
