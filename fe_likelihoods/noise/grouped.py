"""Gaussian errors that are independent in orthonormal coordinates, with one variance for each group of coordinates.

The coordinates are the samples themselves (`fe_likelihoods.ModulatedNoise`: groups are parts of the time) or the
coefficients of an orthonormal transform (`fe_likelihoods.BandNoise`: groups are bands of frequency). An orthonormal
transform keeps sums of squares and has a Jacobian of one, so the density of the coefficients is that of the samples.
Of each group the number of coordinates, the sum of squared residuals and, for a variance that depends on the response,
the sum of squares of the response are sufficient.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .gaussian import HALF_LOG_TWO_PI
from .sample_counts import SampleCounts, samples_per_channel

__all__ = ["MeasuredLayout", "grouped_log_likelihood", "per_channel", "split_sums", "without_layout"]


class MeasuredLayout(NamedTuple):
    """Times of the measured samples, and the number of coordinates in each group.

    Attributes
    ----------
    steps, starts : tuple of float
        Time step and time of the first sample of each channel [s].
    counts : tuple of tuple of int, (n_groups, n_channels)
        Number of coordinates of each channel in each group.
    """

    steps: tuple[float, ...]
    starts: tuple[float, ...]
    counts: tuple[tuple[int, ...], ...]


def without_layout(noise: object) -> ValueError:
    """The error for a noise that does not know the times of the measurements."""
    return ValueError(
        f"{type(noise).__name__} needs the times of the samples: take the noise of a likelihood, FELikelihood(model, "
        "measurements, noise).noise, or noise.with_measurements(measurements)"
    )


def per_channel(dt: float | Sequence[float], n_channels: int) -> tuple[float, ...]:
    """One time step [s] for each channel."""
    return tuple(np.broadcast_to(np.asarray(dt, dtype=float), n_channels).tolist())


def split_sums(statistics: np.ndarray, counts: np.ndarray) -> list[np.ndarray]:
    """Sums of each kind (n, n_groups, n_channels) from statistics (n, n_numbers): of the residuals, of the response.

    The first numbers, the sums of squared residuals over all samples, are left out: those of the groups add up to them.
    """
    n_groups, n_channels = counts.shape
    statistics = np.asarray(statistics, dtype=float)
    rows = statistics.reshape(len(statistics), statistics.shape[1] // n_channels, n_channels)[:, 1:]
    return [rows[:, first : first + n_groups] for first in range(0, rows.shape[1], n_groups)]


def grouped_log_likelihood(
    squares: np.ndarray, counts: np.ndarray, deviations: np.ndarray, n_samples: int | SampleCounts
) -> np.ndarray:
    """Log-likelihood of residuals whose groups have different standard deviations.

    Parameters
    ----------
    squares : (n, n_groups, n_channels) float
        Sums of squared coordinates of the residuals [SI unit of the channel, squared].
    counts : (n_groups, n_channels) int
        Number of coordinates in each group; an empty group has no influence.
    deviations : (n, n_groups, n_channels) float
        Standard deviations [SI unit of the channel]; NaN for impossible parameters.
    n_samples : int or SampleCounts
        Number of measured samples, which must be that of the coordinates.

    Returns
    -------
    (n,) float
        -inf where a standard deviation is not positive and finite, or a sum is not finite; never NaN.

    Raises
    ------
    ValueError
        If the numbers of samples and of coordinates differ.
    """
    if not np.array_equal(counts.sum(axis=0), np.broadcast_to(samples_per_channel(n_samples), counts.shape[1])):
        raise ValueError(
            f"the noise is for {counts.sum(axis=0).tolist()} samples per channel, the measurements have "
            f"{samples_per_channel(n_samples)}: take the noise of a likelihood of these measurements"
        )
    with np.errstate(all="ignore"):
        # the ratio is squared instead of the standard deviation, whose square may underflow
        ratio = np.sqrt(squares) / deviations
        terms = -counts * (HALF_LOG_TWO_PI + np.log(deviations)) - 0.5 * ratio * ratio
    possible = (deviations > 0.0) & (deviations < np.inf) & np.isfinite(squares)
    terms = np.where(possible, np.where(counts > 0, terms, 0.0), -np.inf)
    return terms.sum(axis=(1, 2))
