"""Findings about a fit: does the model follow the measurements at all, and what would explain it if not?"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..likelihood.posterior import Posterior
from ..noise.residuals import ResidualChecks
from ..priors.between_events import spread_of
from ..priors.points import as_points
from ..signals.channels import Channel
from ..signals.error_measures import relative_errors
from ..simulation.model import simulate_batch
from ..text_tables import listed
from .compared import Fit, checks_of, compare, data_sets_of, draws_to_compare
from .fault_words import finding_of
from .faults import EXPLAINED, Fault, find_faults, slow_motions, supports_apart
from .finding import CARE, CORRELATED, HALF, NOTE, SMALL_PROBABILITY, WRONG, Finding, about, percent
from .modal import check_modes, check_squares
from .model import motions_to_replace
from .run import ParameterRow, moments, rows_of
from .tables import MOST_DRAWS, Table, find_changes

__all__ = [
    "SAME_AS_PRIOR",
    "check_fit",
    "check_other_events",
    "check_parameters",
    "check_residuals",
    "check_responses",
    "check_stated_errors",
    "check_supports",
    "describe_residuals",
]

SAME_AS_PRIOR = 0.9  # ratio of the standard deviations of posterior and prior: a fifth of the variance is gone
NEAR_BOUND = 0.1  # distance of the 5 % or 95 % quantile from a bound, in 90 % intervals and in prior deviations
FEWEST = 10  # samples that the tests of correlation and distribution need


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
    wrong A sign may be wrong: acceleration and displacement: measured values have the opposite sign...
    """
    draws, found, fits = draws_to_compare(posterior), list[Finding](), list[Fit]()
    mean = None
    if samples is not None:
        samples = as_points(samples, posterior.prior.names)
        mean, rows = samples.mean(axis=0), rows_of(posterior.parameters, posterior.prior, moments(samples))
        found += check_parameters(rows, posterior, mean)
    for key, likelihood, columns in data_sets_of(posterior):
        own, point = (None if each is None else each[..., columns] for each in (samples, mean))
        fits += compare(likelihood, draws[:, columns], key, point, samples=own)[0]
        found += check_supports(likelihood.model)
    return (*check_responses(fits), *found)


def check_responses(fits: Iterable[Fit]) -> list[Finding]:
    """What responses show of the data and of the fit, if there is one: faults of the data, and missed channels.

    Faults are those that draws of the prior show, before a run and after it: a fit may make up for them.
    """
    found, others = list[Finding](), list[Fit]()
    for fit in fits:
        if fit.modal:
            found += check_modes(fit.modal)
            continue
        others.append(fit)
        history = fit.measurements.is_history
        for fault in find_faults(fit.measurements, fit.draws) if history else _changes(fit):
            channels = [each for each in fit.measurements.channels if each.name in fault.names]
            # of right real events, 5 to 20 draws blame 19 of 396, 50 or 70 draws 3 of 264, and 100 draws 0 of 43
            severity = WRONG if fault.where or len(fit.draws) >= HALF * MOST_DRAWS else CARE
            loads = not history and len(channels) == fit.measurements.n_channels
            found.append(finding_of(fault, fit.title, channels, severity, loads))
        found += about("data", _check_offset(fit)) if history and fit.after is not None else []
    unexplained = all(each.severity != WRONG for each in found)
    return found + (about("fit", check_errors(others)) if unexplained else [])


def _changes(fit: Fit) -> tuple[Fault, ...]:
    """Faults of data without time."""
    measured = fit.measurements
    if fit.expected is None or not len(fit.draws):
        return ()
    cases = [str(each) for each in measured.points or range(1, measured.n_steps + 1)]
    deviations = np.broadcast_to(fit.expected, measured.values.shape)
    table = Table(measured.values, fit.draws, deviations, [each.name for each in measured.channels], cases)
    return find_changes(table, [each.dimension for each in measured.channels])


