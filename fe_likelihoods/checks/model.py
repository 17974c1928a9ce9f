"""Checks of a model: does it repeat itself and read its motion, and are step and mesh fine enough for its data?

Half the step changes the response by d. With its derivatives J by the parameters in units of their posterior standard
deviations, the weights W = 1 / sigma^2 of the residuals, and the precision P of the prior, the parameters change by ::

    delta = (J^T W J + P)^-1 J^T W d

standard deviations. Simulations that a sampler has made cannot show this error, because all of them contain it.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from ..likelihood.likelihood import FELikelihood
from ..likelihood.posterior import Posterior
from ..signals.events import motions_of
from ..signals.records import Record
from ..simulation.model import simulate_batch
from ..text_tables import listed
from .finding import CARE, HALF, WRONG, Finding, percent

# A shift of a parameter by half a step is named from HALF a standard deviation on: the mean square of its error is then
# 1.25 times the variance. For an oscillator with known parameters (eleven noises and steps, six seeds each), 90 %
# intervals without it held the stiffness in 17 of 18 runs with shifts of 0.3 to 1.3, and in 0 of 36 with 5 to 60.
NOTHING = 1e-6  # difference of two responses, relative to their norm, well above the round-off of a long response
STEP = "Step and mesh"
STEPS = "integration step", "Double `substeps` of the model, or halve its `step`"
MESH = "integration step and size of the fibers", "Double `substeps` or `mesh` of the model"
SAMPLES = (
    "time step",
    "Let the model make more integration steps between two samples (ten times as many, for example), or use a method "
    "of higher order",
)


def halve_steps(posterior: Posterior, point: np.ndarray, sd: np.ndarray) -> tuple[list[Finding], str]:
    """Halve step and mesh at a fit (ndim,), and compare the parameters' change with their standard deviations (ndim,).

    Returns findings, and what was tested. A model that fails with half a step, or whose response does not change, keeps
    a step of its own, which is not tested.
    """
    widths = sd / np.array([row[3] for row in posterior.prior.table()[1]])
    precision = np.diag(np.square(np.where(np.isfinite(widths), widths, 0.0)))
    pull, squares, halved, tests = np.zeros(len(sd)), np.zeros(2), dict[str, str](), list[str]()
    for likelihood, columns in posterior.likelihood.data_sets():
        model, n = likelihood.model, len(likelihood.model.parameter_names)
        theta, at = point[columns][:n], columns[:n]
        batch = likelihood.simulate(theta + np.vstack([np.zeros(n), np.diag(sd[at])]))
        if reason := next(filter(None, batch.reasons), ""):
            return [], f"not tested: a simulation failed ({reason})"
        response = batch.response[0]
        sigma = np.sqrt(np.nanmean(np.square(likelihood.residuals_of(response)), axis=1))[:, None]
        weights = np.divide(1.0, sigma, out=np.zeros_like(sigma), where=sigma > 0.0)
        jacobian = ((batch.response[1:] - response) * weights).reshape(n, -1)
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
    shift = np.abs(np.linalg.lstsq(precision, pull)[0])
    numbers = {posterior.parameter_names[i]: float(shift[i]) for i in np.flatnonzero(shift >= HALF)}
    shares = dict(zip(posterior.parameter_names, shift * sd / np.maximum(np.abs(point), 1e-300), strict=True))
    moves = [
        f"{name} by {by:.2g} posterior standard deviations ({percent(shares[name])})" for name, by in numbers.items()
    ]
    change = percent(np.sqrt(squares[0] / max(squares[1], 1e-300)))
    text = f"Half of the {' and '.join(halved)} changes the response by {change}, which moves {listed(moves)}."
    action = f"{'; '.join(halved.values())}. With the shift added to standard deviations, the numbers are usable."
    title = "The model is too coarse for its data"
    found = [Finding(title, CARE, text, action, numbers, "fit")] if numbers else []
    return found, "; ".join(dict.fromkeys(tests))


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
    text = f"The response to {motion} equals that of the calibration, and so will predictions of other events."
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
