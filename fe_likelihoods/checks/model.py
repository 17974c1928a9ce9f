"""Checks of a model: does it follow the measurements, repeat itself, read its motion, and is it used within its range?

Half the step changes the response by d. With its derivatives J by the parameters in units of their posterior standard
deviations, the weights W = 1 / sigma^2 of the residuals, and the precision P of the prior, the parameters change by ::

    delta = (J^T W J + P)^-1 J^T W d

standard deviations. Simulations that a sampler has made cannot show this error, because all of them contain it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from samplers.estimates.genealogy import FEWEST_FOR_VARIANCE as FEWEST

from ..likelihood.fits import MOST_DRAWS, Fit, checks_of
from ..likelihood.likelihood import FELikelihood
from ..likelihood.posterior import Posterior
from ..noise.residuals import ResidualChecks
from ..signals.channels import Channel, relative_errors
from ..signals.records import Record, motions_of
from ..simulation.model import simulate_batch
from ..text_tables import listed
from .faults import EXPLAINED, find_faults, finding_of, supports_apart
from .finding import CARE, CORRELATED, HALF, NOTE, SMALL_PROBABILITY, WRONG, Finding, percent
from .modal import check_modes, squares_of_modes

FAR = 5.0  # mean square of residuals, relative to the stated one, from which on a result is not used
# A shift of a parameter by half a step is named from HALF a standard deviation on: the mean square of its error is then
# 1.25 times the variance. For an oscillator with known parameters (eleven noises and steps, six seeds each), 90 %
# intervals without it held the stiffness in 17 of 18 runs with shifts of 0.3 to 1.3, and in 0 of 36 with 5 to 60.
# Before a run, a shift at the best draw of the prior is rough: 0.6 for 0.16 of a cracked column. Of 48 steps and meshes
# of seven structures, 29 of which move the mode by half a standard deviation or more, it names 24 (21 and 18 from one
# and two standard deviations on), and none of the 19 others; halving at the mode named 27 and 1.
NOTHING = 1e-6  # difference of two responses, relative to their norm, well above the round-off of a long response
# of a predicted peak to the calibrated ones: named in 1 of 100 right runs, and in 96 of 100 at three times the strength
PEAK_RATIO = 2.0
NARROW = 0.2  # bandwidth of a motion by the calibrated one; earthquakes of one structure differ by 0.38 or more
# half the range in the last two seconds by the final value, or by a tenth of the largest response if this is more
UNSETTLED = 0.1
STEP = "Step and mesh"
STEPS = "integration step", "Double `substeps` of the model, or halve its `step`"
MESH = "integration step and size of the fibers", "Double `substeps` or `mesh` of the model"
SAMPLES = (
    "time step",
    "Let the model make more integration steps between two samples (ten times as many, for example), or use a method "
    "of higher order",
)


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


def halve_steps(posterior: Posterior, point: np.ndarray, sd: np.ndarray | None = None) -> tuple[list[Finding], str]:
    """Halve step and mesh at a fit (ndim,), and compare the parameters' change with their standard deviations (ndim,).

    Before a run the point is a draw of the prior, the standard deviations follow from the errors that a linear fit from
    there leaves. Returns findings, and what was tested. A model that fails with half a step, or whose response does not
    change, keeps a step of its own, which is not tested.
    """
    before, prior_sd = sd is None, np.array([row[3] for row in posterior.prior.table()[1]])
    sd = 0.1 * prior_sd if before else sd
    widths = sd / prior_sd
    precision = np.diag(np.square(np.where(np.isfinite(widths), widths, 0.0)))
    pull, squares, halved, tests = np.zeros(len(sd)), np.zeros(2), dict[str, str](), list[str]()
    for likelihood, columns in posterior.likelihood.data_sets():
        model, n = likelihood.model, len(likelihood.model.parameter_names)
        theta, at = point[columns][:n], columns[:n]
        batch = likelihood.simulate(theta + np.vstack([np.zeros(n), np.diag(sd[at])]))
        if reason := next(filter(None, batch.reasons), ""):
            return [], f"not tested: a simulation failed ({reason})"
        response = batch.response[0]
        residuals, differences = likelihood.residuals_of(response), batch.response[1:] - response
        weights = _weights(residuals)
        if before:
            weighted = (differences * weights).reshape(n, -1).T
            step = np.linalg.lstsq(weighted, (np.nan_to_num(residuals) * weights).ravel())[0]
            weights = _weights(residuals - np.tensordot(step, differences, 1))
        jacobian = (differences * weights).reshape(n, -1)
        precision[np.ix_(at, at)] += jacobian @ jacobian.T
        if (found := _finer(model)) is None:
            tests.append("not tested: the model takes neither a motion nor a step that could be halved")
            continue
        (what, action), finer, every = found
        fine = simulate_batch(finer, theta[None])
        if fine.reasons[0]:
            tests.append(f"not tested: with half of the {what} the simulation fails ({fine.reasons[0]})")
            continue
        change = fine.response[0][:, ::every] - response
        same, halved[what] = relative_difference(change, response) <= NOTHING, action
        own = f"not tested: half of the {what} changes nothing: the model has its own, or it is exact"
        tests.append(own if same else f"the {what} was halved at the fit")
        pull[at] += jacobian @ (change * weights).ravel()
        squares += [np.square(each).sum() for each in (change, response)]
    covariance = np.linalg.pinv(precision)
    narrower = np.sqrt(np.maximum(np.diag(covariance), 1e-300)) if before else 1.0
    shift, sd = np.abs(covariance @ pull) / narrower, sd * narrower
    numbers = {posterior.parameter_names[i]: float(shift[i]) for i in np.flatnonzero(shift >= HALF)}
    shares = dict(zip(posterior.parameter_names, shift * sd / np.maximum(np.abs(point), 1e-300), strict=True))
    largest = sorted(numbers, key=numbers.__getitem__, reverse=True)
    moves = [
        f"{name} by {'about ' * before}{numbers[name]:.2g} posterior standard deviations ({percent(shares[name])})"
        for name in largest[:3]
    ] + [f"{len(largest) - 3} more by less"] * (len(largest) > 3)
    change = percent(np.sqrt(squares[0] / max(squares[1], 1e-300)))
    text = f"Half of the {' and '.join(halved)} changes the response by {change}, which moves {listed(moves)}."
    action = f"{'; '.join(halved.values())}. Or add the shift to the standard deviations."
    title = "The model is too coarse for its data"
    found = [Finding(title, CARE, text, action, numbers, "fit")] if numbers else []
    return found, "; ".join(dict.fromkeys(tests))


def _weights(residuals: np.ndarray) -> np.ndarray:
    """Weights (n_channels, n_steps) of samples by the mean square of each channel's residuals; zero if missing."""
    sigma = np.sqrt(np.nanmean(np.square(residuals), axis=1))[:, None]
    return np.isfinite(residuals) / np.where(sigma > 0.0, sigma, np.inf)


