r"""Prediction of an event that the structure has not seen yet, from several events that it has.

Structural parameters differ from event to event: frequency and damping change with the amplitude, the season and the
years. What a model cannot fit differs as well, and both are correlated: where the fit is a compromise, parameters that
give too low a response come with a measured value above the fitted one. A number such as a peak is therefore predicted
from *one* distribution for both. With the median parameters :math:`\bar\theta` of the population (`Hierarchy`),

.. math:: \ln y_k = \ln g_k(\bar\theta) + e_k, \qquad
   e_\mathrm{new} \sim t_\nu\!\left(m,\ s \sqrt{1 + 1 / K}\right),

the ratios :math:`e^{e_k}` of measured values to the values at these parameters contain the deviation of each event from
the median, its fitting error, and their correlation. Eleven events do not know how much events scatter, one knows
nothing of it: the scatter has a prior (`EventRatios`), and one event has the same formula.

Histories are predicted with the parameters of the population, and with its noise.
Equations are on the page ``docs/theory/prediction.rst``.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks.finding import warn
from ..checks.stored_posteriors import check_impossible_draws
from ..checks.transfer import check_widening, is_narrow
from ..events.hierarchy_result import Hierarchy
from ..events.ratios import PRIOR_EVENTS, PRIOR_SD, EventRatios
from ..events.spread import EventSpread
from ..signals.records import Record
from .calibrated_range import bandwidth
from .excitation import under_record
from .inputs import read_source
from .prediction import Prediction
from .propagation import propagate
from .quantities import ChannelQuantity, Quantity, measured_quantity
from .streaming import quantiles_with_errors

__all__ = ["at_parameters", "draw_new_event", "event_ratios", "predict_new_event"]

_SENSITIVITY = 20  # draws of the population, under a motion of another kind


def event_ratios(
    hierarchy: Hierarchy | Mapping[str, float],
    posteriors: Mapping[str, Any],
    quantity: ChannelQuantity | Sequence[ChannelQuantity],
    *,
    form: str = "constant",
    prior_sd: ArrayLike = PRIOR_SD,
    prior_events: float = PRIOR_EVENTS,
) -> EventRatios:
    """Ratios of the measured values of several events to the values at the median parameters of their population.

    Parameters
    ----------
    hierarchy : Hierarchy, or mapping of str to float
        The population of the events, or parameters of your own by name.
    posteriors : mapping of str to Posterior or FELikelihood
        The likelihood with the measurements of each event. Of a `Hierarchy`, its events are used, and must be there.
    quantity : ChannelQuantity or sequence of ChannelQuantity
        Positive numbers, such as ``peak("deck")``.
    form, prior_sd, prior_events
        As for `EventRatios`.

    Returns
    -------
    EventRatios
        With the parameters in ``at``. One simulation per event.

    Raises
    ------
    ValueError
        If a posterior or a parameter is missing, the quantity is no number of channels, measurements or samples of them
        are missing, a value is not positive, and as `EventRatios`.
    SimulationFailed
        If the simulation of an event at these parameters fails.
    """
    several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
    if not isinstance(several, list | tuple) or not all(isinstance(each, ChannelQuantity) for each in several):
        raise ValueError(f"ratios of events need numbers such as quantity=peak(channel); got {quantity!r}")
    of_population = isinstance(hierarchy, Hierarchy)
    names = list(hierarchy.posterior.tests if of_population else posteriors)
    if missing := [name for name in names if name not in posteriors]:
        raise ValueError(f"the posteriors of {', '.join(map(repr, missing))} are missing")
    at, values, levels = hierarchy.median_test() if of_population else dict(hierarchy), [], []
    for name in names:
        source = read_source(posteriors[name])
        if source.likelihood is None:
            raise ValueError(
                f"event {name!r} needs a posterior or a likelihood with measurements; got {source.model!r}"
            )
        measured = measured_quantity(quantity, source.likelihood.measurements)
        rows = at_parameters(at, source.model.parameter_names, 1)
        options = {"quantiles": (), "check": False, "progress": False}
        predicted = propagate(source.likelihood, rows, quantity=quantity, **options).mean
        if not ((measured > 0.0) & (predicted > 0.0)).all():
            raise ValueError(
                f"ratios of events need positive values; event {name!r}: measured {measured}, predicted {predicted}"
            )
        values.append(measured / predicted)
        levels.append(predicted)
    return EventRatios(values, prior_sd, prior_events, levels, form, at)


def predict_new_event(
    hierarchy: Hierarchy,
    posteriors: Mapping[str, Any],
    record: Record | Any,
    *,
    model: Any = None,
    quantity: Quantity | Mapping[str, Quantity] = None,
    form: str = "constant",
    prior_sd: ArrayLike = PRIOR_SD,
    prior_events: float = PRIOR_EVENTS,
    noise: bool | str = False,
    n: int = 500,
    seed: int | None = None,
    **options: Any,
) -> Prediction | dict[str, Prediction]:
    """Predict an event that is not among the events of a hierarchical model.

    Parameters
    ----------
    hierarchy : Hierarchy
        The parameter population over the calibration events. Its varying and common parameters must include the model's
        parameters; for histories also those whose prior is the same in all events.
    posteriors : mapping of str to Posterior or FELikelihood
        The likelihood with the measurements of each event of the hierarchy; others are not used.
    record : Record, or sequence of Record
        Excitation of the new event; None for the excitation of `model`.
    model : Posterior, FELikelihood or Model, optional
        What predicts. Default: the posterior of the first event.
    quantity : optional
        Numbers such as ``peak("deck")``, one or a list of them: the *measured* values of the new event are predicted.
        Histories, as for `propagate`: the response, or the measurements with ``noise=True``. Several of these by name.
        Default: the histories of all channels.
    form, prior_sd, prior_events
        Of the ratio of measured values to the values at the median parameters, see `EventRatios`. The printed
        prediction says how much of the width is due to the prior.
    noise : bool or str
        Whether histories are predicted with noise, as for `propagate`. The noise parameters must be varying, common, or
        have the same prior in all events. Shares of the response (`GaussianNoise`)
        transfer between events, levels in SI units do not. Numbers contain all errors without it.
    n : int
        Number of draws. Histories need a simulation for each, numbers one for each event and one for the new one. Draws
        with an impossible noise, such as a share of 1 or more of ``level="measured"``, are left out.
    seed : int, optional
        Seed for drawing parameters, ratios and noise.
    **options
        Further options of `propagate`, such as ``quantiles=`` and ``from_state=``.

    Returns
    -------
    Prediction, or dict of str to Prediction
        For numbers, mean, variance and standard error are NaN: the exponential of Student's t has no mean; use
        quantiles. The intervals that `exceedance` derives from it contain the uncertainty of the ratio.

    Raises
    ------
    ValueError
        If the posterior of an event is missing, a parameter has no median, the quantity is neither a history nor a
        positive number of a channel, and as `Hierarchy.new_test`, `EventRatios` and `propagate`.
    SimulationFailed
        If the simulation at the median parameters fails, or all simulations of the histories.

    Warns
    -----
    UserWarning
        As `propagate` for peaks outside the range of all events, and for harmonics, with which the scatter is widened
        (see Notes). For histories also as `Hierarchy.new_test`, and if more than 1 % of the draws have an
        impossible noise. Residuals of the single calibrations are not checked.

    Notes
    -----
    The intervals of numbers are those of normal log ratios whose scatter is the same in all events: the same change of
    the parameters changes the logarithm of the value by the same amount. Under a harmonic near a resonance it changes
    far more. If the power of the motion is in a band of less than a fifth of the width in every event, 20 draws of the
    population are simulated in each event and the new one. What the variance of the logarithm over them has more than
    the largest one of the events is added to the variance of the new event.
    See ``docs/theory/prediction.rst``.

    Examples
    --------
    >>> predict_new_event(hierarchy, posteriors, record, quantity=peak("deck")).quantiles
    """
    if not isinstance(posteriors, Mapping) or not posteriors:
        raise ValueError(
            f"predict_new_event: expected the posteriors of the events by name, {{name: posterior}}; got {posteriors!r}"
        )
    if isinstance(quantity, Mapping):
        given = {"model": model, "form": form, "prior_sd": prior_sd, "prior_events": prior_events, "n": n, "seed": seed}
        return {
            name: predict_new_event(
                hierarchy, posteriors, record, quantity=each, noise=noise and not _is_number(each), **given, **options
            )
            for name, each in quantity.items()
        }
    predictor = next(iter(posteriors.values())) if model is None else model
    known = [read_source(posteriors[name]).likelihood for name in hierarchy.posterior.tests if name in posteriors]
    settings = {
        "calibrated": [each.measurements for each in known if each],
        "check": False,
        "progress": False,
    } | options
    if _is_number(quantity):
        if noise:
            raise ValueError("predict_new_event: numbers contain the errors of measurements already; noise=False")
        given = {"form": form, "prior_sd": prior_sd, "prior_events": prior_events}
        ratios = event_ratios(hierarchy, posteriors, quantity, **given)
        rows = at_parameters(
            ratios.at, read_source(predictor).model.parameter_names, n
        )  # equal rows are simulated once
        prediction = propagate(predictor, rows, record=record, quantity=quantity, **settings)
        moved = read_source(predictor).model
        moved = moved if record is None else under_record(moved, record)
        tests = list(hierarchy.posterior.tests)
        width = bandwidth(moved)
        if all(is_narrow(width, bandwidth(read_source(posteriors[name]).model)) for name in tests):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of draws beyond bounds, and what the prediction has said
                seeds = np.random.SeedSequence(seed).spawn(1)[0]
                draws, _ = draw_new_event(hierarchy, list(rows), _SENSITIVITY, None, seeds)
                own = _log_sd(predictor, draws, quantity, record, settings)
                events = [_log_sd(posteriors[name], draws, quantity, None, {}) for name in tests]
            ratios = _widened(ratios, own, np.max(events, axis=0))
            several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
            found = check_widening(dict(zip(map(str, several), np.atleast_1d(ratios.widening).tolist(), strict=True)))
            warn(found)
            prediction = replace(prediction, findings=(*prediction.findings, *found))
        prediction = replace(prediction, spread=EventSpread(prediction.values, None, ratios))
        return _corrected(prediction, ratios, np.random.default_rng(seed))
    source = read_source(predictor)
    names = list(source.model.parameter_names)
    if noise:
        if source.noise is None:
            raise ValueError("predict_new_event: noise=True needs a posterior; got a model")
        names += source.noise.parameter_names
    parameters, errors = np.random.SeedSequence(seed).spawn(2)
    draws, _ = draw_new_event(hierarchy, names, n, source.noise if noise else None, parameters)
    own_seed = int(errors.generate_state(1)[0])
    return propagate(predictor, draws, record=record, quantity=quantity, noise=noise, seed=own_seed, **settings)


def _log_sd(predictor: Any, draws: Mapping[str, np.ndarray], quantity: Any, record: Any, settings: Any) -> np.ndarray:
    """Standard deviation of the logarithm of a quantity over draws of the parameters, shaped like the quantity."""
    options = settings | {"quantiles": (), "calibrated": (), "check": False, "progress": False}
    source = read_source(predictor)
    values = propagate(source.likelihood or source.model, draws, record=record, quantity=quantity, **options).values
    return np.log(np.maximum(values, np.finfo(float).tiny)).std(axis=0)


def _widened(ratios: EventRatios, own: np.ndarray, of_events: np.ndarray) -> EventRatios:
    """Ratios for a new event that depends more on the parameters than the events do."""
    excess = np.maximum(np.square(own) - np.square(of_events), 0.0)
    return replace(ratios, widening=np.sqrt(1.0 + excess / np.square(ratios.sd)))


def _is_number(quantity: Any) -> bool:
    """Whether a quantity is a number, or several, not a history."""
    several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
    is_list = isinstance(several, list | tuple)
    return callable(quantity) or (is_list and any(isinstance(each, ChannelQuantity) for each in several))


def at_parameters(parameters: Mapping[str, float], names: Sequence[str], n: int) -> dict[str, np.ndarray]:
    """Equal rows of a model's parameters (n,) by name; ValueError for parameters without a value."""
    if missing := [name for name in names if name not in parameters]:
        raise ValueError(
            f"{', '.join(missing)} belong to each event alone and have no median; make them varying or common in the "
            "HierarchicalPosterior"
        )
    return {name: np.full(n, parameters[name]) for name in names}


