"""Mean, variance and quantiles of results that come in batches and are too many to keep.

Mean and variance need one pass: each batch has its own, and two of them are joined by the update of Chan, Golub &
LeVeque (1983), which never subtracts large numbers from each other as the mean of squares less the square of the mean
does. Quantiles need the results themselves: as many are kept as a bound of memory allows. A result may stand for
several samples (resampling makes copies), so everything here counts.

References
----------
Chan, Golub & LeVeque (1983), Am. Stat. 37(3), 242-247, doi:10.1080/00031305.1983.10483115
"""

from collections.abc import Sequence

import numpy as np

__all__ = ["Kept", "Moments", "quantiles_with_errors"]

FEWEST_KEPT = 20  # less than one sample beyond a 5 % quantile
_CHUNK = 2**18  # values sorted at once


class Moments:
    """Running mean and variance of arrays of one shape.

    Attributes
    ----------
    count : float — samples so far.
    mean : (*shape) float
    """

    def __init__(self) -> None:
        self.count = 0.0
        self.mean: np.ndarray | None = None
        self._squares: np.ndarray | None = None

    def add(self, values: np.ndarray, counts: np.ndarray) -> None:
        """Enter `values` (m, *shape), each standing for `counts` (m,) samples."""
        total = float(counts.sum())
        if total == 0.0:
            return
        mean = np.tensordot(counts / total, values, axes=1)
        deviations = values - mean
        with np.errstate(over="ignore"):  # the variance of responses that have blown up is infinite
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
        """Mean squared deviation from the mean, (*shape)."""
        return self._squares / self.count


class Kept:
    """Results kept for quantiles: all of them if they fit into `memory`, else those of a random part of the samples.

    Parameters
    ----------
    result_of_sample : (n,) int — which result a sample has; copies share one.
    shape : shape of a result.
    dtype : type in which results are kept.
    memory : int or None — bound of the kept results [bytes]; None for no bound.
    rng : numpy.random.Generator — chooses the part.

    Attributes
    ----------
    complete : bool — whether all results are kept.

    Raises
    ------
    ValueError
        If fewer than 20 results fit.
    """

    def __init__(
        self,
        result_of_sample: np.ndarray,
        shape: tuple[int, ...],
        dtype: type,
        memory: int | None,
        rng: np.random.Generator,
    ) -> None:
        n, n_results, size = len(result_of_sample), int(result_of_sample.max()) + 1, int(np.prod(shape))
        row = max(size * np.dtype(dtype).itemsize, 1)
        fit = n_results if memory is None else int(memory) // row
        self.complete = fit >= n_results
        if not self.complete and fit < FEWEST_KEPT:
            raise ValueError(
                f"quantiles need at least {FEWEST_KEPT} results of {row} bytes each, that is {FEWEST_KEPT * row} bytes "
                f"of memory; got memory={memory}: give more, fewer channels, or quantiles=() for mean and variance only"
            )
        chosen = result_of_sample if self.complete else result_of_sample[rng.choice(n, size=fit, replace=False)]
        counts = np.bincount(chosen, minlength=n_results)
        kept = np.flatnonzero(counts)
        self.shape = shape
        self._position = np.full(n_results, -1)
        self._position[kept] = np.arange(len(kept))
        self._counts = counts[kept]
        self._rows = np.empty((len(kept), size), dtype=dtype)
        self._filled = np.zeros(len(kept), dtype=bool)
        self._largest = float(np.finfo(dtype).max)

    def __contains__(self, result: int) -> bool:
        return self._position[result] >= 0

    def add(self, results: np.ndarray, values: np.ndarray) -> None:
        """Enter `values` (m, *shape) of the `results` (m,); those that are not of the part are passed over."""
        positions = self._position[results]
        wanted = positions >= 0
        if not wanted.any():
            return
        rows = values.reshape(len(values), -1)[wanted]
        # a response that has blown up must stay a number in single precision
        self._rows[positions[wanted]] = np.clip(rows, -self._largest, self._largest)
        self._filled[positions[wanted]] = True

    @property
    def n_samples(self) -> int:
        """Samples that the kept results stand for."""
        return int(self._counts[self._filled].sum())

    def values_of(self, results: np.ndarray) -> np.ndarray:
        """Kept results (m, *shape) of the `results` (m,), which must all have been entered."""
        return self._rows[self._position[results]].reshape(len(results), *self.shape)

    def quantiles(self, probabilities: Sequence[float], effective: float) -> tuple[np.ndarray, np.ndarray]:
        """Quantiles and their standard errors, (n_probabilities, *shape) each (see `quantiles_with_errors`)."""
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
    """Quantiles of the columns of an array, and their standard errors.

    The quantile is that of `numpy.quantile` with every row repeated. Of n samples, the number below the p-quantile is
    binomial: its rank is known to n sqrt(p (1 - p) / effective). The error is what so many ranks are worth: a quarter
    of the way between the sorted samples twice as many ranks below and above, the 95 % interval.

    Parameters
    ----------
    values : (m, k) float
    counts : (m,) int — how many samples each row stands for.
    probabilities : sequence of float in (0, 1)
    effective : float — independent samples that all of them are worth.

    Returns
    -------
    tuple of (n_probabilities, k) float : quantiles and errors; an error is inf for a single sample.
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
