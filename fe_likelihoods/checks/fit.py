"""Findings about a fit: does the model follow the measurements at all, and what would explain it if not?"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.special import chdtrc

from ..likelihood.fits import MOST_DRAWS, Fit, checks_of
from ..noise.residuals import ResidualChecks
from ..signals.channels import Channel, relative_errors
from ..text_tables import listed
from .faults import EXPLAINED, find_faults, finding_of, supports_apart
from .finding import CARE, CORRELATED, HALF, NOTE, SMALL_PROBABILITY, WRONG, Finding, percent
from .modal import check_modes, squares_of_modes
from .model import motions_to_replace

FEWEST = 10  # samples that the tests of correlation and distribution need
FAR = 5.0  # mean square of residuals, relative to the stated one, from which on a result is not used


def check_responses(fits: Iterable[Fit]) -> list[Finding]:
    """What responses show of the data and of the fit, if there is one: faults of the data, and missed channels.

    Faults are those that draws of the prior show, before a run and after it: a fit may make up for them.
    """
    found, others = list[Finding](), [fit for fit in fits if not fit.modal]
    for fit in fits:
        found += check_modes(fit.modal.draws, fit.title) if fit.modal and fit.modal.draws else []
    for fit in others:
        for fault in find_faults(fit.measurements, fit.draws):
            channels = [each for each in fit.measurements.channels if each.name in fault.names]
            # of right real events, 5 to 20 draws blame 19 of 396, 50 or 70 draws 3 of 264, and 100 draws 0 of 43
            severity = WRONG if fault.where or len(fit.draws) >= HALF * MOST_DRAWS else CARE
            found.append(finding_of(fault, fit.title, channels, severity))
        found += _check_offset(fit)
    if any(each.severity == WRONG for each in found):
        return found
    missed = _check_errors(others)
    far = _check_prior([fit for fit in others if missed or fit.after is None], WRONG if missed else CARE)
    return [*found, *far, *missed]  # causes first


def check_supports(model: Any) -> list[Finding]:
    """Supports of one structure whose slow motion has another sign, size or clock than the others."""
    motions, found = motions_to_replace(model) if getattr(model, "supports", ()) else (), list[Finding]()
    if len({(each.n_steps, each.dt) for each in motions}) != 1:
        return []
    names = [f'motion "{each.name}"' for each in motions]
    for k, faults in supports_apart([each.acceleration for each in motions], names, motions[0].dt).items():
        if k not in getattr(model, "inputs", ()):  # whose gains and lags are parameters of a `SensedModel`
            one = [Channel(names[k], "acceleration", "g")]  # waves make lags too
            found += [finding_of(each, "", one, CARE if each.kind == "lag" else WRONG) for each in faults]
    return found


def _check_offset(fit: Fit) -> list[Finding]:
    """Channels whose residuals are mostly a constant, a slope or a parabola: 3 / n of n independent samples."""
    large, residuals = dict[str, float](), fit.residuals if fit.measurements.is_history else None
    for channel, values in () if residuals is None else zip(fit.measurements.channels, residuals, strict=True):
        left = values[np.isfinite(values)]
        if len(left) >= FEWEST and left.any():
            smooth = np.polynomial.Legendre.fit(np.arange(len(left)), left, 2)(np.arange(len(left)))
            share = float(np.square(smooth).sum() / np.square(left).sum())
            large |= {channel.name: share} if share > HALF else {}
    share = percent(max(large.values(), default=0.0))
    text = f"{share} of the power that the fit leaves of {fit.where(*large)} is one parabola over the whole record."
    action = "Correct the baseline (`baseline` in [measurements]), or give the model what displaces it for good."
    kind = "A measurement may have an offset or a drift"
    return [Finding(kind, CARE, text, action, large, "data")] if large else []


def _check_errors(fits: Iterable[Fit]) -> list[Finding]:
    """Channels that the fit does not explain; white and normal noise is no fault."""
    useless = dict[str, float]()
    for fit in (each for each in fits if each.after is not None):
        for each, residuals in zip(fit.channels, fit.residuals, strict=True):
            checks = checks_of(residuals) if each.after**2 > HALF else None
            if checks is not None and min(checks.white[0], checks.normal[0]) < SMALL_PROBABILITY:
                useless[fit.where(each.channel.name)] = each.after
    shown = listed([f"{percent(size)} in {name}" for name, size in useless.items()])
    text = f"The update leaves more than half of the power unexplained: the error (RRMSE) is {shown}; 71 % is half."
    action = "Check column, unit, sign, clock and place of the sensor; if all are right, the model lacks what moves it."
    kind = "The model does not follow the measurements"
    return [Finding(kind, WRONG, text, action, useless, "fit")] if useless else []


def _check_prior(fits: Iterable[Fit], severity: str) -> list[Finding]:
    """Channels that not even the best draw of the prior explains."""
    far = dict[str, float]()
    for fit in (each for each in fits if len(each.draws)):
        measured = fit.measurements.values
        errors = np.nan_to_num(relative_errors(measured - fit.draws, measured))
        best = errors[np.log(np.maximum(errors, 1e-3)).sum(axis=1).argmin()]
        sizes = zip(fit.measurements.channels, best.tolist(), strict=True)
        far |= {fit.where(channel.name): size for channel, size in sizes if size > EXPLAINED}
    shown = listed([f"{percent(size)} in {name}" for name, size in far.items()])
    text = f"No draw of the prior comes near the measurements; the best one has an error (RRMSE) of {shown}."
    action = "Check priors and model, units of a model of your own (SI), and `zero`, at which the base motion begins."
    return [Finding("The prior does not reach the measurements", severity, text, action, far, "fit")] if far else []


def check_residuals(fits: Iterable[Fit]) -> list[Finding]:
    """How much successive errors depend on each other: of real measurements always, so that this limits no result."""
    coloured, assumed, worth = list[str](), 0.0, 0.0
    for fit, each in ((one, each) for one in fits for each in one.channels if each.checks is not None):
        # the information of independent samples is proportional to their number
        known = each.assumed
        if each.checks.white[0] < SMALL_PROBABILITY:
            coloured.append(fit.where(each.channel.name))
            known = min(each.checks.n_effective[0], known)
        assumed, worth = assumed + each.assumed, worth + known
    factor = float(np.sqrt(assumed / worth)) if coloured else 1.0
    text = (
        f"The errors of {listed(coloured)} are correlated: {assumed:.0f} samples are worth {worth:.0f} independent "
        f"ones, and standard deviations from the data are too small by a factor of about {factor:.2g}."
    )
    action = 'Use the wider standard deviations, or AutoregressiveNoise (kind = "autoregressive" in [noise]).'
    return [Finding(CORRELATED, NOTE, text, action, {"factor": factor})] if round(factor, 1) > 1.0 else []


def check_stated_errors(fits: Iterable[Fit]) -> list[Finding]:
    """Whether data without time differ from the model by more than the stated standard deviations explain."""
    found = []
    for fit in fits:
        squares, n = squares_of_modes(fit.modal) if fit.modal else _squares(fit)
        factor = float(np.sqrt(sum(squares.values()) / max(n, 1)))
        if not chdtrc(n, n * factor**2) < SMALL_PROBABILITY:
            continue
        what = "Frequencies and shapes" if fit.modal else f"The {n} values"
        text = f"{fit.where(what)} differ from the model by {factor:.2g} times their stated errors (root mean square)."
        largest = listed(sorted(squares, key=squares.__getitem__)[:-3:-1])
        action = f"The largest: {largest}. Look for a wrong number, sensor or place; else let the errors be unknown."
        severity = WRONG if factor**2 > FAR else CARE
        kind = "Values differ more than their stated errors"
        found.append(Finding(kind, severity, text, action, {"factor": factor}, "fit"))
    return found


def _squares(fit: Fit) -> tuple[dict[str, float], int]:
    """Squares of residuals without time by their stated errors, by name, and how many errors they are of."""
    measured = fit.measurements
    if fit.deviations is None or fit.residuals is None:
        return {}, 0
    cases = measured.points or range(1, measured.n_steps + 1)
    names = [f"{channel.name} at {case}" for channel in measured.channels for case in cases]
    squares = dict(zip(names, np.square(fit.residuals / fit.deviations).ravel().tolist(), strict=True))
    known = {name: each for name, each in squares.items() if np.isfinite(each)}
    return known, len(known)


def describe_residuals(checks: ResidualChecks | None) -> list[str]:
    """What the residuals of each channel look like, in words; None could not be checked."""
    found = [] if checks else ["not checked (too few samples, or an exact fit)."]
    for lag, worth, white, normal, n in zip(*checks[2:7], strict=True) if checks else ():
        text = f"Correlated ({lag:.2f} from sample to sample): {n:.0f} samples are worth {worth:.0f} independent ones."
        text = text if white < SMALL_PROBABILITY else "White: no correlation from sample to sample was found."
        text += " Not normal: look at the tails." if normal < SMALL_PROBABILITY else ""
        found.append(text if n >= FEWEST else f"Not checked: {n:.0f} samples are too few, {FEWEST} are needed.")
    return found
