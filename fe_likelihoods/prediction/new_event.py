r"""Prediction of an event that the structure has not seen yet, from several events that it has.

Structural parameters differ from event to event: frequency and damping change with the amplitude, the season and the
years. The posterior of one event, or the common posterior of all, is narrower than these differences. The prediction of
a new event therefore draws its parameters from the event population (`Hierarchy.new_test`), and corrects quantities
such as peaks by the ratio of measured to fitted values in the calibration events:

.. math:: g_\mathrm{new} = r_\mathrm{new}\, g(\theta_\mathrm{new}), \qquad
   \ln r_\mathrm{new} \sim t_\nu\!\left(m,\ s \sqrt{1 + 1 / K}\right).

Where fitting errors and parameters are correlated, `predict_from_median` has both in one ratio.
Equations are on the page ``docs/theory/prediction.rst``.
"""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..events.hierarchy_result import Hierarchy
from ..events.ratios import EventRatios, LevelRatios
from ..events.spread import EventSpread
from ..signals.records import Record
from .inputs import part_of, read_source
from .prediction import Prediction
from .propagation import propagate
from .quantities import ChannelQuantity, Quantity, measured_quantity
from .streaming import quantiles_with_errors

__all__ = ["draw_new_event", "event_level", "event_ratio", "of_hierarchy", "predict_from_median", "predict_new_event"]

_LARGEST_IMPOSSIBLE = 0.01  # share of draws with an impossible noise without a warning


def event_level(
    posterior: Any, samples: Any, quantity: ChannelQuantity | list[ChannelQuantity], part: str | None = None
) -> np.ndarray:
    """Fitted value of a quantity in the event that a posterior was calibrated with, for `LevelRatios`.

    Parameters
    ----------
    posterior, samples, quantity, part
        As for `event_ratio`.

    Returns
    -------
    ndarray, shape () or (n_quantities,)
        Median over the samples' responses [SI], without noise.

    Raises
    ------
    ValueError
        As `propagate`.
    """
    options = {"quantiles": (0.5,), "check": False, "progress": False}  # the median does not depend on the noise
    return propagate(posterior, samples, part=part, quantity=quantity, **options).quantile(0.5)


def event_ratio(
    posterior: Any, samples: Any, quantity: ChannelQuantity | list[ChannelQuantity], part: str | None = None
) -> np.ndarray:
    """Ratio of the measured to the fitted value of a quantity in the event that a posterior was calibrated with.

    Parameters
    ----------
    posterior : Posterior, FELikelihood or JointLikelihood
        The likelihood with the measurements of the event.
    samples : (n, ndim) array_like, or named values of shape (n,)
        Posterior samples of this event.
    quantity : ChannelQuantity or list of ChannelQuantity
        Such as ``peak("deck")``.
    part : str, optional
        As for `propagate`.

    Returns
    -------
    ndarray, shape () or (n_quantities,)
        Measured value divided by the median over the samples' responses, without noise: the model error in this
        quantity where the model fits best.

    Raises
    ------
    ValueError
        As `propagate`, if there are no measurements or samples of the channel are missing, and if a value is not
        positive.
    """
    likelihood, rows = part_of(posterior, samples, part, False)
    source = read_source(likelihood)
    if source.likelihood is None:
        raise ValueError(f"event_ratio needs a posterior or a likelihood with measurements; got {posterior!r}")
    measured = measured_quantity(quantity, source.likelihood.measurements)
    fitted = event_level(likelihood, rows, quantity)
    if not ((measured > 0.0) & (fitted > 0.0)).all():
        raise ValueError(f"event_ratio needs positive values; measured {measured}, fitted {fitted}")
    return measured / fitted


