"""Bayesian model averaging of predictions.

If several models explain the data, each with its posterior probability, the prediction is the mixture of their
predictions. By the law of total variance its variance is the sum of two parts: the mean variance within the models, and
the variance between the models' means. See ``docs/theory/prediction.rst``.

References
----------
J. A. Hoeting, D. Madigan, A. E. Raftery, C. T. Volinsky (1999), Bayesian model averaging: a tutorial, Statistical
Science 14(4), 382-417, doi:10.1214/ss/1009212519.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..checks.finding import Finding, labelled
from ..signals.channels import Channel
from ..text_tables import number, text_table
from ..units import from_si
from .prediction import Prediction

__all__ = ["AveragedPrediction", "average_predictions"]


class AveragedPrediction(NamedTuple):
    """Prediction averaged over models (Bayesian model averaging).

    Attributes
    ----------
    mean : ndarray, shape (...)
        Mean of the mixture.
    variance : ndarray, shape (...)
        Variance of the mixture, ``within + between``.
    within : ndarray, shape (...)
        Mean of the models' variances.
    between : ndarray, shape (...)
        Variance of the models' means.
    standard_error : ndarray, shape (...)
        Monte Carlo error of `mean` for the given probabilities.
    probabilities : dict of str to float
        Probabilities of the models.
    channels : tuple of Channel
        Channels of the predictions.
    dt : float or None
        Time step of histories [s], None for other quantities.
    findings : tuple of Finding
        What speaks against the predictions, each finding once.
    """

    mean: np.ndarray
    variance: np.ndarray
    within: np.ndarray
    between: np.ndarray
    standard_error: np.ndarray
    probabilities: dict[str, float]
    channels: tuple[Channel, ...]
    dt: float | None
    findings: tuple[Finding, ...] = ()

    def __str__(self) -> str:
        shares = ", ".join(f"{name} {share:.2f}" for name, share in self.probabilities.items())
        what = "values" if self.dt is None else "histories, the sample with the largest mean"
        known = len(self.channels) == (self.mean.size if self.dt is None else len(self.mean))
        arrays = [np.atleast_1d(each) for each in (self.mean, self.sd, self.within, self.between)]
        if self.dt is not None:
            at = np.abs(self.mean).argmax(axis=1)[:, None]
            arrays = [np.take_along_axis(each, at, axis=1) for each in arrays]
        rows = [("value", "unit", "mean", "sd", "within models", "between models")]
        for k, (mean, sd, within, between) in enumerate(zip(*map(np.ravel, arrays), strict=True)):
            name, unit = (self.channels[k].name, self.channels[k].unit) if known else (f"{k}", "SI")
            shown = [x if unit == "SI" else from_si(x, unit) for x in (mean, sd, np.sqrt(within), np.sqrt(between))]
            rows.append((name, unit, *map(number, shown)))
        first = f"Average of the models {shares}; {what}; sd within and between models"
        return "\n".join([first, text_table(rows), *labelled(self.findings)])

    __repr__ = __str__

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation, shape (...)."""
        return np.sqrt(self.variance)


def average_predictions(
    predictions: Mapping[str, Prediction], probabilities: Mapping[str, float]
) -> AveragedPrediction:
    """Average the predictions of several models with their probabilities as weights.

    Parameters
    ----------
    predictions : mapping of str to Prediction
        Predictions of the same quantity, by the name of the model.
    probabilities : mapping of str to float
        Posterior probabilities of the models, by the same names. They sum to one.

    Returns
    -------
    AveragedPrediction
        Mean and variance of the mixture.

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
    error = np.sqrt(np.tensordot(weights**2, [np.square(part.standard_error) for part in parts], axes=1))
    known = dict(zip(names, weights.tolist(), strict=True))
    findings = tuple(dict.fromkeys(each for part in parts for each in part.findings))
    first = parts[0]
    return AveragedPrediction(mean, within + between, within, between, error, known, first.channels, first.dt, findings)
