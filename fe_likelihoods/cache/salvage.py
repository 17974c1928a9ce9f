"""Copies the readable rows of a damaged cache to the new cache.

A damaged page in an SQLite file makes every query fail that reads it, so one bad page would lose all rows. Therefore
ranges of row numbers are read, and halved where they fail, until only rows on damaged pages are left out. Each row has
a checksum, so nothing wrong is copied. Simulations and responses are copied, and labels if they can be read (rows of an
unknown label are verified). Remarks and the table of failures are not copied: simulations yield them again.
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

__all__ = ["Salvaged", "number_or_unknown", "read_options", "salvage"]

logger = logging.getLogger(__name__)

SECONDS = 60.0
FEWEST_BYTES = 100  # per row; bounds the row numbers if they cannot be queried


class _Table(NamedTuple):
    """A table to copy: its columns, the statement and check for a row, and the number of rows per query."""

    name: str
    columns: str
    store: str
    check: Callable[..., bool]
    rows_per_query: int


_SIMULATIONS = _Table("simulations", COLUMNS, STORE, is_undamaged, 1000)
_RESPONSES = _Table("responses", RESPONSE_COLUMNS, STORE_RESPONSE, is_undamaged_response, 20)
_ADDED = "generation, label"  # columns that files of earlier releases do not have


class Salvaged(NamedTuple):
    """Numbers of simulations and responses that were copied, and that are lost (unreadable or a wrong checksum).

    The numbers of lost rows are upper bounds, since they may count deleted rows; None if they are unknown.
    """

    rows: int
    lost: int | None
    responses: int
    lost_responses: int | None


def salvage(damaged: Path, connection: sqlite3.Connection) -> Salvaged:
    """Copy the readable simulations and responses of a damaged cache, which is not changed.

    Parameters
    ----------
    damaged : Path
        The damaged file, with its log.
    connection : sqlite3.Connection
        Connection to the new cache.
    """
    with contextlib.suppress(sqlite3.Error, OSError, ValueError, MemoryError), _opened(damaged) as source:
        rows = source.execute(f"SELECT {LABEL_COLUMNS} FROM labels").fetchall()
        connection.executemany(STORE_LABEL, [row for row in rows if is_undamaged_label(*row)])
    return Salvaged(*_copy(damaged, connection, _SIMULATIONS), *_copy(damaged, connection, _RESPONSES))


@contextlib.contextmanager
def _opened(damaged: Path) -> Iterator[sqlite3.Connection]:
    with contextlib.closing(sqlite3.connect(f"{damaged.as_uri()}?{read_options(damaged)}", uri=True)) as source:
        source.text_factory = bytes
        source.execute("PRAGMA writable_schema = ON")  # so that a truncated file can be read
        yield source


def read_options(path: Path) -> str:
    """SQLite options to read a file without changing it; a file without a log is not in use, and gets no log."""
    return "mode=ro" if path.with_name(f"{path.name}-wal").exists() else "mode=ro&immutable=1"


def number_or_unknown(n: int | None) -> str:
    """A number of rows as text."""
    return "an unknown number" if n is None else str(n)


def _copy(damaged: Path, connection: sqlite3.Connection, table: _Table) -> tuple[int, int | None]:
    """Copy the readable rows of a table; return how many were copied, and how many were lost (None if unknown)."""
    kept, lost, known = 0, 0, True
    try:
        with _opened(damaged) as source:
            table = _as_stored(source, table)
            if (largest := _largest_id(source, table.name)) is None:
                known, largest = False, damaged.stat().st_size // FEWEST_BYTES
            for rows, missing in _ranges(source, damaged, table, largest):
                good = [row for row in rows if table.check(*row)]
                known = known and missing is not None
                lost += (missing or 0) + len(rows) - len(good)
                if good:
                    with transaction(connection):
                        connection.executemany(table.store, good)
                    kept += len(good)
    except (sqlite3.Error, OSError, ValueError, MemoryError) as error:
        logger.warning("%s: no more %s can be salvaged (%s)", damaged.name, table.name, error)
        known = False
    return kept, lost if known else None


def _as_stored(source: sqlite3.Connection, table: _Table) -> _Table:
    """The table with zeros in place of columns that a file of an earlier release does not have."""
    with contextlib.suppress(sqlite3.DatabaseError):
        known = [name for _, name, *_ in source.execute(f"PRAGMA table_info({table.name})")]
        if known and b"label" not in known:
            return table._replace(columns=table.columns.replace(_ADDED, "0, 0"))
    return table


def _ranges(
    source: sqlite3.Connection, path: Path, table: _Table, largest: int
) -> Iterator[tuple[list[tuple], int | None]]:
    """Rows in consecutive ranges of row numbers, and how many rows per range are unreadable (None if unknown)."""
    query = f"SELECT {table.columns} FROM {table.name} WHERE id BETWEEN ? AND ?"
    stop = time.monotonic() + SECONDS
    waiting = [(1, largest)]
    while waiting:
        first, last = waiting.pop()
        if last - first >= table.rows_per_query:
            middle = first + table.rows_per_query
            waiting += [(middle, last), (first, middle - 1)]
            continue
        if time.monotonic() > stop:
            text = "%s: salvage of %s ended after %g s, at row %d of %d"
            logger.warning(text, path.name, table.name, SECONDS, first, last)
            yield [], None
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


def _largest_id(source: sqlite3.Connection, table: str) -> int | None:
    """The largest row number, None if it cannot be read."""
    try:
        (largest,) = source.execute(f"SELECT max(id) FROM {table}").fetchone()
    except (sqlite3.DatabaseError, MemoryError) as error:
        if isinstance(error, sqlite3.OperationalError) and "no such" in str(error):
            raise
        return None
    return largest or 0
