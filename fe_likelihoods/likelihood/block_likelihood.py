"""Log-likelihood of the measurements in blocks of time, for leave-one-out cross-validation.

Neighbouring samples of a response have correlated errors. If single samples are left out, their neighbours predict
them, and the cross-validation measures interpolation instead of prediction. Blocks of time that are longer than the
correlation of the errors are nearly independent, and are left out as a whole [1]_.

The term of block k is log p(y_k | y_1 ... y_{k-1}, theta): the log-likelihood of the measurements up to the end of the
block, minus the log-likelihood up to its beginning. The terms add up to the log-likelihood for every noise. For white
noise the term is the log-likelihood of the block alone; for autoregressive noise only its first sample depends on the
block before it.

References
----------
.. [1] P.-C. Bürkner, J. Gabry, A. Vehtari (2020), "Approximate leave-future-out cross-validation for Bayesian time
   series models", Journal of Statistical Computation and Simulation 90(14), 2499-2523,
   doi:10.1080/00949655.2020.1783262.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..noise.gaussian import GaussianNoise
from ..noise.protocol import Noise, noise_of_part, noise_statistic
from ..noise.residuals import effective_samples
from ..noise.sample_counts import count_samples, samples_per_channel
from ..signals.channels import Measurements

__all__ = ["BlockLogLikelihood", "block_log_likelihood", "choose_blocks", "describe_blocks"]

_CORRELATION_TIMES = 5.0  # length of a block; `effective_samples` sums the correlation over the same window
_MOST_BLOCKS = 100
_ROUND_OFF = 1e-6  # in steps


class BlockLogLikelihood(NamedTuple):
    """Log-likelihood of the measurements in blocks of time.

    Attributes
    ----------
    values : ndarray, shape (n, n_blocks)
        Log-likelihood terms for n parameter samples. Their sum over the blocks is the log-likelihood.
    starts, stops : ndarray, shape (n_blocks,)
        Times of the blocks [s]: samples of all channels with start <= time < stop.
    parts : tuple of str
        For a `JointLikelihood`, the likelihood's name for each block; otherwise empty texts.
    seconds : float
        Length of the longest block [s].
    note : str
        What a block is, in words.
    """

    values: np.ndarray
    starts: np.ndarray
    stops: np.ndarray
    parts: tuple[str, ...]
    seconds: float
    note: str


def choose_blocks(
    measurements: Measurements, values: np.ndarray, residuals: np.ndarray, seconds: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Divide the time of measurements into blocks of equal length; returns their starts and stops (n_blocks,) [s].

    `values` (n_channels, n_samples) are NaN where nothing is compared. The length is `seconds`, or five correlation
    times n / n_eff (`fe_likelihoods.effective_samples`) of the residuals at a fit, in the channel where these are
    longest, with at most 100 blocks. Blocks without a sample are left out, and the first one has a sample of every
    channel. ValueError if `seconds` is not a positive number.
    """
    times = np.stack([measurements.times(channel.name) for channel in measurements.channels])
    there = ~np.isnan(values)
    first, last = times[there].min(), times[there].max()
    step = max(measurements.steps)
    duration = last - first + step
    if seconds is None:
        counts = there.sum(axis=1)
        correlated = [_correlation_time(row, n) for row, n in zip(residuals, counts, strict=True)]
        seconds = float(np.max(_CORRELATION_TIMES * np.array(correlated) * np.array(measurements.steps)))
        seconds = max(seconds, duration / _MOST_BLOCKS)
    elif not 0.0 < seconds < np.inf:
        raise ValueError(f"the length of a block must be a positive number of seconds; got {seconds!r}")
    count = max(1, round(duration / max(seconds, step)))
    edges = first + duration / count * np.arange(count + 1)
    # a sample on an edge belongs to the block after it, also with round-off
    needed = _ROUND_OFF * step + max(row[known][0] for row, known in zip(times, there, strict=True))
    edges = np.concatenate([edges[:1], edges[1:][edges[1:] > needed]])
    counts = np.histogram(times[there], edges - _ROUND_OFF * step)[0]
    return edges[:-1][counts > 0], edges[1:][counts > 0]


