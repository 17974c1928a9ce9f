"""Probability that a response exceeds a limit, given the data.

The posterior probability of an exceedance is estimated by averaging, over the samples, each sample's probability to
exceed the threshold: the robust reliability of Papadimitriou, Beck & Katafygiotis (2001). Without a model error this is
the fraction of the samples whose quantity exceeds the threshold, and its uncertainty is given by the interval of
Clopper & Pearson (1934), which is also valid if none or all of the samples exceed. The model error is in the prediction
(``propagate(..., noise="model")``, `predict_new_event`) or in ``ratios=``. See ``docs/theory/prediction.rst``.
Fragility curves are in `fe_likelihoods.prediction.fragility`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betainccinv, betaincinv

from ..population.event_ratios import EventRatios
from ..signals.channels import Channel
from ..text_tables import number, text_table
from ..units import DIMENSIONS, find_unit, to_si
from .prediction import Prediction
from .scores import check_probability

_DRAWS = 1000  # of the population of ratios


class Exceedance(NamedTuple):
    """Probability that a quantity exceeds a threshold.

    Arrays have the shape of the thresholds, or the shape of the quantity.

    Attributes
    ----------
    threshold : ndarray
        Threshold [SI].
    probability : ndarray
        Mean over the samples of the probability to exceed the threshold; without ratios, the fraction of the samples
        above the threshold.
    standard_error : ndarray
        Monte Carlo error. Without ratios it is sqrt(p (1 - p) / effective sample size), which is zero if none or all of
        the samples exceed; use the interval in these cases.
    lower, upper : ndarray
        Interval of the probability. With ratios, or for a new event, it contains the uncertainty of the ratios and the
        event population, and always the probability itself: small probabilities differ between populations by powers of
        ten, and their mean can be above nearly all of them. Otherwise it is the Clopper-Pearson interval for the
        effective sample size, which contains the Monte Carlo error only.
    effective_sample_size : float
        Effective number of independent samples.
    uncertainty : str
        Which uncertainties the probability contains.
    unit : str
        SI unit of the threshold; "SI" where its dimension is not known.
    """

    threshold: np.ndarray
    probability: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    effective_sample_size: float
    uncertainty: str = ""
    unit: str = "SI"

    def __str__(self) -> str:
        arrays = [self.threshold, self.probability, self.standard_error, self.lower, self.upper]
        first = "threshold" if self.unit == "1" else f"threshold [{self.unit}]"
        rows = [(first, "probability", "MC error", "interval")]
        for limit, share, error, low, high in zip(*map(np.ravel, np.broadcast_arrays(*arrays)), strict=True):
            rows.append((number(limit), number(share), number(error, 2), f"{number(low)} to {number(high)}"))
        said = f"\nThe probability contains {self.uncertainty}." if self.uncertainty else ""
        return text_table(rows) + said

    __repr__ = __str__


def exceedance(
    prediction_or_values: Prediction | ArrayLike,
    threshold: ArrayLike,
    *,
    unit: str | None = None,
    ratios: EventRatios | None = None,
    noise: bool | None = None,
    interval_probability: float = 0.95,
    seed: int = 0,
) -> Exceedance:
    """Estimate the probability that a quantity exceeds a threshold, given the data.

    Parameters
    ----------
    prediction_or_values : Prediction, or (n, ...) array_like
        A prediction with `values`, for instance of ``quantity=peak(...)``, or the values of the samples. Samples whose
        structure collapsed count as exceedances, other failures are left out.
    threshold : float or array_like
        If the quantity is a number: one threshold or an array of any shape. If it is an array: one threshold, or one
        for each entry, shape (...). Positive if there are ratios.
    unit : str, optional
        Unit of the threshold, with the dimension of the predicted channel. Default: SI.
    ratios : EventRatios, optional
        Ratios of measured to fitted values of the quantity in several events: the model error, for a prediction without
        noise. A prediction by `predict_new_event` has its ratios already.
    noise : bool, optional
        False states that the model error is left out on purpose. Default: a prediction without it gives a warning.
    interval_probability : float
        Probability of the interval, between 0 and 1.
    seed : int
        Seed of the draws for the interval, where there are ratios or an event population.

    Returns
    -------
    Exceedance
        The probability with its error and interval.

    Raises
    ------
    ValueError
        If the threshold has the wrong shape or unit, or is not positive where there are ratios; the values are missing
        or not finite; or ratios or ``noise=False`` contradict the prediction.

    Warns
    -----
    UserWarning
        If a prediction contains no model error: its probability is then too close to 0 or to 1.

    Examples
    --------
    >>> peaks = propagate(posterior, samples, quantity=peak("displacement"))
    >>> print(exceedance(peaks, 8.0, unit="cm", ratios=EventRatios([0.93, 1.10, 1.02])))  # doctest: +SAMPLED
    threshold [m]  probability  MC error       interval
    0.08                 0.631    0.0017  0.222 to 0.95
    The probability contains the uncertainty of the parameters and the error of the model, from the ratios of 3
    events.
    """
    known, limits, ratios = inputs(prediction_or_values, threshold, unit, ratios, noise, "exceedance")
    values = known.values
    if values.ndim > 1 and limits.shape not in ((), values.shape[1:]):
        raise ValueError(
            f"expected one threshold, or one for each entry of the quantity, shape {values.shape[1:]}; got shape "
            f"{limits.shape}"
        )
    if ratios is not None and ratios.shape not in ((), values.shape[1:]):
        raise ValueError(
            f"expected ratios (n_events, ...) of a quantity of shape {values.shape[1:]}; got {ratios.values.shape}"
        )
    if values.ndim == 1 and limits.ndim:
        values = values.reshape(-1, *(1,) * limits.ndim)
    found = estimate(values, limits, ratios, known.effective, interval_probability, seed).exceedance
    return found._replace(threshold=limits, uncertainty=known.contents, unit=known.unit)


class Known(NamedTuple):
    """What a probability is estimated from."""

    values: np.ndarray  # (n, ...) of all samples: NaN where the simulation failed, inf where the structure collapsed
    effective: float  # number of independent samples
    contents: str  # which uncertainties the probability contains
    unit: str  # SI unit of the threshold


def inputs(
    given: Prediction | ArrayLike,
    threshold: ArrayLike,
    unit: str | None,
    ratios: EventRatios | None,
    noise: bool | None,
    caller: str,
) -> tuple[Known, np.ndarray, EventRatios | None]:
    """Values, thresholds [SI] and ratios for an estimate.

    With the name of a `caller`, it warns where there is no model error, or a unit seems to be missing.
    """
    prediction = given if isinstance(given, Prediction) else None
    has_error, channels, said = False, (), ""
    if prediction is not None:
        if prediction.values is None:
            raise ValueError(
                f"{caller} needs the values of the samples, but this prediction has none: propagate with a number as "
                "quantity, such as peak(channel)"
            )
        (values, effective), has_error = outcomes(prediction), prediction.noise
        channels, fallen = prediction.channels, len(prediction.collapsed)
        if fallen:
            said = f"; {fallen} of {prediction.n_samples + fallen} structures collapsed, which exceed every limit"
    else:
        values = np.asarray(given, dtype=float)
        if values.ndim == 0 or len(values) == 0 or not np.isfinite(values).all():
            raise ValueError(f"values must be finite, one row per sample; got {values.size} of shape {values.shape}")
        effective = float(len(values))
    if noise is False and has_error:
        raise ValueError(
            "noise=False states that there is no error of the model, but the prediction contains one: propagate with "
            "noise=False, and predict_new_event without ratios"
        )
    if ratios is not None and has_error:
        raise ValueError("ratios contain the error of the model, and the prediction contains it already: leave one")
    if caller and ratios is None and prediction is not None and noise is None and not has_error:
        warn_of_missing_error(caller, 'propagate with noise="model" and noise in shares of the response', 4)
    limits = _threshold_in_si(threshold, unit, channels)
    finite = values[np.isfinite(values)]
    if caller and unit is None and len({channel.unit for channel in channels}) == 1 and limits.size and finite.size:
        shown, (low, high) = (
            to_si(limits, channels[0].unit, channels[0].dimension),
            np.percentile(np.abs(finite), (0, 100)),
        )
        if np.all((low <= shown) & (shown <= high) & ((limits < low) | (limits > high))):
            raise ValueError(f"the threshold {limits.flat[0]:g} has no unit: give unit=, such as {channels[0].unit!r}")
    if prediction is not None and prediction.ratios is not None:  # exact, not by the draws
        ratios, values = prediction.ratios, prediction.predicted[None]
    if ratios is not None and not (limits > 0.0).all():
        raise ValueError(f"with ratios, thresholds must be positive; got {limits}")
    contains = _contents(has_error, ratios) + said
    return Known(values, effective, contains, _unit_of_threshold(unit, channels)), limits, ratios


def outcomes(prediction: Prediction) -> tuple[np.ndarray, float]:
    """Values (n, ...) of all samples, inf where the structure collapsed, NaN where the simulation failed otherwise.

    And how many independent samples they are worth.
    """
    used, n = prediction.n_samples, prediction.n_samples + prediction.n_failed
    found = np.full((n, *prediction.values.shape[1:]), np.nan)
    found[np.setdiff1d(np.arange(n), prediction.failed, assume_unique=True)] = prediction.values
    found[prediction.collapsed] = np.inf
    return found, prediction.effective_sample_size * (n / used if used else 1.0)


class Estimate(NamedTuple):
    """Probability of an exceedance, and what curves are fitted to."""

    exceedance: Exceedance
    single: np.ndarray  # (n, ...), probability of each sample
    counted: np.ndarray  # (n, ...), 0 for failures that are left out, else 1
    draws: np.ndarray | None  # (n_draws, ...), one per population of events


def estimate(
    values: np.ndarray, limits: ArrayLike, ratios: EventRatios | None, effective: float, probability: float, seed: int
) -> Estimate:
    """Probability that values (n, ...), times a ratio, exceed limits, which are broadcast to them.

    Infinite values exceed every limit, NaN are failures, which are left out. Given the population of the ratios, the
    probability is a number; its mean over populations is the probability, and its quantiles, over samples and
    populations, are the interval. Without ratios this is the Clopper-Pearson interval.
    """
    check_probability(probability)
    values, limits = np.broadcast_arrays(values, limits)
    counted = 1.0 - np.isnan(values)
    regular = (values > 0.0) & (values < np.inf)
    known = np.where(regular, values, 1.0)
    logs = np.log(known)

    def above(population: Any, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        found = population.probability_above(limits[rows] / known[rows], logs[rows])
        return np.where(regular[rows], found, values[rows] == np.inf)  # times a ratio, others never exceed

    single = (values > limits).astype(float) if ratios is None else above(ratios)
    number_of = counted.sum(axis=0)
    share, trials = (single * counted).sum(axis=0) / number_of, effective * number_of / len(values)
    error = np.sqrt((np.square(single - share) * counted).sum(axis=0) / number_of / trials)
    if ratios is None:
        ends = _binomial_interval(share, trials, probability)
        return Estimate(Exceedance(limits[0], share, error, *ends, effective), single, counted, None)
    rng = np.random.default_rng(seed)
    rows = rng.permutation(np.resize(rng.permutation(len(values)), _DRAWS))  # each population has one of the samples
    draws = np.where(counted[rows] > 0.0, above(ratios.draw_populations(_DRAWS, rng), rows), np.nan)
    lower, upper = np.nanquantile(draws, [0.5 - 0.5 * probability, 0.5 + 0.5 * probability], axis=0)
    # far in a tail the mean over populations can be above nearly all of their probabilities
    ends = np.minimum(lower, share), np.maximum(upper, share)
    return Estimate(Exceedance(limits[0], share, error, *ends, effective), single, counted, draws)


def _contents(has_noise: bool, ratios: EventRatios | None) -> str:
    """Which uncertainties a probability contains, in words."""
    said = "the uncertainty of the parameters"
    if ratios is not None:
        return f"{said} and the error of the model, from the ratios of {len(ratios.values)} events"
    return said + (
        " and the error of the model, from the noise of the calibration"
        if has_noise
        else ", not the error of the model"
    )


def warn_of_missing_error(caller: str, how: str, stacklevel: int = 3) -> None:
    """Warn that a probability leaves the model error out; `how` says how else to have it than by ratios."""
    warnings.warn(
        f"{caller}: the probabilities leave the error of the model out, so that they are too close to 0 or to 1. Give "
        f"ratios=EventRatios(...) of measured to fitted values in several events, or {how}; noise=False states that "
        "the error is left out on purpose",
        stacklevel=stacklevel,
    )


def _threshold_in_si(threshold: ArrayLike, unit: str | None, channels: Sequence[Channel]) -> np.ndarray:
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


def _unit_of_threshold(unit: str | None, channels: Sequence[Channel]) -> str:
    """SI unit of a threshold that was given in a unit, or for channels; "SI" where the dimension is not known."""
    dimensions = {channel.dimension for channel in channels} or ({find_unit(unit).dimension} if unit else set())
    return DIMENSIONS[dimensions.pop()] if len(dimensions) == 1 else "SI"


def _binomial_interval(share: np.ndarray, effective: ArrayLike, probability: float) -> tuple[np.ndarray, np.ndarray]:
    """Clopper-Pearson interval of a probability, for a share of `effective` trials, which may be no whole number."""
    tail = 0.5 * (1.0 - probability)
    share = np.asarray(share, dtype=float)
    hits, misses = share * effective, (1.0 - share) * effective
    # The beta distribution does not exist for a count of zero. The bound is then 0 or 1.
    lower = np.where(hits > 0.0, betaincinv(np.maximum(hits, 1e-300), misses + 1.0, tail), 0.0)
    upper = np.where(misses > 0.0, betainccinv(hits + 1.0, np.maximum(misses, 1e-300), tail), 1.0)
    return lower, upper
