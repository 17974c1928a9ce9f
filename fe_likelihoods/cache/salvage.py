"""Copies the readable rows of a damaged cache to the new cache.

A damaged page in an SQLite file makes every query fail that reads it. Therefore ranges of row numbers are read, and
halved where they fail, until only rows on damaged pages are left out. Each row has a checksum, so nothing wrong is
copied; rows of a label that cannot be read are verified. Remarks and the table of failures are not copied: simulations
yield them again.
"""

import contextlib
import logging
import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from .rows import (
    COLUMNS,
    LABEL_COLUMNS,
    RESPONSE_COLUMNS,
    STORE,
    STORE_LABEL,
    STORE_RESPONSE,
    is_undamaged,
    is_undamaged_label,
    is_undamaged_response,
    transaction,
)

__all__ = ["Salvaged", "read_options", "salvage"]

logger = logging.getLogger(__name__)

SECONDS = 60.0
FEWEST_BYTES = 100  # per row; bounds the row numbers if they cannot be queried


class Salvaged(NamedTuple):
    """Numbers of simulations and responses that were copied."""

    simulations: int
    responses: int


def salvage(damaged: Path, connection: sqlite3.Connection) -> Salvaged:
    """Copy the readable simulations and responses of a damaged cache, which stays as it is, to a new one."""
    with contextlib.suppress(sqlite3.Error, OSError, ValueError, MemoryError), _opened(damaged) as source:
        rows = source.execute(f"SELECT {LABEL_COLUMNS} FROM labels").fetchall()
        connection.executemany(STORE_LABEL, [row for row in rows if is_undamaged_label(*row)])
    return Salvaged(
        _copy(damaged, connection, "simulations", COLUMNS, STORE, is_undamaged, 1000),
        _copy(damaged, connection, "responses", RESPONSE_COLUMNS, STORE_RESPONSE, is_undamaged_response, 20),
    )


@contextlib.contextmanager
def _opened(damaged: Path) -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(f"{damaged.as_uri()}?{read_options(damaged)}", uri=True)) as source:
        source.text_factory = bytes
        source.execute("PRAGMA writable_schema = ON")  # so that a truncated file can be read
        yield source


def read_options(path: Path) -> str:
    """SQLite options to read a file without changing it; a file without a log is not in use, and gets no log."""
    return "mode=ro" if path.with_name(f"{path.name}-wal").exists() else "mode=ro&immutable=1"


def _copy(
    damaged: Path,
    connection: sqlite3.Connection,
    table: str,
    columns: str,
    store: str,
    check: Callable[..., bool],
    rows_per_query: int,
) -> int:
    """Copy the readable rows of a table; return how many were copied."""
    kept = 0
    try:
        with _opened(damaged) as source:
            # by `rowid`: where the layout is damaged, the column `id` may be no number
            query = f"SELECT {columns} FROM {table} WHERE rowid BETWEEN ? AND ?"
            for rows in _ranges(source, query, _largest_id(source, table, damaged), rows_per_query):
                if good := [row for row in rows if check(*row)]:
                    with transaction(connection):
                        connection.executemany(store, good)
                    kept += len(good)
    except (sqlite3.Error, OSError, ValueError, MemoryError, TimeoutError) as error:
        logger.warning("%s: no more %s can be salvaged (%s)", damaged.name, table, error)
    return kept


def _ranges(source: sqlite3.Connection, query: str, largest: int, rows_per_query: int) -> Iterator[list[tuple]]:
    """Rows in consecutive ranges of row numbers; TimeoutError if it takes too long."""
    stop = time.monotonic() + SECONDS
    waiting = [(1, largest)]
    while waiting:
        first, last = waiting.pop()
        if last - first >= rows_per_query:
            middle = first + rows_per_query
            waiting += [(middle, last), (first, middle - 1)]
            continue
        if time.monotonic() > stop:
            raise TimeoutError(f"stopped after {SECONDS:g} s, at row {first} of {largest}")
        try:
            yield source.execute(query, (first, last)).fetchall()
        except (sqlite3.DatabaseError, MemoryError) as error:
            if _is_absent(error):
                raise
            if first < last:
                middle = (first + last) // 2
                waiting += [(middle + 1, last), (first, middle)]


def _largest_id(source: sqlite3.Connection, table: str, damaged: Path) -> int:
    """The largest row number, or an upper bound if it cannot be read."""
    try:
        (largest,) = source.execute(f"SELECT max(rowid) FROM {table}").fetchone()
        return largest or 0
    except (sqlite3.DatabaseError, MemoryError) as error:
        if _is_absent(error):
            raise
        return damaged.stat().st_size // FEWEST_BYTES


def _is_absent(error: Exception) -> bool:
    """Whether a table is absent from the file."""
    return isinstance(error, sqlite3.OperationalError) and "no such" in str(error)
