"""Probabilities that a response exceeds a limit, given the data: for one excitation, and against its intensity.

The posterior probability of an exceedance is the share of the samples whose quantity exceeds the threshold (the robust
reliability of Papadimitriou, Beck & Katafygiotis 2001). A share of few samples says little about rare events, so it
comes with an interval that holds for none of n as well.

A fragility is that probability against the intensity of the shaking; through its points goes a lognormal curve of
maximum likelihood.

References
----------
Papadimitriou, Beck & Katafygiotis (2001), Probabilistic Eng. Mech. 16(2), 103-113, doi:10.1016/S0266-8920(00)00012-6
Clopper & Pearson (1934), Biometrika 26(4), 404-413, doi:10.1093/biomet/26.4.404
Baker (2015), Efficient analytical fragility function fitting using dynamic structural analysis, Earthquake Spectra
31(1), 579-599, doi:10.1193/021113EQS025M
"""

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special, stats

from ..signals.channels import Channel
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from ..units import to_si
from .accumulator import parts_of, split_samples
from .propagation import Prediction, propagate
from .quantities import ChannelQuantity, evaluator

__all__ = [
    "Exceedance",
    "Fragility",
    "FragilityCurve",
    "exceedance",
    "fit_fragility",
    "fragility",
    "peak_ground_acceleration",
]

logger = logging.getLogger(__name__)

_REPLICATES = 100


