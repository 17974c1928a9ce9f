r"""Damage as a quantity of the posterior: presence, location and extent.

The presence of a limit state is the probability that its measure exceeds its limit, estimated by the fraction of the
samples (`fe_likelihoods.prediction.exceedance`). A limit may have a distribution: the capacity of such structures.
For a strain limit, the location is the same probability at each section and side of a column. The extent is given by
quantiles of the measures.

The samples contain the uncertainty of the parameters only. The model error, which is often larger, enters as ratios of
measured to fitted values (``ratios=``). ``docs/damage.rst`` has the references.
"""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from ..checks.finding import labelled
from ..population.event_ratios import EventRatios
from ..prediction.exceedance import Exceedance, estimate, outcomes, warn_of_missing_error
from ..prediction.prediction import Prediction
from ..priors.distributions import Distribution
from ..text_tables import text_table
from ..units import DIMENSIONS, find_unit, from_si
from .measures import DamageMeasures

_UNITS = {"dissipated energy": "kJ"}  # in which measures are printed; the others are numbers


class LimitState(NamedTuple):
    """Limit state: a damage measure and its limit.

    Examples
    --------
    >>> from fe_likelihoods.column_damage.damage import LimitState
    >>> wide = LimitState("wide cracks", "bar tension", LogNormal(0.015, 0.3), source="own tests")
    >>> wide.limit
    LogNormal(median=0.015, log_sd=0.3)
    """

    name: str  # of the state that is reached when the measure exceeds the limit
    measure: str  # such as "bar tension" or "residual drift"
    limit: float | Distribution  # [SI], or the distribution of the limits of such structures
    source: str = ""  # where the limit comes from


_ASSUMED = (  # from the literature, to hold for any column
    LimitState("cover spalling", "cover compression", 0.004, "Kowalsky (2000), serviceability"),
    LimitState("wide cracks", "bar tension", 0.015, "Kowalsky (2000), serviceability: residual cracks of about 1 mm"),
    LimitState("bar fracture", "bar tension", 0.06, "Kowalsky (2000), damage control; Caltrans (2013), #11 and larger"),
    LimitState(
        "large residual drift", "residual drift", 0.01, "Japanese practice after 1996, see Kawashima et al. (1998)"
    ),
    LimitState("beyond repair", "Park-Ang index", 0.4, "Park, Ang & Wen (1985)"),
    LimitState("collapse", "Park-Ang index", 1.0, "Park, Ang & Wen (1985)"),
)


class Damage(NamedTuple):
    """Damage of a column after each event, given the data.

    Strains, energy and index count from the start of the response, drifts per event. Presence and location are
    probabilities with their Monte Carlo errors and intervals, by the names of limit states.
    """

    limits: tuple[LimitState, ...]
    presence: dict[str, Exceedance]  # that the limit is reached anywhere, (n_events,)
    location: dict[str, Exceedance]  # of strains at each place, (n_events, n_sections, 2)
    extent: dict[
        str, np.ndarray
    ]  # quantiles (n_probabilities, n_events) [SI] by measure, of strains (..., n_sections, 2)
    uncertainty: str  # which uncertainties the probabilities contain
    prediction: Prediction  # whose `quantity` are the `DamageMeasures`; collapsed structures are in no quantile

    @property
    def events(self) -> tuple[str, ...]:
        """Names of the events."""
        return self.prediction.quantity.events

    @property
    def failures(self) -> str:
        """How many structures collapsed and how many samples failed, in a sentence; an empty text if none."""
        collapsed, failed = len(self.prediction.collapsed), self.prediction.n_failed
        total = self.prediction.n_samples + failed
        said = [f"{collapsed} of {total} structures collapsed and reach every limit state"] * (collapsed > 0)
        if failed > collapsed:
            lost = f"{failed - collapsed} of {total} samples failed and are not counted"
            said.append(f"{lost}: probabilities may be too low")
        return "; ".join(said)

    def table(self) -> str:
        """Probabilities of the limit states with their intervals, and quantiles of the measures, after each event.

        Strains are given for the place with the largest quantile.
        """
        rows = [("probability of", *self.events)]
        for name, each in self.presence.items():
            cells = zip(each.probability, each.lower, each.upper, strict=True)
            rows.append((name, *(f"{p:.3g} ({low:.2g} to {high:.2g})" for p, low, high in cells)))
        lines = [text_table(rows)]
        if self.extent:
            rows = [("quantiles " + ", ".join(f"{p:g}" for p in self.prediction.probabilities), *self.events)]
            for name, values in self.extent.items():
                unit = _UNITS.get(name, "1")
                largest = from_si(values.reshape(*values.shape[:2], -1).max(axis=2), unit)
                cells = (" ".join(f"{v:.3g}" for v in column) for column in largest.T)
                rows.append((name + ("" if unit == "1" else f" [{unit}]"), *cells))
            lines += ["", text_table(rows)]
        closing = [f"The probabilities contain {self.uncertainty}."]
        closing += [f"{self.failures}."] if self.failures else []
        return "\n".join([*lines, "", *closing, *labelled(self.prediction.findings)])

    __str__ = __repr__ = table


