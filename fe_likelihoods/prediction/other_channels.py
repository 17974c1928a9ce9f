"""Predictions of channels that were not measured, with noise from the measured channels.

A calibrated model predicts every floor of a building, but the posterior has noise parameters for the measured floors
only. An unmeasured channel gets the mean noise parameters of the measured channels with the same quantity. This is an
assumption: the calibration has made the error of the model small at the measured channels only.
"""

from typing import Any

import numpy as np

from ..likelihood.check_inputs import check_model
from ..noise.protocol import noise_channels, noise_title, noise_under
from ..priors.points import as_points
from ..simulation.model import Model
from .model_and_samples import PredictionSource, split_samples

__all__ = ["predict_channels_of"]


def predict_channels_of(
    model: Model, source: PredictionSource, samples: Any, noise: bool | str
) -> tuple[PredictionSource, Any]:
    """Source and samples with which a posterior predicts the channels of another model that has the same parameters.

    The samples get the noise parameters of these channels, if the noise is wanted (`noise` as for `split_samples`).
    ValueError if there is no likelihood; the model has other parameters; or, if the noise is wanted, a channel shares
    its quantity with no measured channel, a measured channel has another quantity, or the noise has no method
    ``with_channels``.
    """
    if source.likelihood is None:
        raise ValueError(
            "channels_of= predicts other channels of a posterior or likelihood; to predict with a model, give it alone"
        )
    check_model(model)
    names, own = tuple(model.parameter_names), tuple(source.model.parameter_names)
    if names != own:
        raise ValueError(
            f"channels_of= must have the parameters of the calibrated model in the same order, {', '.join(own)}; got "
            f"{', '.join(names)}"
        )
    if not noise:
        return source._replace(model=model), samples
    thetas, _ = split_samples(source, samples, noise)
    calibrated = source.noise
    if not hasattr(calibrated, "with_channels"):
        raise ValueError(
            f"{noise_title(calibrated)} does not say what the noise of other channels is: give it a method "
            "with_channels(channels, weights), see fe_likelihoods.noise.protocol.Noise, or predict with noise=False"
        )
    other, of_parameters = calibrated.with_channels(model.channels, _weights(model, source))
    points = as_points(samples, own + tuple(calibrated.parameter_names))
    samples = np.hstack([thetas, points[:, len(own) :] @ of_parameters.T])
    return source._replace(model=model, noise=noise_under(other, model)), samples


def _weights(model: Model, source: PredictionSource) -> np.ndarray:
    """Weights (n_channels, n_measured) of the measured channels in each channel of a model."""
    measured = noise_channels(source.noise, source.model.channels)
    rows = {channel.name: k for k, channel in enumerate(measured)}
    weights = np.zeros((len(model.channels), len(measured)))
    for row, channel in zip(weights, model.channels, strict=True):
        if channel.name in rows:
            known = measured[rows[channel.name]]
            if known.quantity != channel.quantity:
                raise ValueError(
                    f"the channel {channel.name!r} of channels_of= is {channel.quantity!r}, and was calibrated as "
                    f"{known.quantity!r}: give it another name"
                )
            row[rows[channel.name]] = 1.0
            continue
        alike = [k for k, known in enumerate(measured) if known.quantity == channel.quantity]
        if not alike:
            raise ValueError(
                f"the noise of the channel {channel.name!r} is not known: no measured channel is {channel.quantity!r}; "
                f"measured are {', '.join(f'{each.name} ({each.quantity})' for each in measured)}. Leave the channel "
                "out of channels_of=, or predict with noise=False"
            )
        row[alike] = 1.0 / len(alike)
    return weights
