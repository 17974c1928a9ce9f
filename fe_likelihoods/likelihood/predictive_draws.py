"""Measurements, replicated measurements and the log-likelihood of blocks, as exchange formats such as arviz need them.

Samplers know no structures. They ask a posterior for these plain arrays by the names of its methods.

Blocks are for leave-one-out cross-validation. Neighbouring samples of a response have correlated errors. If single
samples are left out, their neighbours predict them, and the cross-validation measures interpolation instead of
prediction. Blocks of time that are longer than the correlation of the errors are nearly independent, and are left out
as a whole [1]_.

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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..noise.draws import SampleNoise, sample_noise
from ..noise.gaussian import GaussianNoise
from ..noise.marginal import MarginalNoise
from ..noise.protocol import Noise, noise_of_part, noise_statistic, noise_title
from ..noise.residuals import effective_samples
from ..noise.sample_counts import count_samples, samples_per_channel
from ..signals.channels import Channel, Measurements
from ..signals.comparison import Comparison
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .likelihood import FELikelihood
from .sum_of_parts import SumOfParts

__all__ = [
    "BlockLogLikelihood",
    "MeasuredData",
    "MeasuredHistory",
    "PredictiveDraws",
    "choose_blocks",
    "measured_data",
    "predictive_draws",
]

_CORRELATION_TIMES = 5.0  # length of a block; `effective_samples` sums the correlation over the same window
_MOST_BLOCKS = 100
_ROUND_OFF = 1e-6  # in steps


class MeasuredHistory(NamedTuple):
    """One measured channel, or one component of the excitation.

    Attributes
    ----------
    name : str
        Name of the channel; with the name of its likelihood before it for a `JointLikelihood`.
    channel : Channel
        Quantity and units; `values` are in ``channel.si_unit``.
    time : ndarray, shape (n_samples,)
        Times [s].
    values : ndarray, shape (n_samples,)
        Samples [SI], without missing ones.
    """

    name: str
    channel: Channel
    time: np.ndarray
    values: np.ndarray


class MeasuredData(NamedTuple):
    """What a posterior was conditioned on.

    Attributes
    ----------
    channels : tuple of MeasuredHistory
        The measurements.
    excitations : tuple of MeasuredHistory
        Records of the excitation, where the model has any.
    time_steps : dict of str to float
        Time step of each channel [s].
    """

    channels: tuple[MeasuredHistory, ...]
    excitations: tuple[MeasuredHistory, ...]
    time_steps: dict[str, float]


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


class PredictiveDraws(NamedTuple):
    """Predictions of the measurements by samples of the posterior.

    Attributes
    ----------
    responses : dict of str to ndarray, shape (n, n_samples)
        Simulated response at the measured samples [SI], by the names of `MeasuredHistory`.
    replicates : dict of str to ndarray, shape (n, n_samples)
        Response plus one draw of the noise: measurements that the sample predicts [SI]. Empty where the noise cannot be
        drawn from.
    blocks : BlockLogLikelihood
        Log-likelihood in blocks of time.
    notes : tuple of str
        What is left out, and why.
    """

    responses: dict[str, np.ndarray]
    replicates: dict[str, np.ndarray]
    blocks: BlockLogLikelihood
    notes: tuple[str, ...]


def measured_data(likelihood: SumOfParts) -> MeasuredData:
    """Measurements and excitation of a likelihood; nothing is simulated."""
    channels, excitations, steps = [], [], {}
    for prefix, each, _ in _named_parts(likelihood):
        for channel, step, row in zip(
            each.measurements.channels, each.measurements.steps, _compared(each), strict=True
        ):
            there, name = ~np.isnan(row), f"{prefix}{channel.name}"
            channels.append(MeasuredHistory(name, channel, each.measurements.times(channel.name)[there], row[there]))
            steps[name] = float(step)
        for key, record in _records_of(each.model):
            channel = Channel(key, "acceleration", "m/s2")
            excitations.append(MeasuredHistory(f"{prefix}{key}", channel, record.time, record.acceleration))
    return MeasuredData(tuple(channels), tuple(excitations), steps)


def predictive_draws(
    likelihood: SumOfParts, samples: np.ndarray, block: float | None = None, seed: int = 0
) -> PredictiveDraws:
    """Responses, replicated measurements and block log-likelihood of samples, see `Posterior.predictive_draws`."""
    samples = np.atleast_2d(np.asarray(samples, dtype=float))
    if samples.shape[1] != likelihood.ndim or not len(samples):
        raise ValueError(f"expected samples of shape (n, {likelihood.ndim}); got {samples.shape}")
    rng = np.random.default_rng(seed)
    responses: dict[str, np.ndarray] = {}
    replicates: dict[str, np.ndarray] = {}
    notes, blocks = [], []
    for prefix, each, columns in _named_parts(likelihood):
        noise, rows = _with_noise_parameters(each, samples[:, columns], rng)
        simulated, values = _responses(each, rows), _compared(each)
        residuals = -np.stack([each.residuals_of(response) for response in simulated])
        parameters = rows[:, len(each.model.parameter_names) :]
        errors = _errors(each, noise, parameters, simulated, rng)
        if errors is None:
            notes.append(f"{prefix}no replicated measurements: {noise_title(noise)} cannot be drawn from")
        for place, channel in enumerate(each.measurements.channels):
            there, name = ~np.isnan(values[place]), f"{prefix}{channel.name}"
            responses[name] = (residuals[:, place] + values[place])[:, there]
            if errors is not None:
                replicates[name] = responses[name] + errors[:, place, there]
        blocks.append(_blocks(each, noise, residuals, parameters, block, prefix.rstrip("_")))
    joined = BlockLogLikelihood(
        np.concatenate([each.values for each in blocks], axis=1),
        np.concatenate([each.starts for each in blocks]),
        np.concatenate([each.stops for each in blocks]),
        tuple(name for each in blocks for name in each.parts),
        max(each.seconds for each in blocks),
        max((each.note for each in blocks), key=len),
    )
    return PredictiveDraws(responses, replicates, joined, tuple(notes))


def _named_parts(likelihood: SumOfParts) -> Iterator[tuple[str, FELikelihood, list[int]]]:
    for key, (part, columns) in zip(likelihood.likelihoods, likelihood.parts(), strict=True):
        yield f"{key}_" if key else "", part, columns


def _compared(likelihood: FELikelihood) -> np.ndarray:
    """The samples that are compared (n_channels, n_samples) [SI], NaN where there is none."""
    return getattr(likelihood.measured, "values", likelihood.measured)


def _records_of(model: object) -> list[tuple[str, Record]]:
    found = []
    for name in ("record", "vertical", "loading", "supports"):  # of the models of this package; optional in others
        excitation = getattr(model, name, None)
        several = isinstance(excitation, tuple | list)
        for place, each in enumerate(excitation if several else (excitation,)):
            if isinstance(each, Record):
                found.append((f"{name}_{place}" if several else name, each))
    return found


def _with_noise_parameters(
    likelihood: FELikelihood, rows: np.ndarray, rng: np.random.Generator
) -> tuple[Noise, np.ndarray]:
    """The noise, and rows with its parameters: integrated-out parameters are drawn."""
    if not isinstance(likelihood.noise, MarginalNoise):
        return likelihood.noise, rows
    return likelihood.noise.noise, np.stack(list(likelihood.draw_noise(rows, rng).values()), axis=1)


def _responses(likelihood: FELikelihood, rows: np.ndarray) -> np.ndarray:
    """Simulated response of each row at the steps of the model, (n, n_channels, n_steps) [SI]."""
    batch = likelihood.simulate(rows[:, : len(likelihood.model.parameter_names)])
    if failed := [reason for reason in batch.reasons if reason]:
        raise SimulationFailed(
            f"{len(failed)} of {len(rows)} samples of the posterior cannot be simulated; the first reason: "
            f"{failed[0]}. Leave these samples out, or simulate again if the cause was not the model"
        )
    return batch.response


def _errors(
    likelihood: FELikelihood,
    noise: Noise,
    parameters: np.ndarray,
    responses: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """One draw of the errors per row, (n, n_channels, n_samples) [SI]; None for a noise that cannot be drawn from."""
    n_channels, n_samples = _compared(likelihood).shape
    if hasattr(noise, "log_densities"):
        drawn = sample_noise(noise, parameters, n_channels, likelihood.model.dt, at_samples=True)
        responses = np.stack([_at_samples(likelihood, response) for response in responses])
    elif hasattr(noise, "deviations_per_event"):
        deviations = np.nan_to_num(noise.deviations_per_event(parameters))
        drawn = SampleNoise(deviations, None, tuple(slice(*window) for window in noise.statistic.windows))
    elif hasattr(noise, "standard_deviations"):
        drawn = sample_noise(noise, parameters, n_channels, likelihood.model.dt)
    else:
        return None
    if drawn.of_response and not hasattr(noise, "log_densities") and isinstance(likelihood.measured, Comparison):
        # deviations at the steps of the model, then at the times of the samples, where interpolation may overshoot
        drawn = drawn._replace(of_response=partial(_deviations_at_samples, likelihood.measured, drawn.of_response))
    return np.stack([drawn.draw(row, n_samples, rng, response) for row, response in enumerate(responses)])


def _at_samples(likelihood: FELikelihood, response: np.ndarray) -> np.ndarray:
    """A response at the measured samples (n_channels, n_samples) [SI], NaN where one is missing."""
    if not isinstance(likelihood.measured, Comparison):
        return response
    return np.where(likelihood.measured.missing, np.nan, likelihood.measured.at_samples(response))


def _deviations_at_samples(
    comparison: Comparison,
    of_response: Callable[[np.ndarray, np.ndarray], np.ndarray],
    parameters: np.ndarray,
    response: np.ndarray,
) -> np.ndarray:
    return np.maximum(comparison.at_samples(np.ascontiguousarray(of_response(parameters, response))), 0.0)


# blocks of time -------------------------------------------------------------------------------------------------------


def _blocks(
    likelihood: FELikelihood,
    noise: Noise,
    residuals: np.ndarray,
    parameters: np.ndarray,
    seconds: float | None,
    name: str,
) -> BlockLogLikelihood:
    """Terms of n samples with residuals (n, n_channels, n_samples) [SI] and parameters (n, n_noise) of the noise."""
    values, measurements = _compared(likelihood), likelihood.measurements
    terms = partial(_terms, noise, measurements, values, residuals, parameters)
    total = terms([np.inf])
    if likelihood.is_modal:  # no blocks of time: the samples of a mode belong together
        return BlockLogLikelihood(total, np.zeros(1), np.ones(1), (name,), 1.0, "all modes are one block")
    starts, stops = choose_blocks(measurements, values, residuals[np.argmax(total)], seconds)
    how = "a length that was given"
    if seconds is None:
        how = "five correlation times of the residuals of the best sample (fe_likelihoods.effective_samples), or a "
        how += "hundredth of the measurements if that is longer"
    longest = float(np.max(stops - starts))
    note = (
        f"One observation is one block of time with the samples of all channels. Blocks are at most {longest:.4g} s "
        f"long, {how}. Shorter blocks would not be independent. Compare models with equal blocks only."
    )
    if not isinstance(noise, GaussianNoise):
        note += " The term of a block is conditional on the blocks before it."
    return BlockLogLikelihood(terms(stops), starts, stops, (name,) * len(stops), longest, note)


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


def _terms(
    noise: Noise,
    measurements: Measurements,
    values: np.ndarray,
    residuals: np.ndarray,
    parameters: np.ndarray,
    stops: Sequence[float],
) -> np.ndarray:
    """Terms (n, n_blocks) of the log-likelihood of n samples, for blocks that end at the ascending times `stops` [s].

    Values (n_channels, n_samples) [SI] are NaN where there is none.
    """
    times = np.stack([measurements.times(channel.name) for channel in measurements.channels])
    stops = np.asarray(stops) - _ROUND_OFF * max(measurements.steps)
    if hasattr(noise, "log_densities"):  # a term for each sample; samples after the last block belong to none
        block = np.searchsorted(stops, times, side="right").ravel()
        densities = [noise.log_densities(r, r + values, one) for r, one in zip(residuals, parameters, strict=True)]
        return np.array([np.bincount(block, each.ravel(), len(stops) + 1)[:-1] for each in densities])
    statistic, same_times = noise_statistic(noise), measurements.simultaneous
    total = samples_per_channel(count_samples(values))
    sums = np.nancumsum(np.square(residuals), axis=2) if statistic is None and same_times else None
    upto = np.empty((len(residuals), len(stops)))
    for block, stop in enumerate(stops):
        if same_times:
            cut = int(np.searchsorted(measurements.time, stop))
            part, chosen = values[:, :cut], residuals[:, :, :cut]
        else:
            part = np.where(times < stop, values, np.nan)
            chosen = np.where(np.isnan(part), np.nan, residuals)
        if sums is not None:
            statistics = sums[:, :, cut - 1]
        elif statistic is None:
            statistics = np.nansum(np.square(chosen), axis=-1)
        else:
            statistics = np.stack([statistic(each) for each in chosen])
        counts = count_samples(part)
        noise_of_block = noise_of_part(noise, replace(measurements, values=part))
        if getattr(noise, "effective_samples", None) is not None:
            # a sample counts as much as in the whole measurements
            share = np.minimum(np.array(noise.effective_samples) / total, 1.0)
            noise_of_block = replace(noise, effective_samples=share * samples_per_channel(counts))
        upto[:, block] = noise_of_block.log_likelihood(statistics, counts, parameters)
    return np.diff(upto, axis=1, prepend=0.0)