def limit_states(measures: DamageMeasures) -> tuple[LimitState, ...]:
    """Default limit states for which there are measures: yield of a bar at the nominal fy/Es, and limits from papers.

    All are **assumed**; ``limit._replace(limit=...)`` changes one.

    Examples
    --------
    >>> from dataclasses import replace
    >>> complete = replace(column, outputs=damage_outputs(column))
    >>> for limit in limit_states(damage_measures(complete)):
    ...     print(limit.name, limit.measure, limit.limit)
    bar yield bar tension 0.002647887323943662
    cover spalling cover compression 0.004
    wide cracks bar tension 0.015
    bar fracture bar tension 0.06
    large residual drift residual drift 0.01
    beyond repair Park-Ang index 0.4
    collapse Park-Ang index 1.0
    """
    bar_yield = LimitState("bar yield", "bar tension", measures.yield_strain, "nominal fy/Es of the steel")
    return tuple(state for state in (bar_yield, *_ASSUMED) if state.measure in measures.names)


def damage(
    prediction: Prediction,
    limits: Sequence[LimitState] | None = None,
    *,
    ratios: EventRatios | Mapping[str, EventRatios] | None = None,
    noise: bool | None = None,
    interval_probability: float = 0.95,
    seed: int = 0,
) -> Damage:
    """Find presence, location and extent of damage from a prediction.

    Parameters
    ----------
    prediction : Prediction
        The result of ``propagate(column, samples, quantity=damage_measures(column))``.
    limits : sequence of LimitState, optional
        The limit states. Default: `limit_states`.
    ratios : EventRatios, or mapping of str to these, optional
        The model error: ratios of measured to fitted values in several events, for each measure by its name, or the
        same for all. Measures without ratios have no model error. Strains are rarely measured; a stated guess is
        ``EventRatios([1.0], prior_sd=0.3, prior_events=10)``.
    noise : bool, optional
        False states that the model error is left out on purpose. Default: a warning if there are no ratios.
    interval_probability : float
        Level of the probabilities' intervals, between 0 and 1.
    seed : int
        Seed for drawing the ratios.

    Raises
    ------
    ValueError
        If the prediction is of another quantity or contains noise, a limit is not positive or has an unknown measure,
        or ratios are for an unknown measure or several quantities.

    Examples
    --------
    >>> from dataclasses import replace
    >>> quiet = record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0)
    >>> complete = RCColumn.lhpost(quiet)
    >>> complete = replace(complete, outputs=damage_outputs(complete))
    >>> predicted = propagate(complete, np.ones((3, 5)), quantity=damage_measures(complete))
    >>> print(damage(predicted, noise=False))
    probability of                          shaking, rest
    bar yield                             1 (0.29 to 1)
    ...
    peak drift                       0.0091 0.0091 0.0091
    ...
    """
    measures = prediction.quantity
    if not isinstance(measures, DamageMeasures):
        raise ValueError(
            "damage needs a prediction of damage measures: propagate(column, samples, "
            f"quantity=damage_measures(column)); this one has quantity={measures!r}"
        )
    if prediction.noise or noise:
        raise ValueError(
            "the noise of sensors does no damage, and errors that are drawn do work and leave residual values: "
            "propagate the measures with noise=False, and give ratios= for the error of the model"
        )
    states = limit_states(measures) if limits is None else tuple(limits) if np.iterable(limits) else (limits,)
    if isinstance(limits, LimitState) or not all(isinstance(state, LimitState) for state in states):
        raise ValueError(
            'limits must be a sequence of LimitState, such as [LimitState("cracks", "bar tension", 0.015)]; got '
            f"{limits!r}"
        )
    if len({state.name for state in states}) != len(states):
        raise ValueError(f"limit states need different names; got {', '.join(state.name for state in states)}")
    every, effective = outcomes(prediction)
    values = measures.split(every)
    errors = _ratios_of_measures(ratios, tuple(values))
    presence, location, settings = {}, {}, (effective, interval_probability, seed)
    for state in states:
        if state.measure not in values:
            raise ValueError(
                f"limit state {state.name!r} is of {state.measure!r}, the measures are {', '.join(values)}; "
                "damage_measures(measures=...) chooses them"
            )
        found, limit = values[state.measure], _limits(state, len(every), np.random.default_rng(seed))
        shown = {
            "threshold": np.asarray(np.mean(limit)),
            "unit": DIMENSIONS[find_unit(_UNITS.get(state.measure, "1")).dimension],
        }
        ratios_of = errors.get(state.measure)
        if found.ndim == 4:
            at_places = estimate(found, limit[:, None, None, None], ratios_of, *settings)
            location[state.name], found = at_places.exceedance._replace(**shown), found.max(axis=(2, 3))
        presence[state.name] = estimate(found, limit[:, None], ratios_of, *settings).exceedance._replace(**shown)
    without = [state.name for state in states if state.measure not in errors]
    if without and noise is None:
        guess = "state a guess, such as EventRatios([1.0], prior_sd=0.3, prior_events=10)"
        warn_of_missing_error(f"damage ({', '.join(without)})", guess)
    rng, extent = np.random.default_rng(seed), {}
    for name, found in measures.split(prediction.values).items() if prediction.n_samples else ():
        if name in errors:
            largest = found.reshape(*found.shape[:2], -1).max(axis=2)  # all places of an event share its error
            factor = errors[name].quantile(rng.random(largest.shape), np.maximum(largest, np.finfo(float).tiny))
            found = found * factor.reshape(*factor.shape, *(1,) * (found.ndim - 2))
        if prediction.probabilities:
            extent[name] = np.quantile(found, prediction.probabilities, axis=0, method="weibull")
    return Damage(states, presence, location, extent, _contents(states, errors), prediction)


