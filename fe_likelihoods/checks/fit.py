"""The gate that every result passes: does the model follow the measurements at all, and what would explain it if not?

`check_fit` is for users, ``fe-likelihoods check``, the end of a run and the report call `compare` and `fit_gate`.
"""

import logging
import time
from collections.abc import Sequence
from math import comb
from typing import Any, NamedTuple

import numpy as np

from ..cache.memory import distinct_keys
from ..cache.verification import StaleCache
from ..likelihood.failure_log import TooManyFailures
from ..likelihood.likelihood import FELikelihood
from ..likelihood.posterior import Posterior
from ..priors.points import as_points
from ..signals.channels import Measurements
from ..signals.events import find_events
from ..simulation.faults import ChangedModel
from ..simulation.model import simulate_batch
from ..text_tables import listed
from .data_faults import LARGE_ERROR, Fault, describe_unit, find_faults
from .finding import CARE, NOTE, WRONG, Finding
from .table import Moments, ParameterRow, rows_of

__all__ = ["Compared", "Window", "check_fit", "compare", "draws_to_compare", "fit_gate", "windows_of"]

logger = logging.getLogger(__name__)

SAME_AS_PRIOR = 0.9  # ratio of the standard deviations of posterior and prior
NEAR_BOUND = 0.1  # distance of the 5 % or 95 % quantile from a bound, in 90 % intervals and in prior deviations
FAR_FROM_PRIOR = 3.0  # standard deviations of the prior
SMALL_PROBABILITY = 0.01
USELESS_ERROR = 1.2  # RRMSE of a fit that is clearly worse than a response of zero
MISSED = 0.7  # error of another response, as a share of the error of the fit, from which the fit is not the best one
FAR_ERROR = 0.9  # RRMSE of the best of several draws of the prior, from which the prior does not reach the data
MOST_DRAWS, FEWEST_DRAWS = 100, 5
SECONDS = 10.0  # of simulations of these draws
MOST_STORED = 100  # responses of a guide that are compared in addition


class Window(NamedTuple):
    """The part of the measurements that belongs to one event."""

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    inside: np.ndarray  # (n_channels, n_samples) bool, among the samples of all events
    rows: np.ndarray  # channels that are kept
    columns: np.ndarray  # samples that are kept

    def of(self, values: np.ndarray) -> np.ndarray:
        """The part of values (..., n_channels, n_samples), NaN outside of the event."""
        return np.where(self.inside, values, np.nan)[..., self.rows[:, None], self.columns]


class Compared(NamedTuple):
    """Measurements of one event, and responses to compare with them."""

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    responses: np.ndarray  # (n, n_channels, n_samples) at the times of the samples [SI]
    fitted: bool  # whether the first response is the fit, not one more draw of the prior
    parts: dict[str, np.ndarray]  # shares of each support's motion in the responses of a linear structure


def windows_of(likelihood: FELikelihood, key: str = "") -> list[Window]:
    """The measurements of a likelihood, event by event; `key` is the name of the data set."""
    measured, events = likelihood.measurements, find_events(likelihood.model)
    spans = [(key, -np.inf, np.inf)]
    if events is not None and len(events.windows) > 1:
        spans = [(f"{key}, {each.name}" if key else each.name, each.start, each.end) for each in events.windows]
    times = np.stack([measured.times(channel.name) for channel in measured.channels])
    half, found = 0.5 * np.array(measured.steps)[:, None], []
    for title, start, end in spans:
        inside = (times > start - half) & (times < end + half)
        rows = np.flatnonzero((inside & np.isfinite(measured.values)).any(axis=1))
        columns = np.flatnonzero(inside[rows].any(axis=0))
        if not len(rows):
            continue
        part = Measurements(
            tuple(measured.channels[row] for row in rows),
            tuple(measured.steps[row] for row in rows),
            np.where(inside, measured.values, np.nan)[np.ix_(rows, columns)],
            measured.description,
            tuple(measured.starts[row] + columns[0] * measured.steps[row] for row in rows),
        )
        found.append(Window(title, part, inside, rows, columns))
    return found


