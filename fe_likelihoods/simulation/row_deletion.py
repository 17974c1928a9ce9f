"""Deletion of rows of a cache: of all rows, of one model, or of single simulations."""

import sqlite3

import numpy as np

from .cache_rows import REMOVE, simulation_keys, source_number
from .failure_table import FailureTable

__all__ = ["RowDeletion"]

_TABLES = tuple(REMOVE)


class RowDeletion(FailureTable):
    """Base of `SimulationCache`, which documents the attributes: deletes rows of its file."""

    _waiting: list[tuple]

    def clear(self) -> None:
        """Delete all rows, for all users of the file; the caches in memory of likelihoods are not affected.

        Raises
        ------
        OSError
            If the file cannot be written.
        """

        def delete(connection: sqlite3.Connection) -> None:
            connection.execute("BEGIN IMMEDIATE")
            for table in _TABLES:
                connection.execute(f"DELETE FROM {table}")
            connection.execute("COMMIT")

        with self.file.lock:
            self._insist(delete)
            self._waiting.clear()
            # returns the space to the disk; may fail while others read
            self._try("vacuumed", lambda connection: connection.execute("VACUUM"), None)

    def forget(self, *fingerprints: str) -> int:
        """Delete the simulations and responses of some models, for all users of the file.

        The caches in memory of likelihoods are not affected: make a new likelihood.

        Parameters
        ----------
        *fingerprints : str
            As for `look_up`; ``cache.forget(*likelihood.cache_keys)`` deletes what a likelihood uses.

        Returns
        -------
        int
            Number of rows deleted.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        sources = [(source_number(fingerprint),) for fingerprint in fingerprints]

        def delete(connection: sqlite3.Connection) -> int:
            connection.execute("BEGIN IMMEDIATE")
            deleted = sum(connection.executemany(statement, sources).rowcount for statement in REMOVE.values())
            connection.execute("COMMIT")
            return deleted

        with self.file.lock:
            self._waiting = [row for row in self._waiting if (row[1],) not in sources]
            return self._insist(delete)

    def discard(self, thetas: np.ndarray, *fingerprints: str) -> None:
        """Delete the rows of some simulations, if possible.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters.
        *fingerprints : str
            As for `look_up`.
        """
        keys = [(key,) for fingerprint in fingerprints for key in simulation_keys(fingerprint, thetas)]

        def delete(connection: sqlite3.Connection) -> None:
            connection.execute("BEGIN IMMEDIATE")
            for table in _TABLES:
                connection.executemany(f"DELETE FROM {table} WHERE key = ?", keys)
            connection.execute("COMMIT")

        with self.file.lock:
            self._waiting = [row for row in self._waiting if (row[0],) not in set(keys)]
            if self.file.writable:
                self._try("repaired", delete, None)
