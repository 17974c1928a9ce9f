"""Rows of the simulation cache: their keys and their checksums."""

import hashlib
import struct
import zlib
from typing import Any

import numpy as np

__all__ = ["COLUMNS", "checksum", "is_undamaged", "pack_row", "simulation_keys"]

COLUMNS = "key, misfit, n_steps, reason, seconds, crc"
KEY_BYTES = 16
MAX_REASON_LENGTH = 2000
NUMBERS = struct.Struct("<qd")


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