def draws_to_compare(posterior: Posterior, seconds: float | None = None) -> np.ndarray:
    """Draws of the prior (n, ndim), always the same ones: 100, or fewer if these take longer than ten seconds.

    A simulation takes `seconds`; by default the mean of those that the posterior has made, or else of the second draw.
    """
    try:
        draws = posterior.sample_prior(MOST_DRAWS, np.random.RandomState(1))
    except NotImplementedError:  # a prior without draws
        return np.empty((0, posterior.ndim))
    if seconds is None:
        report = posterior.report()
        cached = all(
            part.simulator.are_stored(draws[:, columns][:, : part.simulator.n_structural]).all()
            for part, columns in posterior.likelihood.parts()
        )
        if cached or report["simulations"]:
            seconds = 0.0 if cached else report["seconds"] / report["simulations"]
        else:
            for row in draws[:2]:  # the first one may compile
                start = time.perf_counter()
                posterior.likelihood.log_likelihood(row)
                seconds = time.perf_counter() - start
    return draws[: int(np.clip(SECONDS / max(seconds, 1e-6), FEWEST_DRAWS, MOST_DRAWS))]


def compare(likelihood: FELikelihood, points: np.ndarray, fitted: bool, key: str = "") -> tuple[Compared, ...]:
    """Responses at points (n, ndim), and those that a guide has left in memory, beside the measurements of each event.

    The likelihood's caches are asked first; it counts the other simulations. Failed ones are left out; the result is
    empty if all fail, or the first one fails and is the fit. `key` is the name of the data set.
    """
    n = len(likelihood.model.parameter_names)
    try:
        batch = likelihood.simulate(points[:, :n])
    except (ChangedModel, StaleCache, TooManyFailures) as error:  # concerns the next sampling, not this result
        logger.warning("the fit is compared with no draws of the prior: %s", error)
        return ()
    good = [i for i, reason in enumerate(batch.reasons) if not reason]
    if not good or (fitted and good[0]):
        return ()
    pairs = [(points[i], batch.response[i]) for i in good]
    parts = _support_parts(likelihood.model, points[good, :n], batch.response[good])
    if not parts:
        known = likelihood.simulator.response_memory.responses(likelihood.model.fingerprint)
        others = [key for key in known if key not in set(distinct_keys(points[:, :n])[0])]
        for place in np.unique(np.linspace(0, len(others) - 1, min(len(others), MOST_STORED)).astype(int)):
            pairs.append((np.concatenate([np.frombuffer(others[place]), points[0, n:]]), known[others[place]]))
    measured = likelihood.measurements.values

    def at_samples(theta: np.ndarray, response: np.ndarray) -> np.ndarray:
        # unknown time shifts are those of the fit
        return measured - likelihood.residuals_of(response, np.concatenate([theta[:n], points[0, n:]]))

    responses = np.stack([at_samples(*pair) for pair in pairs])
    sampled = {
        name: np.stack([at_samples(theta, one) for (theta, _), one in zip(pairs, each, strict=True)])
        for name, each in parts.items()
    }
    return tuple(
        Compared(
            window.title,
            window.measurements,
            window.of(responses),
            fitted,
            {name: window.of(each) for name, each in sampled.items()},
        )
        for window in windows_of(likelihood, key)
    )


def _support_parts(model: Any, thetas: np.ndarray, responses: np.ndarray) -> dict[str, np.ndarray]:
    """Contribution of each support to the responses (n, n_channels, n_steps); empty unless they add up to these."""
    supports = getattr(model, "supports", ())
    if len(supports) < 2 or not hasattr(model, "with_record"):
        return {}
    names = [support.name or f"support {k + 1}" for k, support in enumerate(supports)]
    names = [f"{name} ({k + 1})" if names.count(name) > 1 else name for k, name in enumerate(names)]
    found = {}
    for k, name in enumerate(names):
        alone = model.with_record([each if i == k else each.scale(0.0) for i, each in enumerate(supports)])
        found[name] = simulate_batch(alone, thetas).response
    rest = np.abs(responses - sum(found.values())).max()
    return found if rest <= 1e-6 * np.abs(responses).max() else {}


def fit_gate(compared: Sequence[Compared], rows: Sequence[ParameterRow] = ()) -> tuple[Finding, ...]:
    """What speaks against a fit, in words; nothing is simulated, and `rows` are empty before a run.

    Findings are faults of the data that explain the measurements better, channels that are hardly reproduced,
    parameters at bounds, far from their prior, or not informed, and missed true values.
    """
    found: list[Finding] = []
    for each in compared:
        faults = find_faults(each.measurements, each.responses, each.parts, fitted=each.fitted)
        found += [_of_a_fault(each, fault) for fault in faults]
    found += _of_the_errors(compared, bool(found))
    return (*found, *_of_the_prior(rows), *_of_the_truth(rows))


