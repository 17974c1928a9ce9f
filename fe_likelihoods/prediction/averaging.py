"""Bayesian model averaging of predictions.

If several models explain the data, each with its posterior probability, the prediction is the mixture of their
predictions. By the law of total variance its variance is the sum of two parts: the mean variance within the models, and
the variance between the models' means. See ``docs/theory/prediction.rst``.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .prediction import Prediction

__all__ = ["average_predictions"]


def average_predictions(predictions: Mapping[str, Prediction], probabilities: Mapping[str, float]) -> Prediction:
    """Average the predictions of several models with their probabilities as weights.

    Parameters
    ----------
    predictions : mapping of str to Prediction
        Predictions of the same quantity, by the name of the model.
    probabilities : mapping of str to float
        Posterior probabilities of the models, by the same names. They sum to one.

    Returns
    -------
    Prediction
        Mean and variance of the mixture, with the Monte Carlo error of the mean for these probabilities, and the
        findings of all. There are no quantiles and no values.

    Raises
    ------
    ValueError
        If the names differ, the probabilities are negative or do not sum to one, or the predictions differ in channels,
        step, shape, noise or the state from which they start.

    Examples
    --------
    >>> flexible = propagate(LinearOscillator(record, period=1.1), samples[:, :2])
    >>> stiff = propagate(model, samples[:, :2])
    >>> average = average_predictions({"flexible": flexible, "stiff": stiff}, {"flexible": 0.2, "stiff": 0.8})
    >>> average.mean.shape
    (2, 200)
    """
    if not predictions or set(predictions) != set(probabilities):
        raise ValueError(
            f"expected one probability for each prediction; got predictions {', '.join(predictions)}; probabilities "
            f"{', '.join(probabilities)}"
        )
    names, parts = list(predictions), list(predictions.values())
    weights = np.array([probabilities[name] for name in names], dtype=float)
    if not (np.all(weights >= 0.0) and abs(weights.sum() - 1.0) < 1e-6):
        raise ValueError(f"probabilities must be non-negative and sum to one; got {dict(probabilities)}")

    def kind(p: Prediction) -> tuple:
        return [(c.name, c.dimension) for c in p.channels], p.dt, p.mean.shape, p.noise, p.from_state

    for name, part in zip(names, parts, strict=True):
        if kind(part) != kind(parts[0]):
            raise ValueError(
                f"predictions must be of one quantity (channels, step, shape, noise, state); {names[0]!r} has "
                f"{kind(parts[0])}, {name!r} has {kind(part)}"
            )
    mean = np.tensordot(weights, [part.mean for part in parts], axes=1)
    within = np.tensordot(weights, [part.variance for part in parts], axes=1)
    between = np.tensordot(weights, [np.square(part.mean - mean) for part in parts], axes=1)
    return replace(
        parts[0],
        mean=mean,
        variance=within + between,
        standard_error=np.sqrt(np.tensordot(weights**2, [np.square(part.standard_error) for part in parts], axes=1)),
        probabilities=(),
        quantiles=np.zeros((0, *mean.shape)),
        values=None,
        n_samples=sum(part.n_samples for part in parts),
        effective_sample_size=sum(part.effective_sample_size for part in parts),
        failed=np.zeros(0, dtype=int),
        collapsed=np.zeros(0, dtype=int),
        failure_reasons={},
        findings=tuple(dict.fromkeys(each for part in parts for each in part.findings)),
    )
