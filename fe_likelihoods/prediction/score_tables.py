"""Scores of one prediction as tables: of histories per channel, of numbers (peaks, residual values) per quantity."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..noise.residuals import effective_samples
from ..signals.channels import Channel
from ..signals.error_measures import rrmse
from ..text_tables import text_table
from ..units import from_si
from .scores import crps_normal, crps_samples, interval_score, pit_normal, pit_samples

__all__ = [
    "HistoryScores",
    "QuantityScores",
    "central_interval",
    "score_histories",
    "score_values",
    "strong_part",
]

_BINS = 10  # of the histograms of the PIT


class HistoryScores(NamedTuple):
    """Scores of predicted histories, averaged over the measured samples of each channel.

    ``print(scores)`` is a table in the display units of the channels. All arrays are in SI units and have one row per
    channel.

    Attributes
    ----------
    channels : tuple of Channel
        The channels.
    level : float
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
    coverage_strong : ndarray, shape (n_channels,)
        The same in the strong part, between 5 and 95 % of the measured history's sum of squares.
    pit : ndarray, shape (n_channels, 10)
        Shares of the measured samples whose PIT (for the normal distributions) is in each tenth of 0 to 1: about 0.1
        each for a calibrated prediction; high at both ends if the prediction is too narrow, in the middle if too wide.
        A sample with a predicted standard deviation of zero is at an end, or left out if it equals the mean.
    effective_samples : ndarray, shape (n_channels,)
        Number of independent samples that the measured ones are worth, from the autocorrelation of the normalised
        errors (`fe_likelihoods.effective_samples`).
    """

    channels: tuple[Channel, ...]
    level: float
    samples: np.ndarray
    rms: np.ndarray
    rrmse: np.ndarray
    crps: np.ndarray
    interval_score: np.ndarray
    width: np.ndarray
    coverage: np.ndarray
    coverage_strong: np.ndarray
    pit: np.ndarray
    effective_samples: np.ndarray

    def __str__(self) -> str:
        head = ["channel", "unit", "RMS", "RRMSE", "CRPS", "interval score", "width"]
        rows = [[*head, f"in {self.level:.0%} band", "strong part"]]
        for k, channel in enumerate(self.channels):
            scaled = [from_si(a[k], channel.unit) for a in (self.rms, self.crps, self.interval_score, self.width)]
            rms, crps, score, width = (f"{each:.3g}" for each in scaled)
            row = [channel.name, channel.unit, rms, f"{self.rrmse[k]:.1%}", crps, score, width]
            shares = self.coverage[k], self.coverage_strong[k]
            rows.append(row + ["-" if np.isnan(share) else f"{share:.1%}" for share in shares])
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
    level : float
        Probability of the intervals.
    measured : ndarray, shape (n_quantities,)
        Measured values.
    median : ndarray, shape (n_quantities,)
        Predicted medians.
    lower, upper : ndarray, shape (n_quantities,)
        Ends of the predicted intervals: the samples whose ranks are nearest to (n + 1) p, at most the smallest and the
        largest. An interval between such ranks has its level on average, also if it is estimated from few samples.
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
    level: float
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
        return np.abs(self.pit - 0.5) <= 0.5 * self.level

    def __str__(self) -> str:
        head = ["quantity", "unit", "measured", "median", f"{self.level:.0%} interval", "within"]
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
    level: float,
) -> HistoryScores:
    """Score predicted histories [SI]; all arrays are (n_channels, n_samples), measured values NaN where missing.

    Moments are means and standard deviations, the band has quantiles with the probabilities (1 - level) / 2 and (1 +
    level) / 2. ValueError if a channel has no sample or is zero at all of them.
    """
    error = rrmse(moments[0], measured, [channel.name for channel in channels])
    there = np.isfinite(measured)
    inside = (band[0] <= measured) & (measured <= band[1])
    spread = there & (moments[1] > 0.0)
    shares = [_histogram(row[np.isfinite(row)]) for row in pit_normal(*moments, measured)]
    worth = _effective(np.where(spread, measured - moments[0], np.nan) / np.where(spread, moments[1], 1.0))
    return HistoryScores(
        channels=tuple(channels),
        level=level,
        samples=there.sum(axis=1),
        rms=np.sqrt(np.nanmean(np.square(measured), axis=1)),
        rrmse=error,
        crps=np.nanmean(crps_normal(*moments, measured), axis=1),
        interval_score=np.nanmean(interval_score(*band, measured, level), axis=1),
        width=_mean(band[1] - band[0], there),
        coverage=_mean(inside, there),
        coverage_strong=_mean(inside, there & strong_part(measured)),
        pit=np.array(shares),
        effective_samples=worth,
    )


def score_values(
    names: Sequence[str],
    units: Sequence[str],
    values: np.ndarray,
    measured: ArrayLike,
    level: float,
    effective_sample_size: float | None = None,
) -> QuantityScores:
    """Score predicted numbers (n, n_quantities), three samples or more, against measured ones (n_quantities,) [SI]."""
    measured, ascending = np.asarray(measured, dtype=float), np.sort(values, axis=0)
    (lower, upper), quartiles = central_interval(ascending, level), central_interval(ascending, 0.5)
    return QuantityScores(
        names=tuple(names),
        units=tuple(units),
        level=level,
        measured=measured,
        median=np.median(values, axis=0),
        lower=lower,
        upper=upper,
        crps=crps_samples(values, measured, effective_sample_size),
        interval_score=interval_score(lower, upper, measured, level),
        pit=pit_samples(values, measured),
        lower_quartile=quartiles[0],
        upper_quartile=quartiles[1],
    )


def central_interval(ascending: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends (n_quantities,) of the central interval of sorted samples (n, n_quantities), see `QuantityScores.lower`."""
    n = len(ascending)
    rank = max(1, math.ceil(0.5 * (1.0 - level) * (n + 1) - 0.5))  # as `share_within` of the PIT (rank + 0.5) / (n + 1)
    return ascending[rank - 1], ascending[n - rank]


def strong_part(measured: ArrayLike, start: float = 0.05, stop: float = 0.95) -> np.ndarray:
    """Mask of the strong part of histories (..., n_samples), NaN if missing, between two shares of the sum of squares.

    For an acceleration, the samples between 5 and 95 % make up the significant duration (M. D. Trifunac, A. G. Brady,
    1975, A study on the duration of strong earthquake ground motion, Bulletin of the Seismological Society of America
    65, 581-626).
    """
    squares = np.square(np.nan_to_num(np.asarray(measured, dtype=float)))
    share = np.cumsum(squares, axis=-1)
    total = share[..., -1:]
    return (share >= start * total) & (share - squares <= stop * total)


def _effective(errors: np.ndarray) -> np.ndarray:
    """Independent samples (n_channels,) that normalised errors are worth; 1 where they are fewer than two, or zero."""
    worth = np.ones(len(errors))
    for k, row in enumerate(errors):
        if np.isfinite(row).sum() > 1 and np.nan_to_num(row).any():
            worth[k] = effective_samples(row[None])[0]
    return worth


def _histogram(transforms: np.ndarray) -> np.ndarray:
    """Shares of PIT values in each tenth, NaN without any."""
    counts = np.histogram(transforms, _BINS, (0.0, 1.0))[0]
    return counts / len(transforms) if len(transforms) else np.full(_BINS, np.nan)


def _mean(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Mean of each row over the samples `where`, NaN without any."""
    count = where.sum(axis=1)
    return np.where(count > 0, np.where(where, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)