def check_motion(model: Any, theta: np.ndarray, response: np.ndarray) -> list[Finding]:
    """Whether twice the motion, if it can be replaced, does not change the response (n_channels, n_steps)."""
    if not motions_to_replace(model):
        return []
    batch = simulate_batch(_under(model, lambda each: each.scale(2.0)), theta[None])
    difference = None if batch.reasons[0] else relative_difference(batch.response[0] - response, response)
    return check_same_response(difference, "twice the motion")


def check_same_response(difference: float | None, motion: str = "this motion") -> list[Finding]:
    """Whether another motion gives the response of the calibration; `difference` is relative to this response."""
    if difference is None or difference > NOTHING:
        return []
    text = f"The response to {motion} equals the calibrated one, and so will predictions of other events."
    action = "Let the model read the motion that it is given, and not one file that is always the same."
    return [Finding("The motion changes nothing", WRONG, text, action, {"difference": difference}, "input")]


def check_chance(likelihood: FELikelihood, theta: np.ndarray, response: np.ndarray) -> list[Finding]:
    """Whether later simulations of the same parameters give the same response (n_channels, n_steps)."""
    batch = simulate_batch(likelihood.model, np.tile(theta, (2, 1)), likelihood.simulator.pool)
    text, numbers = "", dict[str, float]()
    for again, reason in zip(batch.response, batch.reasons, strict=True):
        if reason:
            text = f"The first simulation at the mean of the prior succeeded, a later one failed: {reason}."
        elif (share := relative_difference(again - response, response)) > NOTHING:
            text, numbers = f"Two simulations of the same parameters differ by {percent(share)}", {"difference": share}
            text += ": no sampler converges."
    action = "Set the seeds of the model, give each simulation a folder of its own, read no results of earlier runs."
    return [Finding("The model is not repeatable", WRONG, text, action, numbers, "input")] if text else []


def at_mean(posterior: Posterior) -> Iterator[tuple[FELikelihood, np.ndarray, str, np.ndarray]]:
    """Each data set at the mean of the prior: structural parameters, reason of a failure, and response."""
    mean = posterior.prior.mean()
    for likelihood, columns in posterior.likelihood.data_sets():
        theta = mean[columns][: len(likelihood.model.parameter_names)]
        batch = likelihood.simulate(theta[None])
        yield likelihood, theta, batch.reasons[0], batch.response[0]


