r"""Prediction of an event that the structure has not seen yet, from one event or several that it has.

Structural parameters differ from event to event: frequency and damping change with the amplitude, the season and the
years. What a model cannot fit differs as well, and both are correlated: where the fit is a compromise, parameters that
give too low a response come with a measured value above the fitted one. A number such as a peak is therefore predicted
from *one* distribution for both. With the median parameters of the population (`Hierarchy`), the ratios of measured
values to the values at these parameters contain the deviation of each event from the median, its fitting error, and
their correlation. How much they are expected to scatter follows from the model, for each event and number
(`fe_likelihoods.population.event_scatter`). How much more or less this structure scatters follows from the events
(`EventRatios`). One event has the same formula.

Histories are predicted with the parameters of the population, and with its noise.
Equations are on the page ``docs/theory/prediction.rst``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..checks.finding import TAIL
from ..likelihood.likelihood import FELikelihood
from ..population.event_ratios import PRIOR_EVENTS, PRIOR_SD, EventRatios
from ..population.event_scatter import REMAINDER, log_variance, remainder_variance, spread_rows
from ..population.hierarchy import Hierarchy
from ..priors.between_events import BETWEEN_EVENTS
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .model_and_motion import read_source
from .prediction import Prediction
from .propagation import propagate
from .quantities import ChannelQuantity, Quantity, evaluator, measured_quantity


def event_ratios(
    hierarchy: Hierarchy | Mapping[str, float],
    posteriors: Mapping[str, Any],
    quantity: ChannelQuantity | Sequence[ChannelQuantity],
    *,
    spread: Mapping[str, float] | None = None,
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
    spread : mapping of str to float, optional
        Standard deviations of the logarithms of structural parameters between events. A key is the beginning of the
        names of parameters that change together, such as ``{"frequency": 0.02, "damping": 0.2}``. Default:
        `fe_likelihoods.priors.between_events.BETWEEN_EVENTS`, with the parameters whose names begin with "frequency",
        "stiffness" and "damping". The scatter that is expected of each number follows from it. If no parameter of the
        model is among them, amplitudes are expected to scatter by 0.12.
    prior_events : float
        As for `EventRatios`.

    Returns
    -------
    EventRatios
        With the parameters in ``at``, and the expected scatter of each number in each event. One simulation per event,
        and two for each group of parameters that changes.

    Raises
    ------
    ValueError
        If a posterior or a parameter is missing, the quantity is no number of channels, measurements or samples of them
        are missing, a value or a spread is not positive, and as `EventRatios`.
    SimulationFailed
        If the simulation of an event at these parameters fails.

    Examples
    --------
    >>> ratios = event_ratios(hierarchy, posteriors, peak("displacement"))
    >>> ratios.values.round(2)  # doctest: +SAMPLED
    array([1.55, 1.51, 0.86])
    """
    spread = BETWEEN_EVENTS if spread is None else spread
    if not isinstance(spread, Mapping) or not all(0.0 < each < np.inf for each in spread.values()):
        raise ValueError(
            "spread: expected positive standard deviations of logarithms by the beginning of a parameter's name, such "
            f'as {{"frequency": 0.02}}; got {spread!r}'
        )
    several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
    if not isinstance(several, list | tuple) or not all(isinstance(each, ChannelQuantity) for each in several):
        raise ValueError(f"ratios of events need numbers such as quantity=peak(channel); got {quantity!r}")
    of_population = isinstance(hierarchy, Hierarchy)
    names = list(hierarchy.posterior.tests if of_population else posteriors)
    if missing := [name for name in names if name not in posteriors]:
        raise ValueError(f"the posteriors of {', '.join(map(repr, missing))} are missing")
    at, found = hierarchy.median_test() if of_population else dict(hierarchy), []
    for name in names:
        own = hierarchy.median_test(hierarchy.posterior.tests[name].covariates) if of_population else at
        source = read_source(posteriors[name])
        if source.likelihood is None:
            raise ValueError(
                f"event {name!r} needs a posterior or a likelihood with measurements; got {source.model!r}"
            )
        try:
            found.append(_event(source.likelihood, own, quantity, spread))
        except ValueError as error:
            raise ValueError(f"event {name!r}: {error}") from None
    values, levels, of_parameters, of_remainder = (np.array(each) for each in zip(*found, strict=True))
    remainder = of_remainder.mean(axis=0)
    sd = np.sqrt(of_parameters + remainder)
    return EventRatios(values, sd, prior_events, levels, at=at, spread=spread, remainder=remainder)


