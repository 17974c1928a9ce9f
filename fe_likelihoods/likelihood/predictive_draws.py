"""Measurements and replicated measurements, as exchange formats such as arviz need them.

Samplers know no structures. They ask a posterior for these plain arrays by the names of its methods.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..noise.draws import SampleNoise, sample_noise
from ..noise.marginal import MarginalNoise
from ..noise.protocol import Noise, noise_statistic
from ..noise.statistics import needs_response
from ..signals.channels import Channel
from ..signals.comparison import Comparison
from ..simulation.model import SimulationFailed
from .likelihood import FELikelihood
from .sum_of_parts import SumOfParts

__all__ = ["MeasuredHistory", "measured_data", "predictive_draws"]


class MeasuredHistory(NamedTuple):
    """One measured channel.

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


def measured_data(likelihood: SumOfParts) -> tuple[MeasuredHistory, ...]:
    """Measurements of a likelihood; nothing is simulated."""
    found = []
    for prefix, each, _ in _named_parts(likelihood):
        for channel, row in zip(each.measurements.channels, _compared(each), strict=True):
            there, times = ~np.isnan(row), each.measurements.times(channel.name)
            found.append(MeasuredHistory(f"{prefix}{channel.name}", channel, times[there], row[there]))
    return tuple(found)


def predictive_draws(likelihood: SumOfParts, samples: np.ndarray, seed: int = 0) -> dict[str, np.ndarray]:
    """Replicated measurements (n, n_samples) by the names of `MeasuredHistory`, see `Posterior.predictive_draws`."""
    samples = np.atleast_2d(np.asarray(samples, dtype=float))
    if samples.shape[1] != likelihood.ndim or not len(samples):
        raise ValueError(f"expected samples of shape (n, {likelihood.ndim}); got {samples.shape}")
    rng, found = np.random.default_rng(seed), {}
    for prefix, each, columns in _named_parts(likelihood):
        noise, rows = _with_noise_parameters(each, samples[:, columns], rng)
        simulated, values = _responses(each, rows), _compared(each)
        errors = _errors(each, noise, rows[:, len(each.model.parameter_names) :], simulated, rng)
        if errors is not None:
            errors -= np.stack([each.residuals_of(response) for response in simulated])
            for place, channel in enumerate(each.measurements.channels):
                there = ~np.isnan(values[place])
                found[f"{prefix}{channel.name}"] = (values[place] + errors[:, place])[:, there]
    return found


def _named_parts(likelihood: SumOfParts) -> Iterator[tuple[str, FELikelihood, list[int]]]:
    for key, (part, columns) in zip(likelihood.likelihoods, likelihood.parts(), strict=True):
        yield f"{key}_" if key else "", part, columns


def _compared(likelihood: FELikelihood) -> np.ndarray:
    """The samples that are compared (n_channels, n_samples) [SI], NaN where there is none."""
    return getattr(likelihood.measured, "values", likelihood.measured)


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
    measured, apart = likelihood.measured, isinstance(likelihood.measured, Comparison)
    follows = needs_response(noise_statistic(noise))
    if follows:
        drawn = sample_noise(noise, parameters, n_channels, likelihood.model.dt, at_samples=True)
        if apart:
            at_samples = (measured.at_samples(response) for response in responses)
            responses = np.stack([np.where(measured.missing, np.nan, each) for each in at_samples])
    elif hasattr(noise, "deviations_per_event"):
        deviations = np.nan_to_num(noise.deviations_per_event(parameters))
        drawn = SampleNoise(deviations, None, tuple(slice(*window) for window in noise.statistic.windows))
    elif hasattr(noise, "standard_deviations"):
        drawn = sample_noise(noise, parameters, n_channels, likelihood.model.dt)
    else:
        return None
    if (of_response := drawn.of_response) and not follows and apart:

        def between(parameters: np.ndarray, response: np.ndarray) -> np.ndarray:
            """Deviations at the steps of the model, then at the samples, where interpolation may overshoot."""
            return np.maximum(measured.at_samples(np.ascontiguousarray(of_response(parameters, response))), 0.0)

        drawn = drawn._replace(of_response=between)
    return np.stack([drawn.draw(row, n_samples, rng, response) for row, response in enumerate(responses)])
