"""Cache of simulations on disk, shared by runs, samplers, processes and programs.

The statistics of a simulation depend neither on the noise parameters nor on the prior, so one simulation serves every
noise level, every tempering stage and every sampler. Its key is a digest of the declared identity (fingerprints of
model and measurements), the generation, and the structural parameters to the last bit. Responses and failures of the
model have keys of the model alone, for any measurements. Faults of the infrastructure
(`fe_likelihoods.simulation.failure_reasons`), also of a time limit, are not stored.

A cache never makes a run fail. A row that does not match its checksum is simulated again, a damaged file is moved
aside, and while the file cannot be written, rows wait in memory.
"""

import hashlib
import json
import logging
import os
import sqlite3
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..simulation.failure_reasons import MisfitReason, TransientReason, shortened
from .file import CacheFile, transaction

__all__ = [
    "TOLERANCE",
    "CacheInfo",
    "Row",
    "SimulationCache",
    "pack_rows",
]

logger = logging.getLogger(__name__)

MAX_WAITING_ROWS = 100_000  # rows kept in memory while the file cannot be written
KEYS_PER_QUERY = 500  # keys in one SELECT
TOLERANCE = 1e-9
COLUMNS = "key, source, generation, theta, value, reason, session, crc, size"
STORE = f"INSERT OR REPLACE INTO rows ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
LABEL_COLUMNS = "source, code, files, generation, crc"
STORE_LABEL = f"INSERT OR REPLACE INTO labels ({LABEL_COLUMNS}) VALUES (?, ?, ?, ?, ?)"
KEY_BYTES = 16
NUMBERS = struct.Struct("<qqq")


class Row(NamedTuple):
    """A stored simulation: the values of `COLUMNS`; arrays are bytes."""

    key: bytes
    source: int
    generation: int
    theta: bytes  # structural parameters
    value: bytes  # statistics or response; empty if it failed
    reason: bytes  # of the failure
    session: int  # number of the process that stored the row
    crc: int
    size: int | None

    @property
    def outcome(self) -> bytes | str:
        """The value, or the reason of a failure."""
        return self.reason.decode("utf-8", "replace") if self.reason else self.value


def simulation_keys(fingerprint: str, thetas: np.ndarray, generation: int = 1) -> list[bytes]:
    """Keys of simulations, digests of 128 bits.

    `fingerprint` is the declared identity: everything that a simulation depends on, except the structural parameters
    (n, n_structural), where -0.0 and 0.0 have the same key, and the generation.
    """
    start = hashlib.blake2b(f"{fingerprint}\0{generation}\0".encode(), digest_size=KEY_BYTES)
    keys = []
    for row in np.asarray(thetas, dtype="<f8") + 0.0:  # adding zero makes 0.0 of -0.0
        digest = start.copy()
        digest.update(row.tobytes())
        keys.append(digest.digest())
    return keys


def source_number(fingerprint: str) -> int:
    """64-bit number of a declared identity."""
    return int.from_bytes(hashlib.blake2b(fingerprint.encode(), digest_size=8).digest(), signed=True)


def pack_rows(
    fingerprint: str,
    thetas: np.ndarray,
    values: np.ndarray,
    reasons: Sequence[str],
    generation: int,
    session: int = 0,
    of_model: bool = False,
) -> list[Row]:
    """Simulations as they are stored: statistics, or responses `of_model`.

    Failures whose cause may be gone are left out: faults of the infrastructure, and in the rows of a model failures
    that depend on the measurements.
    """
    source, rows = source_number(fingerprint), []
    keys = simulation_keys(fingerprint, thetas, generation)
    for key, theta, value, reason in zip(keys, thetas, values, reasons, strict=True):
        if isinstance(reason, TransientReason) or (of_model and isinstance(reason, MisfitReason)):
            continue
        data = b"" if reason else np.asarray(value, dtype="<f8").tobytes()
        text = shortened(reason).encode("utf-8", "backslashreplace")
        packed = key, source, generation, np.asarray(theta, dtype="<f8").tobytes(), data, text, session
        rows.append(Row(*packed, _checksum(*packed), len(data) if of_model else None))
    return rows


def _checksum(key, source, generation, theta, value, reason, session) -> int:  # noqa: ANN001
    """CRC-32 of a row; the key is included, so swapped rows count as damaged."""
    numbers = NUMBERS.pack(source, generation, session)
    return zlib.crc32(value, zlib.crc32(b"".join((key, numbers, theta, reason))))


def is_undamaged(row: tuple) -> bool:
    """Whether the values of `COLUMNS` match their checksum, which leaves out the size, and the size the value."""
    try:
        return row[7] == _checksum(*row[:7]) and row[8] in (None, len(row[4]))
    except (TypeError, struct.error):  # damage may change the type of a value
        return False


