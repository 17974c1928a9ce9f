"""Finished simulations on their way to the file of a cache: written together, about a second after they came."""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

__all__ = ["FinishedRows", "RowBuffer"]

SECONDS_BETWEEN_WRITES = 1.0
MOST_BYTES = 2**26  # of responses that wait


class FinishedRows(NamedTuple):
    """Simulations to be written.

    Attributes
    ----------
    thetas : (n, n_structural) float
        Structural parameters.
    misfit : (n, n_numbers) float
        Statistics.
    reasons : list of n str
        Reasons of failures.
    response : (n, n_channels, n_steps) float, optional
        Responses, if they are stored.
    seconds : float
        Wall time [s].
    """

    thetas: np.ndarray
    misfit: np.ndarray
    reasons: list[str]
    response: np.ndarray | None
    seconds: float


class RowBuffer:
    """Rows that wait to be written.

    The first rows are written at once, later ones together, a second after the last write: by the thread that adds
    them, or by a timer if no more come.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._rows: list[FinishedRows] = []
        self._write: Callable[[FinishedRows], None] | None = None
        self._timer: threading.Timer | None = None
        self._bytes, self._last = 0, -np.inf

    def add(self, rows: FinishedRows, write: Callable[[FinishedRows], None]) -> None:
        """Add rows, which the function `write` writes."""
        with self._lock:
            self._rows.append(rows)
            self._write = write
            self._bytes += 0 if rows.response is None else rows.response.nbytes
            wait = self._last + SECONDS_BETWEEN_WRITES - time.monotonic()
            if wait <= 0.0 or self._bytes > MOST_BYTES:
                self.flush()
            elif self._timer is None:
                self._timer = threading.Timer(wait, self.flush)  # no daemon: the process ends after the last rows
                self._timer.start()

    def flush(self) -> None:
        """Write the rows that wait."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if not self._rows:
                return
            rows, self._rows, self._bytes = self._rows, [], 0
            self._last = time.monotonic()
            write, self._write = self._write, None  # it refers to the likelihood
            # those with responses apart: one cannot be stored without the other
            for some in ([r for r in rows if r.response is None], [r for r in rows if r.response is not None]):
                if some:
                    write(_joined(some))


def _joined(rows: list[FinishedRows]) -> FinishedRows:
    response = None if rows[0].response is None else np.concatenate([row.response for row in rows])
    return FinishedRows(
        np.concatenate([row.thetas for row in rows]),
        np.concatenate([row.misfit for row in rows]),
        [reason for row in rows for reason in row.reasons],
        response,
        sum(row.seconds for row in rows),
    )
