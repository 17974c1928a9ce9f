"""Probability that a response exceeds a limit, given the data.

The posterior probability of an exceedance is estimated by averaging, over the samples, each sample's probability to
exceed the threshold: the robust reliability of Papadimitriou, Beck & Katafygiotis (2001). Without a model error this is
the fraction of the samples whose quantity exceeds the threshold, and its uncertainty is given by the interval of
Clopper & Pearson (1934), which is also valid if none or all of the samples exceed. The model error is in the prediction
(``propagate(..., noise="model")``, `predict_new_event`) or in ``ratios=``. See ``docs/theory/prediction.rst``.
Fragility curves are in `fe_likelihoods.prediction.fragility`.

References
----------
C. Papadimitriou, J. L. Beck, L. S. Katafygiotis (2001), Updating robust reliability using structural test data,
Probabilistic Engineering Mechanics 16(2), 103-113, doi:10.1016/S0266-8920(00)00012-6.
C. J. Clopper, E. S. Pearson (1934), The use of confidence or fiducial limits illustrated in the case of the binomial,
Biometrika 26(4), 404-413, doi:10.1093/biomet/26.4.404.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from ..checks.finding import warn
from ..checks.transfer import check_unit_of_threshold
from ..events.ratios import EventRatios
from ..signals.channels import Channel
from ..text_tables import number, text_table
from ..units import DIMENSIONS, find_unit, to_si
from .prediction import Prediction

__all__ = [
    "Estimate",
    "Exceedance",
    "check_level",
    "contents",
    "estimate",
    "exceedance",
    "exceeded",
    "threshold_in_si",
    "unit_of_threshold",
    "warn_of_missing_error",
]

_DRAWS = 1000  # of the population of ratios
_ARRAYS = ("probability", "standard_error", "lower", "upper", "upper_by_events")  # of an `Exceedance`


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
    upper_by_events : ndarray or None
        With `EventRatios`, the upper end of the Clopper-Pearson interval for the share of events whose ratio exceeds,
        averaged over the samples: what the events tell without assuming normal log ratios. Where it is far above
        `upper`, no event was near the threshold, and the probability depends on the assumed tail. None without ratios.
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
    upper_by_events: np.ndarray | None = None
    unit: str = "SI"

    def __str__(self) -> str:
        arrays = [self.threshold, self.probability, self.standard_error, self.lower, self.upper]
        by_events = self.upper_by_events is not None
        arrays += [self.upper_by_events] if by_events else []
        first = "threshold" if self.unit == "1" else f"threshold [{self.unit}]"
        rows = [(first, "probability", "MC error", "interval", *(["upper end by the events alone"] * by_events))]
        for limit, share, error, low, high, *rest in zip(*map(np.ravel, np.broadcast_arrays(*arrays)), strict=True):
            cells = number(limit), number(share), number(error, 2), f"{number(low)} to {number(high)}"
            rows.append((*cells, *map(number, rest)))
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
    level: float = 0.95,
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
    level : float
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
        If a prediction contains no model error: its probability is then too close to 0 or to 1. If a threshold without
        a unit seems to be in the unit of the channel.

    Examples
    --------
    >>> peaks = propagate(posterior, samples, quantity=peak("displacement"))
    >>> print(exceedance(peaks, 8.0, unit="cm", ratios=EventRatios([0.93, 1.10, 1.02])))  # doctest: +SAMPLED
    threshold [m]  probability  MC error       interval  upper end by the events alone
    0.08                 0.631    0.0017  0.222 to 0.95                          0.992
    The probability contains the uncertainty of the parameters and the error of the model, from the ratios of 3
    events.
    """
    prediction = prediction_or_values if isinstance(prediction_or_values, Prediction) else None
    n_collapsed, has_error, channels = 0, False, ()
    if prediction is not None:
        if prediction.values is None:
            raise ValueError(
                "exceedance needs the values of the samples, but this prediction has none: propagate with a number as "
                "quantity, such as peak(channel)"
            )
        values, has_error, channels = prediction.values, prediction.noise, prediction.channels
        effective, n_collapsed = prediction.effective_sample_size, len(prediction.collapsed)
    else:
        values = np.asarray(prediction_or_values, dtype=float)
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
    if ratios is None and prediction is not None and noise is None and not has_error:
        warn_of_missing_error("exceedance", 'propagate with noise="model" and noise in shares of the response')
    limits = threshold_in_si(threshold, unit, channels)
    if values.ndim > 1 and limits.shape not in ((), values.shape[1:]):
        raise ValueError(
            f"expected one threshold, or one for each entry of the quantity, shape {values.shape[1:]}; got shape "
            f"{limits.shape}"
        )
    check_level(level)
    if unit is None and len({channel.unit for channel in channels}) == 1 and limits.size:
        warn(check_unit_of_threshold(limits, values, channels[0]), stacklevel=2)
    if prediction is not None and prediction.ratios is not None:  # exact, not by the draws
        ratios, values = prediction.ratios, prediction.predicted[None]
    if ratios is not None:
        if not (limits > 0.0).all():
            raise ValueError(f"with ratios, thresholds must be positive; got {limits}")
        if ratios.shape not in ((), values.shape[1:]):
            raise ValueError(
                f"expected ratios (n_events, ...) of a quantity of shape {values.shape[1:]}; got {ratios.values.shape}"
            )
    if values.ndim == 1 and limits.ndim:
        values = values.reshape(-1, *(1,) * limits.ndim)
    settings = n_collapsed, effective, level, seed
    if ratios is None or not ratios.shape:
        found = exceeded(values, limits, ratios, *settings)
    else:  # each quantity has ratios of its own
        rows = np.broadcast_to(limits, values.shape[1:])
        columns = [exceeded(values[:, k], rows[k], ratios.of_quantity(k), *settings) for k in range(len(rows))]
        arrays = {name: np.array([getattr(each, name) for each in columns]) for name in _ARRAYS}
        found = columns[0]._replace(**arrays)
    said = contents(has_error, ratios) + found.uncertainty
    return found._replace(threshold=limits, uncertainty=said, unit=unit_of_threshold(unit, channels))


