r"""Fragility: probability that a response exceeds a limit, against the intensity of the shaking.

Under each record the probability of an exceedance is the fraction of the samples of the posterior that exceed. A
lognormal curve

.. math:: P(\text{exceed} \mid x) = \Phi\!\left(\frac{\ln (x / m)}{s}\right)

with median :math:`m` and dispersion :math:`s` is fitted to these points by maximum likelihood (Baker 2015). See
``docs/theory/prediction.rst``.

References
----------
J. W. Baker (2015), Efficient analytical fragility function fitting using dynamic structural analysis, Earthquake
Spectra 31(1), 579-599, doi:10.1193/021113EQS025M.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .excitation import chosen_state, excite, under_record
from .inputs import part_of, read_source, split_samples
from .propagation import check_effective_sample_size, propagate
from .quantities import ChannelQuantity, evaluator
from .reliability import binomial_interval, check_level, threshold_in_si

__all__ = ["Fragility", "FragilityCurve", "fit_fragility", "fragility", "peak_ground_acceleration"]

logger = logging.getLogger(__name__)

_REPLICATES = 100  # resamplings for the errors of the curve


class FragilityCurve(NamedTuple):
    """Lognormal fragility curve, P(exceed | intensity) = Phi(ln(intensity / median) / dispersion).

    Attributes
    ----------
    median : float
        Intensity at which the probability is one half.
    dispersion : float
        Standard deviation of the logarithm of the capacity in terms of intensity [-].
    median_error, dispersion_error : float
        Monte Carlo errors, by resampling the samples (which all records share) for fixed records. They do not include
        the effect of other records. They are inf if more than a tenth of the resamplings do not determine a curve.
    """

    median: float
    dispersion: float
    median_error: float = np.inf
    dispersion_error: float = np.inf

    def probability(self, intensity: ArrayLike) -> np.ndarray:
        """Return the probability of an exceedance at positive intensities."""
        return special.ndtr(np.log(np.asarray(intensity, dtype=float) / self.median) / self.dispersion)


class Fragility(NamedTuple):
    """Probability of an exceedance against intensity.

    Attributes
    ----------
    names : tuple of str
        Names of the records; those of the components of an excitation are joined by a comma.
    intensity : ndarray, shape (n_records,)
        Intensities of the records.
    probability : ndarray, shape (n_records,)
        Fraction of the samples that exceed.
    standard_error : ndarray, shape (n_records,)
        Monte Carlo error, as in `fe_likelihoods.Exceedance`.
    lower, upper : ndarray, shape (n_records,)
        Clopper-Pearson interval, as in `fe_likelihoods.Exceedance`.
    n_failed : ndarray of int, shape (n_records,)
        Number of samples whose simulation failed.
    curve : FragilityCurve or None
        The fitted curve, None if the points do not determine one (the reason is logged as a warning).
    threshold : float
        Threshold [SI].
    from_state : str
        State of the structure at the beginning of each record, "virgin" or "end", as in
        `fe_likelihoods.prediction.propagation.propagate`.
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
    from_state: str = "virgin"


def peak_ground_acceleration(record: Record | Sequence[Record]) -> float:
    """Return the largest absolute acceleration of a record, or of the first one of several components [m/s²]."""
    return float(np.max(np.abs(_components(record)[0].acceleration)))


def _components(record: Record | Sequence[Record]) -> tuple[Record, ...]:
    """The records of one excitation: one, or those of its directions or supports."""
    return (record,) if isinstance(record, Record) else tuple(record)


def _name(record: Record | Sequence[Record]) -> str:
    """Names of the records of one excitation."""
    return ", ".join(each.name for each in _components(record))


