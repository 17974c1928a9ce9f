r"""Proper scores of predictions, and tables of them: of histories per channel, of numbers such as peaks per quantity.

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
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from ..signals.channels import Channel, relative_errors
from ..text_tables import text_table
from ..units import from_si


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


def interval_score(lower: ArrayLike, upper: ArrayLike, observed: ArrayLike, probability: float) -> np.ndarray:
    r"""Score (...) of central intervals with the probability p: :math:`(u - l) + 2 [(l - y)_+ + (y - u)_+] / (1 - p)`.

    Gneiting and Raftery 2007, section 6.2, in the unit of the values; NaN where the observed value is.
    """
    lower, upper, observed = (np.asarray(each, dtype=float) for each in (lower, upper, observed))
    outside = np.maximum(lower - observed, 0.0) + np.maximum(observed - upper, 0.0)
    return (upper - lower) + 2.0 / (1.0 - probability) * outside


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


def check_probability(probability: float) -> None:
    """Raise ValueError if the probability of an interval is not between 0 and 1."""
    if not 0.0 < probability < 1.0:
        raise ValueError(f"interval_probability must be between 0 and 1; got {probability!r}")


def share_within(pit: ArrayLike, interval_probability: float) -> Share:
    """Share of measured values within their central predicted intervals, from their PIT.

    Parameters
    ----------
    pit : (n,) array_like
        Probability integral transforms of independent measured values, such as the peaks of several events; NaN values
        are left out.
    interval_probability : float
        Probability of the intervals, between 0 and 1. The share is about as large if the predictions are calibrated.

    Returns
    -------
    Share
        The numbers, the share, and its interval.

    Raises
    ------
    ValueError
        If there is no value, one is not between 0 and 1, or `interval_probability` is out of range.

    References
    ----------
    E. B. Wilson (1927), Probable inference, the law of succession, and statistical inference, Journal of the American
    Statistical Association 22, 209-212, doi:10.1080/01621459.1927.10502953.

    Examples
    --------
    >>> print(share_within([0.1, 0.4, 0.97], 0.9))
    2 of 3: 21 to 94 %
    """
    check_probability(interval_probability)
    there = np.ravel(np.asarray(pit, dtype=float))
    there = there[~np.isnan(there)]
    if not there.size or not ((there >= 0.0) & (there <= 1.0)).all():
        raise ValueError(f"share_within: expected PIT values between 0 and 1; got {pit!r}")
    return Share(int((np.abs(there - 0.5) <= 0.5 * interval_probability).sum()), there.size)


class HistoryScores(NamedTuple):
    """Scores of predicted histories, averaged over the measured samples of each channel.

    ``print(scores)`` is a table in the display units of the channels. All arrays are in SI units and have one row per
    channel.

    Attributes
    ----------
    channels : tuple of Channel
        The channels.
    interval_probability : float
        Probability of the intervals.
    samples : ndarray of int, shape (n_channels,)
        Number of measured samples.
    rms : ndarray, shape (n_channels,)
        Root mean square of the measured samples, the scale of the scores.
    rrmse : ndarray, shape (n_channels,)
        Relative root mean square error of the mean [-].
    crps : ndarray, shape (n_channels,)
        CRPS of the normal distributions with the predicted means and standard deviations.
    interval_score : ndarray, shape (n_channels,)
        Interval score of the band between the quantiles.
    width : ndarray, shape (n_channels,)
        Width of this band: the sharpness of the prediction.
    coverage : ndarray, shape (n_channels,)
        Share of the measured samples in the band.
    """

    channels: tuple[Channel, ...]
    interval_probability: float
    samples: np.ndarray
    rms: np.ndarray
    rrmse: np.ndarray
    crps: np.ndarray
    interval_score: np.ndarray
    width: np.ndarray
    coverage: np.ndarray

    def __str__(self) -> str:
        head = ["channel", "unit", "RMS", "RRMSE", "CRPS", "interval score", "width"]
        rows = [[*head, f"in {self.interval_probability:.0%} band"]]
        for k, channel in enumerate(self.channels):
            scaled = [from_si(a[k], channel.unit) for a in (self.rms, self.crps, self.interval_score, self.width)]
            rms, crps, score, width = (f"{each:.3g}" for each in scaled)
            shares = f"{self.rrmse[k]:.1%}", f"{self.coverage[k]:.1%}"
            rows.append([channel.name, channel.unit, rms, shares[0], crps, score, width, shares[1]])
        return text_table(rows)

    __repr__ = __str__


class QuantityScores(NamedTuple):
    """Scores of predicted numbers, such as peaks, each against one measured value.

    ``print(scores)`` is a table in the display units of the channels. All arrays are in SI units and have one entry
    per quantity. One value says little about calibration: collect `pit` over events and channels, and see
    `share_within`.

    Attributes
    ----------
    names : tuple of str
        Names of the quantities: their channels' names, or numbers.
    units : tuple of str
        Display units, "SI" for a function of the whole response.
    interval_probability : float
        Probability of the intervals.
    measured : ndarray, shape (n_quantities,)
        Measured values.
    median : ndarray, shape (n_quantities,)
        Predicted medians.
    lower, upper : ndarray, shape (n_quantities,)
        Ends of the predicted intervals: the samples whose ranks are nearest to (n + 1) p, at most the smallest and the
        largest. Intervals between such ranks have their probability on average, also if estimated from few samples.
    crps : ndarray, shape (n_quantities,)
        CRPS of the samples, for their effective sample size.
    interval_score : ndarray, shape (n_quantities,)
        Interval score.
    pit : ndarray, shape (n_quantities,)
        Predicted probability of a smaller value than the measured one.
    lower_quartile, upper_quartile : ndarray, shape (n_quantities,)
        Ends of the intervals with probability 0.5, as `lower` and `upper`.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    interval_probability: float
    measured: np.ndarray
    median: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    crps: np.ndarray
    interval_score: np.ndarray
    pit: np.ndarray
    lower_quartile: np.ndarray
    upper_quartile: np.ndarray

    @property
    def within(self) -> np.ndarray:
        """Whether each measured value is in its interval, from its `pit` as `share_within`.

        Fewer than ten samples cannot show that a value is outside a 90 % interval.
        """
        return np.abs(self.pit - 0.5) <= 0.5 * self.interval_probability

    def __str__(self) -> str:
        head = ["quantity", "unit", "measured", "median", f"{self.interval_probability:.0%} interval", "within"]
        rows = [[*head, "CRPS", "interval score", "PIT"]]
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            arrays = (self.measured, self.median, self.lower, self.upper, self.crps, self.interval_score)
            scaled = [array[k] if unit == "SI" else from_si(array[k], unit) for array in arrays]
            measured, median, lower, upper, crps, score = (f"{each:.3g}" for each in scaled)
            within = "yes" if self.within[k] else "no"
            row = [name, unit, measured, median, f"{lower} to {upper}", within, crps, score, f"{self.pit[k]:.3f}"]
            rows.append(row)
        return text_table(rows)

    __repr__ = __str__


