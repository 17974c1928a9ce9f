r"""Proper scores of predictions, and the checks that go with them.

A score compares a predicted distribution with the value that was measured; smaller is better. It is *proper* if its
expectation is smallest for the true distribution, so that neither too wide nor too narrow a prediction pays. The share
of measurements in a band (coverage) is not a score: a band that is ten times too wide covers everything.

=====================  ===============================================================================================
CRPS                   Integral of the squared difference between the predicted distribution function and the step at
                       the measured value, in the unit of the quantity; the absolute error if the prediction is a number
interval score         Width of an interval plus a penalty for every measured value outside it
PIT                    Probability integral transform: the predicted probability of a value below the measured one;
                       uniform between 0 and 1 if the predictions are calibrated
=====================  ===============================================================================================

Missing measurements are NaN and have scores of NaN. Equations are on the page ``docs/theory/prediction.rst``.

References
----------
T. Gneiting, A. E. Raftery (2007), Strictly proper scoring rules, prediction, and estimation, Journal of the American
Statistical Association 102, 359-378, doi:10.1198/016214506000001437.

C. A. T. Ferro (2014), Fair scores for ensemble forecasts, Quarterly Journal of the Royal Meteorological Society 140,
1917-1923, doi:10.1002/qj.2270.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

__all__ = [
    "Share",
    "crps_normal",
    "crps_samples",
    "interval_score",
    "pit_normal",
    "pit_samples",
    "share_within",
]


def crps_normal(mean: ArrayLike, sd: ArrayLike, observed: ArrayLike) -> np.ndarray:
    r"""Continuous ranked probability score (...) of normal distributions; the absolute error where sd is zero.

    :math:`\sigma\,[z\,(2 \Phi(z) - 1) + 2 \varphi(z) - 1 / \sqrt \pi]` with :math:`z = (y - \mu) / \sigma` (Gneiting
    and Raftery 2007, section 4.2, with the opposite sign).
    """
    error = np.asarray(observed, dtype=float) - mean
    with np.errstate(divide="ignore", invalid="ignore"):
        z = error / sd
        density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
        score = sd * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))
    return np.where(np.asarray(sd) > 0.0, score, np.abs(error))


def crps_samples(values: ArrayLike, observed: ArrayLike, effective: float | None = None) -> np.ndarray:
    r"""Unbiased continuous ranked probability score (...) of samples (n, ...), n > 1, which are worth `effective` ones.

    :math:`\frac1n \sum_i |x_i - y| - \frac{1}{2 n^2 (1 - 1 / N)} \sum_{i, j} |x_i - x_j|` (Ferro 2014 for N = n).
    Copies by a sampler are worth :math:`N = n^2 / \sum_g m_g^2` for the numbers of copies :math:`m_g`.
    """
    ascending, n = np.sort(np.asarray(values, dtype=float), axis=0), len(values)
    # sum over pairs of |x_i - x_j| = 2 sum_i (2 i - n - 1) x_(i), with the ranks i = 1 ... n
    ranks = 2.0 * np.arange(1, n + 1) - n - 1.0
    pairs = n * (n - 1.0) if effective in (None, n) else n * n * (1.0 - 1.0 / effective)
    return np.abs(ascending - observed).mean(axis=0) - np.tensordot(ranks, ascending, axes=1) / pairs


def interval_score(lower: ArrayLike, upper: ArrayLike, observed: ArrayLike, level: float) -> np.ndarray:
    r"""Score of central prediction intervals.

    Parameters
    ----------
    lower, upper : (...) array_like
        Ends of the intervals: the quantiles with the probabilities (1 - level) / 2 and (1 + level) / 2.
    observed : (...) array_like
        Measured values, NaN where missing.
    level : float
        Probability of the intervals, between 0 and 1.

    Returns
    -------
    ndarray, shape (...)
        :math:`(u - l) + \frac{2}{1 - p} \left[ (l - y)_+ + (y - u)_+ \right]` for the level p (Gneiting and Raftery
        2007, section 6.2), in the unit of the values.

    Raises
    ------
    ValueError
        If the level is not between 0 and 1, or a lower end is above its upper end.

    Examples
    --------
    >>> interval_score([0.9, 0.9], [1.1, 1.1], [1.0, 1.2], level=0.9)  # inside: the width; outside: a penalty
    array([0.2, 2.2])
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"interval_score: level must be a probability between 0 and 1; got {level!r}")
    lower, upper, observed = (np.asarray(each, dtype=float) for each in (lower, upper, observed))
    if (lower > upper).any():
        raise ValueError(
            f"interval_score: expected lower ends below the upper ends; {np.count_nonzero(lower > upper)} "
            "are above: exchange them"
        )
    outside = np.maximum(lower - observed, 0.0) + np.maximum(observed - upper, 0.0)
    return (upper - lower) + 2.0 / (1.0 - level) * outside