class CacheInfo(NamedTuple):
    """State of the file of a cache."""

    path: Path
    simulations: int
    failures: int  # among the stored simulations
    responses: int
    response_bytes: int  # of the stored responses [bytes]


class SimulationCache:
    """Cache of simulations (sums of squared residuals, responses and failures) in one SQLite file.

    Any number of threads, processes and programs may use a file at the same time, each process through its own
    connection. The object may be forked and pickled: another process opens the file by its path. The file must be on a
    local disk, because SQLite's shared memory does not work on network file systems. On a cluster, let the parent
    process own the cache (``FELikelihood(..., pool=...)``); its workers return sums.

    Stored rows survive if the process is killed, even by ``kill -9``; a power failure may lose the last seconds.

    Parameters
    ----------
    path : path
        The file; created if it does not exist.
    responses : bool
        Store the response of every simulation. By default, only requested responses are stored
        (`FELikelihood.simulate`, guides).
    max_response_bytes : int
        Largest size of all stored responses [bytes], at 8 bytes per channel and sample. The oldest are evicted.
    tolerance : float
        Accepted difference between a stored and a new response, relative to the response norm. On another processor,
        and in sums over several threads, the last digits differ.

    Attributes
    ----------
    damaged : int
        Rows that this object has found damaged in this process; they are simulated and stored again.
    file : CacheFile
        The SQLite file and its connection.

    Raises
    ------
    ValueError
        If a bound is not positive, if the tolerance is negative, if the path is a folder or in no existing folder, or
        if the file cannot be read or created, is not a cache, belongs to another program, or has the layout of another
        release. Such a file is not changed.

    Examples
    --------
    >>> cached = FELikelihood(model, measurements, cache=SimulationCache("oscillator.sqlite"))
    >>> value = cached.log_likelihood([1.1, 0.9, 0.1, 0.005])
    >>> cached.simulator.cache.info().simulations
    1
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        responses: bool = False,
        max_response_bytes: int = 2**30,
        tolerance: float = TOLERANCE,
    ) -> None:
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"SimulationCache: expected the path of a file; got {path!r}")
        most = max_response_bytes
        if isinstance(most, bool) or not isinstance(most, int | np.integer) or most < 1:
            raise ValueError(f"SimulationCache: max_response_bytes must be a whole number of 1 or more; got {most!r}")
        if not 0.0 <= tolerance < np.inf:
            raise ValueError(f"SimulationCache: tolerance must be a number of 0 or more; got {tolerance!r}")
        self.max_response_bytes, self.responses = int(max_response_bytes), bool(responses)
        self.tolerance = tolerance
        self.file = CacheFile(path)
        self.file.check()
        self.damaged, self._waiting = 0, list[Row]()

    def __getstate__(self) -> dict:
        return vars(self) | {"damaged": 0, "_waiting": []}

    def __repr__(self) -> str:
        return f"SimulationCache({str(self.path)!r})"

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.file.path

    # rows ---------------------------------------------------------------------------------------------------------

    def look_up(self, fingerprint: str, thetas: np.ndarray, width: int, generation: int) -> list[Row | None]:
        """Stored simulations of `width` numbers each, with few queries for the whole batch; None where none is stored.

        Rows of another width count as damaged.
        """
        keys = simulation_keys(fingerprint, thetas, generation)
        found: list[Row] = []
        for start in range(0, len(keys), KEYS_PER_QUERY):
            part = keys[start : start + KEYS_PER_QUERY]
            query = f"SELECT {COLUMNS} FROM rows WHERE key IN ({','.join('?' * len(part))})"
            found += map(Row._make, self.file.select(query, tuple(part)))
        good = {row.key: row for row in found if is_undamaged(row) and (row.reason or len(row.value) == 8 * width)}
        if len(good) < len(found):
            if not self.damaged:
                logger.warning("%s has damaged rows; they are simulated again, see SimulationCache.damaged", self.path)
            self.damaged += len(found) - len(good)
        return [good.get(key) for key in keys]

    def write(self, rows: list[Row]) -> None:
        """Store rows, and those that wait, and evict the oldest, in one transaction."""
        if not rows and not self._waiting:
            return
        with self.file.lock:
            rows = self._waiting + rows
            written = self.file.attempt("written", lambda connection: self._insert(connection, rows) or True, False)
            # responses can be computed again
            self._waiting = [] if written else [row for row in rows if not row.size][-MAX_WAITING_ROWS:]

    def _insert(self, connection: sqlite3.Connection, rows: list[Row]) -> None:
        limit = (self.max_response_bytes,)
        with transaction(connection):
            connection.executemany(STORE, rows)
            too_many = "SELECT total(size) > ? FROM rows WHERE size > 0"
            if any(row.size for row in rows) and connection.execute(too_many, limit).fetchone()[0]:
                sums = "SELECT id, sum(size) OVER (ORDER BY id DESC) AS newest FROM rows WHERE size > 0"
                evict = f"DELETE FROM rows WHERE id IN (SELECT id FROM ({sums}) WHERE newest > ?)"
                connection.execute(evict, limit)

    # generations --------------------------------------------------------------------------------------------------

    def generations_of(self, fingerprint: str) -> list[int]:
        """Generations of one identity's rows, the latest first."""
        query = "SELECT generation FROM rows WHERE source = ? AND generation GROUP BY generation ORDER BY max(id) DESC"
        return [generation for (generation,) in self.file.select(query, (source_number(fingerprint),))]

    def some_rows(
        self, fingerprint: str, generation: int, width: int, n: int, other_than: int | None = None
    ) -> list[Row]:
        """Undamaged rows of one identity and generation, at most n: random ones, or the latest successes.

        The latest ones are those of sessions `other_than` one with a number.
        """
        kind, order, more = "length(value) = ? OR length(reason) > 0", "random()", ()
        if other_than is not None:
            kind, order, more = "length(reason) = 0 AND length(value) = ? AND session != ?", "id DESC", (other_than,)
        chosen = f"SELECT id FROM rows WHERE source = ? AND generation = ? AND ({kind}) ORDER BY {order} LIMIT ?"
        query = f"SELECT {COLUMNS} FROM rows WHERE id IN ({chosen}) ORDER BY random()"
        rows = self.file.select(query, (source_number(fingerprint), generation, 8 * width, *more, n))
        return [Row._make(row) for row in rows if is_undamaged(row)]

    def labels_of(self, fingerprint: str) -> list[tuple[str, dict[str, str], int]]:
        """Labels of a model with a declared identity, the earliest first: code, opened files, generation."""
        query = f"SELECT {LABEL_COLUMNS} FROM labels WHERE source = ? ORDER BY rowid"
        rows = self.file.select(query, (source_number(fingerprint),))
        good = [row for row in rows if row[4] == zlib.crc32(repr(row[:4]).encode())]
        found = [(code.decode(), json.loads(files), generation) for _, code, files, generation, _ in good]
        return [
            (code, {os.path.join(self.path.parent, name): files[name] for name in files}, n) for code, files, n in found
        ]

    def store_label(self, fingerprint: str, label: tuple, before: tuple | None) -> None:
        """Store a label of a model, see `labels_of`, in the place of an earlier one.

        Files below the folder of the cache are known by their places there, also where this folder is copied.
        """
        source, rows = source_number(fingerprint), []
        for code, files, *generation in filter(None, (before, label)):
            files = {name.removeprefix(f"{self.path.parent}{os.sep}"): digest for name, digest in files.items()}
            values = source, code.encode(), json.dumps(files, sort_keys=True).encode(), *generation
            rows.append((*values, zlib.crc32(repr(values).encode())))
        delete = "DELETE FROM labels WHERE source = ? AND code = ? AND files = ?"
        self.file.write((delete, [row[:3] for row in rows[:-1]]), (STORE_LABEL, rows[-1:]))

    # the file -----------------------------------------------------------------------------------------------------

    def info(self) -> CacheInfo:
        """State of the cache."""
        query = (
            "SELECT total(size IS NULL), total(size IS NULL AND length(reason) > 0), total(size > 0), total(size) "
            "FROM rows"
        )
        counted = (self.file.select(query) or [(0,) * 4])[0]
        return CacheInfo(self.path, *map(int, counted))

    def forget(self, *fingerprints: str) -> int:
        """Delete all rows with these fingerprints, in all generations, for all users of the file; returns their number.

        ``cache.forget(*likelihood.simulator.cache_keys)`` deletes the rows that a likelihood uses. Likelihoods keep
        their caches in memory: make a new likelihood. OSError if the file cannot be written.
        """
        sources = {source_number(fingerprint) for fingerprint in fingerprints}
        with self.file.lock:
            self._waiting = [row for row in self._waiting if row.source not in sources]
            delete, rows = "DELETE FROM rows WHERE source = ?", [(source,) for source in sources]
            deleted = self.file.attempt("written", lambda connection: connection.executemany(delete, rows).rowcount, -1)
            if deleted < 0:
                raise OSError(f"{self.path} cannot be written: nothing was deleted; try again later")
            return deleted

    def discard(self, thetas: np.ndarray, *fingerprints: str, generation: int) -> None:
        """Delete the rows of some simulations, if possible."""
        keys = {key for fingerprint in fingerprints for key in simulation_keys(fingerprint, thetas, generation)}
        with self.file.lock:
            self._waiting = [row for row in self._waiting if row.key not in keys]
            self.file.write(("DELETE FROM rows WHERE key = ?", [(key,) for key in keys]))

    def close(self) -> None:
        """Store waiting rows, if possible, and close this process's connection; the next use opens a new connection."""
        with self.file.lock:
            self.file.retry_times.clear()
            self.write([])
            self.file.close()
