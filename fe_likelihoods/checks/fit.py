"""Findings about a fit: does the model follow the measurements at all, and what would explain it if not?"""

import re
from collections.abc import Container, Iterable, Sequence
from math import comb
from typing import Any

import numpy as np
from scipy.stats import chi2

from ..likelihood.parameters import Parameter
from ..likelihood.posterior import Posterior
from ..noise.residuals import ResidualChecks, residual_checks
from ..priors.between_events import spread_of
from ..priors.points import as_points
from ..signals.error_measures import relative_errors
from ..simulation.model import simulate_batch
from ..text_tables import listed
from .compared import ChannelFit, Compared, Fit, Fits, compare, data_sets_of, draws_to_compare
from .data_faults import BETTER, EXPLAINED, Fault, describe_unit, find_faults
from .finding import CARE, CORRELATED, HALF, NOTE, SMALL_PROBABILITY, SURE, WRONG, Finding, percent
from .modal_faults import check_modes
from .slow_motion import find_slow_faults, support_gains, supports_apart
from .steps import motions_to_replace
from .table import Moments, ParameterRow, rows_of

__all__ = [
    "SAME_AS_PRIOR",
    "check_damping",
    "check_fit",
    "check_other_events",
    "check_parameters",
    "check_residuals",
    "check_responses",
    "check_stated_errors",
    "check_supports",
    "describe_residuals",
    "limits_of_model",
    "residual_sentence",
]

