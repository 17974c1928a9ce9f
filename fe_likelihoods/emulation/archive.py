"""All runs of a record, with their residuals in a file, and bilinear forms of linear combinations of residuals.

Slopes, principal components and predictions are linear combinations sum_i w_i r_i of histories r_i, residuals of runs
or derivatives of residuals, and are kept as their weights w. For white noise, the statistics of a combination are sums
over the products r_i . r_j per channel, which are computed once, when they are needed. With hundreds of channels, all
histories have gigabytes, so histories and products are in temporary files, of which a part is in memory at a time.
"""

import tempfile
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..noise.statistics import sums_of_squares
from .quadratic import bilinear_form

__all__ = ["Archive"]

_VALUES = 2**22  # largest number of values of residuals in memory at once: 32 MiB
_RUNS = 64  # whose products are in memory at once


class _Numbers:
    """Arrays of one type in a temporary file without a name, which the system deletes with this object."""

    def __init__(self, dtype: type) -> None:
        self._dtype = np.dtype(dtype)
        self._file = tempfile.TemporaryFile(buffering=0)
        weakref.finalize(self, self._file.close)

    def __reduce__(self) -> tuple:
        self._file.seek(0)
        return _restored, (self._dtype.type, self._file.read())

    def write(self, place: int, array: np.ndarray) -> None:
        """Write an array from a place on, counted in numbers."""
        self._file.seek(place * self._dtype.itemsize)
        data = memoryview(np.ascontiguousarray(array, self._dtype).reshape(-1).view(np.uint8))
        while data:
            data = data[self._file.write(data) :]

    def read(self, place: int, shape: tuple[int, ...]) -> np.ndarray:
        """The array of a shape that begins at a place; zero where nothing was written."""
        array = np.zeros(shape, self._dtype)
        self._file.seek(place * self._dtype.itemsize)
        data = memoryview(array.reshape(-1).view(np.uint8))
        while data and (count := self._file.readinto(data)):
            data = data[count:]
        return array


def _restored(dtype: type, content: bytes) -> _Numbers:
    numbers = _Numbers(dtype)
    numbers.write(0, np.frombuffer(content, dtype))
    return numbers


