"""Which stored simulations belong together: labels of models, and the generations of rows that they belong to."""

import sqlite3

import numpy as np

from ..simulation.model import Model
from .guarded_file import GuardedFile
from .rows import (
    COLUMNS,
    LABEL_COLUMNS,
    OF_EARLIER_RELEASES,
    STORE_LABEL,
    StoredLabel,
    StoredSimulation,
    is_undamaged,
    is_undamaged_label,
    pack_label,
    regenerated,
    simulation_keys,
    source_number,
    unpack_label,
)
from .sqlite_file import CacheFile

__all__ = ["MAX_CANDIDATES", "Generations"]

MAX_CANDIDATES = 5000  # rows among which those to be compared are chosen
MAX_SOURCES = 8  # of earlier releases that are compared with a model


class Generations(GuardedFile):
    """Base of `SimulationCache`, which documents the attributes: labels and generations in its file."""

    def __init__(self, file: CacheFile) -> None:
        super().__init__(file)
        self._has_earlier: bool | None = None  # rows of earlier releases, None until it was looked for

    def labels_of(self, model: Model) -> list[StoredLabel]:
        """Labels under which simulations of a model were stored or adopted."""
        query = f"SELECT {LABEL_COLUMNS} FROM labels WHERE source = ? ORDER BY rowid"
        source = source_number(model.fingerprint)
        rows = self._try("read", lambda connection: connection.execute(query, (source,)).fetchall(), [])
        return [unpack_label(*row) for row in rows if is_undamaged_label(*row)]

    def add_label(self, label: StoredLabel, move: bool = False) -> StoredLabel:
        """Store a label, unless another process has stored it; return the one that is stored.

        Parameters
        ----------
        label : StoredLabel
        move : bool
            Replace the generation of a stored one.
        """

        def add(connection: sqlite3.Connection) -> StoredLabel:
            connection.execute("BEGIN IMMEDIATE")
            query = f"SELECT {LABEL_COLUMNS} FROM labels WHERE source = ? AND label = ? AND cpu = ?"
            found = connection.execute(query, (label.source, label.label.encode(), label.cpu.encode())).fetchone()
            new = label
            if found is not None and is_undamaged_label(*found):
                stored = unpack_label(*found)
                new = label._replace(id=stored.id) if move else stored
                if not move and label.generation == stored.generation and label.compared > stored.compared:
                    new = stored._replace(compared=label.compared)
            connection.execute(STORE_LABEL, pack_label(new))
            connection.execute("COMMIT")
            return new

        with self.file.lock:
            return self._try("written", add, label) if self.file.writable else label

    def update_label(self, label: StoredLabel) -> StoredLabel:
        """Replace the text and the files of a stored label."""

        def update(connection: sqlite3.Connection) -> StoredLabel:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(STORE_LABEL, pack_label(label))
            connection.execute("COMMIT")
            return label

        with self.file.lock:
            return self._try("written", update, label) if self.file.writable else label

    def generations_of(self, fingerprint: str, table: str = "simulations") -> list[int]:
        """Generations of the simulations, or of the responses, of one identity, the latest first."""
        source = source_number(fingerprint)
        query = f"SELECT generation FROM {table} WHERE source = ? GROUP BY generation ORDER BY max(id) DESC"
        rows = self._try("read", lambda connection: connection.execute(query, (source,)).fetchall(), [])
        return [generation for (generation,) in rows]

    def _given_or_latest(self, fingerprint: str, generation: int | None) -> int:
        if generation is not None:
            return generation
        tables = ("simulations", "responses", "labels")
        return next((found[0] for table in tables if (found := self.generations_of(fingerprint, table))), 1)

    def stored_rows(
        self, fingerprint: str | int, generation: int, n_channels: int, n_steps: int, most: int = MAX_CANDIDATES
    ) -> list[StoredSimulation]:
        """Undamaged simulations of one identity and generation, the latest first, evenly chosen if there are many.

        Parameters
        ----------
        fingerprint : str or int
            As for `look_up`, or the number of a source of an earlier release.
        generation : int
        n_channels, n_steps : int
            Shape of the measurements.
        most : int
            Largest number of rows, about.
        """
        source = fingerprint if isinstance(fingerprint, int) else source_number(fingerprint)

        def read(connection: sqlite3.Connection) -> list[tuple]:
            where = "FROM simulations WHERE source = ? AND generation = ?"
            columns = f"SELECT {COLUMNS} {where}"
            ((n,),) = connection.execute(f"SELECT count(*) {where}", (source, generation)).fetchall()
            if n <= most or most == 1:
                return connection.execute(f"{columns} ORDER BY id DESC LIMIT ?", (source, generation, most)).fetchall()
            latest = connection.execute(f"{columns} ORDER BY id DESC LIMIT 10", (source, generation)).fetchall()
            some = f"{columns} AND id % ? = 0 ORDER BY id DESC"
            return latest + connection.execute(some, (source, generation, n // most + 1)).fetchall()

        rows = self._try("read", read, [])
        found = {}
        for row in rows:
            if is_undamaged(*row) and len(row[3]) == 8 * n_channels and row[4] == n_steps:
                theta, misfit = (np.frombuffer(data, dtype="<f8") for data in row[2:4])
                found[row[0]] = StoredSimulation(theta, misfit, row[5].decode("utf-8", "replace"), row[9])
        return list(found.values())

    def label_of(self, fingerprint: str, theta: np.ndarray, generation: int) -> int:
        """Id of the label under which a simulation or a response was stored; 0 if it is not known."""
        (key,) = simulation_keys(fingerprint, theta[None], generation)
        for table in ("simulations", "responses"):
            query = f"SELECT label FROM {table} WHERE key = ?"
            for (label,) in self._try("read", lambda connection, q=query: connection.execute(q, (key,)).fetchall(), []):
                return label
        return 0

    def response_points(self, model: Model, generation: int, most: int = MAX_CANDIDATES) -> list[tuple]:
        """Parameters (n_structural,) and label of stored responses of a model, the latest first."""
        source = source_number(model.fingerprint)
        query = "SELECT theta, label FROM responses WHERE source = ? AND generation = ? ORDER BY id DESC LIMIT ?"
        values = source, generation, most
        rows = self._try("read", lambda connection: connection.execute(query, values).fetchall(), [])
        return [(np.frombuffer(theta, dtype="<f8"), label) for theta, label in rows if isinstance(theta, bytes)]

    def earlier_sources(self, n_parameters: int, n_channels: int, n_steps: int) -> list[int]:
        """Sources of simulations that an earlier release has stored with such shapes, the latest first."""
        if self._has_earlier is None:
            query = "SELECT 1 FROM simulations INDEXED BY simulation_generations WHERE generation = ? LIMIT 1"
            values = (OF_EARLIER_RELEASES,)
            self._has_earlier = bool(self._try("read", lambda found: found.execute(query, values).fetchall(), []))
        if not self._has_earlier:
            return []
        query = (
            "SELECT source FROM simulations WHERE generation = ? AND length(theta) = ? AND length(misfit) = ? "
            "AND n_steps = ? GROUP BY source ORDER BY max(id) DESC LIMIT ?"
        )
        values = OF_EARLIER_RELEASES, 8 * n_parameters, 8 * n_channels, n_steps, MAX_SOURCES
        rows = self._try("read", lambda connection: connection.execute(query, values).fetchall(), [])
        return [source for (source,) in rows]

    def adopt_earlier(self, source: int, fingerprint: str, generation: int, label: int) -> None:
        """Make the simulations of an earlier release those of an identity and generation."""
        update = (
            "UPDATE OR REPLACE simulations SET key = ?, source = ?, crc = ?, generation = ?, label = ? WHERE key = ?"
        )
        query = f"SELECT {COLUMNS} FROM simulations WHERE source = ? AND generation = ?"

        def adopt(connection: sqlite3.Connection) -> None:
            connection.execute("BEGIN IMMEDIATE")
            rows = connection.execute(query, (source, OF_EARLIER_RELEASES)).fetchall()
            good = [regenerated(fingerprint, generation, label, row) for row in rows if is_undamaged(*row)]
            connection.executemany(update, good)
            connection.execute("COMMIT")

        with self.file.lock:
            if self.file.writable:
                self._try("written", adopt, None)