class Exceedance(NamedTuple):
    """Probability that a quantity exceeds a threshold; arrays have the shape of the thresholds, or the quantity's.

    Attributes
    ----------
    threshold : float — [SI].
    probability : float — share of the samples above it.
    standard_error : float — Monte-Carlo error, sqrt(p (1 - p) / effective sample size); zero where none or all exceed:
        read the interval there.
    lower, upper : float — Clopper-Pearson interval of the probability, from the effective sample size.
    effective_sample_size : float
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
    """Probability that a quantity is larger than a threshold, given the data.

    Parameters
    ----------
    prediction_or_values : Prediction with `values` (of ``quantity=peak(...)``, say), or values (n, *shape)
    threshold : float, or array
        For a number a sample: one threshold or many, of any shape. For arrays: one, or one for each entry (*shape).
    unit : str, optional — of the threshold, by default SI; it must measure what the prediction's channel does.
    effective_sample_size : float, optional — by default the prediction's; of bare values their number.
    level : float in (0, 1) — of the interval.

    Returns
    -------
    Exceedance

    Raises
    ------
    ValueError
        For a threshold of a wrong shape or unit, or not finite; values that are missing or not finite.
    """
    if isinstance(prediction_or_values, Prediction):
        values, channels = prediction_or_values.values, prediction_or_values.channels
        if values is None:
            raise ValueError(
                "exceedance needs the values of the samples, this prediction keeps none: propagate with a number as "
                "quantity, such as peak(channel)"
            )
        effective = prediction_or_values.effective_sample_size
    else:
        values, channels = np.asarray(prediction_or_values, dtype=float), ()
        if values.ndim == 0 or len(values) == 0 or not np.isfinite(values).all():
            raise ValueError(f"values must be finite, one row a sample; got {values.size} of shape {values.shape}")
        effective = float(len(values))
    if effective_sample_size is not None:
        effective = float(effective_sample_size)
    if not (np.isfinite(effective) and effective > 0.0):
        raise ValueError(f"effective_sample_size must be a positive number; got {effective_sample_size!r}")
    limits = _threshold(threshold, unit, channels)
    if values.ndim > 1 and limits.shape not in ((), values.shape[1:]):
        raise ValueError(
            f"one threshold, or one for each entry of the quantity, shape {values.shape[1:]}, is needed; got shape "
            f"{limits.shape}"
        )
    if values.ndim == 1:
        share = 1.0 - np.searchsorted(np.sort(values), limits, side="right") / len(values)
    else:
        share = (values > limits).mean(axis=0)
    lower, upper = _interval(share, effective, level)
    return Exceedance(limits, share, np.sqrt(share * (1.0 - share) / effective), lower, upper, effective)


class FragilityCurve(NamedTuple):
    """Lognormal fragility: P(exceed | intensity) = Phi(ln(intensity / median) / dispersion).

    Attributes
    ----------
    median : float — intensity at which one half exceeds.
    dispersion : float — standard deviation of the logarithm of the intensity that is borne [-].
    median_error, dispersion_error : float — Monte-Carlo errors, from resampling the samples (which all records share)
        with the records fixed; inf where the points say too little for it: where a tenth of the resamplings leave the
        curve open. How other records would change the curve they do not say.
    """

    median: float
    dispersion: float
    median_error: float = np.inf
    dispersion_error: float = np.inf

    def probability(self, intensity: ArrayLike) -> np.ndarray:
        """Probability of an exceedance at intensities > 0."""
        return special.ndtr(np.log(np.asarray(intensity, dtype=float) / self.median) / self.dispersion)


class Fragility(NamedTuple):
    """Probability of an exceedance against intensity, one entry a record.

    Attributes
    ----------
    names : tuple of str — of the records.
    intensity : (n_records,) float
    probability, standard_error, lower, upper : (n_records,) float — as in `Exceedance`.
    n_failed : (n_records,) int — samples whose simulation failed.
    curve : FragilityCurve, or None — None where the points determine none (a warning says why).
    threshold : float — [SI].
    """

    names: tuple[str, ...]
    intensity: np.ndarray
    probability: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    n_failed: np.ndarray
    curve: FragilityCurve | None
    threshold: float


def peak_ground_acceleration(record: Record) -> float:
    """Largest absolute acceleration of a record [m/s²]."""
    return float(np.max(np.abs(record.acceleration)))


def fragility(
    posterior_or_model: Any,
    samples: Any,
    records: Sequence[Record],
    quantity: ChannelQuantity | Callable[[np.ndarray], float],
    threshold: float,
    *,
    unit: str | None = None,
    intensity: Callable[[Record], float] = peak_ground_acceleration,
    failures_exceed: bool = False,
    effective_sample_size: float | None = None,
    level: float = 0.95,
    seed: int | None = None,
    **settings: Any,
) -> Fragility:
    """Probability that a quantity exceeds a threshold, given the data, under each of several records.

    Parameters
    ----------
    posterior_or_model, samples, quantity : as in `propagate`, with a number as quantity: ``peak("displacement")``.
    records : sequence of Record — such as one motion scaled, ``[record.scale(k) for k in factors]``, or many motions.
    threshold : float, `unit` : as in `exceedance`.
    intensity : callable — of a record, a positive number; by default its peak acceleration [m/s²].
    failures_exceed : bool — count a failed simulation as an exceedance (where it means collapse) instead of leaving
        the sample out.
    effective_sample_size : float, optional — as in `propagate`.
    level : float in (0, 1) — of the intervals.
    seed : int, optional — of the noise and of the resampling behind the curve's errors.
    **settings : other arguments of `propagate`: noise, batch, pool, progress.

    Returns
    -------
    Fragility

    Raises
    ------
    ValueError
        As `propagate` and `exceedance`, before any simulation where it can be known; also for no records, intensities
        that are not positive, and a quantity that is not one number.
    SimulationFailed
        If every simulation under a record fails and they do not count as exceedances.
    """
    if taken := {"record", "quantiles", "memory"} & set(settings):
        raise ValueError(f"fragility sets {', '.join(sorted(taken))} itself; leave them out")
    model, noise, _ = parts_of(posterior_or_model, None)
    thetas, _ = split_samples(model, noise, samples, settings.get("noise", False))
    known = evaluator(quantity, model.channels)
    if known.rows is not None or len(known.channels) > 1:
        raise ValueError(f"fragility needs one number as quantity, such as peak(channel); got {quantity!r}")
    limit = _threshold(threshold, unit, known.channels)
    if limit.shape != ():
        raise ValueError(f"fragility needs one threshold; got an array of shape {limit.shape}")
    records = list(records)
    if not records:
        raise ValueError("fragility needs records: such as [record.scale(k) for k in factors]")
    if not hasattr(model, "with_record"):
        raise ValueError(f"{type(model).__name__} knows no other record: give it a method with_record(record)")
    for record in records:
        model.with_record(record)
    intensities = np.array([float(intensity(record)) for record in records])
    if not np.all((intensities > 0.0) & (intensities < np.inf)):
        raise ValueError(f"intensities must be positive and finite; got {intensities}")

    n = len(thetas)
    effective = n if effective_sample_size is None else float(effective_sample_size)
    if not (np.isfinite(effective) and effective > 0.0):
        raise ValueError(f"effective_sample_size must be a positive number; got {effective_sample_size!r}")
    _checked_level(level)

    exceeds, counted = np.zeros((2, len(records), n))
    failed = np.zeros(len(records), dtype=int)
    for k, record in enumerate(records):
        try:
            prediction = propagate(
                posterior_or_model, samples, quantity=quantity, record=record, quantiles=(), seed=seed, **settings
            )
        except SimulationFailed as error:
            if not failures_exceed:
                raise SimulationFailed(f"record {record.name!r}: {error.reason}") from error
            exceeds[k] = counted[k] = 1.0
            failed[k] = n
            continue
        if prediction.values is None or prediction.values.ndim != 1:
            raise ValueError(f"fragility needs one number as quantity; got arrays of shape {prediction.mean.shape}")
        used = np.setdiff1d(np.arange(n), prediction.failed, assume_unique=True)
        counted[k, used], exceeds[k, used] = 1.0, prediction.values > limit
        failed[k] = prediction.n_failed
        if failures_exceed:
            counted[k] = 1.0
            exceeds[k, prediction.failed] = 1.0
    trials = effective * counted.mean(axis=1)
    share = exceeds.sum(axis=1) / counted.sum(axis=1)
    lower, upper = _interval(share, trials, level)
    error = np.sqrt(share * (1.0 - share) / trials)
    try:
        curve = _curve_with_errors(intensities, exceeds, counted, effective, np.random.default_rng(seed))
    except ValueError as reason:
        logger.warning("no fragility curve: %s", reason)
        curve = None
    names = tuple(record.name for record in records)
    return Fragility(names, intensities, share, error, lower, upper, failed, curve, float(limit))


def fit_fragility(intensity: ArrayLike, exceedances: ArrayLike, trials: ArrayLike) -> FragilityCurve:
    """Lognormal fragility curve of maximum likelihood (Baker 2015: binomial at each intensity).

    Parameters
    ----------
    intensity : (n,) float > 0
    exceedances, trials : (n,) float — so many of so many exceeded, not necessarily whole numbers.

    Returns
    -------
    FragilityCurve : without errors (inf).

    Raises
    ------
    ValueError
        If the points determine no rising curve: fewer than two intensities, none or all exceed, every intensity with
        an exceedance is above every one without, or the probability falls with intensity.
    """
    intensity, exceedances, trials = (np.asarray(each, dtype=float) for each in (intensity, exceedances, trials))
    if not intensity.shape == exceedances.shape == trials.shape or intensity.ndim != 1:
        raise ValueError(
            f"one number of exceedances and of trials for each intensity; got shapes {intensity.shape}, "
            f"{exceedances.shape}, {trials.shape}"
        )
    if not (np.all(intensity > 0.0) and np.all((exceedances >= 0.0) & (exceedances <= trials + 1e-9))):
        raise ValueError("intensities must be positive, and 0 <= exceedances <= trials")
    some, not_all = intensity[exceedances > 0.0], intensity[exceedances < trials]
    if not some.size or not not_all.size:
        raise ValueError(f"{'all' if some.size else 'none'} exceed: take records of other intensities")
    if np.ptp(intensity[trials > 0.0]) == 0.0 or some.min() >= not_all.max():
        raise ValueError(
            "the points leave the slope open: take more intensities between those where none and all exceed"
        )

    logs = np.log(intensity)
    centre, width = logs.mean(), logs.std()
    x = (logs - centre) / width
    total = trials.sum()

    def loss(ab: np.ndarray) -> tuple[float, np.ndarray]:
        z = ab[0] + ab[1] * x
        above, below = special.log_ndtr(z), special.log_ndtr(-z)
        density = -0.5 * z**2 - 0.5 * np.log(2.0 * np.pi)
        slope = exceedances * np.exp(density - above) - (trials - exceedances) * np.exp(density - below)
        value = exceedances @ above + (trials - exceedances) @ below
        return -value / total, -np.array([slope.sum(), slope @ x]) / total

    found = optimize.minimize(loss, np.array([0.0, 1.0]), jac=True, method="BFGS", options={"gtol": 1e-8})
    offset, slope = found.x
    if not (np.isfinite(found.x).all() and slope > 0.0):
        raise ValueError("the probability does not rise with intensity: no fragility curve fits")
    return FragilityCurve(float(np.exp(centre - width * offset / slope)), float(width / slope))


def _curve_with_errors(
    intensity: np.ndarray, exceeds: np.ndarray, counted: np.ndarray, effective: float, rng: np.random.Generator
) -> FragilityCurve:
    """The curve of (n_records, n_samples) exceedances, and its errors by resampling whole samples."""
    n = exceeds.shape[1]
    curve = fit_fragility(intensity, exceeds.sum(axis=1), counted.sum(axis=1))
    found = []
    draws = max(int(round(effective)), 1)
    for weights in rng.multinomial(draws, np.full(n, 1.0 / n), size=_REPLICATES):
        try:
            found.append(fit_fragility(intensity, exceeds @ weights, counted @ weights)[:2])
        except ValueError:  # this resampling leaves the curve open
            continue
    if len(found) < 0.9 * _REPLICATES:  # those that can be fitted would be a choice
        return curve
    return curve._replace(
        **dict(zip(("median_error", "dispersion_error"), np.std(found, axis=0).tolist(), strict=True))
    )


def _threshold(threshold: ArrayLike, unit: str | None, channels: Sequence[Channel]) -> np.ndarray:
    """Threshold [SI]; ValueError if it is not finite or its unit is of another dimension than the channels."""
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
            f"one unit cannot serve channels of {', '.join(sorted(dimensions))}; give the thresholds in SI"
        )
    return np.asarray(to_si(limits, unit, *dimensions))


def _interval(share: np.ndarray, effective: ArrayLike, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Clopper-Pearson interval of a probability, at a number of trials that need not be whole."""
    tail = 0.5 * (1.0 - _checked_level(level))
    share = np.asarray(share, dtype=float)
    hits, misses = share * effective, (1.0 - share) * effective
    # where a count is zero the bound is the end of the scale, and the beta distribution none
    lower = np.where(hits > 0.0, stats.beta.ppf(tail, np.maximum(hits, 1e-300), misses + 1.0), 0.0)
    upper = np.where(misses > 0.0, stats.beta.isf(tail, hits + 1.0, np.maximum(misses, 1e-300)), 1.0)
    return lower, upper


def _checked_level(level: float) -> float:
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be between 0 and 1; got {level!r}")
    return level
