"""Rows of the simulation cache: their keys, checksums and SQL statements, and what a cache returns of them."""

import hashlib
import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "COLUMNS",
    "STORE",
    "STORE_RESPONSE",
    "CacheInfo",
    "CachedRows",
    "checksum",
    "is_undamaged",
    "pack_row",
    "simulation_keys",
]

COLUMNS = "key, misfit, n_steps, reason, seconds, crc"
KEY_BYTES = 16
MAX_REASON_LENGTH = 2000
NUMBERS = struct.Struct("<qd")


STORE = (
    "INSERT INTO simulations (key, misfit, n_steps, reason, seconds, crc) VALUES (?, ?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET misfit = excluded.misfit, n_steps = excluded.n_steps, reason = excluded.reason, "
    "seconds = excluded.seconds, crc = excluded.crc WHERE length(reason) > 0"  # a success is never overwritten
)
# replaces a response that an earlier version stored in single precision
STORE_RESPONSE = "INSERT OR REPLACE INTO responses (key, n_channels, size, crc, response) VALUES (?, ?, ?, ?, ?)"


class CachedRows(NamedTuple):
    """Result of looking up n simulations.

    Attributes
    ----------
    misfit : (n, n_channels) float
        Sums of squared residuals [SI unit of the channel, squared]; NaN where the simulation failed or is not stored.
    reasons : list of n str
        Reasons of failures; empty where the simulation succeeded or is not stored.
    known : (n,) bool
        Whether the simulation is stored.
    """

    misfit: np.ndarray
    reasons: list[str]
    known: np.ndarray


class CacheInfo(NamedTuple):
    """State of a cache.

    Attributes
    ----------
    path : Path
        The file.
    simulations, failures : int
        Number of stored simulations, and of failed ones among them.
    responses, response_bytes : int
        Number of stored responses, and their size [bytes].
    seconds : float
        Wall time of the stored simulations [s].
    file_bytes : int
        Size of the file without its write-ahead log [bytes].
    hits, misses, evictions, damaged : int
        Rows found, not found, evicted and found damaged by this object in this process.
    """

    path: Path
    simulations: int
    failures: int
    responses: int
    response_bytes: int
    seconds: float
    file_bytes: int
    hits: int
    misses: int
    evictions: int
    damaged: int


def simulation_keys(fingerprint: str, thetas: np.ndarray) -> list[bytes]:
    """Keys of simulations.

    Parameters
    ----------
    fingerprint : str
        Everything but the parameters that a simulation depends on.
    thetas : (n, n_structural) float
        Structural parameters; -0.0 and 0.0 have the same key.

    Returns
    -------
    list of n bytes
        Digests of 128 bits.
    """
    start = hashlib.blake2b(fingerprint.encode() + b"\0", digest_size=KEY_BYTES)
    keys = []
    for row in np.asarray(thetas, dtype="<f8") + 0.0:  # adding zero makes 0.0 of -0.0
        digest = start.copy()
        digest.update(row.tobytes())
        keys.append(digest.digest())
    return keys


def checksum(key: bytes, misfit: bytes, n_steps: int, reason: bytes, seconds: float) -> int:
    """CRC-32 of a stored simulation, its key included, so that values of another key are found to be damaged."""
    return zlib.crc32(b"".join((key, NUMBERS.pack(n_steps, seconds), misfit, reason)))


def is_undamaged(key: Any, misfit: Any, n_steps: Any, reason: Any, seconds: Any, crc: Any) -> bool:
    """Whether a stored simulation matches its checksum."""
    try:
        return crc == checksum(key, misfit, n_steps, reason, seconds)
    except (TypeError, struct.error):  # damage may change the type of a value
        return False


def pack_row(key: bytes, misfit: np.ndarray, n_steps: int, reason: str, seconds: float) -> tuple:
    """A simulation as it is stored: the values of `COLUMNS`, with misfit and reason as bytes and the checksum last."""
    values = (
        key,
        np.asarray(misfit, dtype="<f8").tobytes(),
        int(n_steps),
        reason[:MAX_REASON_LENGTH].encode("utf-8", "backslashreplace"),
        float(seconds),
    )
    return (*values, checksum(*values))
