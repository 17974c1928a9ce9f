"""The likelihood of white noise with integrated levels, tabulated: for the millions of values that an emulator needs.

Per channel it is a function of x = log sqrt(J / n) alone, for the sum of squares J of n samples, and without the
maximum of the likelihood, -n (log(2 pi) / 2 + x + 1 / 2), it is as smooth as the prior, seen through a kernel of
the width w = 1 / sqrt(2 n). Polynomials of degree 7 in cells of half of that width, made where they are needed,
have errors below the errors of the quadrature.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from .marginal import MarginalNoise, log_integral
from .protocol import Noise
from .sample_counts import SampleCounts

__all__ = ["tabulated"]

_DEGREE = 7
_NODES = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
_TO_COEFFICIENTS = np.linalg.inv(np.vander(_NODES))  # the highest power first
_CELL = 0.5  # width, as a share of the kernel's
_MOST_CELLS = 2**15
_HALF_LOG_TWO_PI_E = 0.5 * float(np.log(2.0 * np.pi * np.e))


class _Table:
    """Logarithms of the integral for a number of samples and a prior, see `log_integral`."""

    def __init__(self, count: float, prior: Any) -> None:
        self._count, self._prior, self._width = count, prior, _CELL / np.sqrt(2.0 * count)
        self._first = 0
        self._coefficients = np.empty((_DEGREE + 1, 0))

    def __call__(self, squares: np.ndarray) -> np.ndarray:
        """Values (n,) for sums of squares (n,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            x = 0.5 * np.log(squares / self._count)
            place = x / self._width
        cells = np.floor(np.where(np.isfinite(place), np.clip(place, -1e15, 1e15), np.nan))
        known = self._cover(cells)
        with np.errstate(invalid="ignore"):
            cells = np.where(known, cells - self._first, 0.0).astype(int)
            local, values = 2.0 * (place - np.floor(place)) - 1.0, np.zeros(len(x))
            for row in self._coefficients if known.any() else ():
                values *= local
                values += row[cells]
            values -= self._count * (_HALF_LOG_TWO_PI_E + x)
        rest = np.flatnonzero(~known | ~np.isfinite(values))
        if len(rest):
            values[rest] = log_integral(squares[rest], self._count, self._prior)
        return values

    def _cover(self, cells: np.ndarray) -> np.ndarray:
        """Make the cells (n,) that are missing; whether each is in the table (n,), which has a largest size."""
        finite = cells[np.isfinite(cells)]
        if not len(finite):
            return np.zeros(len(cells), dtype=bool)
        size = self._coefficients.shape[1]
        low, high = finite.min(), finite.max() + 1.0
        if size:
            low, high = min(low, self._first), max(high, self._first + size)
        elif high - low > _MOST_CELLS:
            low = np.median(finite)
            high = low + 1.0
        if high - low <= _MOST_CELLS and high - low > size:
            wider = np.full((_DEGREE + 1, int(high - low)), np.nan)
            start = int(self._first - low)
            if size:
                wider[:, start : start + size] = self._coefficients
            self._first, self._coefficients = int(low), wider
        inside = (cells >= self._first) & (cells < self._first + self._coefficients.shape[1])
        used = np.zeros(self._coefficients.shape[1], dtype=bool)
        used[(cells[inside] - self._first).astype(int)] = True
        if len(new := np.flatnonzero(used & np.isnan(self._coefficients[0]))):
            x = (self._first + new + 0.5 * (1.0 + _NODES[:, None])) * self._width
            squares = self._count * np.exp(2.0 * x)
            values = log_integral(squares.ravel(), self._count, self._prior).reshape(x.shape)
            self._coefficients[:, new] = _TO_COEFFICIENTS @ (values + self._count * (_HALF_LOG_TWO_PI_E + x))
        return inside


class _Tabulated:
    """`MarginalNoise.log_likelihood` by tables, one for all channels with equal priors and numbers of samples."""

    def __init__(self, noise: MarginalNoise) -> None:
        self._noise = noise
        self._tables: dict[tuple[float, Any], _Table] = {}

    def _integral(self, squares: np.ndarray, count: float, prior: Any) -> np.ndarray:
        try:
            table = self._tables.get((count, prior))
        except TypeError:  # a distribution of the user that has no hash
            return log_integral(squares, count, prior)
        if table is None:
            table = self._tables[count, prior] = _Table(count, prior)
        return table(squares)

    def __call__(self, misfit: np.ndarray, n_samples: int | SampleCounts, parameters: Any = None) -> np.ndarray:
        return self._noise.log_likelihood(misfit, n_samples, parameters, self._integral)


def tabulated(noise: Noise) -> Callable[..., np.ndarray]:
    """The method `log_likelihood` of a noise, tabulated if its levels are integrated out."""
    return _Tabulated(noise) if isinstance(noise, MarginalNoise) else noise.log_likelihood
