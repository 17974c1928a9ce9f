"""All runs of a record, and quadratic forms of linear combinations of their residuals.

Slopes, principal components and predictions are linear combinations sum_i w_i r_i of histories r_i, residuals of runs
or derivatives of residuals, and are kept as their weights w. The numbers that a Gaussian noise needs (sums of squares,
of squared differences, ...) are quadratic in the residuals, so those of a combination are sums over

    B(r_i, r_j) = (S(r_i + r_j) - S(r_i - r_j)) / 4,

which are computed once for every pair. No statistic needs to be known in more detail than as a function. With hundreds
of channels all histories have gigabytes, so they are in a temporary file.
"""

import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ..noise.sufficient_statistics import bilinear_form

_VALUES = 2**21  # of residuals that are multiplied together: 16 MiB


class Archive:
    """All m successful simulations of a record: residuals (n_channels, n_steps), and a quadratic statistic of them.

    `numbers` (m,) are the numbers of the runs among all histories, which are residuals of runs, and derivatives of
    residuals; `coords` (m, n_structural) their structural coordinates, `statistics` (m, n_numbers) of their residuals.
    """

    def __init__(self, statistic: Callable[[np.ndarray], np.ndarray], shape: tuple[int, int]) -> None:
        self._statistic, self._shape = statistic, shape
        self.numbers, self.coords, self.statistics = np.empty(0, int), np.empty((0, 0)), np.empty((0, 0))
        self._forms: list[np.ndarray] = []  # (i + 1, n_numbers) of history i with those up to itself
        self._file = tempfile.TemporaryFile(buffering=0)
        weakref.finalize(self, self._file.close)

    def __reduce__(self):
        return Archive, (self._statistic, self._shape)  # without its runs, which fitted emulators do not need

    def __len__(self) -> int:
        return len(self._forms)

    def add(self, coords: np.ndarray, residuals: np.ndarray, statistics: np.ndarray) -> np.ndarray:
        """Add runs at coordinates (m, n_structural); returns their numbers (m,)."""
        numbers = self.add_histories(residuals)
        both = (self.coords, coords), (self.statistics, statistics)
        self.coords, self.statistics = (np.concatenate(each[not len(self.numbers) :]) for each in both)
        self.numbers = np.append(self.numbers, numbers)
        return numbers

    def add_histories(self, histories: np.ndarray) -> np.ndarray:
        """Add histories (m, n_channels, n_steps), rounded to single precision; returns their numbers (m,)."""
        # computed in double precision and then rounded, a residual keeps its digits where a channel has an offset of a
        # million times its noise; a rounded response would not
        first, end = len(self), len(self) + len(histories)
        self._file.seek(0, 2)
        np.asarray(histories, np.float32).tofile(self._file)
        for rows in self._blocks(first, end):
            own = self.read(rows)
            parts = [bilinear_form(self._statistic, own, self.read(each)) for each in self._blocks(0, rows.stop)]
            products = np.concatenate(parts, axis=1)
            self._forms += [row[: number + 1].copy() for number, row in zip(rows, products, strict=True)]
        return np.arange(first, end)

    def _blocks(self, first: int, end: int) -> Iterator[range]:
        """Numbers of histories that are in memory together."""
        size = max(1, _VALUES // (self._shape[0] * self._shape[1]))
        return (range(begin, min(begin + size, end)) for begin in range(first, end, size))

    def read(self, rows: range) -> np.ndarray:
        """Histories (n, n_channels, n_steps) by their numbers: of runs, measured minus simulated responses [SI]."""
        size = self._shape[0] * self._shape[1]
        self._file.seek(4 * size * rows.start)
        return np.fromfile(self._file, np.float32, size * len(rows)).reshape(-1, *self._shape).astype(float)

    def weights(self, rows: Sequence[Any]) -> np.ndarray:
        """Combinations (k, n) that are given as numbers of histories, or as weights of the first of them."""
        result = np.zeros((len(rows), len(self)))
        for row, each in zip(result, rows, strict=True):
            if np.ndim(each):
                row[: len(each)] = each
            else:
                row[each] = 1.0
        return result

    def forms(self, combinations: np.ndarray) -> np.ndarray:
        """Bilinear form (k, k, n_numbers) of the statistic for combinations (k, n)."""
        used = np.flatnonzero(combinations.any(axis=0))
        both, below = combinations[:, used], []
        for place, number in enumerate(used):
            row = self._forms[number][used[: place + 1]]
            row[-1] *= 0.5
            below.append(both[:, : place + 1] @ row)
        lower = np.einsum("ki,ilc->klc", both, np.array(below), optimize=True)
        return lower + lower.transpose(1, 0, 2)