SAME_AS_PRIOR = 0.9  # ratio of the standard deviations of posterior and prior: a fifth of the variance is gone
NEAR_BOUND = 0.1  # distance of the 5 % or 95 % quantile from a bound, in 90 % intervals and in prior deviations
LARGE_ERROR = HALF  # RRMSE of a channel that is hardly reproduced: a quarter of its power is left
LARGE_DAMPING = 0.3  # in 9 of 37 right fits of decks on abutments, and in 5 of 8 with a gain of one half
FEWEST = 10  # samples that the tests of correlation and distribution need
FAULTS = {
    "factor": (
        "A {what} may be wrong",
        "Responses times {value:.3g} fit the {which} of {where} much better: {better}. The {which} and the model "
        "differ by this factor{units}.",
        "Check the gain of the sensor, and the units of file, model (it returns SI units) and base motion.",
    ),
    "sign": (
        "A sign may be wrong",
        "Response and measurements have opposite signs: {where}; with the other sign, {better}.",
        "Where the sensor counts the other way, name it in `reversed` of [measurements], or change its sign.",
    ),
    "swap": (
        "Channels may be swapped",
        "The channels {where} may be exchanged: the other way round, {better}.",
        "Check the columns of the file and the places of sensors.",
    ),
    "lag": (
        "Clocks may differ",
        "The {which} of {where} {are} {value:.3g} s {late} than the response: with this lag, {better}.{support}",
        "Check the time at which the base motion begins (zero in [measurements]) and the clocks; see `align`.",
    ),
}
"""Kind, text and action of each fault of data."""


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
    >>> wrong_sign = Measurements(measurements.channels, record.dt, -measurements.values)
    >>> for finding in check_fit(Posterior(FELikelihood(model, wrong_sign), prior)):
    ...     print(finding.severity, finding)
    wrong A sign may be wrong: Response and measurements have opposite signs...
    """
    points, found = draws_to_compare(posterior), []
    if samples is not None:
        samples = as_points(samples, posterior.prior.names)
        points = np.concatenate([samples.mean(axis=0)[None], points])
        none = np.full(posterior.ndim, np.nan)
        rows = rows_of(posterior.parameters, posterior.prior, Moments.of_samples(samples, none, none), none)
        limits = limits_of_model(posterior.likelihood, posterior.parameters, rows, points[0])
        found += check_parameters(rows, limits)
    compared: list[Compared] = []
    for key, likelihood, columns in data_sets_of(posterior):
        own = None if samples is None else samples[:, columns]
        compared += compare(likelihood, points[:, columns], samples is not None, key, own)
        found += check_supports(likelihood.model)
        found += [] if samples is None else check_damping(likelihood.model, points[0, columns], compared)
    return (*check_responses(compared), *found)


def check_responses(compared: Iterable[Compared]) -> list[Finding]:
    """What responses show of the data and of the fit, if there is one: faults of the data, and missed channels.

    A fault that draws of the prior show before a run is named after it as well: a fit may make up for it.
    """
    found, compared = [], list(compared)
    modal, compared = [each.modal for each in compared if each.modal], [each for each in compared if not each.modal]
    for each in compared:
        faults = find_faults(each.measurements, each.responses)
        slow = {(fault.kind, *fault.names): (fault, band) for fault, band in find_slow_faults(each.slow)}
        for fault in faults:
            own = [slow.pop((fault.kind, name))[0].value for name in fault.names if (fault.kind, name) in slow]
            found.append(_of_a_fault(each, fault._replace(value=float(np.median(own))) if own else fault, WRONG))
        found += [_of_a_fault(each, fault, WRONG, band) for fault, band in slow.values()]
        if each.fitted:
            before = find_faults(each.measurements, each.draws)
            known = {fault.kind for fault in (*faults, *(fault for fault, _ in slow.values()))}
            found += [_of_a_fault(each, fault, CARE) for fault in before if fault.kind not in known]
    unexplained = all(each.severity != WRONG for each in found)
    for each in compared:
        found += _check_offset(each) if each.fitted and each.is_history else []
    return found + _check_errors(compared, unexplained) + [fault for each in modal for fault in check_modes(each)]


def check_supports(model: Any) -> list[Finding]:
    """Supports of one structure whose slow motion has another sign or size than that of the others."""
    motions = motions_to_replace(model) if getattr(model, "supports", ()) else ()
    if len({(each.n_steps, each.dt) for each in motions}) != 1:
        return []
    found, unknown = [], getattr(model, "inputs", ())  # whose gains are parameters of a `SensedModel`
    apart = supports_apart(support_gains([each.acceleration for each in motions], motions[0].dt))
    for k, gain in ((k, gain) for k, gain in apart.items() if k not in unknown):
        unit = describe_unit(abs(gain), "acceleration")
        kind = "A sign may be wrong" if gain < 0.0 else "A unit may be wrong" if unit else "A gain may be wrong"
        text = (
            f"Where it is slow, the motion of {motions[k].name} is {gain:.2g} times the motion of the other supports"
            f"{f', about the ratio of {unit}' if unit and gain > 0.0 else ''}; slow motions of one site are equal."
        )
        action = "Check sign, unit and gain of its file. If supports move so: nothing."
        found.append(Finding(kind, WRONG, text, action, {motions[k].name: gain}))
    return found


def _where(names: Sequence[str], compared: Compared | Fit) -> str:
    return f"{listed(list(names))}{f' ({compared.title})' if compared.title else ''}"


def _of_a_fault(compared: Compared, fault: Fault, severity: str, band: tuple[float, float] | None = None) -> Finding:
    """A fault in words, and the band [Hz] in which it was found; one that limits a fit was seen among draws alone."""
    better = f"the error (RRMSE) is {percent(fault.after)} instead of {percent(fault.before)}"
    better += "" if severity == WRONG else " for the best draw of the prior; the fit may make up for it"
    if band is not None:
        better += f" between {band[0]:.2g} and {band[1]:.2g} Hz, where parameters hardly change the response"
    dimensions = sorted({each.dimension for each in compared.measurements.channels if each.name in fault.names})
    near = [describe_unit(fault.value, each) for each in dimensions] if fault.kind == "factor" else []
    units, several = " or ".join(filter(None, dict.fromkeys(near))), len(fault.names) > 1
    words = {
        "where": _where(fault.names, compared),
        "better": better,
        "which": "measurements" if several else "measurement",
        "are": "are" if several else "is",
        "value": abs(fault.value),
        "late": "later" if fault.value > 0.0 else "earlier",
        "what": "unit" if units else "gain",
        "units": f", about the ratio of {units}" if units else "",
        "support": " The clock of a support's recorder may be the wrong one as well." if compared.supports > 1 else "",
    }
    kind, text, action = FAULTS[fault.kind]
    numbers = {"before": fault.before, "after": fault.after, fault.kind: fault.value}
    return Finding(kind.format(**words), severity, text.format(**words), action, numbers)


def _check_offset(compared: Compared) -> list[Finding]:
    """Channels whose residuals are mostly a constant, a slope or a parabola: 3 / n of n independent samples."""
    shares = {}
    for channel, measured, response in zip(
        compared.measurements.channels, compared.measurements.values, compared.responses[0], strict=True
    ):
        residuals = (measured - response)[np.isfinite(measured - response)]
        if len(residuals) >= FEWEST and residuals.any():
            smooth = np.polynomial.Legendre.fit(np.arange(len(residuals)), residuals, 2)(np.arange(len(residuals)))
            shares[channel.name] = float(np.square(smooth).sum() / np.square(residuals).sum())
    large = {name: share for name, share in shares.items() if share > HALF}
    if not large:
        return []
    text = (
        f"What the fit leaves of {_where(list(large), compared)} is mostly an offset or a drift: a parabola has "
        f"{percent(max(large.values()))} of the power of the residuals. The noise takes it for scatter."
    )
    action = "Correct the baseline of the measurement, or let the model have the residual displacement."
    return [Finding("A measurement may have an offset or a drift", CARE, text, action, large)]


def _check_errors(compared: Sequence[Compared], unexplained: bool) -> list[Finding]:
    """Channels that the fit, or the best draw of the prior, does not reproduce, where no fault explains it."""
    found: list[Finding] = []
    useless, poor, far = {}, {}, {}
    for each in compared:
        errors = np.nan_to_num(relative_errors(each.measurements.values - each.responses, each.measurements.values))
        levels = np.exp(np.log(np.maximum(errors, 1e-3)).mean(axis=1))
        closest = int(np.argmin(levels))
        if each.fitted and levels[closest] < BETTER * levels[0] and (errors[0] > LARGE_ERROR).any():
            text = (
                f"Another response that was simulated fits much better{f' ({each.title})' if each.title else ''}: its "
                f"error (RRMSE) is {percent(levels[closest])}, and {percent(levels[0])} at the fit (geometric means "
                "of the channels)."
            )
            action = "The sampler or the search may have missed the best fit, or the noise prefers another one."
            found.append(Finding("The fit is not the best one known", CARE, text, action))
        for row, channel in enumerate(each.measurements.channels):
            place, error = _where([channel.name], each), float(errors[0 if each.fitted else closest, row])
            if not each.fitted:
                far |= {place: error} if error > EXPLAINED else {}
            elif error > LARGE_ERROR:
                noise = _is_noise(each.measurements.values[[row]] - each.responses[0, [row]])
                useless |= {place: error} if error**2 > HALF and not noise else {}
                poor |= {place: error} if (error**2 > HALF) == noise else {}

    def shown(errors: dict[str, float]) -> str:
        return listed([f"{place} ({percent(error)})" for place, error in errors.items()])

    action = "Check units, signs, clocks and the place of the sensor in the model; or the model lacks what moves it."
    if useless and unexplained:
        text = f"After the update, the model explains less than half of the power of {shown(useless)} (error, RRMSE)."
        found.append(Finding("The model does not follow the measurements", WRONG, text, action, useless))
    if poor and unexplained:
        text = f"After the update, the relative error (RRMSE) is still large: {shown(poor)}."
        found.append(Finding("A channel is hardly reproduced", CARE, text, action, poor))
    if far and unexplained:
        text = f"No draw of the prior comes near the measurements; the best one has an error (RRMSE) of {shown(far)}."
        action = (
            "Check the model and the priors. A model of your own must return SI units (m, m/s², N, Pa, rad), whatever "
            "the units in [model.channels], and zero in [measurements] is the time at which the base motion begins."
        )
        found.append(Finding("The prior does not reach the measurements", CARE, text, action, far))
    return found


def _is_noise(residuals: np.ndarray) -> bool:
    """Whether the residuals (1, n_samples) of a channel are white and normal, so that no model explains more."""
    try:
        checks = residual_checks(residuals)
    except ValueError:  # hardly any sample
        return True
    return min(checks.white[0], checks.normal[0]) > SMALL_PROBABILITY


def edges(rows: Sequence[ParameterRow]) -> dict[str, tuple[str, float, float]]:
    """Parameters that the data push to a bound of their prior: label, bound, and a value beyond it, by name."""
    found = {}
    for row in (row for row in rows if row.sd <= SAME_AS_PRIOR * row.prior_sd):  # else the prior is at its own edge
        near = NEAR_BOUND * np.nanmin([row.high - row.low, row.prior_sd])
        for bound, distance, side in ((row.lower, row.low - row.lower, -1.0), (row.upper, row.upper - row.high, 1.0)):
            if distance < near:
                found[row.name] = (row.label, bound, bound + side * NEAR_BOUND * row.prior_sd)
    return found


def limits_of_model(
    likelihood: Any, parameters: Sequence[Parameter], rows: Sequence[ParameterRow], point: np.ndarray
) -> set[str]:
    """Names of `edges` beyond which the model, or the noise, is not defined: it fails at `point` (ndim,) with them."""
    found, names = set(), [row.name for row in rows]
    for name, (_, _, beyond) in edges(rows).items():
        i, moved = names.index(name), np.array(point)
        moved[i] = beyond * parameters[i].factor
        for part, columns in likelihood.parts():
            n = len(part.model.parameter_names)
            if i in columns[:n]:  # not by the likelihood, which would count a failure
                found |= {name} if simulate_batch(part.model, moved[None, columns[:n]]).reasons[0] else set()
            elif i in columns:
                found |= set() if part.possible(moved[None, columns])[0] else {name}
    return found


def check_damping(model: Any, theta: np.ndarray, compared: Iterable[Compared]) -> list[Finding]:
    """Damping ratios at the structural parameters (n_parameters,) that no structure has by itself.

    Where gain and clock of every channel are known to be right, the ratio makes up for neither, and limits nothing.
    """
    large = {}
    for name, value in zip(model.parameter_names, theta.tolist(), strict=False):
        own = 1.0 if hasattr(model, "supports") else getattr(model, "damping_ratio", None)
        ratio = value * getattr(model, "nominal", {}).get(name, np.nan if own is None else own)
        if re.fullmatch(r"damping(_\d+)?", name) and ratio > LARGE_DAMPING:
            large[name] = ratio
    if not large:
        return []
    compared = [each for each in compared if not each.modal]
    known = all(len(each.slow) == each.measurements.n_channels and not find_slow_faults(each.slow) for each in compared)
    text = f"The damping ratio of the fit is {listed([f'{ratio:.2g} ({name})' for name, ratio in large.items()])}."
    if known:
        text += " It does not make up for gains or clocks, which are right where parameters hardly change the response."
        action = "Ask where the energy goes: soil and abutments radiate it, and other modes look like damping."
        return [Finding("The damping is large", NOTE, text, action, large)]
    action = "Damping makes up for a gain, a clock or a sensor that was stuck. Look at the data and at the model."
    return [Finding("The damping is not plausible", WRONG, text, action, large)]


def check_parameters(rows: Sequence[ParameterRow], limits: Container[str] = ()) -> list[Finding]:
    """Parameters at bounds, far from their prior or not informed, and missed true values.

    The bounds of the names in `limits` are limits of the model as well, and end a posterior rightly.
    """
    found = []
    far = {row.label: (row.mean - row.prior_mean) / row.prior_sd for row in rows}
    far = {name: distance for name, distance in far.items() if abs(distance) > SURE}
    flat = [row for row in rows if row.sd > SAME_AS_PRIOR * row.prior_sd and row.label not in far]
    at = [f"{label} at {bound:.4g}" for name, (label, bound, _) in edges(rows).items() if name not in limits]
    if at:
        text = f"The posterior reaches the edge of its prior: {listed(at)}. The bound, not the data, ends it there."
        action = "Widen the prior, and ask what the parameter makes up for in the model."
        found.append(Finding("At the edge of the prior", CARE, text, action))
    if flat:
        names = listed([row.label for row in flat])
        text = f"The posterior of {names} is nearly as wide as its prior: these data say little about it."
        action = "Do not report it as identified. A stronger excitation or another sensor may inform it."
        found.append(Finding("Not informed by the data", NOTE, text, action))
    if far:
        text = (
            f"The posterior mean of {listed(list(far))} is more than {SURE:.2g} standard deviations of the "
            "prior away from the mean of the prior: prior and data disagree."
        )
        action = (
            "Check the nominal value and the width of the prior; the parameter may make up for an error of the model."
        )
        found.append(Finding("Far from the prior", CARE, text, action, far))
    return found + _check_truth(rows)


def _check_truth(rows: Sequence[ParameterRow]) -> list[Finding]:
    """A finding if fewer true values are within their intervals than chance explains."""
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


def check_other_events(rows: Sequence[ParameterRow]) -> list[Finding]:
    """By which factors the standard deviations from one event are too small for the parameters of another event."""
    spread = spread_of([row.name for row in rows])
    known = [(row, spread[row.name]) for row in rows if row.name in spread and row.cv > 0.0]
    factors = {row.label: float(np.sqrt(1.0 + 2.0 * (sd / row.cv) ** 2)) for row, sd in known}
    if not factors:
        return []
    differing = [f"{row.label} by about {percent(sd)} (factor {factors[row.label]:.2g})" for row, sd in known]
    text = (
        "The standard deviations hold for this event. For another event of the same structure they are too small, "
        f"because parameters differ between events: {listed(differing)}."
    )
    action = "Predict another event with this spread (in Python, predict_new_event), or calibrate several events."
    return [Finding("Another event differs", NOTE, text, action, factors)]


def check_residuals(fits: Fits) -> list[Finding]:
    """How much successive errors depend on each other, which widens standard deviations.

    Residuals of real measurements are always correlated, so that this alone limits no result.
    """
    checked = [(fit, each) for fit in fits.fits for each in fit.channels if each.checks is not None]
    coloured = [_where([each.channel.name], fit) for fit, each in checked if _is_coloured(each)]
    # the information of independent samples is proportional to their number
    assumed = sum(each.assumed for _, each in checked)
    independent = [min(each.checks.n_effective[0], each.assumed) for _, each in checked if _is_coloured(each)]
    worth = sum(independent) + sum(each.assumed for _, each in checked if not _is_coloured(each))
    factor = float(np.sqrt(assumed / worth)) if coloured else 1.0
    if round(factor, 1) <= 1.0:
        return []
    text = (
        f"The errors of {listed(coloured)} are correlated: the noise takes {assumed:.0f} samples for independent that "
        f"are worth {worth:.0f}. Standard deviations from the data are too small by a factor of about {factor:.2g}."
    )
    action = (
        "Use the wider standard deviations. Compare with AutoregressiveNoise (in a TOML file: kind = "
        '"autoregressive" in [noise]), with GaussianNoise with bands of frequency (groups = [1.0, 5.0]) or with '
        "effective_samples=, and look at the residuals for an effect that the model lacks."
    )
    return [Finding(CORRELATED, NOTE, text, action, {"factor": factor})]


def check_stated_errors(fits: Fits) -> list[Finding]:
    """Whether data without time differ from the model by more than the standard deviations of their errors."""
    found = []
    for fit in fits.fits:
        if fit.deviations is None or fit.residuals is None:
            continue
        errors = fit.residuals / fit.deviations
        square, n = float(np.nansum(np.square(errors))), int(np.isfinite(errors).sum())
        if not chi2.sf(square, n) < SMALL_PROBABILITY:
            continue
        factor = float(np.sqrt(square / n))
        text = (
            f"The {n} values{f' of {fit.title}' if fit.title else ''} differ from the model by {factor:.2g} times the "
            "standard deviations of their errors (root mean square). The model differs from the structure, a load case "
            "or a sensor is another one, or the stated errors are too small: intervals of the parameters are too "
            "narrow."
        )
        action = (
            "Look at the values one by one. Leave out known errors, which then are parameters, or state larger ones."
        )
        found.append(Finding("Values differ more than their stated errors", CARE, text, action, {"factor": factor}))
    return found


def _is_coloured(each: ChannelFit) -> bool:
    return each.checks.white[0] < SMALL_PROBABILITY


def describe_residuals(checks: ResidualChecks) -> list[str]:
    """What the residuals of each channel look like, in words."""
    found = []
    for lag, worth, white, normal, n in zip(*checks[2:7], strict=True):
        if n < FEWEST:
            found.append(f"Not checked: {n:.0f} samples are too few, {FEWEST} are needed.")
            continue
        text = f"Correlated ({lag:.2f} from sample to sample): {n:.0f} samples are worth {worth:.0f} independent ones."
        if white >= SMALL_PROBABILITY:
            text = "White: no correlation from sample to sample was found."
        found.append(f"{text} Not normal: look at the tails." if normal < SMALL_PROBABILITY else text)
    return found


def residual_sentence(fit: Fit, each: ChannelFit) -> str:
    """What the residuals of one channel look like, in a sentence."""
    where = _where([each.channel.name], fit)
    if each.checks is None:
        return f"{where}: the residuals could not be checked (too few samples, or an exact fit)."
    return f"{where}: {describe_residuals(each.checks)[0]}"