def pit_normal(mean: ArrayLike, sd: ArrayLike, observed: ArrayLike) -> np.ndarray:
    """Predicted probability (...) of a value below the measured one, for normal distributions; NaN where missing.

    Where the standard deviation is zero, it is 0 or 1, and NaN for a measured value that is the mean.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return ndtr((np.asarray(observed, dtype=float) - mean) / sd)


def pit_samples(values: ArrayLike, observed: ArrayLike) -> np.ndarray:
    """Predicted probability (...) of a value below the measured one, from samples (n, ...); NaN where one is missing.

    It is (k + 0.5) / (n + 1) for k samples below the value, equal samples counting one half, and never 0 or 1, because
    no finite number of samples shows that a value is impossible.
    """
    values, observed = np.asarray(values, dtype=float), np.asarray(observed, dtype=float)
    below = (values < observed).sum(axis=0) + 0.5 * (values == observed).sum(axis=0)
    return np.where(np.isnan(observed + values.sum(axis=0)), np.nan, (below + 0.5) / (len(values) + 1.0))


class Share(NamedTuple):
    """How many measured values are within their intervals; ``print`` shows "10 of 11: 62 to 98 %".

    Attributes
    ----------
    inside, n : int
        Number of values within, and of all values.
    """

    inside: int
    n: int

    @property
    def value(self) -> float:
        """The share [-]."""
        return self.inside / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Interval of 95 % for the share in further events (Wilson 1927): values of n events show it no better."""
        from scipy.stats import binomtest  # slow to import

        return tuple(binomtest(self.inside, self.n).proportion_ci(method="wilson"))

    def __str__(self) -> str:
        low, high = (100.0 * each for each in self.interval)
        return f"{self.inside} of {self.n}: {low:.0f} to {high:.0f} %"

    __repr__ = __str__


def share_within(pit: ArrayLike, level: float) -> Share:
    """Share of measured values within their central predicted intervals, from their PIT.

    Parameters
    ----------
    pit : (n,) array_like
        Probability integral transforms of independent measured values, such as the peaks of several events; NaN values
        are left out.
    level : float
        Probability of the intervals, between 0 and 1. The share is about as large if the predictions are calibrated.

    Returns
    -------
    Share
        The numbers, the share, and its interval.

    Raises
    ------
    ValueError
        If there is no value, one is not between 0 and 1, or the level is out of range.

    References
    ----------
    E. B. Wilson (1927), Probable inference, the law of succession, and statistical inference, Journal of the American
    Statistical Association 22, 209-212, doi:10.1080/01621459.1927.10502953.

    Examples
    --------
    >>> print(share_within([0.1, 0.4, 0.97], 0.9))
    2 of 3: 21 to 94 %
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"share_within: level must be a probability between 0 and 1; got {level!r}")
    there = np.ravel(np.asarray(pit, dtype=float))
    there = there[~np.isnan(there)]
    if not there.size or not ((there >= 0.0) & (there <= 1.0)).all():
        raise ValueError(f"share_within: expected PIT values between 0 and 1; got {pit!r}")
    return Share(int((np.abs(there - 0.5) <= 0.5 * level).sum()), there.size)
