"""Probability that a response exceeds a limit, given the data.

The posterior probability of an exceedance is estimated by the fraction of the samples whose quantity exceeds the
threshold: the robust reliability of Papadimitriou, Beck & Katafygiotis (2001). Its uncertainty is given by the interval
of Clopper & Pearson (1934), which is also valid if none or all of the samples exceed. See
``docs/theory/prediction.rst``. Fragility curves are in `fe_likelihoods.prediction.fragility`.

References
----------
C. Papadimitriou, J. L. Beck, L. S. Katafygiotis (2001), Updating robust reliability using structural test data,
Probabilistic Engineering Mechanics 16(2), 103-113, doi:10.1016/S0266-8920(00)00012-6.
C. J. Clopper, E. S. Pearson (1934), The use of confidence or fiducial limits illustrated in the case of the binomial,
Biometrika 26(4), 404-413, doi:10.1093/biomet/26.4.404.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from ..signals.channels import Channel
from ..units import to_si
from .prediction import Prediction
from .propagation import check_effective_sample_size

__all__ = ["Exceedance", "binomial_interval", "check_level", "exceedance", "threshold_in_si"]


class Exceedance(NamedTuple):
    """Probability that a quantity exceeds a threshold.

    Arrays have the shape of the thresholds, or the shape of the quantity.

    Attributes
    ----------
    threshold : ndarray
        Threshold [SI].
    probability : ndarray
        Fraction of the samples above the threshold.
    standard_error : ndarray
        Monte Carlo error sqrt(p (1 - p) / effective sample size). It is zero if none or all of the samples exceed; use
        the interval in these cases.
    lower, upper : ndarray
        Clopper-Pearson interval of the probability, for the effective sample size.
    effective_sample_size : float
        Effective number of independent samples.
    """

    threshold: np.ndarray
    probability: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    effective_sample_size: float


def exceedance(
    prediction_or_values: Prediction | ArrayLike,
    threshold: ArrayLike,
    *,
    unit: str | None = None,
    effective_sample_size: float | None = None,
    level: float = 0.95,
) -> Exceedance:
    """Estimate the probability that a quantity exceeds a threshold, given the data.

    Parameters
    ----------
    prediction_or_values : Prediction, or (n, ...) array_like
        A prediction with `values`, for instance of ``quantity=peak(...)``, or the values of the samples.
    threshold : float or array_like
        If the quantity is a number: one threshold or an array of any shape. If it is an array: one threshold, or one
        for each entry, shape (...).
    unit : str, optional
        Unit of the threshold. It must have the dimension of the channel of the prediction. Default: SI.
    effective_sample_size : float, optional
        Effective number of independent samples. Default: that of the prediction, or the number of values.
    level : float
        Probability of the interval, between 0 and 1.

    Returns
    -------
    Exceedance
        The probability with its error and interval.

    Raises
    ------
    ValueError
        If the threshold has the wrong shape or unit or is not finite, or the values are missing or not finite.
    """
    if isinstance(prediction_or_values, Prediction):
        values, channels = prediction_or_values.values, prediction_or_values.channels
        if values is None:
            raise ValueError(
                "exceedance needs the values of the samples, but this prediction has none: propagate with a number as "
                "quantity, such as peak(channel)"
            )
        effective = prediction_or_values.effective_sample_size
    else:
        values, channels = np.asarray(prediction_or_values, dtype=float), ()
        if values.ndim == 0 or len(values) == 0 or not np.isfinite(values).all():
            raise ValueError(f"values must be finite, one row per sample; got {values.size} of shape {values.shape}")
        effective = float(len(values))
    effective = float(check_effective_sample_size(effective_sample_size, effective))
    limits = threshold_in_si(threshold, unit, channels)
    if values.ndim > 1 and limits.shape not in ((), values.shape[1:]):
        raise ValueError(
            f"expected one threshold, or one for each entry of the quantity, shape {values.shape[1:]}; got shape "
            f"{limits.shape}"
        )
    if values.ndim == 1:
        share = 1.0 - np.searchsorted(np.sort(values), limits, side="right") / len(values)
    else:
        share = (values > limits).mean(axis=0)
    lower, upper = binomial_interval(share, effective, level)
    return Exceedance(limits, share, np.sqrt(share * (1.0 - share) / effective), lower, upper, effective)


def threshold_in_si(threshold: ArrayLike, unit: str | None, channels: Sequence[Channel]) -> np.ndarray:
    """Return a threshold [SI]; raise ValueError if it is not finite or its unit has another dimension."""
    try:
        limits = np.asarray(threshold, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"threshold must be numbers; got {threshold!r}") from error
    if not np.isfinite(limits).all():
        raise ValueError(f"threshold must be finite; got {threshold!r}")
    if unit is None:
        return limits
    dimensions = {channel.dimension for channel in channels}
    if len(dimensions) > 1:
        raise ValueError(
            f"the channels have different dimensions ({', '.join(sorted(dimensions))}); give the thresholds in SI "
            "units, without a unit"
        )
    return np.asarray(to_si(limits, unit, *dimensions))


def binomial_interval(share: np.ndarray, effective: ArrayLike, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the Clopper-Pearson interval of a probability.

    Parameters
    ----------
    share : array_like
        Fraction of the trials that exceed.
    effective : array_like
        Number of independent trials, not necessarily a whole number.
    level : float
        Probability of the interval, between 0 and 1.

    Returns
    -------
    lower, upper : ndarray
        Bounds of the interval.

    Raises
    ------
    ValueError
        If the level is not between 0 and 1.
    """
    tail = 0.5 * (1.0 - check_level(level))
    share = np.asarray(share, dtype=float)
    hits, misses = share * effective, (1.0 - share) * effective
    # The beta distribution does not exist for a count of zero. The bound is then 0 or 1.
    lower = np.where(hits > 0.0, stats.beta.ppf(tail, np.maximum(hits, 1e-300), misses + 1.0), 0.0)
    upper = np.where(misses > 0.0, stats.beta.isf(tail, hits + 1.0, np.maximum(misses, 1e-300)), 1.0)
    return lower, upper


def check_level(level: float) -> float:
    """Return the level; raise ValueError if it is not between 0 and 1."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be between 0 and 1; got {level!r}")
    return level