def draw_new_event(
    hierarchy: Hierarchy, names: list[str], n: int, noise: Any, seed: np.random.SeedSequence
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draw named parameters of a new event, m arrays each, and their weights (n_populations, m) in single populations.

    See `Hierarchy.population_weights`. Draws where the noise, whose parameters are among the names, is impossible are
    left out, with a warning if they are more than 1 %.
    """
    own = [name for name in hierarchy.posterior.varying if name not in names]
    draws = hierarchy.new_test(n, [*names, *own], np.random.default_rng(seed))
    if noise is not None:
        draws = _possible(draws, noise)
    return {name: draws[name] for name in names}, hierarchy.population_weights(draws)


def _possible(draws: dict[str, np.ndarray], noise: Any) -> dict[str, np.ndarray]:
    """Leave out draws whose noise is impossible: a population has no bounds, but shares of the response have."""
    if not hasattr(noise, "standard_deviations"):
        return draws
    deviations = noise.standard_deviations(np.stack([draws[name] for name in noise.parameter_names], axis=1))
    possible = (deviations > 0.0).all(axis=1)
    warn(check_impossible_draws(possible), stacklevel=3)
    return {name: values[possible] for name, values in draws.items()}


def _corrected(prediction: Prediction, ratios: EventRatios, rng: np.random.Generator) -> Prediction:
    """The prediction times draws of a new event's ratio."""
    values = prediction.values * ratios.draw(prediction.values, rng)
    effective = prediction.effective_sample_size
    quantiles, errors = quantiles_with_errors(
        values.reshape(len(values), -1), np.ones(len(values), dtype=int), prediction.probabilities, effective
    )
    shape = (len(prediction.probabilities), *prediction.mean.shape)
    unknown = np.full(prediction.mean.shape, np.nan)  # exp(t) of Student's t has no mean
    return replace(
        prediction,
        mean=unknown,
        variance=unknown,
        standard_error=unknown,
        quantiles=quantiles.reshape(shape),
        quantile_error=errors.reshape(shape),
        values=values,
        noise=True,
    )