def check_fit(posterior: Posterior, samples: Any = None) -> tuple[Finding, ...]:
    """Look for wrong units, signs, clocks and channels, for a poor fit and for parameters at their bounds.

    Parameters
    ----------
    posterior : Posterior
    samples : (n, ndim) array_like or mapping, optional
        Samples of the posterior, whose mean is the fit. Default: before a run, the data are compared with draws of the
        prior alone.

    Returns
    -------
    tuple of Finding
        Empty if nothing was found. ``str`` of a finding gives it in words. The mean and up to 100 draws of the prior
        are simulated where they are not cached; fewer draws if a simulation takes longer than 0.1 s.

    Examples
    --------
    >>> for finding in check_fit(posterior, sampler.get_chain(flat=True)):
    ...     print(finding.severity, finding)
    """
    points, rows = draws_to_compare(posterior), []
    if samples is not None:
        samples = as_points(samples, posterior.prior.names)
        points = np.concatenate([samples.mean(axis=0)[None], points])
        none = np.full(posterior.ndim, np.nan)
        rows = rows_of(posterior.parameters, posterior.prior, Moments.of_samples(samples, none), none)
    compared: list[Compared] = []
    keys = getattr(posterior.likelihood, "likelihoods", {"": None})
    for key, (likelihood, columns) in zip(keys, posterior.likelihood.parts(), strict=True):
        compared += compare(likelihood, points[:, columns], samples is not None, key)
    return fit_gate(compared, rows)


def _of_a_fault(compared: Compared, fault: Fault) -> Finding:
    names, where = listed(list(fault.names)), f" ({compared.title})" if compared.title else ""
    better = f"the error (RRMSE) is {_percent(fault.after)} in place of {_percent(fault.before)}"
    which = "measurements" if len(fault.names) > 1 else "measurement"
    if fault.kind == "factor":
        dimensions = sorted({each.dimension for each in compared.measurements.channels if each.name in fault.names})
        units = dict.fromkeys(describe_unit(fault.value, each) for each in dimensions)
        unit = " or ".join(each for each in units if each)
        ratio = f", about the ratio of {unit}" if unit else ""
        text = (
            f"Responses times {fault.value:.3g} fit the {which} of {names}{where} much better: {better}. The "
            f"{which} and the model differ by this factor{ratio}."
        )
        action = "Check the unit of the file, of the model (it returns SI units) and of the base motion."
        return Finding("A unit may be wrong", WRONG, text, action)
    if fault.kind == "sign":
        text = f"Response and measurements have opposite signs: {names}{where}; with the other sign, {better}."
        action = "Where the sensor counts the other way, name it in `reversed` of [measurements], or change its sign."
        return Finding("A sign may be wrong", WRONG, text, action)
    if fault.kind == "swap":
        text = f"The channels {names}{where} may be exchanged: the other way round, {better}."
        return Finding(
            "Channels may be swapped", WRONG, text, "Check the columns of the file and the places of sensors."
        )
    late = "later" if fault.value > 0.0 else "earlier"
    if fault.kind == "input lag":
        text = (
            f"The motion of {names}{where} seems to be {abs(fault.value):.3g} s {late} than the other motions and the "
            f"measured response: without this lag, {better}. The clocks of recorders may differ."
        )
        # a motion that is recorded late must be shifted to earlier times
        action = (
            "Compare the clocks of the recorders, with `align`, and shift the record before you use the result, or "
            "make the lag a parameter (lags= of LinearStructure)."
        )
        return Finding("Clocks of input recorders may differ", WRONG, text, action)
    text = (
        f"The {which} of {names}{where} {'are' if len(fault.names) > 1 else 'is'} {abs(fault.value):.3g} s {late} than "
        f"the response: with this lag, {better}."
    )
    if compared.parts:
        text += " The clock of a support's recorder may be the wrong one as well."
    action = "Check the time at which the base motion begins (zero in [measurements]) and the clocks; see `align`."
    return Finding("Clocks may differ", WRONG, text, action)