def check_supports(model: Any) -> list[Finding]:
    """Supports of one structure whose slow motion has another sign, size or clock than that of the others."""
    motions = motions_to_replace(model) if getattr(model, "supports", ()) else ()
    if len({(each.n_steps, each.dt) for each in motions}) != 1:
        return []
    found, slow = [], slow_motions([each.acceleration for each in motions], motions[0].dt)
    for k, fault in supports_apart(slow, [f'motion "{each.name}"' for each in motions]):
        if k not in getattr(model, "inputs", ()):  # whose gains and lags are parameters of a `SensedModel`
            severity, channels = CARE if fault.kind == "lag" else WRONG, [Channel(*fault.names, "acceleration", "g")]
            found.append(finding_of(fault, "", channels, severity))  # waves make lags too
    return about("input", found)


def _check_offset(fit: Fit) -> list[Finding]:
    """Channels whose residuals are mostly a constant, a slope or a parabola: 3 / n of n independent samples."""
    large = {}
    for channel, values in zip(fit.measurements.channels, fit.residuals, strict=True):
        left = values[np.isfinite(values)]
        if len(left) >= FEWEST and left.any():
            smooth = np.polynomial.Legendre.fit(np.arange(len(left)), left, 2)(np.arange(len(left)))
            share = float(np.square(smooth).sum() / np.square(left).sum())
            large |= {channel.name: share} if share > HALF else {}
    if not large:
        return []
    text = (
        f"{percent(max(large.values()))} of the power that the fit leaves of {fit.where(*large)} is one slow parabola "
        "over the whole record: no vibration makes it, and the noise takes it for scatter."
    )
    action = (
        "Correct the baseline (`baseline` in [measurements]); if the structure did keep a displacement, the model must "
        "have it."
    )
    return [Finding("A measurement may have an offset or a drift", CARE, text, action, large)]


def check_errors(fits: Sequence[Fit]) -> list[Finding]:
    """Channels that the fit, or the best draw of the prior, does not explain; white and normal noise is no fault."""
    useless, far = dict[str, float](), dict[str, float]()
    for fit in fits:
        measured, responses = fit.measurements.values, fit.draws if fit.after is None else fit.after[None]
        errors = np.nan_to_num(relative_errors(measured - responses, measured))
        best = errors[np.log(np.maximum(errors, 1e-3)).sum(axis=1).argmin()] if len(errors) else ()
        for row, size in enumerate(best):
            name = fit.where(fit.measurements.channels[row].name)
            if fit.after is None and size > EXPLAINED:
                far[name] = float(size)
            elif fit.after is not None and size**2 > HALF:
                checks = checks_of(fit.residuals[row])
                if checks is not None and min(checks.white[0], checks.normal[0]) < SMALL_PROBABILITY:
                    useless[name] = float(size)
    shown = listed([f"{percent(size)} in {name}" for name, size in (useless or far).items()])
    if useless:
        text = f"The update leaves more than half of the power unexplained: the error (RRMSE) is {shown}; 71 % is half."
        action = (
            "Check that it is the right column, its unit, sign and clock, and the place of the sensor in the model; if "
            "all of them are right, the model lacks what moves it."
        )
        return [Finding("The model does not follow the measurements", WRONG, text, action, useless)]
    text = f"No draw of the prior comes near the measurements; the best one has an error (RRMSE) of {shown}."
    action = (
        "Check model and priors. A model of your own must return SI units (m, m/s², N, Pa, rad), and zero in "
        "[measurements] is the time at which the base motion begins."
    )
    return [Finding("The prior does not reach the measurements", CARE, text, action, far)] if far else []


def check_parameters(rows: Sequence[ParameterRow], of: Any, point: np.ndarray) -> list[Finding]:
    """Parameters that are not informed, or at the edge of their prior; `of` is the posterior, or a run, at its fit."""
    found, at = [], list[str]()
    flat = [row.label for row in rows if row.sd > SAME_AS_PRIOR * row.prior_sd]  # these are at no edge but the prior's
    for i, row in ((i, row) for i, row in enumerate(rows) if row.sd <= SAME_AS_PRIOR * row.prior_sd):
        near, moved = NEAR_BOUND * np.nanmin([row.high - row.low, row.prior_sd]), np.array(point)
        for bound, distance, side in ((row.lower, row.low - row.lower, -1.0), (row.upper, row.upper - row.high, 1.0)):
            moved[i] = (bound + side * NEAR_BOUND * row.prior_sd) * of.parameters[i].factor
            if distance < near and not _fails(of.likelihood, moved, i):
                at.append(f"{row.label} at {bound:.4g}")
    if at:
        text = f"The posterior reaches the edge of its prior: {listed(at)}. The bound, not the data, ends it there."
        action = "If no other finding explains it, widen the prior; else the parameter makes up for that fault."
        found.append(Finding("At the edge of the prior", CARE, text, action))
    if flat:
        text = f"The posterior of {listed(flat)} is nearly as wide as its prior: these data say little about it."
        action = "Do not report it as identified. A stronger excitation or another sensor may inform it."
        found.append(Finding("Not informed by the data", NOTE, text, action))
    return found