def predict_new_event(
    hierarchy: Hierarchy,
    posteriors: Mapping[str, Any],
    record: Record | Any,
    *,
    model: Any = None,
    quantity: Quantity = None,
    spread: Mapping[str, float] | None = None,
    prior_events: float = PRIOR_EVENTS,
    covariates: Mapping[str, float] | None = None,
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
        parameters; for histories also those whose prior is the same in all events.
    posteriors : mapping of str to Posterior or FELikelihood
        The likelihood with the measurements of each event of the hierarchy; others are not used.
    record : Record, or sequence of Record
        Excitation of the new event; None for the excitation of `model`.
    model : Posterior, FELikelihood or Model, optional
        What predicts. Default: the posterior of the first event.
    quantity : optional
        Numbers such as ``peak("deck")``, one or a list of them: the *measured* values of the new event are predicted.
        Histories, as for `propagate`: the response, or the measurements with ``noise=True``. Default: those of all
        channels.
    spread, prior_events
        Of the ratio of measured values to the values at the median parameters, see `event_ratios`. The printed
        prediction says how much of the width is due to the scatter that is expected before the events.
    covariates : mapping of str to float, optional
        Conditions of the new event for a population with `Varying.slopes`, such as ``{"temperature": -5.0}``. Default:
        their means over the events. Beyond covariates of the events, intervals grow with the uncertainty of the slopes.
    noise : bool or str
        Whether histories are predicted with noise, as for `propagate`. The noise parameters must be varying, common, or
        have the same prior in all events. Shares of the response (`GaussianNoise`)
        transfer between events, levels in SI units do not. Numbers contain all errors without it.
    n : int
        Number of draws. Histories need a simulation for each. Numbers need three to five for each event and for the new
        one; their quantiles are exact, and their draws have equal probabilities. Draws with an impossible noise, such
        as a share of 1 or more of ``shares_of="measured"``, are left out.
    seed : int, optional
        Seed for drawing parameters and noise, and for the order of the draws of numbers.
    **options
        Further options of `propagate`, such as ``quantiles=`` and ``from_state=``.

    Returns
    -------
    Prediction
        For numbers, mean, variance and standard error are NaN: the exponential of Student's t has no mean; use
        quantiles. The intervals that `exceedance` derives from it contain the uncertainty of the ratio.

    Raises
    ------
    ValueError
        If the posterior of an event is missing, a parameter has no median, the quantity is neither a history nor a
        positive number of a channel, and as `Hierarchy.new_test`, `EventRatios` and `propagate`.
    SimulationFailed
        If the simulation at the median parameters fails, other than by collapse, or all simulations of the histories.

    Warns
    -----
    UserWarning
        As `propagate`, for peaks outside the range of all events.

    Notes
    -----
    The new event has its own expected scatter, from the model under its motion: near a resonance with a harmonic, a
    number changes far more with frequency and damping than under an earthquake.

    Examples
    --------
    >>> stronger = record.scale(1.5)
    >>> new = predict_new_event(hierarchy, posteriors, stronger, quantity=peak("displacement"))
    >>> print(new)  # doctest: +SAMPLED
    Prediction: 500 samples, of measured values, by the ratios of 3 events; effective sample size 500
    the ratio of a new event has no mean: use the quantiles; 50% of their squared width is due to the prior of the
    scatter between events
    value         unit  mean  MC error  sd   5 %  50 %  95 %
    displacement    cm     -         -   -  10.9    18  29.9
    """
    if not isinstance(posteriors, Mapping) or not posteriors:
        raise ValueError(
            f"predict_new_event: expected the posteriors of the events by name, {{name: posterior}}; got {posteriors!r}"
        )
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
        ratios = event_ratios(hierarchy, posteriors, quantity, spread=spread, prior_events=prior_events)
        if covariates is not None:
            wider = dict(ratios.spread)
            for name, sd in hierarchy.posterior.slope_spread(hierarchy.samples, covariates).items():
                kind = next((each for each in wider if name.startswith(each)), name)
                wider[kind] = float(np.hypot(wider.get(kind, 0.0), sd))
            ratios = replace(ratios, at=hierarchy.median_test(covariates), spread=wider)
        probabilities = settings.pop("quantiles", (0.05, 0.5, 0.95))
        prediction, values, ratios = _under_motion(predictor, ratios, record, quantity, **settings)
        if 0 in prediction.collapsed:  # as it would in every draw
            unknown, every = np.full(values.shape[1:], np.nan), np.arange(n)
            moments = dict.fromkeys(("mean", "variance", "standard_error"), unknown)
            return replace(
                prediction,
                values=prediction.values[:0],
                n_samples=0,
                effective_sample_size=float(n),
                failed=every,
                collapsed=every,
                noise=True,
                ratios=ratios,
                predicted=np.full(values.shape[1:], np.inf),
                **moments,
            )
        if np.isnan(values[0]).any():
            raise SimulationFailed(f"the simulation at the median parameters fails: {[*prediction.failure_reasons]}")
        return _corrected(prediction, values[0], ratios, n, probabilities, np.random.default_rng(seed))
    source = read_source(predictor)
    names = list(source.model.parameter_names)
    if noise:
        if source.noise is None:
            raise ValueError("predict_new_event: noise=True needs a posterior; got a model")
        names += source.noise.parameter_names
    parameters, errors = np.random.SeedSequence(seed).spawn(2)
    draws = hierarchy.new_test(n, names, np.random.default_rng(parameters), covariates)
    if noise:
        draws = _possible(draws, source.noise)
    own_seed = int(errors.generate_state(1)[0])
    return propagate(predictor, draws, record=record, quantity=quantity, noise=noise, seed=own_seed, **settings)


def _event(likelihood: FELikelihood, at: Mapping[str, float], quantity: Any, spread: Mapping[str, float]) -> tuple:
    """Ratio of measured to predicted value of one event, the predicted one, and the variances of the log ratio."""
    model, measured = likelihood.model, measured_quantity(quantity, likelihood.measurements)
    rows = spread_rows(_at_parameters(at, model.parameter_names), model.parameter_names, spread)
    responses, reasons = likelihood.simulate(rows)
    if reasons[0]:
        raise SimulationFailed(reasons[0])
    evaluate = evaluator(quantity, model.channels, model.dt, model.n_steps).function
    values = np.array(
        [
            np.full(measured.shape, np.nan) if why else evaluate(each)
            for each, why in zip(responses, reasons, strict=True)
        ]
    )
    if not ((measured > 0.0) & (values[0] > 0.0)).all():
        raise ValueError(f"ratios of events need positive values; measured {measured}, predicted {values[0]}")
    residuals = likelihood.residuals_of(responses[0])
    residuals = residuals if residuals.shape == responses[0].shape else None
    floor = PRIOR_SD if len(rows) == 1 or residuals is None else REMAINDER
    remainder = remainder_variance(evaluate, responses, residuals, floor)
    return measured / values[0], values[0], log_variance(values), remainder


def _is_number(quantity: Any) -> bool:
    """Whether a quantity is a number, or several, not a history."""
    several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
    is_list = isinstance(several, list | tuple)
    return callable(quantity) or (is_list and any(isinstance(each, ChannelQuantity) for each in several))


def _at_parameters(parameters: Mapping[str, float], names: Sequence[str]) -> list[float]:
    """Values of a model's parameters; ValueError for parameters without a value."""
    if missing := [name for name in names if name not in parameters]:
        raise ValueError(
            f"{', '.join(missing)} belong to each event alone and have no median; make them varying or common in the "
            "HierarchicalPosterior"
        )
    return [parameters[name] for name in names]


def _under_motion(
    predictor: Any, ratios: EventRatios, record: Any, quantity: Quantity, **settings: Any
) -> tuple[Prediction, np.ndarray, EventRatios]:
    """Prediction at `ratios.at` and at its spread, the values (1 + 2 m, ...), NaN for failures, and ratios for them.

    The ratios have the scatter of the parameters that this motion makes of the number.
    """
    names = read_source(predictor).model.parameter_names
    rows = spread_rows(_at_parameters(ratios.at, names), names, ratios.spread or {})
    prediction = propagate(predictor, rows, record=record, quantity=quantity, quantiles=(), **settings)
    values = np.full((len(rows), *prediction.mean.shape), np.nan)
    values[np.setdiff1d(np.arange(len(rows)), prediction.failed)] = prediction.values
    if ratios.spread is not None and np.isfinite(values[0]).all():
        ratios = replace(ratios, new_sd=np.sqrt(log_variance(values) + ratios.remainder))
    return prediction, values, ratios


def _possible(draws: dict[str, np.ndarray], noise: Any) -> dict[str, np.ndarray]:
    """Leave out draws whose noise is impossible: a population has no bounds, but shares of the response have."""
    if not hasattr(noise, "standard_deviations"):
        return draws
    deviations = noise.standard_deviations(np.stack([draws[name] for name in noise.parameter_names], axis=1))
    possible = (deviations > 0.0).all(axis=1)
    if (share := 1.0 - possible.mean()) > TAIL:
        raise ValueError(
            f"{share:.0%} of the draws have an impossible noise, a share of the signal of 1 or more: use "
            "shares_of='response', or a narrower prior of the spread of shares between events"
        )
    return {name: values[possible] for name, values in draws.items()}


def _corrected(
    prediction: Prediction,
    predicted: np.ndarray,
    ratios: EventRatios,
    n: int,
    probabilities: Sequence[float],
    rng: np.random.Generator,
) -> Prediction:
    """The predicted values times the ratio of a new event: exact quantiles, and n draws that have them."""
    order = rng.permuted(np.tile(np.arange(n).reshape(-1, *[1] * predicted.ndim), (1, *predicted.shape)), axis=0)
    quantiles = [predicted * ratios.quantile(each, predicted) for each in probabilities]
    unknown = np.full(predicted.shape, np.nan)  # exp(t) of Student's t has no mean
    return replace(
        prediction,
        mean=unknown,
        variance=unknown,
        standard_error=unknown,
        probabilities=tuple(probabilities),
        quantiles=np.reshape(quantiles, (len(probabilities), *predicted.shape)),
        values=predicted * ratios.quantile((order + 0.5) / n, predicted),
        n_samples=n,
        effective_sample_size=float(n),
        failed=np.zeros(0, dtype=int),
        collapsed=np.zeros(0, dtype=int),
        failure_reasons={},
        noise=True,
        ratios=ratios,
        predicted=predicted,
    )