def refuse_chance(posterior: Posterior) -> None:
    """Simulate the mean of the prior again; ValueError if the responses differ. A failed simulation is no such case."""
    for likelihood, theta, reason, response in at_mean(posterior):
        for found in [] if reason else check_chance(likelihood, theta, response):
            if found.numbers:
                raise ValueError(str(found))


def relative_difference(difference: np.ndarray, reference: np.ndarray) -> float:
    """Norm of a difference, relative to the norm of a reference [-]."""
    norm = float(np.linalg.norm(reference))
    return float(np.linalg.norm(difference)) / norm if norm > 0.0 else float(np.any(difference))


def motions_to_replace(model: Any) -> tuple[Record, ...]:
    """The records that excite a model; empty where they cannot be replaced."""
    if not hasattr(model, "with_record"):
        return ()
    supports, found = getattr(model, "supports", ()), motions_of(model)
    return found if supports and len(found) == len(supports) else found[:1]


def _under(model: Any, change: Callable[[Record], Record]) -> Any:
    """The model under its motions, each of which is changed."""
    motions = tuple(change(each) for each in motions_to_replace(model))
    vertical = getattr(model, "vertical", None)
    if isinstance(vertical, Record):
        return model.with_record((motions[0], change(vertical)))
    return model.with_record(motions if getattr(model, "supports", ()) else motions[0])


def _finer(model: Any) -> tuple[tuple[str, str], Any, int] | None:
    """What is halved and what to do, the finer model, and its response samples per sample of the model."""
    names = {each.name for each in fields(model)} if is_dataclass(model) else set()
    usual = model.analysis if "analysis" in names else None
    if is_dataclass(usual) and {"substeps", "mesh"} <= {each.name for each in fields(usual)}:
        return MESH, replace(model, analysis=replace(usual, substeps=2 * usual.substeps, mesh=2 * usual.mesh)), 1
    if "step" in names and hasattr(model, "integration_step"):
        return STEPS, replace(model, step=0.5 * model.integration_step), 1
    if motions_to_replace(model):
        finer = _under(model, lambda each: each.resample(0.5 * each.dt))
        return (SAMPLES, finer, 2) if (finer.n_steps - 1) == 2 * (model.n_steps - 1) else None
    return None


# predictions


def check_peaks(
    predicted: Mapping[str, float], calibrated: Sequence[Mapping[str, float]], alone: bool
) -> list[Finding]:
    """Peaks [SI] beyond the calibrated events' by a factor of two; `alone`: the parameters belong to one likelihood."""
    numbers = {}
    for name, value in predicted.items():
        measured = [event[name] for event in calibrated if event.get(name, 0.0) > 0.0]
        nearest = min(max(value, min(measured)), max(measured)) if measured else value
        if nearest and not 1.0 / PEAK_RATIO <= value / nearest <= PEAK_RATIO:
            numbers[name] = value / nearest
    far = ", ".join(
        f"{name} ({each:.2g} times the {'largest' if each > 1.0 else 'smallest'} calibrated one)"
        for name, each in numbers.items()
    )
    text = f"The predicted peaks are outside of the calibrated ones by more than a factor of {PEAK_RATIO:g}: {far}."
    # several events show how parameters vary between them, but not at amplitudes that none of them had
    other = ", or let parameters vary between events (in Python, Hierarchy)" if alone and len(calibrated) == 1 else ""
    action = f"Calibrate with events of this amplitude, on which stiffness and damping depend{other}."
    return [Finding("Beyond the calibrated amplitude", CARE, text, action, numbers)] if numbers else []


def check_bandwidth(bandwidth: float | None, calibrated: float | None) -> list[Finding]:
    """Whether the power of a motion is in a much narrower band [Hz] than in the calibration."""
    if bandwidth is None or calibrated is None or not bandwidth < NARROW * calibrated:
        return []
    text = (
        f"Its power is in a band of {bandwidth:.2g} Hz, as a harmonic has; of the calibration's, {calibrated:.2g} Hz."
    )
    action = "Calibrate with such a motion, or predict with the spread between events (in Python, predict_new_event)."
    return [Finding("A narrow-band motion", CARE, text, action, {"ratio": bandwidth / calibrated})]


def check_final_values(ends: Mapping[str, Sequence[float]]) -> list[Finding]:
    """Final values that still move: half the range in the last two seconds, value, and largest response, by name."""
    numbers = {
        name: half / value
        for name, (half, value, largest) in ends.items()
        if value > 0.0 and half > UNSETTLED * max(value, UNSETTLED * largest)
    }
    shares = ", ".join(f"{name} (+- {share:.0%})" for name, share in numbers.items())
    text = f"The structure still moves in the last 2 s, by a part of its final value: {shares}."
    action = "Append rest to the record (record.followed_by), or take a mean, final_value(channel, samples=...)."
    return [Finding("A final value still moves", CARE, text, action, numbers)] if numbers else []