def predict_new_event(
    hierarchy: Hierarchy,
    posterior_or_model: Any,
    record: Record | Any,
    *,
    quantity: Quantity = None,
    ratios: EventRatios | LevelRatios | None = None,
    noise: bool | str = False,
    n: int = 500,
    seed: int | None = None,
    **options: Any,
) -> Prediction:
    """Predict an event that is not among the events of a hierarchical model.

    Parameters
    ----------
    hierarchy : Hierarchy
        The parameter population over the calibration events. Its varying and common parameters must include the model's
        parameters, except those whose prior is the same in all events.
    posterior_or_model : Posterior, FELikelihood or Model
        The model to predict with, such as one event's posterior; with a noise for ``noise=True``.
    record : Record, or sequence of Record
        Excitation of the new event.
    quantity : optional
        As for `propagate`. Default: the histories of all channels.
    ratios : EventRatios or LevelRatios, optional
        Ratios of measured to fitted values of the quantity in the calibration events, for numbers such as
        ``peak(name)`` or several of them. The measured value is then predicted. With `LevelRatios` (one number only)
        each draw has the ratio at its predicted value.
    noise : bool or str
        Whether histories are predicted with noise, as for `propagate`. The noise parameters must be varying, common, or
        have the same prior in all events. Shares of the response (`GaussianNoise`)
        transfer between events, levels in SI units do not.
    n : int
        Number of draws, each one simulation. Draws with an impossible noise, such as a share of 1 or more of
        ``level="measured"``, are left out.
    seed : int, optional
        Seed for drawing parameters, ratios and noise.
    **options
        Further options of `propagate`, such as ``quantiles=`` and ``from_state=``.

    Returns
    -------
    Prediction
        Its spread contains the spread between events. With ratios, mean, variance and standard error are NaN: the
        exponential of Student's t has no mean; use quantiles. The intervals that `exceedance` derives from it contain
        the uncertainty of the population and the ratios.

    Raises
    ------
    ValueError
        As `Hierarchy.new_test` and `propagate`; if ratios are given for histories, together with noise (they contain
        the errors already), or for another number of quantities.

    Warns
    -----
    UserWarning
        As `Hierarchy.new_test`, and if more than 1 % of the draws have an impossible noise. As `propagate` for peaks
        outside the range of all events, if each `StoredPosterior` has its measurements. Residuals of the single
        calibrations are not checked.

    Examples
    --------
    >>> ratios = EventRatios([event_ratio(posteriors[name], chains[name], peak("deck")) for name in posteriors])
    >>> predict_new_event(hierarchy, posterior, record, quantity=peak("deck"), ratios=ratios)
    """
    source = read_source(posterior_or_model)
    names = list(source.model.parameter_names)
    if noise:
        if source.noise is None:
            raise ValueError("predict_new_event: noise=True needs a posterior; got a model")
        names += source.noise.parameter_names
    if ratios is not None:
        several = (quantity,) if isinstance(quantity, ChannelQuantity) else quantity
        numbers = callable(quantity) or (
            isinstance(several, list | tuple) and all(isinstance(each, ChannelQuantity) for each in several)
        )
        if not numbers or noise:
            raise ValueError(
                "predict_new_event: ratios are for numbers such as peak(channel) and contain the error of the "
                "measurements already: give quantity=peak(channel), and noise=False"
            )
    parameters, drawn, errors = np.random.SeedSequence(seed).spawn(3)
    draws, weights = draw_new_event(hierarchy, names, n, source.noise if noise else None, parameters)
    settings = {"progress": False} | of_hierarchy(hierarchy) | options
    prediction = propagate(
        posterior_or_model,
        draws,
        record=record,
        quantity=quantity,
        noise=noise,
        seed=int(errors.generate_state(1)[0]),
        **settings,
    )
    if isinstance(prediction, Mapping):  # several quantities of the same draws
        return {name: _with_spread(each, weights, None) for name, each in prediction.items()}
    prediction = _with_spread(prediction, weights, ratios)
    return prediction if ratios is None else _corrected(prediction, ratios, np.random.default_rng(drawn))


def predict_from_median(
    hierarchy: Hierarchy,
    posteriors: Mapping[str, Any],
    posterior_or_model: Any,
    record: Record | Any,
    *,
    quantity: ChannelQuantity | list[ChannelQuantity],
    prior_sd: float = 0.1,
    prior_events: float = 0.0,
    n: int = 500,
    seed: int | None = None,
    **options: Any,
) -> Prediction:
    r"""Predict the measured peaks of a new event from the population's median parameters and a ratio.

    Each ratio divides a measured value by the value at these parameters, :math:`r_k = y_k / g_k(\bar\theta)`. It
    combines the event's deviation from the median and its fitting error, including their correlation.
    `predict_new_event` adds both as if they were independent, so that intervals are too wide where both cancel: where
    events whose parameters give a low response are also fitted too low.

    Parameters
    ----------
    hierarchy : Hierarchy
        The parameter population over the calibration events.
    posteriors : mapping of str to Posterior or FELikelihood
        The likelihood with the measurements of each event of the hierarchy; others are not used.
    posterior_or_model : Posterior, FELikelihood or Model
        The model to predict with. All its parameters must be varying or common.
    record : Record, or sequence of Record
        Excitation of the new event; None for the model's excitation.
    quantity : ChannelQuantity or list of ChannelQuantity
        Positive numbers, such as ``peak("deck")``.
    prior_sd, prior_events : float
        Guess of the log ratios' standard deviation, and the number of events that it is worth, as for `EventRatios`.
        Needed for one event.
    n : int
        Number of ratio draws. Each event of the hierarchy, and the new one, is simulated once.
    seed : int, optional
        Seed of the draws.
    **options
        Further options of `propagate`, such as ``quantiles=`` and ``from_state=``.

    Returns
    -------
    Prediction
        Its values predict measurements. The intervals that `exceedance` derives from it contain the uncertainty of the
        ratio.

    Raises
    ------
    ValueError
        If the posterior of an event is missing, a parameter of the model is neither varying nor common, the quantity is
        a history, and as `event_ratio` and `EventRatios`.
    SimulationFailed
        If the simulation at these parameters fails.

    Warns
    -----
    UserWarning
        As `predict_new_event`, if peaks are outside the range of all events.

    Notes
    -----
    The intervals are exact for normal log ratios whose scatter is the same in all events: the same change of the
    parameters changes the logarithm of the peak by the same amount. See ``docs/theory/prediction.rst``.

    Examples
    --------
    >>> predict_from_median(hierarchy, posteriors, model, record, quantity=peak("deck")).quantiles
    """
    several = (quantity,) if isinstance(quantity, ChannelQuantity) else quantity
    if not isinstance(several, list | tuple) or not all(isinstance(each, ChannelQuantity) for each in several):
        raise ValueError(f"predict_from_median needs numbers such as quantity=peak(channel); got {quantity!r}")
    if missing := [name for name in hierarchy.posterior.tests if name not in posteriors]:
        raise ValueError(f"predict_from_median: posteriors of {', '.join(map(repr, missing))} are missing")
    median = hierarchy.median_test()
    wanted = read_source(posterior_or_model).model.parameter_names
    if missing := [name for name in wanted if name not in median]:
        raise ValueError(
            f"predict_from_median: {', '.join(missing)} belong to each event alone and have no median; make them "
            "varying or common, or use predict_new_event"
        )
    events = [posteriors[name] for name in hierarchy.posterior.tests]
    at_median = {name: np.array([median[name]]) for name in wanted}
    ratios = EventRatios([event_ratio(each, at_median, quantity) for each in events], prior_sd, prior_events)
    rows = {name: np.full(n, median[name]) for name in wanted}  # equal rows are simulated once
    measured = [read_source(each).likelihood.measurements for each in events]
    settings = {"progress": False, "calibrated": measured, "check": False} | options
    prediction = propagate(posterior_or_model, rows, record=record, quantity=quantity, **settings)
    prediction = replace(prediction, spread=EventSpread(prediction.values, None, ratios))
    return _corrected(prediction, ratios, np.random.default_rng(seed))


