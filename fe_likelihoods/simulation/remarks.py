"""Remarks of models about their simulations, kept in the cache on disk: a law was continued beyond its range.

A built-in model says once, as a warning, that a simulation was beyond the range of its laws. A later process that takes
the simulations from the cache would hear nothing. Therefore the text is stored beside the rows, under the key of the
model, and is repeated as a warning when rows of this model are first used in another process.
"""

import logging
import sqlite3

from .cache_rows import source_number
from .fingerprint import simulation_fingerprint
from .guarded_file import GuardedFile
from .model import Model

__all__ = ["RemarkTable", "repeat_remark_of", "store_remark_of"]

logger = logging.getLogger(__name__)

_STORE = "INSERT OR IGNORE INTO remarks (key, source, text) VALUES (?, ?, ?)"
_repeated: set[tuple[str, int]] = set()  # by file and model, in this process


class RemarkTable(GuardedFile):
    """Base of `SimulationCache`, which documents the attributes: the table of remarks of its file."""

    def store_remark(self, model: Model, text: str) -> None:
        """Store the remark of a model, unless there is one or the file is read-only."""
        source = source_number(simulation_fingerprint(model))
        row = _key(source), source, text.encode("utf-8", "backslashreplace")
        with self.file.lock:
            if self.file.writable:
                self._try("written", lambda connection: connection.execute(_STORE, row), None)

    def look_up_remark(self, model: Model) -> str:
        """Remark of a model; empty if there is none."""
        key = _key(source_number(simulation_fingerprint(model)))

        def read(connection: sqlite3.Connection) -> list[tuple]:
            has_table = "SELECT count(*) FROM sqlite_master WHERE name = 'remarks'"  # not in a read-only earlier file
            if connection.execute(has_table).fetchone() == (0,):
                return []
            return connection.execute("SELECT text FROM remarks WHERE key = ?", (key,)).fetchall()

        rows = self._try("read", read, [])
        return bytes(rows[0][0]).decode("utf-8", "replace") if rows else ""


def store_remark_of(model: Model, cache: RemarkTable) -> None:
    """Store the attribute `range_remark` of a model, if it has one."""
    if text := getattr(model, "range_remark", ""):
        cache.store_remark(model, text)


def repeat_remark_of(model: Model, cache: RemarkTable | None) -> None:
    """Log the stored remark of a model, once per process and not where the model has made one itself."""
    if cache is None or not hasattr(model, "range_remark"):
        return
    place = str(cache.path), source_number(simulation_fingerprint(model))
    if place in _repeated:
        return
    _repeated.add(place)
    text = cache.look_up_remark(model)
    if text and not model.range_remark:
        logger.warning("simulations of this model in %s: %s", cache.path, text)


def _key(source: int) -> bytes:
    return source.to_bytes(8, "little", signed=True)
