"""Rows of the simulation cache: what they contain, their keys and checksums, and how they are read and written.

One table has the rows of all simulations, another one the labels of models with their generations. A row belongs to an
identity, the `source`: that of a model against measurements, whose values are statistics, or that of a model, whose
values are responses [SI] and whose failures are valid for any measurements. A row without values is a failure.
"""

import contextlib
import hashlib
import json
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..simulation.faults import MisfitReason, TransientReason

__all__ = [
    "COLUMNS",
    "LABEL_COLUMNS",
    "LAYOUT",
    "STORE",
    "STORE_LABEL",
    "Row",
    "is_undamaged",
    "is_undamaged_label",
    "pack_label",
    "pack_rows",
    "simulation_keys",
    "source_number",
    "transaction",
]

LAYOUT = (
    # the id orders rows by age; the size of a response [bytes] is 0 for failures of a model and empty for statistics
    "CREATE TABLE rows (id INTEGER PRIMARY KEY, key BLOB NOT NULL UNIQUE, source INTEGER NOT NULL, "
    "generation INTEGER NOT NULL, theta BLOB NOT NULL, value BLOB NOT NULL, reason BLOB NOT NULL, "
    "session INTEGER NOT NULL, crc INTEGER NOT NULL, size INTEGER)",
    "CREATE INDEX row_generations ON rows (source, generation)",
    "CREATE INDEX response_sizes ON rows (size) WHERE size > 0",  # for their sum without reading the responses
    # labels of models, and the generation of each label
    "CREATE TABLE labels (source INTEGER NOT NULL, code BLOB NOT NULL, files BLOB NOT NULL, "
    "generation INTEGER NOT NULL, crc INTEGER NOT NULL, UNIQUE (source, code, files))",
)
COLUMNS = "key, source, generation, theta, value, reason, session, crc, size"
STORE = (
    f"INSERT INTO rows ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET value = excluded.value, reason = excluded.reason, session = excluded.session, "
    "crc = excluded.crc, size = excluded.size WHERE length(reason) > 0"  # a success is never overwritten
)
LABEL_COLUMNS = "source, code, files, generation, crc"
STORE_LABEL = f"INSERT OR REPLACE INTO labels ({LABEL_COLUMNS}) VALUES (?, ?, ?, ?, ?)"
KEY_BYTES = 16
MAX_REASON_LENGTH = 2000
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
        text = reason[:MAX_REASON_LENGTH].encode("utf-8", "backslashreplace")
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


def pack_label(source: int, code: str, files: dict[str, str], generation: int) -> tuple:
    """Values of `LABEL_COLUMNS`."""
    values = source, code.encode(), json.dumps(files, sort_keys=True).encode(), generation
    return *values, zlib.crc32(repr(values).encode())


def is_undamaged_label(row: tuple) -> bool:
    """Whether the values of `LABEL_COLUMNS` match their checksum."""
    return row[4] == zlib.crc32(repr(row[:4]).encode())


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
