"""A file that HDF5 can write without an error or an interrupt, which it does not survive."""

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Iterator

try:
    from fcntl import LOCK_EX, LOCK_NB, flock
except ImportError:
    flock = None

__all__ = ["LenientFile", "deferred_interrupts"]

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Context in which Ctrl-C waits for the end, since it must not be raised in a function that HDF5 calls."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    received: list[tuple] = []
    signal.signal(signal.SIGINT, lambda *arguments: received.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if received:
            handler(*received[0])


class LenientFile:
    """A file for HDF5 whose writes never fail.

    HDF5 keeps a file open in an unknown state where it cannot be written, for example because the disk is full, and a
    later access can end the process (signal 11; HDF5 1.14). So an error is kept here, and HDF5 is not informed of it.
    Nothing is written after an error: HDF5 writes data first, and what refers to it last, so that the file stays
    readable, and its other groups can be copied.

    Parameters
    ----------
    path : str
        The file, which exists. It is locked as HDF5 would lock it; BlockingIOError if another process reads it.

    Attributes
    ----------
    error : OSError, or None
        The first error.
    """

    def __init__(self, path: str):
        self._file = open(path, "r+b", buffering=0)  # noqa: SIM115  closed by `close`
        self.error: OSError | None = None
        if flock is not None and os.environ.get("HDF5_USE_FILE_LOCKING", "TRUE").upper() not in ("FALSE", "0"):
            try:
                flock(self._file, LOCK_EX | LOCK_NB)
            except BlockingIOError:
                self._file.close()
                raise
            except OSError as error:  # a file system without locks
                logger.info("%s cannot be locked (%s)", path, error.strerror)

    def __getattr__(self, name: str):
        return getattr(self._file, name)

    def write(self, data: bytes) -> int:
        """Write all bytes, or keep the error."""
        data = memoryview(data).cast("B")
        written = 0
        try:
            while written < len(data) and self.error is None:
                written += self._file.write(data[written:])
        except OSError as error:
            self.error = error
        return len(data)

    def truncate(self, *size: int) -> None:
        """Change the size of the file, or keep the error."""
        try:
            if self.error is None:
                self._file.truncate(*size)
        except OSError as error:
            self.error = error
