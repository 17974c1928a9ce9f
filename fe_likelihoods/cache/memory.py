"""Outcomes of simulations in memory: statistics, and responses.

Residual statistics do not depend on the noise parameters. They are reused when only noise parameters change, when a
sampler returns to a point, and when a chain is evaluated again. Responses depend neither on the noise nor on the
measurements. They are reused when a mode search is repeated, and by other likelihoods with the same model.
"""

import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterable, Sequence
from typing import Any

import numpy as np

__all__ = ["MemoryCache", "ResponseMemory", "distinct_keys", "thetas_of"]

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


class _Memory:
    """Outcomes by key, the oldest first, of at most `most` in size. Threads may share it.

    An outcome is a value, or a text: the reason of a failure. It is empty after unpickling, because its contents would
    dominate the size of the pickle. ValueError if `most` is not a whole number of 0 or more.
    """

    _what = ""

    def __init__(self, most: int) -> None:
        if isinstance(most, bool) or not isinstance(most, int | np.integer) or most < 0:
            raise ValueError(f"{self._what}, a whole number of 0 or more; got {most!r}")
        self.most, self._lock = int(most), threading.Lock()
        self.clear()

    def __reduce__(self) -> tuple:
        return type(self), (self.most,)

    def __len__(self) -> int:
        return len(self._outcomes)

    def clear(self) -> None:
        """Drop all outcomes."""
        self._outcomes: OrderedDict[Hashable, Any] = OrderedDict()
        self._bytes = 0  # of responses


class MemoryCache(_Memory):
    """The most recently used statistics of at most `most` simulations, by the bytes of structural parameters."""

    _what = "memory_rows must be the number of simulations to cache in memory"

    def look_up(self, keys: Sequence[bytes], width: int) -> tuple[np.ndarray, list[bool]]:
        """Cached statistics (n, width) of n distinct keys, NaN if failed or not cached, and whether each is cached."""
        found, unknown = [], _NAN * width
        with self._lock:
            for key in keys:
                outcome = self._outcomes.get(key)
                if outcome is not None:
                    self._outcomes.move_to_end(key)
                found.append(outcome)
        # a bytearray makes a writable array
        filled = bytearray().join([each if isinstance(each, bytes) else unknown for each in found])
        return np.frombuffer(filled, dtype=float).reshape(len(keys), width), [each is not None for each in found]

    def successes(self, n_structural: int) -> np.ndarray:
        """Structural parameters (n, n_structural) of cached simulations that did not fail."""
        with self._lock:
            keys = [key for key, outcome in self._outcomes.items() if isinstance(outcome, bytes)]
        return thetas_of(keys, n_structural)

    def store(self, keys: Sequence[bytes], statistics: np.ndarray, reasons: Sequence[str]) -> None:
        """Cache the statistics (n, width) of n distinct keys, and the reasons of failures; empty for others."""
        outcomes = [reason or row.tobytes() for row, reason in zip(statistics, reasons, strict=True)]
        with self._lock:
            self._outcomes.update(zip(keys, outcomes, strict=True))
            while len(self._outcomes) > self.most:
                self._outcomes.popitem(last=False)

    def reason(self, key: bytes) -> str:
        """Reason of a cached failure; empty for others."""
        outcome = self._outcomes.get(key)
        return outcome if isinstance(outcome, str) else ""


class ResponseMemory(_Memory):
    """Responses (n_channels, n_steps) [SI], not to be changed, in at most `most` bytes, by fingerprint and parameters.

    Likelihoods with the same model or shortened versions of it share one.
    """

    _what = "memory_bytes must be the size of the responses to keep in memory [bytes]"

    def look_up(self, keys: Iterable[Hashable]) -> list[np.ndarray | str | None]:
        """Outcomes of keys; None where nothing is stored."""
        with self._lock:
            return [self._outcomes.get(key) for key in keys]

    def store(self, keys: Sequence[Hashable], outcomes: Iterable[np.ndarray | str]) -> None:
        """Store copies of responses, and reasons of failures."""
        with self._lock:
            for key, outcome in zip(keys, outcomes, strict=True) if self.most else ():
                self._bytes += _size(outcome) - _size(self._outcomes.pop(key, None))
                self._outcomes[key] = outcome if isinstance(outcome, str) else np.array(outcome)
                while self._bytes > self.most:
                    self._bytes -= _size(self._outcomes.popitem(last=False)[1])


def _size(outcome: np.ndarray | str | None) -> int:
    """Bytes of an outcome in the response memory."""
    if outcome is None:
        return 0
    return _ENTRY_BYTES + (len(outcome) if isinstance(outcome, str) else outcome.nbytes)