class Archive:
    """All m successful simulations of a record: residuals (n_channels, n_steps), and a quadratic statistic of them.

    `numbers` (m,) are the numbers of the runs among all histories, which are residuals of runs, and derivatives of
    residuals; `coords` (m, n_structural) their structural coordinates, `statistics` (m, n_numbers) of their residuals.
    """

    def __init__(self, statistic: Callable[[np.ndarray], np.ndarray], shape: tuple[int, int]) -> None:
        self._statistic, self._shape, self._size = statistic, shape, shape[0] * shape[1]
        self._numbers: list[int] = []
        self._coords: list[np.ndarray] = []
        self._statistics: list[np.ndarray] = []
        # computed in double precision and then rounded, a residual keeps its digits where a channel has an offset of a
        # million times its noise; a rounded response would not
        self._residuals = _Numbers(np.float32)
        self._products = _Numbers(np.float64)  # of the runs i and j <= i in all channels, from i (i + 1) / 2 + j on
        self._multiplied: list[np.ndarray] = []  # whether the products of run i with the runs up to i are known

    def __len__(self) -> int:
        return len(self._multiplied)

    @property
    def numbers(self) -> np.ndarray:
        return np.array(self._numbers, dtype=int)

    @property
    def coords(self) -> np.ndarray:
        return np.array(self._coords)

    @property
    def statistics(self) -> np.ndarray:
        return np.array(self._statistics)

    def add(self, coords: np.ndarray, residuals: np.ndarray, statistics: np.ndarray) -> np.ndarray:
        """Add m runs; returns their numbers (m,)."""
        self._coords += list(coords)
        self._statistics += list(statistics)
        numbers = self.add_histories(residuals)
        self._numbers += list(numbers)
        return numbers

    def add_histories(self, histories: np.ndarray) -> np.ndarray:
        """Add histories (m, n_channels, n_steps), rounded to single precision; returns their numbers (m,)."""
        first = len(self)
        self._residuals.write(first * self._size, histories)
        self._multiplied += [np.zeros(number + 1, dtype=bool) for number in range(first, first + len(histories))]
        return np.arange(first, len(self))

    def residuals(self, run: int) -> np.ndarray:
        """Residuals (n_channels, n_steps) float32 of a run, by its number: measured minus simulated response [SI]."""
        return self._residuals.read(run * self._size, self._shape)

    def weights(self, rows: Sequence[Any]) -> np.ndarray:
        """Combinations (k, n) that are given as numbers of histories, or as weights of the first of them."""
        result = np.zeros((len(rows), len(self)))
        for row, each in zip(result, rows, strict=True):
            if np.ndim(each):
                row[: len(each)] = each
            else:
                row[each] = 1.0
        return result

    def combined(self, weights: np.ndarray) -> np.ndarray:
        """Histories (k, n_channels, n_steps) of combinations (k, n)."""
        result = np.zeros((len(weights), self._size))
        used = np.flatnonzero(weights.any(axis=0))
        count = max(1, _VALUES // self._size)
        for some in np.split(used, range(count, len(used), count)):
            result += weights[:, some] @ np.array([self.residuals(run).ravel() for run in some], dtype=float)
        return result.reshape(len(weights), *self._shape)

    def forms(self, first: np.ndarray, second: np.ndarray | None = None) -> np.ndarray:
        """Bilinear form (k, l, n_numbers) of the statistic for combinations (k, n) and (l, n), `first` by default."""
        if self._statistic is not sums_of_squares:
            others = None if second is None else self.combined(second)
            return bilinear_form(self._statistic, self.combined(first), others)
        second = first if second is None else second
        used = np.flatnonzero(first.any(axis=0) | second.any(axis=0))
        both = np.concatenate([first, second])[:, used]
        ahead = np.array([both[:, : place + 1] @ row for place, row in enumerate(self._halves(used))])
        lower = np.einsum("ki,ilc->klc", both, ahead, optimize=True)
        k = len(first)
        return lower[:k, k:] + lower[k:, :k].transpose(1, 0, 2)

    def products(self, runs: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Sums (m, m) over the channels of weights (n_channels,) times the products of the residuals of m runs."""
        order = np.argsort(runs)
        lower = np.zeros((len(runs), len(runs)))
        for place, row in enumerate(self._halves(runs[order])):
            lower[place, : place + 1] = row @ weights
        back = np.argsort(order)
        return (lower + lower.T)[np.ix_(back, back)]

    def _halves(self, runs: np.ndarray) -> Any:
        """For each of m ascending runs, its products (i, n_channels) with the runs up to it; of itself, a half."""
        self._multiply(runs)
        for place, run in enumerate(runs):
            row = self._products.read(run * (run + 1) // 2 * self._shape[0], (run + 1, self._shape[0]))
            row = row[runs[: place + 1]]
            row[-1] *= 0.5
            yield row

    def _multiply(self, runs: np.ndarray) -> None:
        """Compute those products of ascending runs that are not known."""
        n_channels, n_steps = self._shape
        new = [place for place, run in enumerate(runs) if not self._multiplied[run][runs[: place + 1]].all()]
        width = max(1, _VALUES // (len(runs) * n_steps))
        for begin in range(0, len(new), _RUNS):
            rows = new[begin : begin + _RUNS]
            found = np.empty((len(rows), rows[-1] + 1, n_channels))
            for channel in range(0, n_channels, width):
                shape = min(width, n_channels - channel), n_steps
                part = np.empty((rows[-1] + 1, *shape))
                for row, run in zip(part, runs, strict=False):
                    row[:] = self._residuals.read(run * self._size + channel * n_steps, shape)
                for k in range(shape[0]):
                    found[:, :, channel + k] = part[rows, k] @ part[:, k].T
            for place, products in zip(rows, found, strict=True):
                run, others = runs[place], runs[: place + 1]
                for other, values in zip(others, products, strict=False):
                    self._products.write((run * (run + 1) // 2 + other) * n_channels, values)
                self._multiplied[run][others] = True
