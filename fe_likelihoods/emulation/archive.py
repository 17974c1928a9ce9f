"""All runs of a record, and quadratic forms of linear combinations of their residuals.

Slopes, principal components and predictions are linear combinations sum_i w_i r_i of histories r_i, residuals of runs
or derivatives of residuals, and are kept as their weights w. The numbers that a Gaussian noise needs (sums of squares,
of squared differences, ...) are quadratic in the residuals, so those of a combination are sums over

    B(r_i, r_j) = (S(r_i + r_j) - S(r_i - r_j)) / 4,

which are computed once for every pair, when the two are first in one combination: derivatives at different points
never are. No statistic needs to be known in more detail than as a function. With hundreds of channels all histories
have gigabytes, so they are in a temporary file.
"""

import tempfile
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..noise.sufficient_statistics import bilinear_form

_VALUES = 2**21  # of residuals that are multiplied together: 16 MiB


class Archive:
    """All m successful simulations of a record: residuals (n_channels, n_steps), and a quadratic statistic of them.

    `numbers` (m,) are the numbers of the runs among all histories, which are residuals of runs, and derivatives of
    residuals; `coords` (m, n_structural) their structural coordinates, `statistics` (m, n_numbers) of their residuals.
    `derivatives` are coordinates (d,), and numbers (d,) or weights (d, n) of the derivatives there.
    """

    def __init__(self, statistic: Callable[[np.ndarray], np.ndarray], shape: tuple[int, int]) -> None:
        self._statistic, self._shape, self._kept = statistic, shape, 1.0
        self._views: list[Archive] = []
        self.derivatives: list[tuple[np.ndarray, np.ndarray]] = []
        self.numbers, self.coords, self.statistics = np.empty(0, int), np.empty((0, 0)), np.empty((0, 0))
        self.number_of: dict[bytes, int] = {}  # number of the run at simulated coordinates, -1 where it failed
        self._ends = [0]  # of the histories that were added, and are multiplied, together
        self._forms: dict[tuple[int, int], np.ndarray] = {}  # (n_numbers, k, l) of two such batches
        self._file = tempfile.TemporaryFile(buffering=0)
        weakref.finalize(self, self._file.close)

    def __reduce__(self):
        return Archive, (self._statistic, self._shape)  # without its runs, which fitted emulators do not need

    def __len__(self) -> int:
        return self._ends[-1]

    def add(self, coords: np.ndarray, residuals: np.ndarray, statistics: np.ndarray) -> np.ndarray:
        """Add runs at coordinates (m, n_structural); returns their numbers (m,)."""
        numbers = self.add_histories(residuals)
        for each in (self, *self._views) if len(numbers) else ():
            own = statistics if each is self else np.array([each._statistic(r * each._kept) for r in residuals])
            both = (each.coords, coords), (each.statistics, own)
            each.coords, each.statistics = (np.concatenate(pair[not len(each.numbers) :]) for pair in both)
            each.numbers = np.append(each.numbers, numbers)
        return numbers

    def view(self, statistic: Callable[[np.ndarray], np.ndarray], kept: np.ndarray) -> "Archive":
        """An archive of the same histories, so far none, that are zero where not `kept` (n_channels, n_steps)."""
        other = Archive(statistic, self._shape)
        other._file.close()
        other._kept, other._file, other._ends, other.number_of = kept, self._file, self._ends, self.number_of
        self._views.append(other)
        return other

    def add_histories(self, histories: np.ndarray) -> np.ndarray:
        """Add histories (m, n_channels, n_steps), rounded to single precision; returns their numbers (m,)."""
        # computed in double precision and then rounded, a residual keeps its digits where a channel has an offset of a
        # million times its noise; a rounded response would not
        self._file.seek(0, 2)
        np.asarray(histories, np.float32).tofile(self._file)
        first, end = len(self), len(self) + len(histories)
        size = max(1, _VALUES // (self._shape[0] * self._shape[1]))
        self._ends += [min(each, end) for each in range(first + size, end + size, size)]
        return np.arange(first, end)

    def _form(self, *batches: int) -> np.ndarray:
        """The bilinear form (n_numbers, k, l) of all histories of two batches."""
        if batches not in self._forms:
            histories = (self.read(range(*self._ends[batch : batch + 2])) for batch in batches)
            self._forms[batches] = np.ascontiguousarray(bilinear_form(self._statistic, *histories).transpose(2, 0, 1))
        return self._forms[batches]

    def read(self, rows: range) -> np.ndarray:
        """Histories (n, n_channels, n_steps) by their numbers: of runs, measured minus simulated responses [SI]."""
        size = self._shape[0] * self._shape[1]
        self._file.seek(4 * size * rows.start)
        found = np.fromfile(self._file, np.float32, size * len(rows)).reshape(-1, *self._shape)
        return found.astype(float) * self._kept

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
        used = np.unique(np.searchsorted(self._ends, np.flatnonzero(combinations.any(axis=0)), side="right") - 1)
        parts = {batch: combinations[:, slice(*self._ends[batch : batch + 2])] for batch in used}
        lower = 0.0
        for k, weights in parts.items():
            below = sum(parts[m] / (1 + (m == k)) @ self._form(m, k) for m in used if m <= k)
            lower = lower + below @ weights.T
        return (lower + lower.transpose(0, 2, 1)).transpose(1, 2, 0)
