"""Checks of a model at a fit: does it read its motion, and are step and mesh fine enough for its data?

At a fit, the response r changes by d with half the step. With the derivatives J of the response by the parameters, each
in units of its posterior standard deviation, and the weights W = 1 / sigma^2 of the residuals, ::

    delta = (J^T W J + P)^-1 J^T W d

is about the change of the parameters in their standard deviations, where P is the precision of the prior in this unit.
Simulations that a sampler has made cannot show this error, because all of them contain it.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from ..likelihood.posterior import Posterior
from ..signals.events import motions_of
from ..signals.records import Record
from ..simulation.model import SimulationBatch
from .finding import CARE, NOTE, WRONG, Finding

__all__ = [
    "find_discretisation_error",
    "find_unread_motion",
    "motions_to_replace",
    "relative_difference",
    "simulations_of_the_test",
    "under",
]

SHIFT, LARGE_SHIFT = 0.5, 2.0  # of a parameter by half a step, in standard deviations: a caution, and a wrong result
LARGE_SHARE = 0.1  # of the prior's standard deviation, below which no shift makes a result wrong

NOTHING = 1e-6  # difference of two responses, relative to their norm, up to which a motion changes nothing
UNREAD = "Check that the model reads the motion that it is given, and not one file that is always the same."

Simulate = Callable[[Any, np.ndarray], SimulationBatch]
"""Simulates a model at points (n, n_parameters)."""


def find_discretisation_error(
    posterior: Posterior, point: np.ndarray, sd: np.ndarray, simulate: Simulate
) -> list[Finding]:
    """Halve step and mesh at a fit (ndim,), and compare the parameters' change with their standard deviations (ndim,).

    ``simulate(model, points)`` returns a `SimulationBatch`. No finding where step and mesh are fine enough.
    """
    prior_sd = np.array([row[3] for row in posterior.prior.table()[1]])
    parts, changes = [], {}
    for likelihood, columns in posterior.likelihood.parts():
        n = len(likelihood.model.parameter_names)
        theta, at = point[columns], columns[:n]
        batch = simulate(likelihood.model, theta[:n] + np.vstack([np.zeros(n), np.diag(sd[at])]))
        if reason := next(filter(None, batch.reasons), ""):
            return [Finding("Step and mesh were not tested", NOTE, f"A simulation failed: {reason}.")]
        response, slopes = batch.response[0], batch.response[1:] - batch.response[0]
        residuals = likelihood.residuals_of(response, theta)
        sigma = np.sqrt(np.nanmean(np.square(residuals), axis=1))
        parts.append((at, response, slopes, sigma))
        for what, model, every in _finer(likelihood.model):
            fine = simulate(model, theta[None, :n])
            if fine.reasons[0]:
                text = f"With half of {what} the simulation at the fit fails: {fine.reasons[0]}."
                return [Finding("A finer model fails", CARE, text, "Check the convergence of the model.")]
            changes.setdefault(what, {})[len(parts) - 1] = fine.response[0][:, ::every] - response
    if not changes:
        text = "The model takes neither a motion nor a step that could be halved."
        return [Finding("The time step was not tested", NOTE, text, "Halve it in the model, and compare.")]
    found = [_compare(what, change, parts, sd, prior_sd, posterior.parameter_names) for what, change in changes.items()]
    return [each for each in found if each is not None]


def find_unread_motion(model: Any, theta: np.ndarray, response: np.ndarray, simulate: Simulate) -> list[Finding]:
    """Finding if twice the motion fails, or does not change the response (n_channels, n_steps) at `theta`.

    A model without a motion that can be replaced has none; `simulate` as for `find_discretisation_error`.
    """
    if not motions_to_replace(model):
        return []
    batch = simulate(under(model, lambda each: each.scale(2.0)), theta[None])
    if batch.reasons[0]:
        text = f"Under twice the base motion the simulation fails: {batch.reasons[0]}."
        return [Finding("A stronger motion fails", CARE, text, "Predictions of stronger events may fail as well.")]
    if relative_difference(batch.response[0] - response, response) > NOTHING:
        return []
    text = "Twice the base motion gives the same response: the model does not use the motion that it is given."
    return [Finding("The motion changes nothing", WRONG, f"{text} Predictions of other events repeat it.", UNREAD)]


def relative_difference(difference: np.ndarray, reference: np.ndarray) -> float:
    """Norm of a difference, relative to the norm of a reference [-]."""
    norm = float(np.linalg.norm(reference))
    return float(np.linalg.norm(difference)) / norm if norm > 0.0 else float(np.any(difference))


def simulations_of_the_test(posterior: Posterior) -> int:
    """Number of simulations that `find_discretisation_error` makes."""
    models = [likelihood.model for likelihood, _ in posterior.likelihood.parts()]
    return sum(1 + len(model.parameter_names) + len(list(_finer(model))) for model in models)


def motions_to_replace(model: Any) -> tuple[Record, ...]:
    """The records that excite a model; empty where they cannot be replaced."""
    if not hasattr(model, "with_record"):
        return ()
    supports, found = getattr(model, "supports", ()), motions_of(model)
    return found if supports and len(found) == len(supports) else found[:1]


def under(model: Any, change: Callable[[Record], Record]) -> Any:
    """The model under its motions, each of which is changed."""
    motions = tuple(change(each) for each in motions_to_replace(model))
    vertical = getattr(model, "vertical", None)
    if isinstance(vertical, Record):
        return model.with_record((motions[0], change(vertical)))
    return model.with_record(motions if getattr(model, "supports", ()) else motions[0])


def _finer(model: Any) -> Iterator[tuple[str, Any, int]]:
    """What is halved, the finer model, and its response samples per sample of the model."""
    names = {each.name for each in fields(model)} if is_dataclass(model) else set()
    if "substeps" in names:
        yield "the integration step", replace(model, substeps=2 * model.substeps), 1
    elif "step" in names and hasattr(model, "integration_step"):
        yield "the integration step", replace(model, step=0.5 * model.integration_step), 1
    elif motions_to_replace(model):
        finer = under(model, lambda each: each.resample(0.5 * each.dt))
        if (finer.n_steps - 1) == 2 * (model.n_steps - 1):
            yield "the time step", finer, 2
    if "mesh" in names and isinstance(model.mesh, int):
        yield "the fibers of the section", replace(model, mesh=2 * model.mesh), 1


def _compare(
    what: str, change: dict[int, np.ndarray], parts: list, sd: np.ndarray, prior_sd: np.ndarray, names: tuple[str, ...]
) -> Finding | None:
    """The finding about one refinement, whose changes of the response are given by data set; None if it is small."""
    ndim = len(sd)
    widths = sd / prior_sd
    precision = np.diag(np.square(np.where(np.isfinite(widths), widths, 0.0)))
    pull, squares = np.zeros(ndim), np.zeros(2)
    for i, (at, response, slopes, sigma) in enumerate(parts):
        used = sigma > 0.0
        jacobian = (slopes[:, used] / sigma[used, None]).reshape(len(slopes), -1)
        precision[np.ix_(at, at)] += jacobian @ jacobian.T
        if i in change:
            pull[at] += jacobian @ (change[i][used] / sigma[used, None]).ravel()
            squares += np.square(change[i]).sum(), np.square(response).sum()
    shift = np.linalg.lstsq(precision, pull)[0]
    large = np.abs(shift) >= SHIFT
    if not large.any():
        return None
    moved = ", ".join(f"{names[i]} by {abs(shift[i]):.2g}" for i in np.flatnonzero(large))
    text = (
        f"Half of {what} changes the response by {100.0 * np.sqrt(squares[0] / squares[1]):.2g} %, which moves {moved} "
        "posterior standard deviations: intervals that are narrower than the error of the model miss the truth."
    )
    wrong = (np.abs(shift) > LARGE_SHIFT) & ~(np.abs(shift) * widths < LARGE_SHARE)
    weight = WRONG if wrong.any() else CARE
    return Finding("The model is too coarse for its data", weight, text, f"Halve {what} until this is small.")
