"""Rows of a damaged cache that can still be read, copied to the new one.

A damaged page of an SQLite file makes every query fail that reads it, so one bad page would lose all rows. Ranges of
row numbers are read, and halved where they fail, until only the rows of the damaged pages are left out. Each row has a
checksum of its own, so nothing wrong is copied. Responses are not copied: they can be simulated again.
"""

import contextlib
import logging
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from .cache_rows import COLUMNS, STORE, is_undamaged

__all__ = ["Salvaged", "salvage"]

logger = logging.getLogger(__name__)

SECONDS = 60.0
ROWS_PER_QUERY = 1000
FEWEST_BYTES = 100  # of a row; bounds the row numbers where they cannot be queried


class Salvaged(NamedTuple):
    """What was copied.

    Attributes
    ----------
    rows : int
        Simulations that were copied.
    lost : int
        Simulations that could not be read, or whose checksum is wrong; at most so many where rows had been deleted.
    """

    rows: int
    lost: int


def salvage(damaged: Path, connection: sqlite3.Connection) -> Salvaged:
    """Copy the readable simulations of a damaged cache, and say in a warning how many were lost.

    Parameters
    ----------
    damaged : Path
        The damaged file, with its log; it is not changed.
    connection : sqlite3.Connection
        Connection to the new cache.

    Returns
    -------
    Salvaged
        The counts; zero where the file as a whole cannot be read.
    """
    kept = lost = 0
    try:
        with contextlib.closing(sqlite3.connect(f"{damaged.as_uri()}?mode=ro", uri=True)) as source:
            source.text_factory = bytes
            for rows, missing in _ranges(source, damaged):
                good = [row for row in rows if is_undamaged(*row)]
                lost += missing + len(rows) - len(good)
                if good:
                    connection.execute("BEGIN IMMEDIATE")
                    connection.executemany(STORE, good)
                    connection.execute("COMMIT")
                    kept += len(good)
    except (sqlite3.Error, OSError, ValueError, MemoryError) as error:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        logger.warning("%s: no more simulations can be salvaged (%s)", damaged.name, error)
    logger.warning("%s: %d simulations were salvaged, %d were lost", damaged.name, kept, lost)
    return Salvaged(kept, lost)


def _ranges(source: sqlite3.Connection, path: Path) -> Iterator[tuple[list[tuple], int]]:
    """Rows of consecutive ranges of row numbers, and how many rows of each cannot be read."""
    query, stop = f"SELECT {COLUMNS} FROM simulations WHERE id BETWEEN ? AND ?", time.monotonic() + SECONDS
    waiting = [(1, _largest_id(source, path))]
    while waiting:
        first, last = waiting.pop()
        if last - first >= ROWS_PER_QUERY:
            middle = first + ROWS_PER_QUERY
            waiting += [(middle, last), (first, middle - 1)]
            continue
        if time.monotonic() > stop:
            logger.warning("%s: salvage ended after %g s, at row %d of %d", path.name, SECONDS, first, last)
            return
        try:
            yield source.execute(query, (first, last)).fetchall(), 0
        except (sqlite3.DatabaseError, MemoryError) as error:
            if isinstance(error, sqlite3.OperationalError) and "no such" in str(error):
                raise
            if first == last:
                yield [], 1
            elif last >= first:
                middle = (first + last) // 2
                waiting += [(middle + 1, last), (first, middle)]


def _largest_id(source: sqlite3.Connection, path: Path) -> int:
    """The largest row number, or an upper bound of it."""
    bound = path.stat().st_size // FEWEST_BYTES
    try:
        (largest,) = source.execute("SELECT max(id) FROM simulations").fetchone()
    except (sqlite3.DatabaseError, MemoryError):
        return bound
    return largest or 0