def _limits(state: LimitState, n: int, rng: np.random.Generator) -> np.ndarray:
    """Limits of n samples, shape (n,) or (1,); of a distribution quantiles in random order."""
    if isinstance(state.limit, Distribution) and state.limit.bounds[0] >= 0.0:
        return state.limit.ppf((rng.permutation(n) + 0.5) / n)
    if not isinstance(state.limit, Real) or not 0.0 < state.limit < np.inf:
        raise ValueError(
            f"the limit of {state.name!r} must be a positive number or a distribution of positive numbers; got "
            f"{state.limit!r}"
        )
    return np.array([float(state.limit)])


def _ratios_of_measures(ratios: Any, measures: tuple[str, ...]) -> dict[str, EventRatios]:
    """Ratios by the names of the measures; ValueError if they cannot be used."""
    found = (
        dict(ratios) if isinstance(ratios, Mapping) else dict.fromkeys(measures if ratios is not None else (), ratios)
    )
    if unknown := sorted(set(found) - set(measures)):
        raise ValueError(f"ratios of {', '.join(unknown)}; the measures are {', '.join(measures)}")
    for name, each in found.items():
        if not isinstance(each, EventRatios) or each.shape:
            raise ValueError(f"the ratios of {name!r} must be EventRatios of one quantity; got {each!r}")
    return found


def _contents(states: Sequence[LimitState], errors: Mapping[str, EventRatios]) -> str:
    """Which uncertainties the probabilities contain, in words."""
    measures = list(dict.fromkeys(state.measure for state in states))
    with_error = [name for name in measures if name in errors]
    missing = [] if with_error else ["the error of the model"]
    whose = "" if len(with_error) == len(measures) else f" in {', '.join(with_error)}"
    said = ["the uncertainty of the parameters", *([f"the error of the model{whose}"] if with_error else [])]
    capacity = any(isinstance(state.limit, Distribution) for state in states)
    (said if capacity else missing).append("the distribution of limits")
    return " and ".join(said) + (f", not {' or '.join(missing)}" if missing else "")
