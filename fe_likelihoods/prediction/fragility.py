"""Fragility: probability that a response exceeds a limit, against the intensity of the shaking.

Under each record the probability of an exceedance is the mean over the samples of the posterior of the probability that
each exceeds; for a `Hierarchy`, the probability in a new event. It contains the model error, from ratios of measured to
fitted values or from a noise that follows the response. A lognormal curve is fitted to these points
(`fe_likelihoods.prediction.fragility_curve`). See ``docs/theory/prediction.rst``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..events.hierarchy_result import Hierarchy
from ..events.ratios import EventRatios
from ..noise.protocol import follows_response
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from ..text_tables import number, text_table
from ..units import DIMENSIONS
from .excitation import chosen_state, excite, under_record
from .fragility_curve import FragilityCurve, curve_with_errors
from .inputs import PredictionSource, part_of, read_source, split_samples
from .new_event import at_parameters, under_motion
from .propagation import AllFailed, check_effective_sample_size, propagate
from .quantities import ChannelQuantity, evaluator
from .reliability import (
    Estimate,
    check_level,
    contents,
    estimate,
    threshold_in_si,
    unit_of_threshold,
    warn_of_missing_error,
)

__all__ = ["Fragility", "fragility", "peak_ground_acceleration"]

logger = logging.getLogger(__name__)


class Fragility(NamedTuple):
    """Probability of an exceedance against intensity.

    Attributes
    ----------
    names : tuple of str
        Names of the records; component names of one excitation are joined by a comma.
    intensity : ndarray, shape (n_records,)
        Intensities of the records.
    probability : ndarray, shape (n_records,)
        Mean over the samples of the probability to exceed.
    standard_error : ndarray, shape (n_records,)
        Monte Carlo error, as in `Exceedance`.
    lower, upper : ndarray, shape (n_records,)
        Interval of each probability, as in `Exceedance`.
    n_failed : ndarray of int, shape (n_records,)
        Number of samples whose simulation failed, without those whose structure collapsed.
    n_collapsed : ndarray of int, shape (n_records,)
        Number of samples whose structure collapsed (`fe_likelihoods.SimulationFailed` with a reason that begins with
        "collapse"). They count as exceedances.
    curve : FragilityCurve or None
        The fitted curve, None if the points do not determine one (the reason is logged as a warning).
    threshold : float
        Threshold [SI].
    from_state : str
        State of the structure at the beginning of each record, "virgin" or "end", as in
        `fe_likelihoods.prediction.propagation.propagate`.
    uncertainty : str
        Which uncertainties the probabilities contain.
    unit : str
        SI unit of the threshold; "SI" where its dimension is not known.
    intensity_unit : str
        Unit of the intensities: m/s2 for `peak_ground_acceleration`, empty for another function.
    """

    names: tuple[str, ...]
    intensity: np.ndarray
    probability: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    n_failed: np.ndarray
    n_collapsed: np.ndarray
    curve: FragilityCurve | None
    threshold: float
    from_state: str = "virgin"
    uncertainty: str = ""
    unit: str = "SI"
    intensity_unit: str = ""

    def __str__(self) -> str:
        intensity = f"intensity [{self.intensity_unit}]" if self.intensity_unit else "intensity"
        rows = [("record", intensity, "P(exceed)", "MC error", "interval", "failed", "collapsed")]
        for k, name in enumerate(self.names):
            numbers = number(self.intensity[k]), number(self.probability[k]), number(self.standard_error[k], 2)
            ends = f"{number(self.lower[k])} to {number(self.upper[k])}"
            rows.append((name, *numbers, ends, f"{self.n_failed[k]}", f"{self.n_collapsed[k]}"))
        unit = "" if self.unit == "1" else f" {self.unit}"
        lines = [f"Probability to exceed {number(self.threshold)}{unit}, from the state {self.from_state!r}"]
        lines += [
            text_table(rows),
            "no curve: the points do not determine one" if self.curve is None else f"{self.curve}",
        ]
        return "\n".join([*lines, *([f"The probabilities contain {self.uncertainty}."] if self.uncertainty else [])])

    __repr__ = __str__


def peak_ground_acceleration(record: Record | Sequence[Record]) -> float:
    """Return the largest absolute acceleration of a record, or of the first one of several components [m/s²].

    Examples
    --------
    >>> from fe_likelihoods.prediction.fragility import peak_ground_acceleration
    >>> round(peak_ground_acceleration(record), 2)  # m/s²
    0.93
    """
    return float(np.max(np.abs(_components(record)[0].acceleration)))


def _components(record: Record | Sequence[Record]) -> tuple[Record, ...]:
    """The records of one excitation: one, or one per direction or support."""
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
    ratios: EventRatios | None = None,
    noise: bool | str | None = None,
    intensity: Callable[[Record], float] = peak_ground_acceleration,
    from_state: str | None = None,
    rest: float = 10.0,
    level: float = 0.95,
    seed: int | None = None,
    **settings: Any,
) -> Fragility:
    """Estimate the probability that a quantity exceeds a threshold under each of several records, and fit a curve.

    Parameters
    ----------
    posterior_or_model, samples
        As in `fe_likelihoods.prediction.propagation.propagate`. The samples may be a `Hierarchy`, with the ratios of
        `event_ratios`: each record is then simulated at the median parameters, and at their spread between events, from
        which the scatter under this record follows.
    records : sequence of (Record or tuple of Record)
        Excitations, such as one motion scaled, ``[record.scale(k) for k in factors]``, or different motions. Each is a
        tuple if the model has several components: the horizontal and the vertical record of an `IsolatedBridge`, or the
        support records of a `LinearStructure`.
    quantity : ChannelQuantity or callable
        A quantity that is one number, such as ``peak("displacement")``.
    threshold : float
        The threshold; positive if there are ratios.
    part : str, optional
        For a `JointLikelihood` or its posterior: the name of the likelihood whose model predicts.
    unit : str, optional
        Unit of the threshold, with the dimension of the quantity's channel. Default: SI.
    ratios : EventRatios, optional
        Ratios of measured to predicted values of the quantity in several events: the model error.
    noise : bool or str, optional
        The model error from the noise of the calibration, as for `propagate`. Default: "model" if there are no ratios,
        the noise follows the response (`GaussianNoise` with shares) and the samples have its parameters. Otherwise the
        model error is left out, with a warning; False states that this is on purpose.
    intensity : callable
        Function that returns a positive number for an element of `records`. Default: peak acceleration [m/s²], of the
        first record of a tuple (the horizontal component, or the first support).
    from_state, rest
        State of the structure at the beginning of each record, as in `propagate`. With "end" every record follows the
        excitation of the model, not the other records.
    level : float
        Probability of the intervals, between 0 and 1.
    seed : int, optional
        Seed of the noise, of ratio distributions, and of the resampling for the errors of the curve.
    **settings
        Further arguments of `propagate`: cache, effective_sample_size, pool, progress.

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
        If every simulation under a record fails, none by collapse.

    Warns
    -----
    UserWarning
        If the model error is left out without ``noise=False``. As `propagate`; with a `Hierarchy`, also if peaks are
        outside the range of all its tests, where each `StoredPosterior` has its measurements.

    Examples
    --------
    >>> motions = [record.scale(factor) for factor in (0.8, 0.9, 1.0, 1.1, 1.2)]
    >>> ratios = EventRatios([0.93, 1.10, 1.02, 0.99])  # measured to predicted peaks of earlier events
    >>> curve = fragility(
    ...     posterior, samples, motions, peak("displacement"), 8.0, unit="cm", ratios=ratios, seed=1
    ... )
    >>> print(curve)  # doctest: +SAMPLED
    Probability to exceed 0.08 m, from the state 'virgin'
    record   intensity [m/s2]  P(exceed)  MC error          interval  failed  collapsed
    shaking              0.74     0.0777   0.00061  0.00138 to 0.372       0          0
    shaking             0.833      0.295    0.0017   0.0528 to 0.699       0          0
    shaking             0.925      0.624    0.0019    0.255 to 0.924       0          0
    shaking              1.02      0.856     0.001    0.515 to 0.992       0          0
    shaking              1.11      0.952   0.00039        0.734 to 1       0          0
    lognormal fragility curve: median 0.89 +- 0.054 m/s2, dispersion 0.129 +- 0.028
    The probabilities contain the uncertainty of the parameters and the error of the model, from the ratios of 4
    events.
    """
    if taken := {"record", "quantiles"} & set(settings):
        raise ValueError(f"fragility sets {', '.join(sorted(taken))} itself; leave these arguments out")
    predictor, rows, noise = _chosen(posterior_or_model, samples, part, ratios, noise)
    source = read_source(predictor)
    thetas, _ = split_samples(source, rows, noise, True)
    known = evaluator(quantity, source.model.channels, source.model.dt)
    if known.rows is not None or len(known.channels) > 1:
        raise ValueError(f"fragility needs one number as quantity, such as peak(channel); got {quantity!r}")
    limit = threshold_in_si(threshold, unit, known.channels)
    if limit.shape != ():
        raise ValueError(f"fragility needs one threshold; got an array of shape {limit.shape}")
    if ratios is not None and (ratios.shape or not limit > 0.0):
        raise ValueError("with ratios, fragility needs those of one quantity, (n_events,), and a positive threshold")
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
    if isinstance(samples, Hierarchy):  # all its tests together give the range of amplitudes
        measured = [each.measurements for each in samples.posterior.tests.values() if each.measurements is not None]
        settings = {"calibrated": measured, "check": False} | settings
    n = len(thetas)
    effective = check_effective_sample_size(settings.get("effective_sample_size"), n)
    check_level(level)

    values = np.full((n, len(records)), np.nan)
    collapsed = np.zeros(values.shape, dtype=bool)
    under = [ratios] * len(records)
    common = {"from_state": state, "rest": rest, "noise": noise, "seed": seed}
    for k, record in enumerate(records):
        more = settings if k == np.argmax(intensities) else settings | {"calibrated": ()}  # warned of once
        try:
            if isinstance(samples, Hierarchy):
                prediction, found, under[k] = under_motion(predictor, ratios, record, quantity, **common, **more)
                values[0, k], collapsed[0, k] = found[0], 0 in prediction.collapsed
            else:
                prediction = propagate(
                    predictor, rows, quantity=quantity, record=record, quantiles=(), **common, **more
                )
                found = prediction.values
                values[np.setdiff1d(np.arange(n), prediction.failed, assume_unique=True), k] = found
                collapsed[prediction.collapsed, k] = True
        except AllFailed as error:
            collapsed[error.collapsed[error.collapsed < n], k] = True
            if not collapsed[:, k].any():
                raise SimulationFailed(f"record {_name(record)!r}: {error.reason}") from error
        if np.isnan(values[:, k]).all() and not collapsed[:, k].any():
            raise SimulationFailed(f"record {_name(record)!r}: the simulation at the median parameters failed")
    columns = [
        estimate(each, limit, of_record, exceeds, effective, level, seed)
        for each, of_record, exceeds in zip(values.T, under, collapsed.T, strict=True)
    ]
    found = Estimate(*(None if each[0] is None else np.array(each) for each in zip(*columns, strict=True)))
    draws = None if found.draws is None else found.draws.T
    intensity_unit = DIMENSIONS["acceleration"] if intensity is peak_ground_acceleration else ""
    try:
        rng = np.random.default_rng(seed)
        curve = curve_with_errors(intensities, found.single, found.counted, effective, draws, rng)
        curve = curve._replace(unit=intensity_unit)
    except ValueError as reason:
        logger.warning("no fragility curve: %s", reason)
        curve = None
    return Fragility(
        tuple(_name(record) for record in records),
        intensities,
        found.probability,
        found.standard_error,
        found.lower,
        found.upper,
        (np.isnan(values) & ~collapsed).sum(axis=0),
        collapsed.sum(axis=0),
        curve,
        float(limit),
        state,
        contents(bool(noise), ratios),
        unit_of_threshold(unit, known.channels),
        intensity_unit,
    )


def _chosen(
    posterior_or_model: Any,
    samples: Any,
    part: str | None,
    ratios: EventRatios | None,
    noise: bool | str | None,
) -> tuple[Any, Any, bool | str]:
    """The object to predict with, its samples, and the noise to predict with."""
    if ratios is not None and noise:
        raise ValueError("ratios contain the error of the model already: leave out noise, or give noise=False")
    if isinstance(samples, Hierarchy):
        if ratios is None or ratios.at is None:
            raise ValueError(
                "fragility: draws of a Hierarchy and ratios are correlated; give ratios=event_ratios(hierarchy, "
                "posteriors, quantity), which contain the spread of the parameters"
            )
        names = read_source(posterior_or_model).model.parameter_names
        return posterior_or_model, [at_parameters(ratios.at, names)], False
    predictor, rows = part_of(posterior_or_model, samples, part, bool(noise))
    source = read_source(predictor)
    if noise is None and ratios is None:
        complete = None
        if source.noise is not None and follows_response(source.noise):
            complete = _with_noise(posterior_or_model, samples, part, source)
        if complete is not None:
            return predictor, complete, "model"
        warn_of_missing_error(
            "fragility", "calibrate with noise in shares of the response and give samples of all parameters", 4
        )
    return predictor, rows, noise or False


def _with_noise(posterior: Any, samples: Any, part: str | None, source: PredictionSource) -> Any:
    """The samples with the noise parameters, None if they have structural parameters only."""
    try:
        rows = part_of(posterior, samples, part, True)[1]
    except ValueError:  # of a joint likelihood, without the parameters of the noise
        return None
    names = [*source.model.parameter_names, *source.noise.parameter_names]
    complete = set(names) <= set(rows) if isinstance(rows, Mapping) else np.shape(rows)[-1:] == (len(names),)
    return rows if complete else None
