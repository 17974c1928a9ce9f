"""Rows of the simulation cache: what they contain, their keys and checksums, and how they are read and written."""

import contextlib
import hashlib
import json
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..simulation.faults import MisfitReason, TransientReason

__all__ = [
    "COLUMNS",
    "LABEL_COLUMNS",
    "MIN_STOPS",
    "RESPONSE_COLUMNS",
    "STORE",
    "STORE_FAILURE",
    "STORE_LABEL",
    "STORE_RESPONSE",
    "CachedRows",
    "StoredLabel",
    "StoredSimulation",
    "checksum",
    "insert_rows",
    "is_undamaged",
    "is_undamaged_label",
    "is_undamaged_response",
    "pack_failure",
    "pack_label",
    "pack_response",
    "pack_row",
    "select_rows",
    "simulation_keys",
    "source_number",
    "transaction",
    "unpack_failure",
    "unpack_label",
    "unpack_row",
]

COLUMNS = "key, source, theta, misfit, n_steps, reason, seconds, crc, generation, label"
RESPONSE_COLUMNS = "key, source, theta, n_channels, size, crc, response, generation, label"
LABEL_COLUMNS = "id, source, label, cpu, generation, compared, files, crc"
KEY_BYTES = 16
KEYS_PER_QUERY = 500  # keys in one SELECT
MAX_REASON_LENGTH = 2000
NUMBERS = struct.Struct("<qqd")
ALL_NUMBERS = struct.Struct("<qqdqq")

STORE = (
    f"INSERT INTO simulations ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET misfit = excluded.misfit, n_steps = excluded.n_steps, reason = excluded.reason, "
    "seconds = excluded.seconds, crc = excluded.crc, label = excluded.label "
    "WHERE length(reason) > 0"  # a success is never overwritten
)
STORE_RESPONSE = f"INSERT OR REPLACE INTO responses ({RESPONSE_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
STORE_LABEL = f"INSERT OR REPLACE INTO labels ({LABEL_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)"
# counts how often a simulation was stopped at the same time limit
STORE_FAILURE = (
    "INSERT INTO failures (key, source, reason, time_limit, crc, stops) VALUES (?, ?, ?, ?, ?, 1) "
    "ON CONFLICT (key) DO UPDATE SET "
    "stops = CASE WHEN time_limit = excluded.time_limit THEN stops + 1 ELSE 1 END, "
    "reason = excluded.reason, time_limit = excluded.time_limit, crc = excluded.crc"
)
MIN_STOPS = 2  # stops at a time limit before the simulation counts as too slow; a busy machine may cause the first


class CachedRows(NamedTuple):
    """Stored rows for n simulations."""

    misfit: np.ndarray  # (n, n_channels) sums of squares [SI unit squared]; NaN where failed or not stored
    reasons: list[str]  # of n failures; empty otherwise
    known: np.ndarray  # (n,) whether the simulation is stored


class StoredSimulation(NamedTuple):
    """One stored simulation."""

    theta: np.ndarray  # structural parameters (n_structural,)
    misfit: np.ndarray  # (n_channels,) sums of squares [SI unit squared]; NaN if it failed
    reason: str  # of the failure
    label: int = 0  # id of the `StoredLabel` under which it was stored


class StoredLabel(NamedTuple):
    """A label under which simulations of a model were stored or adopted."""

    id: int  # by which rows refer to the label
    source: int  # number of the model
    label: str  # see `fe_likelihoods.simulation.label.ModelLabel`
    cpu: str  # name of the processor
    generation: int
    compared: int  # rows that were compared before the rows of other labels were adopted
    files: tuple[str, ...] = ()  # that simulations opened


# keys and checksums ---------------------------------------------------------------------------------------------------


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
    """64-bit number of a fingerprint; identifies all simulations of one model against one set of measurements."""
    return int.from_bytes(hashlib.blake2b(fingerprint.encode(), digest_size=8).digest(), signed=True)


def checksum(*values: Any) -> int:
    """CRC-32 of the values in `COLUMNS` except the checksum; the key is included, so swapped rows count as damaged."""
    key, source, theta, misfit, n_steps, reason, seconds, generation, label = values
    numbers = ALL_NUMBERS.pack(source, n_steps, seconds, generation, label)
    return zlib.crc32(b"".join((key, numbers, theta, misfit, reason)))


def is_undamaged(*row: Any) -> bool:
    """Whether a stored simulation, given by the values of `COLUMNS`, matches its checksum."""
    try:
        return row[7] == checksum(*row[:7], *row[8:])
    except (TypeError, struct.error):  # damage may change the type of a value
        return False


def is_undamaged_response(*row: Any) -> bool:
    """Whether a stored response, given by the values of `RESPONSE_COLUMNS`, matches its checksum and its size."""
    key, _, _, _, size, crc, data, _, _ = row
    return isinstance(data, bytes) and len(data) == size and isinstance(key, bytes) and crc == zlib.crc32(key + data)


def _failure_checksum(key: bytes, source: int, text: bytes, time_limit: float) -> int:
    return zlib.crc32(b"".join((key, NUMBERS.pack(source, len(text), time_limit), text)))