def _with_spread(prediction: Prediction, weights: np.ndarray, ratios: EventRatios | LevelRatios | None) -> Prediction:
    """The prediction with its event spread; histories, whose values are not kept, are returned unchanged."""
    if prediction.values is None:
        return prediction
    weights = np.delete(weights, prediction.failed, axis=1)
    spread = EventSpread(prediction.values, weights / weights.sum(axis=1, keepdims=True), ratios)
    return replace(prediction, spread=spread)


def draw_new_event(
    hierarchy: Hierarchy, names: list[str], n: int, noise: Any, seed: np.random.SeedSequence
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draw the parameters of a new event, and their weights in single populations.

    Parameters
    ----------
    hierarchy : Hierarchy
        The population.
    names : list of str
        Parameters to draw.
    n : int
        Number of draws.
    noise : Noise or None
        Noise whose parameters are among the names; draws where it is impossible are left out, with a warning if they
        are more than 1 %.
    seed : numpy.random.SeedSequence
        Seed of the draws.

    Returns
    -------
    draws : dict of str to (m,) ndarray
        Draws of these parameters.
    weights : (n_populations, m) ndarray
        See `Hierarchy.population_weights`.
    """
    own = [name for name in hierarchy.posterior.varying if name not in names]
    draws = hierarchy.new_test(n, [*names, *own], np.random.default_rng(seed))
    if noise is not None:
        draws = _possible(draws, noise)
    return {name: draws[name] for name in names}, hierarchy.population_weights(draws)


def of_hierarchy(hierarchy: Hierarchy) -> dict[str, Any]:
    """Arguments of `propagate` for draws of a population, which was calibrated with all tests, not with one of them."""
    tests = hierarchy.posterior.tests.values()
    return {"calibrated": [each.measurements for each in tests if each.measurements is not None], "check": False}


def _possible(draws: dict[str, np.ndarray], noise: Any) -> dict[str, np.ndarray]:
    """Leave out draws whose noise is impossible: a population has no bounds, but shares of the response have."""
    if not hasattr(noise, "standard_deviations"):
        return draws
    deviations = noise.standard_deviations(np.stack([draws[name] for name in noise.parameter_names], axis=1))
    possible = (deviations > 0.0).all(axis=1)
    if possible.mean() < 1.0 - _LARGEST_IMPOSSIBLE:
        warnings.warn(
            f"predict_new_event: {1.0 - possible.mean():.0%} of the draws have an impossible noise, such as a share of "
            "the measured signal of 1 or more, and are left out. Use level='response', whose shares have no "
            'upper bound, let shares vary with Varying(..., scale="logit"), or state a narrower prior of their '
            "spread between events",
            stacklevel=3,
        )
    return {name: values[possible] for name, values in draws.items()}


def _corrected(prediction: Prediction, ratios: EventRatios | LevelRatios, rng: np.random.Generator) -> Prediction:
    """The prediction times draws of a new event's ratio."""
    if ratios.shape != prediction.mean.shape:
        raise ValueError(
            f"predict_new_event: expected ratios (n_events, ...) of a quantity of shape {prediction.mean.shape}; got "
            f"{ratios.values.shape}"
        )
    values = prediction.values * ratios.draw_at(prediction.values, rng)
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