def exceeded(
    values: np.ndarray,
    limits: np.ndarray,
    ratios: EventRatios | None,
    n_collapsed: int,
    effective: float,
    level: float,
    seed: int,
) -> Exceedance:
    """Probability that values (n, ...) of samples exceed limits, which are broadcast to them.

    Further `n_collapsed` samples exceed every limit: a probability without them speaks of the structures that stand.
    """
    values, limits = np.broadcast_arrays(values, limits)
    n, total = len(values), len(values) + n_collapsed
    fallen, effective = np.full((n_collapsed, *values.shape[1:]), np.nan), effective * total / n
    known, above = np.concatenate([values, fallen]), np.concatenate([limits, np.ones(fallen.shape)])
    found = estimate(known, above, ratios, np.isnan(known), effective, level, seed)
    by_events = None
    if ratios is not None:  # each event is one trial
        logs = np.log(np.where(values > 0.0, values, 1.0))
        moved = [values * ratios.of_event(k, logs) > limits for k in range(len(ratios.values))]
        share = (np.mean(moved, axis=0).sum(axis=0) + n_collapsed) / total
        by_events = _binomial_interval(share, len(ratios.values), level)[1]
    said = f"; {n_collapsed} of {total} structures collapsed, which exceed every limit" if n_collapsed else ""
    return Exceedance(limits[0], *found[:4], effective, said, by_events)


class Estimate(NamedTuple):
    """Probability (...) of an exceedance with its Monte Carlo error and interval, and what curves are fitted to."""

    probability: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    single: np.ndarray  # (n, ...), of each sample
    counted: np.ndarray  # (n, ...), 0 for failures that are left out, else 1
    draws: np.ndarray | None  # (n_draws, ...), one per population of events


def estimate(
    values: np.ndarray,
    limits: np.ndarray,
    ratios: EventRatios | None,
    exceeding: np.ndarray,
    effective: float,
    level: float,
    seed: int | None,
) -> Estimate:
    """Probability that values (n, ...), times a ratio, exceed limits, which are broadcast to them.

    Given the population of the ratios, the probability is a number; its mean over populations is the probability, and
    its quantiles, over samples and populations, are the interval. Without ratios this is the Clopper-Pearson interval.
    NaN are failures, which are left out, or count as exceedances where `exceeding`.
    """
    values, limits = np.broadcast_arrays(values, limits)
    failed = np.isnan(values)
    counted = 1.0 - (failed & ~exceeding)
    known = np.where(failed, np.nanmax(np.where(failed, -np.inf, values), initial=-np.inf), values)

    def of_samples(rows: np.ndarray | slice, above: np.ndarray) -> np.ndarray:
        return np.where(failed[rows], exceeding[rows], above)

    if ratios is None:
        single = of_samples(slice(None), known > limits).astype(float)
    else:
        single = of_samples(slice(None), _with_ratios(known, limits, ratios.probability_above))
    number_of = counted.sum(axis=0)
    share, trials = (single * counted).sum(axis=0) / number_of, effective * number_of / len(values)
    error = np.sqrt((np.square(single - share) * counted).sum(axis=0) / number_of / trials)
    if ratios is None:
        return Estimate(share, error, *_binomial_interval(share, trials, level), single, counted, None)
    rng = np.random.default_rng(seed)
    rows = rng.permutation(np.resize(rng.permutation(len(values)), _DRAWS))  # each population has one of the samples
    populations = ratios.draw_populations(_DRAWS, rng)
    draws = of_samples(rows, _with_ratios(known[rows], limits[rows], populations.probability_above))
    draws = np.where(counted[rows] > 0.0, draws, np.nan)
    lower, upper = np.nanquantile(draws, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    # far in a tail the mean over populations can be above nearly all of their probabilities
    return Estimate(share, error, np.minimum(lower, share), np.maximum(upper, share), single, counted, draws)


def _with_ratios(
    values: np.ndarray, limits: np.ndarray, probability_above: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """Probability that values times a ratio exceed positive limits; values that are not positive never do."""
    positive = values > 0.0
    known = np.where(positive, values, 1.0)
    return np.where(positive, probability_above(limits / known, np.log(known)), 0.0)


def contents(has_noise: bool, ratios: EventRatios | None) -> str:
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


def unit_of_threshold(unit: str | None, channels: Sequence[Channel]) -> str:
    """SI unit of a threshold that was given in a unit, or for channels; "SI" where the dimension is not known."""
    dimensions = {channel.dimension for channel in channels} or ({find_unit(unit).dimension} if unit else set())
    return DIMENSIONS[dimensions.pop()] if len(dimensions) == 1 else "SI"


def _binomial_interval(share: np.ndarray, effective: ArrayLike, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Clopper-Pearson interval of a probability, for a share of `effective` trials, which may be no whole number."""
    tail = 0.5 * (1.0 - level)
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