def _of_the_errors(compared: Sequence[Compared], explained: bool) -> list[Finding]:
    """Channels that the fit, or the best of several draws of the prior, does not reproduce."""
    found: list[Finding] = []
    useless, poor, far = [], [], []
    for each in compared:
        errors = _errors_of(each)
        levels = np.exp(np.log(np.maximum(errors, 1e-3)).mean(axis=1))
        closest = int(np.argmin(levels))
        best = errors[0 if each.fitted else closest]
        if each.fitted and levels[closest] < MISSED * levels[0] and (errors[0] > LARGE_ERROR).any():
            where = f" ({each.title})" if each.title else ""
            text = (
                f"Another response that was simulated fits much better{where}: its error (RRMSE) is "
                f"{_percent(levels[closest])}, and {_percent(levels[0])} at the fit (geometric means of the channels)."
            )
            action = "The sampler or the search may have missed the best fit, or the noise prefers another one."
            found.append(Finding("The fit is not the best one known", CARE, text, action))
        for channel, error in zip(each.measurements.channels, best, strict=True):
            text = f"{channel.name}{f' ({each.title})' if each.title else ''} ({_percent(error)})"
            if not each.fitted:
                far += [text] if error > FAR_ERROR else []
            elif error > LARGE_ERROR:
                (useless if error > USELESS_ERROR else poor).append(text)
    action = (
        "If the signal is not small against its noise, check units, signs, time offsets and the channel's place in "
        "the model before you interpret the parameters."
    )
    if useless:
        text = f"After the update, the error (RRMSE) is larger than that of a response of zero: {listed(useless)}."
        found.append(Finding("The model does not follow the measurements", WRONG, text, action))
    if poor:
        text = f"After the update, the relative error (RRMSE) is still large: {listed(poor)}."
        found.append(Finding("A channel is hardly reproduced", CARE, text, action))
    if far and not explained:
        text = f"No draw of the prior comes near the measurements; the best one has an error (RRMSE) of {listed(far)}."
        action = (
            "Check the model and the priors. A model of your own must return SI units (m, m/s², N, Pa, rad), whatever "
            "the units in [model.channels], and zero in [measurements] is the time at which the base motion begins."
        )
        found.append(Finding("The prior does not reach the measurements", CARE, text, action))
    return found


def _errors_of(compared: Compared) -> np.ndarray:
    """RRMSE (n, n_channels); zero for a channel that is zero."""
    measured = compared.measurements.values
    power = np.nansum(np.square(measured), axis=1)
    squares = np.nansum(np.square(compared.responses - measured), axis=2)
    return np.sqrt(np.divide(squares, power, out=np.zeros_like(squares), where=power > 0.0))


def _of_the_prior(rows: Sequence[ParameterRow]) -> list[Finding]:
    found, edges = [], []
    flat = [row for row in rows if row.sd > SAME_AS_PRIOR * row.prior_sd]
    for row in (row for row in rows if row not in flat):  # where the data say little, the prior is at its own edge
        near = NEAR_BOUND * np.nanmin([row.high - row.low, row.prior_sd])
        edges += [f"{row.label} at {row.lower:.4g}"] if row.low - row.lower < near else []
        edges += [f"{row.label} at {row.upper:.4g}"] if row.upper - row.high < near else []
    if edges:
        text = f"The posterior reaches the edge of its prior: {listed(edges)}. The bound, not the data, ends it there."
        action = (
            "If the bound is physical, nothing is wrong. Otherwise widen the prior, and ask what the parameter makes "
            "up for in the model."
        )
        found.append(Finding("At the edge of the prior", CARE, text, action))
    if flat:
        names = listed([row.label for row in flat])
        text = f"The posterior of {names} is nearly as wide as its prior: these data say little about it."
        action = "Do not report it as identified. A stronger excitation or another sensor may inform it."
        found.append(Finding("Not informed by the data", NOTE, text, action))
    far = [row.label for row in rows if abs(row.mean - row.prior_mean) > FAR_FROM_PRIOR * row.prior_sd]
    if far:
        text = (
            f"The posterior mean of {listed(far)} is more than {FAR_FROM_PRIOR:.0f} standard deviations of the prior "
            "away from the mean of the prior: prior and data disagree."
        )
        action = (
            "Check the nominal value and the width of the prior; the parameter may make up for an error of the model."
        )
        found.append(Finding("Far from the prior", CARE, text, action))
    return found


def _of_the_truth(rows: Sequence[ParameterRow]) -> list[Finding]:
    """A caution if fewer true values are within their intervals than chance explains."""
    known = [row for row in rows if np.isfinite(row.truth)]
    outside = [row.label for row in known if not row.low <= row.truth <= row.high]
    # probability that so many 90 % intervals or more miss, if they were independent
    n, k = len(known), len(outside)
    if not k or sum(comb(n, j) * 0.1**j * 0.9 ** (n - j) for j in range(k, n + 1)) >= SMALL_PROBABILITY:
        return []
    text = (
        f"The true values of {listed(outside)} are outside of their 90 % intervals, {k} of {n}; about one in ten is "
        "usual. The model that was updated is not the one that made the data."
    )
    action = "Expect the same of real data: intervals do not contain the error of the model. Try a finer model or step."
    return [Finding("True values are missed", CARE, text, action)]


def _percent(error: float) -> str:
    return f"{100.0 * error:.3g} %"
