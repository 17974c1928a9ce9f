"""A stored simulation: by which key it is found, and how it is known to be whole."""

import hashlib
import struct
import zlib
from typing import Any

import numpy as np

__all__ = ["COLUMNS", "checksum", "is_whole", "packed", "simulation_keys"]

COLUMNS = "key, misfit, n_steps, reason, seconds, crc"
KEY_BYTES = 16
LONGEST_REASON = 2000
NUMBERS = struct.Struct("<qd")


def simulation_keys(fingerprint: str, thetas: np.ndarray) -> list[bytes]:
    """Digests of a fingerprint and each row of `thetas` (n, n_structural); -0.0 and 0.0 are one, by adding zero."""
    start = hashlib.blake2b(fingerprint.encode() + b"\0", digest_size=KEY_BYTES)
    keys = []
    for row in np.asarray(thetas, dtype="<f8") + 0.0:
        digest = start.copy()
        digest.update(row.tobytes())
        keys.append(digest.digest())
    return keys


def checksum(key: bytes, misfit: bytes, n_steps: int, reason: bytes, seconds: float) -> int:
    """CRC-32 of a stored simulation, its key included: values that belong to another key are damage too."""
    return zlib.crc32(b"".join((key, NUMBERS.pack(n_steps, seconds), misfit, reason)))


def is_whole(key: Any, misfit: Any, n_steps: Any, reason: Any, seconds: Any, crc: Any) -> bool:
    """Whether a stored simulation matches its checksum."""
    try:
        return crc == checksum(key, misfit, n_steps, reason, seconds)
    except (TypeError, struct.error):  # damage may change the type of a value too
        return False


def packed(key: bytes, misfit: np.ndarray, n_steps: int, reason: str, seconds: float) -> tuple:
    """A simulation as it is stored: the values of `COLUMNS`, misfit and reason as bytes, the checksum last."""
    values = (
        key,
        np.asarray(misfit, dtype="<f8").tobytes(),
        int(n_steps),
        reason[:LONGEST_REASON].encode("utf-8", "backslashreplace"),
        float(seconds),
    )
    return (*values, checksum(*values))
