"""Mean, variance and quantiles of results that arrive in batches. See ``docs/theory/prediction.rst``.

Mean and variance need one pass. They are combined over batches by the update of T. F. Chan, G. H. Golub and R. J.
LeVeque (1983), The American Statistician 37(3), 242-247, doi:10.1080/00031305.1983.10483115, which avoids the
cancellation in "mean square minus squared mean". Quantiles need the results themselves, of which as many are retained
as fit into a limit of memory. Every result has a count, because resampling makes copies of samples.
"""

from collections.abc import Sequence

import numpy as np

__all__ = ["RetainedResults", "RunningMoments", "quantiles_with_errors"]

FEWEST_RETAINED = 20  # with fewer samples a 5 % quantile has less than one sample below it
_CHUNK = 2**18  # values that are sorted at once


class RunningMoments:
    """Running mean (None before the first sample) and variance of `count` equally shaped arrays."""

    def __init__(self) -> None:
        self.count = 0.0
        self.mean: np.ndarray | None = None
        self._squares: np.ndarray | None = None

    def add(self, values: np.ndarray, counts: np.ndarray) -> None:
        """Add results `values` (m, ...) that stand for `counts` (m,) samples each."""
        total = float(counts.sum())
        if total == 0.0:
            return
        mean = np.tensordot(counts / total, values, axes=1)
        deviations = values - mean
        with np.errstate(over="ignore"):  # unstable responses may have an infinite variance
            squares = np.tensordot(counts, np.square(deviations, out=deviations), axes=1)
        if self.mean is None:
            self.count, self.mean, self._squares = total, mean, squares
            return
        joint = self.count + total
        shift = mean - self.mean
        self.mean = self.mean + shift * (total / joint)
        with np.errstate(over="ignore"):
            self._squares = self._squares + squares + shift**2 * (self.count * total / joint)
        self.count = joint

    @property
    def variance(self) -> np.ndarray:
        """Mean squared deviation from the mean, shape (...)."""
        return self._squares / self.count


class RetainedResults:
    """Results retained for quantiles: all of them if they fit into the limit [bytes], else a random subsample.

    Each of the n samples has the index of its result, because copies of a sample share one. ValueError if fewer than 20
    results fit; `complete` says whether all are retained.
    """

    def __init__(
        self,
        result_of_sample: np.ndarray,
        shape: tuple[int, ...],
        dtype: type,
        memory_bytes: int | None,
        rng: np.random.Generator,
    ) -> None:
        n, n_results, size = len(result_of_sample), int(result_of_sample.max()) + 1, int(np.prod(shape))
        row = max(size * np.dtype(dtype).itemsize, 1)
        fit = n_results if memory_bytes is None else int(memory_bytes) // row
        self.complete = fit >= n_results
        if not self.complete and fit < FEWEST_RETAINED:
            raise ValueError(
                f"quantiles need at least {FEWEST_RETAINED} results of {row} bytes each, {FEWEST_RETAINED * row} bytes "
                f"in all; got memory_bytes={memory_bytes}: give more, take fewer channels, or use quantiles=() for "
                "mean and variance only"
            )
        chosen = result_of_sample if self.complete else result_of_sample[rng.choice(n, size=fit, replace=False)]
        counts = np.bincount(chosen, minlength=n_results)
        retained = np.flatnonzero(counts)
        self.shape = shape
        self._position = np.full(n_results, -1)
        self._position[retained] = np.arange(len(retained))
        self._counts = counts[retained]
        self._rows = np.empty((len(retained), size), dtype=dtype)
        self._filled = np.zeros(len(retained), dtype=bool)
        self._largest = float(np.finfo(dtype).max)

    def __contains__(self, result: int) -> bool:
        return self._position[result] >= 0

    def add(self, results: np.ndarray, values: np.ndarray) -> None:
        """Add the values (m, ...) of the results with indices `results` (m,). Results not chosen are skipped."""
        positions = self._position[results]
        wanted = positions >= 0
        if not wanted.any():
            return
        rows = values.reshape(len(values), -1)[wanted]
        # Unstable responses are clipped, so that they stay finite in single precision.
        self._rows[positions[wanted]] = np.clip(rows, -self._largest, self._largest)
        self._filled[positions[wanted]] = True

    @property
    def n_samples(self) -> int:
        """Number of samples that the retained results stand for."""
        return int(self._counts[self._filled].sum())

    def values_of(self, results: np.ndarray) -> np.ndarray:
        """Return the values (m, ...) of the results with indices `results` (m,), all of them added before."""
        return self._rows[self._position[results]].reshape(len(results), *self.shape)

    def quantiles(self, probabilities: Sequence[float], effective: float) -> tuple[np.ndarray, np.ndarray]:
        """Return quantiles and their standard errors, each (n_probabilities, ...); see `quantiles_with_errors`."""
        counts = self._counts[self._filled]
        size = self._rows.shape[1]
        out = np.empty((2, len(probabilities), size))
        columns = max(1, _CHUNK // max(len(counts), 1))
        for start in range(0, size, columns):
            part = slice(start, start + columns)
            block = self._rows[:, part][self._filled].astype(float)
            out[:, :, part] = quantiles_with_errors(block, counts, probabilities, effective)
        return tuple(out.reshape(2, len(probabilities), *self.shape))


def quantiles_with_errors(
    values: np.ndarray, counts: np.ndarray, probabilities: Sequence[float], effective: float
) -> tuple[np.ndarray, np.ndarray]:
    r"""Quantiles (n_probabilities, k) of values (m, k), each row taken `counts` times, and their standard errors.

    The number of samples below the p-quantile is binomial, so that its rank among n samples has the standard error
    :math:`s = n \sqrt{p (1 - p) / n_\mathrm{eff}}`. The error of the quantile is a quarter of the distance between the
    sorted samples at the ranks 2 s below and 2 s above it, the 95 % interval, and inf for a single sample. See
    ``docs/theory/prediction.rst``.
    """
    n = int(counts.sum())
    if n == len(values):
        ascending, cumulative = np.sort(values, axis=0), None
    else:
        order = np.argsort(values, axis=0)
        ascending, cumulative = np.take_along_axis(values, order, axis=0), np.cumsum(counts[order], axis=0)

    def at_rank(rank: int) -> np.ndarray:
        if cumulative is None:
            return ascending[rank]
        return np.take_along_axis(ascending, (cumulative <= rank).sum(axis=0)[None], axis=0)[0]

    def at(position: float) -> np.ndarray:
        low = min(int(position), n - 1)
        value, share = at_rank(low), position - low
        return value if share == 0.0 else value + share * (at_rank(low + 1) - value)

    quantiles, errors = np.empty((len(probabilities), values.shape[1])), np.empty((len(probabilities), values.shape[1]))
    for k, p in enumerate(probabilities):
        position, spread = (n - 1) * p, n * np.sqrt(p * (1.0 - p) / effective)
        low, high = max(position - 2.0 * spread, 0.0), min(position + 2.0 * spread, n - 1.0)
        quantiles[k] = at(position)
        errors[k] = (at(high) - at(low)) * (spread / (high - low)) if high > low else np.inf
    return quantiles, errors