def fragility(
    posterior_or_model: Any,
    samples: Any,
    records: Sequence[Record | Sequence[Record]],
    quantity: ChannelQuantity | Callable[[np.ndarray], float],
    threshold: float,
    *,
    part: str | None = None,
    unit: str | None = None,
    intensity: Callable[[Record], float] = peak_ground_acceleration,
    failures_exceed: bool = False,
    from_state: str | None = None,
    rest: float = 10.0,
    effective_sample_size: float | None = None,
    level: float = 0.95,
    seed: int | None = None,
    **settings: Any,
) -> Fragility:
    """Estimate the probability that a quantity exceeds a threshold under each of several records, and fit a curve.

    Parameters
    ----------
    posterior_or_model, samples
        As in `fe_likelihoods.prediction.propagation.propagate`.
    records : sequence of Record, or of tuples of Record
        Excitations, such as one motion scaled, ``[record.scale(k) for k in factors]``, or different motions. Each is a
        tuple if the model has several components: the horizontal and the vertical record of an `IsolatedBridge`, or the
        records of the supports of a `LinearStructure`.
    quantity : ChannelQuantity or callable
        A quantity that is one number, such as ``peak("displacement")``.
    threshold : float
        The threshold.
    part : str, optional
        For a `JointLikelihood` or its posterior: the name of the likelihood whose model predicts.
    unit : str, optional
        Unit of the threshold. It must have the dimension of the channel of the quantity. Default: SI.
    intensity : callable
        Function of an element of `records` that returns a positive number. Default: peak acceleration [m/s²], of the
        first record of a tuple (the horizontal component, or the first support).
    failures_exceed : bool
        Count a failed simulation as an exceedance, for models whose simulation fails at collapse. Default: failed
        samples are left out.
    from_state, rest
        State of the structure at the beginning of each record, as in `propagate`. With "end" every record follows the
        excitation of the model, not the other records.
    effective_sample_size : float, optional
        Effective number of independent samples. Default: the number of samples.
    level : float
        Probability of the intervals, between 0 and 1.
    seed : int, optional
        Seed of the noise and of the resampling for the errors of the curve.
    **settings
        Further arguments of `propagate`: noise, batch, pool, progress.

    Returns
    -------
    Fragility
        Probabilities per record, and the curve.

    Raises
    ------
    ValueError
        As `propagate` and `exceedance`, before any simulation where possible. Also if there are no records, an
        intensity is not positive, or the quantity is not one number.
    SimulationFailed
        If every simulation under a record fails and failures do not count as exceedances.
    """
    if taken := {"record", "quantiles", "memory_bytes"} & set(settings):
        raise ValueError(f"fragility sets {', '.join(sorted(taken))} itself; leave these arguments out")
    posterior_or_model, samples = part_of(posterior_or_model, samples, part, settings.get("noise", False))
    source = read_source(posterior_or_model)
    thetas, _ = split_samples(source, samples, settings.get("noise", False), True)
    known = evaluator(quantity, source.model.channels, source.model.dt)
    if known.rows is not None or len(known.channels) > 1:
        raise ValueError(f"fragility needs one number as quantity, such as peak(channel); got {quantity!r}")
    limit = threshold_in_si(threshold, unit, known.channels)
    if limit.shape != ():
        raise ValueError(f"fragility needs one threshold; got an array of shape {limit.shape}")
    records = list(records)
    if not records:
        raise ValueError("fragility needs one record or more, such as [record.scale(k) for k in factors]; got none")
    under_record(source.model, records[0])  # errors come before the warning about the state
    state = chosen_state(source.model, records, from_state)
    for record in records:
        excite(source.model, record, state, rest)
    intensities = np.array([float(intensity(record)) for record in records])
    if not np.all((intensities > 0.0) & (intensities < np.inf)):
        raise ValueError(f"intensities must be positive and finite; got {intensities}")

    n = len(thetas)
    effective = check_effective_sample_size(effective_sample_size, n)
    check_level(level)

    exceeds, counted = np.zeros((2, len(records), n))
    failed = np.zeros(len(records), dtype=int)
    for k, record in enumerate(records):
        try:
            prediction = propagate(
                posterior_or_model,
                samples,
                quantity=quantity,
                record=record,
                from_state=state,
                rest=rest,
                quantiles=(),
                seed=seed,
                **settings,
            )
        except SimulationFailed as error:
            if not failures_exceed:
                raise SimulationFailed(f"record {_name(record)!r}: {error.reason}") from error
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
    lower, upper = binomial_interval(share, trials, level)
    error = np.sqrt(share * (1.0 - share) / trials)
    try:
        curve = _curve_with_errors(intensities, exceeds, counted, effective, np.random.default_rng(seed))
    except ValueError as reason:
        logger.warning("no fragility curve: %s", reason)
        curve = None
    names = tuple(_name(record) for record in records)
    return Fragility(names, intensities, share, error, lower, upper, failed, curve, float(limit), state)


