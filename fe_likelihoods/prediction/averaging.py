"""Bayesian model averaging of predictions.

Where several models explain the data, each with its posterior probability, the prediction is their mixture. Its
variance has two parts, by the law of total variance: what each model does not know of itself, and that the models
differ.

References
----------
Hoeting, Madigan, Raftery & Volinsky (1999), Stat. Sci. 14(4), 382-417, doi:10.1214/ss/1009212519
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..signals.channels import Channel
from .propagation import Prediction

__all__ = ["AveragedPrediction", "average_predictions"]


class AveragedPrediction(NamedTuple):
    """Prediction averaged over models (Bayesian model averaging).

    Attributes
    ----------
    mean, variance : (*shape) float — of the mixture: ``variance = within + between``.
    within : (*shape) float — mean of the models' variances.
    between : (*shape) float — variance of the models' means.
    standard_error : (*shape) float — Monte-Carlo error of `mean`, the probabilities taken as given.
    probabilities : dict of str to float
    channels : tuple of Channel
    dt : float or None
    """

    mean: np.ndarray
    variance: np.ndarray
    within: np.ndarray
    between: np.ndarray
    standard_error: np.ndarray
    probabilities: dict[str, float]
    channels: tuple[Channel, ...]
    dt: float | None

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation, (*shape)."""
        return np.sqrt(self.variance)


def average_predictions(
    predictions: Mapping[str, Prediction], probabilities: Mapping[str, float]
) -> AveragedPrediction:
    """Average the predictions of several models, weighted by the models' probabilities.

    Parameters
    ----------
    predictions : by the model's name, of one and the same quantity.
    probabilities : by the same names, summing to one.

    Raises
    ------
    ValueError
        If the names differ, the probabilities are none, or the predictions differ in channels, step, shape or noise.
    """
    if not predictions or set(predictions) != set(probabilities):
        raise ValueError(
            f"one probability for each prediction is needed; predictions: {', '.join(predictions)}; probabilities: "
            f"{', '.join(probabilities)}"
        )
    names, parts = list(predictions), list(predictions.values())
    weights = np.array([probabilities[name] for name in names], dtype=float)
    if not (np.all(weights >= 0.0) and abs(weights.sum() - 1.0) < 1e-6):
        raise ValueError(f"probabilities must be non-negative and sum to one; got {dict(probabilities)}")

    def kind(p: Prediction) -> tuple:
        return [(c.name, c.dimension) for c in p.channels], p.dt, p.mean.shape, p.noise

    for name, part in zip(names, parts, strict=True):
        if kind(part) != kind(parts[0]):
            raise ValueError(
                f"predictions must be of one quantity (channels, step, shape, noise): {names[0]!r} is of "
                f"{kind(parts[0])}, {name!r} of {kind(part)}"
            )
    mean = np.tensordot(weights, [part.mean for part in parts], axes=1)
    within = np.tensordot(weights, [part.variance for part in parts], axes=1)
    between = np.tensordot(weights, [np.square(part.mean - mean) for part in parts], axes=1)
    error = np.sqrt(np.tensordot(weights**2, [np.square(part.standard_error) for part in parts], axes=1))
    known = dict(zip(names, weights.tolist(), strict=True))
    return AveragedPrediction(mean, within + between, within, between, error, known, parts[0].channels, parts[0].dt)