def _correlation_time(residuals: np.ndarray, n: int) -> float:
    """Correlation time of one channel in samples; one for a perfect fit and for a single sample."""
    if n < 2 or not np.nan_to_num(residuals).any():
        return 1.0
    return float(n / effective_samples(residuals[None])[0])


def block_log_likelihood(
    noise: Noise,
    measurements: Measurements,
    values: np.ndarray,
    residuals: np.ndarray,
    parameters: np.ndarray,
    stops: Sequence[float],
) -> np.ndarray:
    """Terms (n, n_blocks) of the log-likelihood of n samples, for blocks that end at the ascending times `stops` [s].

    Values (n_channels, n_samples) [SI], NaN where there is none, residuals (n, n_channels, n_samples) [SI] and
    parameters (n, n_noise) belong to a noise that was not integrated out.
    """
    if hasattr(noise, "log_densities"):
        return _blocks_of_samples(noise, measurements, values, residuals, parameters, stops)
    statistic = noise_statistic(noise)
    total = samples_per_channel(count_samples(values))
    sums = np.nancumsum(np.square(residuals), axis=2) if statistic is None and measurements.simultaneous else None
    round_off = _ROUND_OFF * max(measurements.steps)
    upto = np.empty((len(residuals), len(stops)))
    for block, stop in enumerate(stops):
        part, cut = _until(measurements, values, stop - round_off)
        if sums is not None:
            statistics = sums[:, :, cut - 1]
        else:
            chosen = residuals[:, :, :cut] if measurements.simultaneous else np.where(np.isnan(part), np.nan, residuals)
            reduce = _sums_of_squares if statistic is None else statistic
            statistics = np.stack([reduce(each) for each in chosen])
        counts = count_samples(part)
        noise_of_block = noise_of_part(noise, replace(measurements, values=part))
        if getattr(noise, "effective_samples", None) is not None:
            # a sample counts as much as in the whole measurements
            share = np.minimum(np.array(noise.effective_samples) / total, 1.0)
            noise_of_block = replace(noise, effective_samples=share * samples_per_channel(counts))
        upto[:, block] = noise_of_block.log_likelihood(statistics, counts, parameters)
    return np.diff(upto, axis=1, prepend=0.0)


def _blocks_of_samples(
    noise: Noise,
    measurements: Measurements,
    values: np.ndarray,
    residuals: np.ndarray,
    parameters: np.ndarray,
    stops: Sequence[float],
) -> np.ndarray:
    """Terms of blocks for a noise that has a term for each sample."""
    times = np.stack([measurements.times(channel.name) for channel in measurements.channels])
    block = np.searchsorted(np.asarray(stops) - _ROUND_OFF * max(measurements.steps), times, side="right")
    # samples after the last block, if there are any, belong to none
    terms = [
        np.bincount(block.ravel(), noise.log_densities(each, each + values, one).ravel(), minlength=len(stops) + 1)
        for each, one in zip(residuals, parameters, strict=True)
    ]
    return np.array(terms)[:, : len(stops)]


def _until(measurements: Measurements, values: np.ndarray, stop: float) -> tuple[np.ndarray, int]:
    """The samples before a time, and their number where all channels have the same times."""
    if measurements.simultaneous:
        cut = int(np.searchsorted(measurements.time, stop))
        return values[:, :cut], cut
    times = np.stack([measurements.times(channel.name) for channel in measurements.channels])
    return np.where(times < stop, values, np.nan), values.shape[1]


def _sums_of_squares(residuals: np.ndarray) -> np.ndarray:
    return np.nansum(np.square(residuals), axis=-1)


def describe_blocks(seconds: float, chosen: bool, noise: Noise) -> str:
    """What a block is, in words."""
    how = (
        "five correlation times of the residuals of the best sample (fe_likelihoods.effective_samples), or a hundredth "
        "of the measurements if that is longer"
        if chosen
        else "a length that was given"
    )
    text = (
        f"One observation is one block of time with the samples of all channels. Blocks are at most {seconds:.4g} s "
        f"long, {how}. Shorter blocks would not be independent. Compare models with equal blocks only."
    )
    return (
        text
        if isinstance(noise, GaussianNoise)
        else text + " The term of a block is conditional on the blocks before it."
    )
