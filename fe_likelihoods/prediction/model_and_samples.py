"""Inputs of a prediction: the model and the noise to predict with, and the parameters in the samples."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..noise.draws import SampleNoise, sample_noise
from ..noise.gaussian import GaussianNoise
from ..noise.marginal import sampled_noise
from ..noise.protocol import noise_title
from ..priors.points import as_points
from ..signals.events import find_events
from ..simulation.executors import as_executor
from ..simulation.model import Model
from .model_error import ModelError, model_error

__all__ = [
    "PredictionSource",
    "distinct_rows",
    "one_data_set",
    "read_source",
    "split_samples",
]


class PredictionSource(NamedTuple):
    """What a prediction is made with; a bare model has no noise and no likelihood."""

    model: Model
    noise: Any  # for a noise that was integrated out, the noise with its parameters
    likelihood: FELikelihood | None
    executor: Any  # where simulations run, None: in this process


def read_source(posterior_or_model: Any, pool: Any = None) -> PredictionSource:
    """Model, noise, likelihood and executor (default: the likelihood's pool) of a posterior, likelihood or model.

    ValueError if the object is none of the three.
    """
    likelihood = getattr(posterior_or_model, "likelihood", posterior_or_model)
    if hasattr(likelihood, "measurements") and hasattr(likelihood, "model"):
        executor = getattr(likelihood, "pool", None) if pool is None else as_executor(pool, likelihood.model)
        return PredictionSource(likelihood.model, sampled_noise(likelihood.noise), likelihood, executor)
    if not (hasattr(posterior_or_model, "simulate") and hasattr(posterior_or_model, "parameter_names")):
        raise ValueError(
            f"expected a Posterior, an FELikelihood or a model with simulate(theta); got {posterior_or_model!r}"
        )
    return PredictionSource(posterior_or_model, None, None, as_executor(pool, posterior_or_model))


def one_data_set(posterior_or_model: Any, samples: Any, data_set: str | None, noise: bool) -> tuple[Any, Any]:
    """The likelihood named `data_set` of a `JointLikelihood` and its samples; anything else as it is given.

    `noise` says whether the noise parameters are needed. ValueError if there is one model and `data_set` is given, or
    several and it is not.
    """
    likelihood = getattr(posterior_or_model, "likelihood", posterior_or_model)
    if not isinstance(likelihood, JointLikelihood):
        if data_set is not None:
            raise ValueError(f"data_set={data_set!r} is for a JointLikelihood; leave it out")
        return posterior_or_model, samples
    if data_set is None:
        raise ValueError(
            f"a prediction is of one model: give data_set= one of {', '.join(map(repr, likelihood.likelihoods))}"
        )
    return likelihood[data_set], likelihood.samples_of(data_set, samples, noise)


def split_samples(
    source: PredictionSource, samples: Any, noise: bool | str, other_record: bool = False
) -> tuple[np.ndarray, SampleNoise | ModelError | None]:
    """Structural parameters (n, n_structural) of samples, and the noise or model error of each if wanted, else None.

    `noise` is whether the noise is wanted; the name of an event for the noise that was calibrated with it
    (``groups="event"``); or "model" for the `model_error` alone. Without it, samples may be structural parameters
    alone. `other_record` says that the record is not the likelihood's. ValueError for samples of another shape, not
    finite, or with an impossible noise, and if the model is bare or the noise has no ``standard_deviations``.
    """
    model, noise_model = source.model, source.noise
    structural = tuple(model.parameter_names)
    names = structural + (() if noise_model is None else tuple(noise_model.parameter_names))
    if noise and noise_model is None:
        raise ValueError("noise=True needs a posterior, whose samples have the parameters of the noise; got a model")
    width = len(samples) if isinstance(samples, Mapping) else np.shape(samples)[-1:]
    structural_only = width in (len(structural), (len(structural),))
    if noise and structural_only and len(structural) < len(names):
        raise ValueError(
            f"noise={noise!r} needs {', '.join(names[len(structural) :])} of each sample; got only the "
            f"{len(structural)} structural parameters. Give all columns of the chain, or posterior.draw_noise(samples) "
            "where the noise was integrated out"
        )
    try:
        points = as_points(samples, structural if structural_only else names)
    except TypeError as error:
        raise ValueError(f"samples must be numbers, (n, {len(names)}): {error}") from error
    if points.ndim != 2 or len(points) == 0:
        raise ValueError(
            f"expected samples of shape (n, {len(names)}), as sampler.get_chain(flat=True) returns; got {points.shape}"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ValueError(
            f"samples must be finite: {bad.size} of {len(points)} are not, the first is sample {bad[0]}: "
            f"{points[bad[0]]}; leave them out"
        )
    thetas = points[:, : len(structural)]
    if not noise:
        return thetas, None
    parameters = points[:, len(structural) :]
    if hasattr(noise_model, "deviations_per_event"):
        return thetas, _noise_of_events(noise_model, parameters, model, noise, other_record)
    if isinstance(noise, str) and noise != "model":
        raise ValueError(
            f"noise={noise!r} names an event, and {noise_title(noise_model)} has no levels per event; give noise=True"
        )
    whole = sample_noise(noise_model, parameters, len(model.channels), model.dt)  # refuses impossible parameters
    return thetas, model_error(noise_model, parameters, model.dt) if noise == "model" else whole


def distinct_rows(thetas: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """The distinct rows, and the indices of the samples that each of them stands for."""
    distinct, row_of_sample, counts = np.unique(thetas, axis=0, return_inverse=True, return_counts=True)
    return distinct, np.split(np.argsort(row_of_sample.ravel(), kind="stable"), np.cumsum(counts)[:-1])


def _noise_of_events(
    noise_model: GaussianNoise, parameters: np.ndarray, model: Model, noise: bool | str, other_record: bool
) -> SampleNoise:
    """Noise with levels per event: each level at its steps, or one event's levels at all steps."""
    known = [each.name for each in noise_model.events]
    names = ", ".join(map(repr, known))
    rows = [[channel.name for channel in noise_model.channels].index(channel.name) for channel in model.channels]
    deviations = noise_model.deviations_per_event(parameters)[:, :, rows]
    if not (deviations[~np.isnan(deviations)] > 0.0).all() or np.isinf(deviations).any():
        raise ValueError("the noise needs positive standard deviations; some samples have others")
    if not isinstance(noise, str):
        events = find_events(model)
        if other_record or events is None or list(events.names) != known:
            raise ValueError(
                "the noise has levels per event, and the prediction is of another record: give the event whose levels "
                f"hold for it, noise= one of {names}"
            )
        steps = [(each.start / model.dt, each.end / model.dt) for each in events.windows]
        events = tuple(slice(math.ceil(start - 1e-6), math.floor(end + 1e-6) + 1) for start, end in steps)
        return SampleNoise(np.nan_to_num(deviations), None, events)
    if noise not in known:
        raise ValueError(f"noise={noise!r} is no event of the noise; give one of {names}")
    chosen = deviations[:, known.index(noise)]
    if np.isnan(chosen).any():
        without = [c.name for c, values in zip(model.channels, chosen.T, strict=True) if np.isnan(values).any()]
        raise ValueError(
            f"the channels {', '.join(without)} were not measured in {noise!r}, so their noise is not known; give "
            f"another event of {names}, or noise=False"
        )
    return SampleNoise(chosen, None)