def _fails(likelihood: Any, point: np.ndarray, i: int) -> bool:
    """Whether model or noise are not defined at a point (ndim,), for its parameter i."""
    for part, columns in () if likelihood is None else likelihood.parts():
        own = columns[: len(part.model.parameter_names)]  # not by the likelihood, which would count a failure
        if i in own and simulate_batch(part.model, point[None, own]).reasons[0]:
            return True
        if not part.possible(point[None, columns])[0]:
            return True
    return False


def check_other_events(rows: Sequence[ParameterRow]) -> list[Finding]:
    """By which factors the standard deviations from one event are too small for the parameters of another event."""
    spread = spread_of([row.name for row in rows])
    known = [(row, spread[row.name]) for row in rows if row.name in spread and row.cv > 0.0]
    factors = {row.label: float(np.sqrt(1.0 + 2.0 * (sd / row.cv) ** 2)) for row, sd in known}
    if not factors:
        return []
    differing = [f"{row.label} by about {percent(sd)} (factor {factors[row.label]:.2g})" for row, sd in known]
    text = f"For another event the standard deviations are too small: parameters differ, {listed(differing)}."
    action = "Predict another event with this spread (in Python, predict_new_event), or calibrate several events."
    return [Finding("Another event differs", NOTE, text, action, factors)]


def check_residuals(fits: Iterable[Fit]) -> list[Finding]:
    """How much successive errors depend on each other: of real measurements always, so that this limits no result."""
    checked = [(fit, each) for fit in fits for each in fit.channels if each.checks is not None]
    coloured = [fit.where(each.channel.name) for fit, each in checked if each.checks.white[0] < SMALL_PROBABILITY]
    # the information of independent samples is proportional to their number
    assumed = sum(each.assumed for _, each in checked)
    worth = sum(
        min(each.checks.n_effective[0], each.assumed) if each.checks.white[0] < SMALL_PROBABILITY else each.assumed
        for _, each in checked
    )
    factor = float(np.sqrt(assumed / worth)) if coloured else 1.0
    if round(factor, 1) <= 1.0:
        return []
    text = (
        f"The errors of {listed(coloured)} are correlated: {assumed:.0f} samples are worth {worth:.0f} independent "
        f"ones, and standard deviations from the data are too small by a factor of about {factor:.2g}."
    )
    action = (
        'Use the wider standard deviations, or AutoregressiveNoise (kind = "autoregressive" in [noise]), and look at '
        "the residuals for an effect that the model lacks."
    )
    return [Finding(CORRELATED, NOTE, text, action, {"factor": factor})]


def check_stated_errors(fits: Iterable[Fit]) -> list[Finding]:
    """Whether data without time differ from the model by more than the standard deviations of their errors."""
    found = []
    for fit in fits:
        if fit.deviations is None or fit.residuals is None:
            continue
        measured, squares = fit.measurements, np.square(fit.residuals / fit.deviations)
        n, cases = int(np.isfinite(squares).sum()), measured.points or range(1, measured.n_steps + 1)
        names = [f"{channel.name} at {case}" for channel in measured.channels for case in cases]
        more = "leave the stated errors out: they are then estimated."
        found += check_squares(
            squares.ravel(), n, names, f"The {n} values{f' of {fit.title}' if fit.title else ''}", more
        )
    return found


def describe_residuals(checks: ResidualChecks | None) -> list[str]:
    """What the residuals of each channel look like, in words; None could not be checked."""
    if checks is None:
        return ["not checked (too few samples, or an exact fit)."]
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
