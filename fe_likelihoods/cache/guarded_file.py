"""File of a cache whose errors do not stop a run."""

import logging
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .sqlite_file import CacheFile, is_damage

__all__ = ["GuardedFile"]

logger = logging.getLogger(__name__)

RETRY_SECONDS = 60.0  # wait after a failed access to the file


class GuardedFile:
    """Base of `Generations`: access to its file that continues after errors.

    Parameters
    ----------
    file : CacheFile
        The SQLite file and its connection.

    Attributes
    ----------
    file : CacheFile
        As given.
    retry_times : dict of str to float
        Actions on the file that failed, and the monotonic time [s] before which they are not tried again.
    """

    def __init__(self, file: CacheFile) -> None:
        self.file = file
        self.retry_times: dict[str, float] = {}

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.file.path

    def _try(self, what: str, action: Callable[[sqlite3.Connection], Any], otherwise: Any) -> Any:
        """Result of an action on the connection; after an error a warning, `otherwise`, and a pause of this action."""
        with self.file.lock:
            if time.monotonic() < self.retry_times.get(what, -np.inf):
                return otherwise
            for attempt in range(2):
                try:
                    result = action(self.file.connection())
                    self.retry_times.pop(what, None)
                    return result
                except (sqlite3.Error, OSError, ValueError, MemoryError) as error:  # a damaged size may be huge
                    self.file.close()  # also ends a transaction
                    failure = error
                except BaseException:
                    self.file.close()
                    raise
                if attempt or not self.file.writable or not is_damage(failure):
                    break
                try:
                    self.file.set_aside(str(failure))
                except (OSError, ValueError) as error:
                    failure = error
                    break
            if what not in self.retry_times:
                logger.warning(
                    "%s cannot be %s (%s); the run continues without it and tries again after %g s",
                    self.path,
                    what,
                    failure,
                    RETRY_SECONDS,
                )
            self.retry_times[what] = time.monotonic() + RETRY_SECONDS
            return otherwise

    def _insist(self, action: Callable[[sqlite3.Connection], Any]) -> Any:
        """Result of an action that the user has called explicitly; errors are raised."""
        with self.file.lock:
            try:
                return action(self.file.connection())
            except (sqlite3.Error, ValueError) as error:
                self.file.close()
                raise OSError(f"{self.path} cannot be used: {error}") from error
            except BaseException:
                self.file.close()
                raise
