"""Outcomes of simulations in memory: statistics, and responses.

Residual statistics do not depend on the noise parameters. They are reused when only noise parameters change, when a
sampler returns to a point, and when a chain is evaluated again. Responses depend neither on the noise nor on the
measurements. They are reused when a mode search is repeated, and by other likelihoods with the same model.
"""

import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

__all__ = [
    "MemoryCache",
    "Requested",
    "ResponseMemory",
    "distinct_keys",
    "outcomes_of",
    "reason_in",
    "statistics_in",
    "thetas_of",
]

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


def statistics_in(outcomes: Iterable[bytes | str | None], width: int) -> np.ndarray:
    """Statistics (n, width) of outcomes; NaN for failures and unknown ones."""
    unknown = _NAN * width
    # a bytearray makes a writable array
    filled = bytearray().join([each if isinstance(each, bytes) else unknown for each in outcomes])
    return np.frombuffer(filled, dtype=float).reshape(-1, width)


def outcomes_of(keys: Sequence[bytes], statistics: np.ndarray, reasons: Sequence[str]) -> dict[bytes, bytes | str]:
    """Outcomes of simulations with statistics (n, n_numbers), and reasons of failures; empty for others."""
    return {key: reason or row.tobytes() for key, row, reason in zip(keys, statistics, reasons, strict=True)}


def reason_in(outcome: Any) -> str:
    """The reason of a failure; empty for others."""
    return outcome if isinstance(outcome, str) else ""


class Requested:
    """Simulations of a model that were requested, and what is known of them, by key (see `distinct_keys`).

    `outcomes` are statistics in bytes, `responses` arrays (n_channels, n_steps) if `full` ones were requested; failures
    have their reasons in both. `which` has the index of the key of every row. `fingerprint` is the model's.
    """

    def __init__(self, thetas: np.ndarray, full: bool, model: Any) -> None:
        (self.keys, self.which), self.full, self._model = distinct_keys(thetas), full, model
        self.outcomes: dict[bytes, bytes | str] = {}
        self.responses: dict[bytes, np.ndarray | str] = {}

    @cached_property
    def fingerprint(self) -> str:
        return self._model.fingerprint

    @property
    def left(self) -> list[bytes]:
        """Keys that are to be simulated."""
        done = self.responses if self.full else self.outcomes
        return [key for key in self.keys if key not in done]

    def enter(self, outcomes: dict[bytes, bytes | str]) -> None:
        """Fill in outcomes."""
        self.outcomes |= outcomes
        self.responses |= {key: reason for key, reason in outcomes.items() if isinstance(reason, str)}

    def statistics(self, width: int) -> np.ndarray:
        """Statistics (n, width) of all rows; NaN for failures."""
        return statistics_in(map(self.outcomes.get, self.keys), width)[self.which]


class MemoryCache:
    """The most recently used outcomes of simulations, of at most `most` in size. Threads may share it.

    An outcome is a value (bytes of statistics, by the bytes of structural parameters), or a text: the reason of a
    failure. The object is empty after unpickling, because its contents would dominate the size of the pickle.
    ValueError if `most` is not a whole number of 0 or more.
    """

    _what = "memory_rows must be the number of simulations to cache in memory"

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
        self._size = 0

    def look_up(self, keys: Iterable[Hashable]) -> dict[Hashable, Any]:
        """Outcomes that are known, by key."""
        found = {}
        with self._lock:
            for key in keys:
                if key in self._outcomes:
                    found[key] = self._outcomes[key]
                    self._outcomes.move_to_end(key)
        return found

    def store(self, keys: Iterable[Hashable], outcomes: Iterable[Any]) -> None:
        """Keep outcomes, which are not changed later."""
        with self._lock:
            for key, outcome in zip(keys, outcomes, strict=True) if self.most else ():
                if (old := self._outcomes.pop(key, None)) is not None:
                    self._size -= self._size_of(old)
                self._size += self._size_of(outcome)
                self._outcomes[key] = outcome
                while self._size > self.most:
                    self._size -= self._size_of(self._outcomes.popitem(last=False)[1])

    @staticmethod
    def _size_of(outcome: Any) -> int:
        return 1


class ResponseMemory(MemoryCache):
    """Responses (n_channels, n_steps) [SI], not to be changed, in at most `most` bytes, by fingerprint and parameters.

    Likelihoods with the same model or shortened versions of it share one.
    """

    _what = "memory_bytes must be the size of the responses to keep in memory [bytes]"

    @staticmethod
    def _size_of(outcome: Any) -> int:
        return _ENTRY_BYTES + (len(outcome) if isinstance(outcome, str) else outcome.nbytes)