# values of the columns ------------------------------------------------------------------------------------------------


def pack_row(
    key: bytes,
    source: int,
    theta: np.ndarray,
    misfit: np.ndarray,
    n_steps: int,
    reason: str,
    seconds: float,
    generation: int = 1,
    label: int = 0,
) -> tuple:
    """A simulation as it is stored: the values of `COLUMNS`, with arrays and reason as bytes."""
    values = key, source, _packed(theta), _packed(misfit), int(n_steps), _encoded(reason), float(seconds)
    return (*values, checksum(*values, generation, label), generation, label)


def unpack_row(row: tuple) -> StoredSimulation:
    """An undamaged simulation, given by the values of `COLUMNS`."""
    theta, misfit = (np.frombuffer(data, dtype="<f8") for data in row[2:4])
    return StoredSimulation(theta, misfit, row[5].decode("utf-8", "replace"), row[9])


def pack_response(
    key: bytes, source: int, theta: np.ndarray, response: np.ndarray, generation: int, label: int
) -> tuple:
    """A response as it is stored: the values of `RESPONSE_COLUMNS`."""
    data = _packed(response)
    crc = zlib.crc32(key + data)
    return key, source, _packed(theta), len(response), len(data), crc, data, generation, label


def pack_failure(key: bytes, source: int, reason: str) -> tuple | None:
    """A failure as it is stored: key, source, reason, time limit [s], checksum; None for failures that are not stored.

    Not stored are failures that depend on the measurements, and faults of the infrastructure except time limits.
    """
    time_limit = reason.time_limit if isinstance(reason, TransientReason) else 0.0
    if not reason or isinstance(reason, MisfitReason) or (isinstance(reason, TransientReason) and not time_limit):
        return None
    text = _encoded(reason)
    return key, source, text, time_limit, _failure_checksum(key, source, text, time_limit)


def unpack_failure(key: bytes, source: int, text: bytes, time_limit: float, crc: int) -> str | None:
    """Reason of a stored failure; None if it is damaged."""
    try:
        if crc != _failure_checksum(key, source, text, time_limit):
            return None
    except (TypeError, struct.error):
        return None
    reason = text.decode("utf-8", "replace")
    return TransientReason(reason, time_limit) if time_limit else reason


def is_undamaged_label(*row: Any) -> bool:
    """Whether a stored label, given by the values of `LABEL_COLUMNS`, matches its checksum."""
    return row[-1] == zlib.crc32(repr(row[:-1]).encode())


def pack_label(label: StoredLabel) -> tuple:
    """A label as it is stored, the values of `LABEL_COLUMNS`: texts as bytes, the checksum last."""
    texts = label.label.encode(), label.cpu.encode()
    values = (label.id, label.source, *texts, label.generation, label.compared, json.dumps(label.files).encode())
    return (*values, zlib.crc32(repr(values).encode()))


def unpack_label(*row: Any) -> StoredLabel:
    """An undamaged label, given by the values of `LABEL_COLUMNS`."""
    return StoredLabel(*row[:2], row[2].decode(), row[3].decode(), *row[4:6], tuple(json.loads(row[6])))


def _packed(values: np.ndarray) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()


def _encoded(reason: str) -> bytes:
    return reason[:MAX_REASON_LENGTH].encode("utf-8", "backslashreplace")


# reading and writing --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """A write transaction; an error inside rolls it back."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):  # SQLite itself may have ended it
            connection.execute("ROLLBACK")
        raise


def select_rows(
    connection: sqlite3.Connection, keys: list[bytes], columns: str = f"{COLUMNS} FROM simulations"
) -> list[tuple]:
    """Rows of a table with given keys, in any order; keys that are not stored have no row."""
    found = []
    for start in range(0, len(keys), KEYS_PER_QUERY):
        part = keys[start : start + KEYS_PER_QUERY]
        marks = ",".join("?" * len(part))
        found += connection.execute(f"SELECT {columns} WHERE key IN ({marks})", part).fetchall()
    return found


def insert_rows(
    connection: sqlite3.Connection, statement: str, rows: list[tuple], max_rows: int, max_response_bytes: int
) -> tuple[int, int]:
    """Store the values of a statement and evict the oldest rows beyond the limits, in one transaction.

    Returns the numbers of evicted simulations and responses.
    """
    with transaction(connection):
        connection.executemany(statement, rows)
        table = "failures" if statement is STORE_FAILURE else "simulations"
        evict = f"DELETE FROM {table} WHERE id <= (SELECT max(id) FROM {table}) - ?"
        evicted = connection.execute(evict, (max_rows,)).rowcount
        responses = 0
        if statement is STORE_RESPONSE:
            ((excess,),) = connection.execute("SELECT total(size) - ? FROM responses", (max_response_bytes,))
            for age, size in connection.execute("SELECT id, size FROM responses ORDER BY id").fetchall():
                if excess <= 0:
                    break
                connection.execute("DELETE FROM responses WHERE id = ?", (age,))
                excess -= size
                responses += 1
    return evicted, responses
