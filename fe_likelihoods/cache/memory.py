"""Caches of recent statistics and responses in memory.

Residual statistics do not depend on the noise parameters. They are reused when only noise parameters change, when a
sampler returns to a point, and when a chain is evaluated again. Responses depend neither on the noise nor on the
measurements. They are reused when a mode search is repeated, and by other likelihoods with the same model.
"""

import logging
import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

__all__ = ["MemoryCache", "ResponseMemory", "distinct_keys", "thetas_of"]

logger = logging.getLogger(__name__)

_NAN = np.array([np.nan]).tobytes()
_ENTRY_BYTES = 250  # memory of one stored response, besides its numbers


def distinct_keys(rows: np.ndarray) -> tuple[list[bytes], list[int]]:
    """Bytes of a float array's distinct rows, in order of appearance, and the index of every row among them."""
    first: dict[bytes, int] = {}
    which = [first.setdefault(row.tobytes(), len(first)) for row in rows + 0.0]  # adding zero makes 0.0 of -0.0
    return list(first), which


def thetas_of(keys: Sequence[bytes], n_structural: int) -> np.ndarray:
    """Structural parameters (n, n_structural) of keys."""
    return np.frombuffer(b"".join(keys), dtype=float).reshape(len(keys), n_structural).copy()


def _as_limit(name: str, what: str, value: Any) -> int:
    """A cache limit as int; ValueError for anything but a whole number of 0 or more."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ValueError(f"{name} must be the {what}, a whole number of 0 or more; got {value!r}")
    return int(value)


class MemoryCache:
    """Least-recently-used cache of statistics of at most `rows` simulations, by the bytes of the structural parameters.

    Failures are cached as NaN, with their reasons. Threads may share the cache. It is empty after unpickling, because
    its contents would dominate the size of the pickle. ValueError if `rows` is not a whole number or is negative.
    """

    def __init__(self, rows: int) -> None:
        self.rows = _as_limit("memory_rows", "number of simulations to cache in memory", rows)
        self._misfits: OrderedDict[bytes, bytes] = OrderedDict()  # from the least to the most recently used
        self._reasons: dict[bytes, str] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple:
        return type(self), (self.rows,)

    def __len__(self) -> int:
        return len(self._misfits)

    def look_up(self, keys: Sequence[bytes], width: int) -> tuple[np.ndarray, list[bool]]:
        """Cached statistics (n, width) of n distinct keys, NaN if failed or not cached, and whether each is cached."""
        found = []
        with self._lock:
            for key in keys:
                misfit = self._misfits.get(key)
                if misfit is not None:
                    self._misfits.move_to_end(key)
                found.append(misfit)
        unknown = _NAN * width
        filled = bytearray().join([unknown if misfit is None else misfit for misfit in found])  # makes a writable array
        misfits = np.frombuffer(filled, dtype=float).reshape(len(keys), width)
        return misfits, [misfit is not None for misfit in found]

    def successes(self, n_structural: int) -> np.ndarray:
        """Structural parameters (n, n_structural) of cached simulations that did not fail."""
        with self._lock:
            keys = [key for key, misfit in self._misfits.items() if not np.isnan(np.frombuffer(misfit)).any()]
        return thetas_of(keys, n_structural)

    def clear(self) -> None:
        """Drop all rows."""
        with self._lock:
            self._misfits.clear()
            self._reasons.clear()

    def store(self, keys: Sequence[bytes], misfits: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache the statistics (n, width) of n distinct keys, and the reasons of failures; empty for others."""
        with self._lock:
            self._misfits.update(zip(keys, map(np.ndarray.tobytes, misfits), strict=True))
            self._reasons.update((key, reason) for key, reason in zip(keys, reasons, strict=True) if reason)
            while len(self._misfits) > self.rows:
                self._reasons.pop(self._misfits.popitem(last=False)[0], None)

    def reason(self, key: bytes) -> str:
        """Reason of a cached failure; empty for others."""
        return self._reasons.get(key, "")


class ResponseMemory:
    """The most recently stored responses in double precision, and reasons of failures, in at most `max_bytes` [bytes].

    Likelihoods with the same model or shortened versions of it share one. Threads may share it. It is empty after
    unpickling, like a `MemoryCache`. The oldest are dropped (`dropped` counts them); the first time, a message at level
    INFO. ValueError if `max_bytes` is not a whole number or is negative.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = _as_limit("memory_bytes", "size of the responses to keep in memory [bytes]", max_bytes)
        self.dropped = 0
        self._outcomes: OrderedDict[tuple[str, bytes], np.ndarray | str] = OrderedDict()  # the oldest first
        self._bytes = 0
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple:
        return type(self), (self.max_bytes,)

    def __len__(self) -> int:
        return len(self._outcomes)

    def look_up(self, fingerprint: str, keys: Sequence[bytes]) -> list[np.ndarray | str | None]:
        """Stored outcomes for a model's fingerprint and keys from `distinct_keys`; None where nothing is stored.

        An outcome is the response (n_channels, n_steps) [SI], not to be changed, or the reason of a failure.
        """
        with self._lock:
            return [self._outcomes.get((fingerprint, key)) for key in keys]

    def responses(self, fingerprint: str) -> dict[bytes, np.ndarray]:
        """Responses of a model's simulations that did not fail, by their keys, the oldest first; not to be changed."""
        with self._lock:
            found = {key: outcome for (model, key), outcome in self._outcomes.items() if model == fingerprint}
        return {key: outcome for key, outcome in found.items() if not isinstance(outcome, str)}

    def store(self, fingerprint: str, keys: Sequence[bytes], outcomes: Iterable[np.ndarray | str]) -> None:
        """Store copies of responses, and reasons of failures; drops the oldest outcomes beyond the limit."""
        if not self.max_bytes:
            return
        with self._lock:
            for key, outcome in zip(keys, outcomes, strict=True):
                self._remove((fingerprint, key))
                self._outcomes[fingerprint, key] = outcome if isinstance(outcome, str) else np.array(outcome)
                self._bytes += _size(outcome)
                while self._bytes > self.max_bytes:
                    self._remove(next(iter(self._outcomes)))
                    if not self.dropped:
                        logger.info(
                            "responses are dropped from memory, the oldest first, because they have more than %d bytes "
                            "(memory_bytes); they are simulated again if they are needed and in no cache on disk",
                            self.max_bytes,
                        )
                    self.dropped += 1

    def clear(self) -> None:
        """Drop all responses."""
        with self._lock:
            self._outcomes.clear()
            self._bytes = 0

    def _remove(self, key: tuple[str, bytes]) -> None:
        outcome = self._outcomes.pop(key, None)
        if outcome is not None:
            self._bytes -= _size(outcome)


def _size(outcome: np.ndarray | str) -> int:
    """Bytes of an outcome in the response memory."""
    return _ENTRY_BYTES + (len(outcome) if isinstance(outcome, str) else outcome.nbytes)