def score_histories(
    channels: Sequence[Channel],
    measured: np.ndarray,
    moments: tuple[np.ndarray, np.ndarray],
    band: tuple[np.ndarray, np.ndarray],
    probability: float,
) -> HistoryScores:
    """Score predicted histories [SI]; all arrays are (n_channels, n_samples), measured values NaN where missing.

    Moments are means and standard deviations; the band is central. ValueError if a channel has no sample or only
    zeros.
    """
    error = relative_errors(moments[0] - measured, measured)
    if zero := [channel.name for channel, each in zip(channels, error, strict=True) if np.isnan(each)]:
        raise ValueError(f"score: expected measurements that are not zero; {', '.join(zero)} is zero at all samples")
    there = np.isfinite(measured)
    inside = (band[0] <= measured) & (measured <= band[1])
    return HistoryScores(
        channels=tuple(channels),
        interval_probability=probability,
        samples=there.sum(axis=1),
        rms=np.sqrt(np.nanmean(np.square(measured), axis=1)),
        rrmse=error,
        crps=np.nanmean(crps_normal(*moments, measured), axis=1),
        interval_score=np.nanmean(interval_score(*band, measured, probability), axis=1),
        width=np.nanmean(np.where(there, band[1] - band[0], np.nan), axis=1),
        coverage=inside.sum(axis=1) / there.sum(axis=1),
    )


def score_values(
    names: Sequence[str],
    units: Sequence[str],
    values: np.ndarray,
    measured: ArrayLike,
    probability: float,
    effective_sample_size: float | None = None,
) -> QuantityScores:
    """Score predicted numbers (n, n_quantities), three samples or more, against measured ones (n_quantities,) [SI]."""
    measured, ascending = np.asarray(measured, dtype=float), np.sort(values, axis=0)
    (lower, upper), quartiles = central_interval(ascending, probability), central_interval(ascending, 0.5)
    return QuantityScores(
        names=tuple(names),
        units=tuple(units),
        interval_probability=probability,
        measured=measured,
        median=np.median(values, axis=0),
        lower=lower,
        upper=upper,
        crps=crps_samples(values, measured, effective_sample_size),
        interval_score=interval_score(lower, upper, measured, probability),
        pit=pit_samples(values, measured),
        lower_quartile=quartiles[0],
        upper_quartile=quartiles[1],
    )


def central_interval(ascending: np.ndarray, probability: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends (n_quantities,) of the central interval of sorted samples (n, n_quantities), see `QuantityScores.lower`."""
    n = len(ascending)
    # as `share_within` of the PIT (rank + 0.5) / (n + 1)
    rank = max(1, math.ceil(0.5 * (1.0 - probability) * (n + 1) - 0.5))
    return ascending[rank - 1], ascending[n - rank]