def fit_fragility(intensity: ArrayLike, exceedances: ArrayLike, trials: ArrayLike) -> FragilityCurve:
    """Fit a lognormal fragility curve by maximum likelihood (Baker 2015: binomial at each intensity).

    Parameters
    ----------
    intensity : (n,) array_like
        Positive intensities.
    exceedances : (n,) array_like
        Number of exceedances at each intensity, not necessarily a whole number.
    trials : (n,) array_like
        Number of trials at each intensity, not necessarily a whole number.

    Returns
    -------
    FragilityCurve
        The curve, without errors (inf).

    Raises
    ------
    ValueError
        If the points do not determine a rising curve: fewer than two intensities, none or all of the trials exceed,
        every intensity with an exceedance is above every one without, or the probability decreases with intensity.
    """
    intensity, exceedances, trials = (np.asarray(each, dtype=float) for each in (intensity, exceedances, trials))
    if not intensity.shape == exceedances.shape == trials.shape or intensity.ndim != 1:
        raise ValueError(
            f"expected one number of exceedances and of trials for each intensity; got shapes {intensity.shape}, "
            f"{exceedances.shape}, {trials.shape}"
        )
    if not (np.all(intensity > 0.0) and np.all((exceedances >= 0.0) & (exceedances <= trials + 1e-9))):
        raise ValueError(
            f"expected positive intensities and 0 <= exceedances <= trials; got {intensity}, {exceedances}, {trials}"
        )
    some, not_all = intensity[exceedances > 0.0], intensity[exceedances < trials]
    if not some.size or not not_all.size:
        raise ValueError(f"{'all' if some.size else 'none'} of the trials exceed: use records of other intensities")
    if np.ptp(intensity[trials > 0.0]) == 0.0 or some.min() >= not_all.max():
        raise ValueError(
            "the points do not determine the slope: use more intensities between those where none and all exceed"
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
        raise ValueError(
            "the probability does not rise with intensity, so that no fragility curve fits: check the intensities"
        )
    return FragilityCurve(float(np.exp(centre - width * offset / slope)), float(width / slope))


def _curve_with_errors(
    intensity: np.ndarray, exceeds: np.ndarray, counted: np.ndarray, effective: float, rng: np.random.Generator
) -> FragilityCurve:
    """Fit the curve to exceedances (n_records, n_samples), with errors by resampling whole samples."""
    n = exceeds.shape[1]
    curve = fit_fragility(intensity, exceeds.sum(axis=1), counted.sum(axis=1))
    found = []
    draws = max(int(round(effective)), 1)
    for weights in rng.multinomial(draws, np.full(n, 1.0 / n), size=_REPLICATES):
        try:
            found.append(fit_fragility(intensity, exceeds @ weights, counted @ weights)[:2])
        except ValueError:  # this resampling does not determine a curve
            continue
    if len(found) < 0.9 * _REPLICATES:  # the resamplings with a curve would be a biased selection
        return curve
    return curve._replace(
        **dict(zip(("median_error", "dispersion_error"), np.std(found, axis=0).tolist(), strict=True))
    )
