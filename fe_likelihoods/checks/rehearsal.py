"""What the command ``check`` rehearses: is a model what a sampler takes it for, and are its numerical errors small?

A model that returns something else the second time, or the same under every motion, ends in numbers that look like a
result. `check_model` simulates a few times what a run would simulate thousands of times.
"""

from collections.abc import Mapping
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ..emulation.modes import Mode, find_modes
from ..emulation.target import ResponseTarget
from ..likelihood.likelihood import FELikelihood
from ..likelihood.posterior import Posterior
from ..simulation.model import SimulationBatch, simulate_batch
from .compared import compare, data_sets_of, draws_to_compare
from .finding import CARE, WRONG, Finding, by_severity
from .fit import check_responses, check_supports
from .screening import check_data, check_gaps
from .steps import (
    NOTHING,
    StepTest,
    check_same_response,
    check_stronger_motion,
    halve_steps,
    motions_to_replace,
    not_tested,
    relative_difference,
)

__all__ = ["ModelCheck", "check_model", "refuse_chance"]

SECONDS = 60.0  # of the search for the best fit
MOST_SEARCHED = 150  # simulations of this search


class ModelCheck(NamedTuple):
    """What `check_model` has found, the most severe finding first."""

    findings: tuple[Finding, ...]
    tests: dict[str, str]  # names of the tests of step and mesh, and what was tested or why it was not
    simulations: int  # number of simulations made
    seconds: float  # per simulation [s]
    searched: float  # simulations of a search for the best fit from one start; NaN without one
    best_fit: tuple[Posterior, Mode] | None = None  # of this search; None without a fit, or where data are wrong


def check_model(posterior: Posterior, events: Mapping[str, Any] | None = None, *, progress: bool = False) -> ModelCheck:
    """Try the model and the data of a posterior before a run.

    It simulates the mean of the prior twice, under twice the motion and the motion of another event, and draws of the
    prior, which are compared with the measurements as in `fe_likelihoods.check_fit`. Where time permits (a minute), it
    searches for the best fit, and halves step and mesh there. `fe_likelihoods.check_data` looks at the data.

    Parameters
    ----------
    posterior : Posterior
    events : mapping of str to Record, optional
        Other motions that will be predicted, as for ``model.with_record``.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    ModelCheck

    Raises
    ------
    ValueError
        If the simulation at the mean of the prior fails.

    Examples
    --------
    >>> checked = check_model(posterior)
    >>> [finding.kind for finding in checked.findings if finding.severity == "wrong"]
    []
    """
    mean, found, fits, seconds, before = posterior.prior.mean(), list[Finding](), [], 0.0, _made(posterior)
    with tqdm(disable=not progress, unit="simulation", desc="check") as bar:
        posterior.when_simulated(bar.update)

        def simulate(model: Any, points: np.ndarray, pool: Any = None) -> SimulationBatch:
            batch = simulate_batch(model, points, pool)
            bar.update(len(points))
            nonlocal made
            made += len(points)
            return batch

        made = 0
        try:
            for key, likelihood, columns in data_sets_of(posterior):
                model, n = likelihood.model, len(likelihood.model.parameter_names)
                theta = mean[columns][:n]
                batch = likelihood.simulate(theta[None])
                if batch.reasons[0]:
                    raise ValueError(
                        f"the simulation at the mean of the prior has failed: {batch.reasons[0]}; check model, priors"
                    )
                start = perf_counter()
                again = simulate(model, theta[None])
                took = perf_counter() - start
                fits += compare(likelihood, draws_to_compare(posterior, took)[:, columns], key)[0]
                # generators of workers have moved on meanwhile
                chance = _check_chance(batch.response[0], again) or _check_chance(
                    batch.response[0], simulate(model, np.tile(theta, (2, 1)), likelihood.simulator.pool)
                )
                # where responses differ by chance, other differences say nothing
                found += chance or _check_motions(simulate, model, theta, batch.response[0], events or {})
                found += check_supports(model) + list(check_data(likelihood.measurements, motions_to_replace(model)))
                found += check_gaps(likelihood.noise)
                seconds += took
            best = _BestFit(StepTest([], {}))
            if isinstance(posterior.likelihood, FELikelihood) and all(each.severity != WRONG for each in found):
                best = _check_best_fit(simulate, posterior, seconds)
            of_fit = check_responses(fits)
        finally:
            posterior.when_simulated(None)
    found += [*best.test.findings, *of_fit, *_check_failures(posterior)]
    # what the data tell is not known where they are wrong or out of reach
    known, made = None if of_fit else best.found, made + _made(posterior) - before
    return ModelCheck(by_severity(found), best.test.tests, made, seconds, best.searched, known)


def _made(posterior: Posterior) -> int:
    """Simulations that a posterior has made, also for verification and with first parts of its records."""
    parts = [part for part, _ in posterior.likelihood.parts()]
    return sum(each.simulations + each.verifications for part in parts for each in (part, *part.shortened))


def refuse_chance(posterior: Posterior) -> None:
    """Simulate the mean of the prior again; ValueError if the responses differ. A failed simulation is no such case."""
    mean = posterior.prior.mean()
    for likelihood, columns in posterior.likelihood.parts():
        theta = mean[columns][: len(likelihood.model.parameter_names)]
        first = likelihood.simulate(theta[None])
        later = simulate_batch(likelihood.model, np.tile(theta, (2, 1)), likelihood.simulator.pool)
        if not any((*first.reasons, *later.reasons)):
            for finding in _check_chance(first.response[0], later):
                raise ValueError(str(finding))


def _check_chance(response: np.ndarray, later: SimulationBatch) -> list[Finding]:
    """Whether later simulations of the same parameters give the same response."""
    text = ""
    for again, reason in zip(later.response, later.reasons, strict=True):
        share = np.inf if reason else relative_difference(again - response, response)
        if reason:
            text = f"The first simulation at the mean of the prior succeeded, a later one failed: {reason}."
        elif share > NOTHING:
            text = f"Two simulations of the same parameters differ by {100.0 * share:.2g} %: no sampler converges."
    action = "Set the seeds of the model, give each simulation a folder of its own, read no results of earlier runs."
    return [Finding("The model is not repeatable", WRONG, text, action)] if text else []


def _check_failures(posterior: Posterior) -> list[Finding]:
    """The most frequent reason of failed simulations, most of which are draws of the prior."""
    report = posterior.report()
    if not report["failure_count"]:
        return []
    often, count = max(report["failure_reasons"].items(), key=lambda each: each[1])
    text = f"{report['failure_count']} of the simulations of this check failed, {count} of them: {often}."
    action = "A failed simulation counts as impossible: mend the model where its parameters are plausible."
    return [Finding("Simulations failed", CARE, text, action, {"count": report["failure_count"]})]


def _check_motions(
    simulate: Any, model: Any, theta: np.ndarray, response: np.ndarray, events: Mapping[str, Any]
) -> list[Finding]:
    """Whether the response follows the motion: twice the motion, and one other event; all are read in the same way."""
    found = check_stronger_motion(model, theta, response, simulate)
    if not motions_to_replace(model) or any(each.severity == WRONG for each in found):
        return found
    for name, record in list(events.items())[:1]:
        other = model.with_record(record)
        batch = simulate(other, theta[None])
        if batch.reasons[0]:
            text = f"Event {name}: the simulation at the mean of the prior fails: {batch.reasons[0]}."
            found.append(Finding("An event fails", CARE, text, "Check its motion and the steps of the model."))
        elif other.fingerprint != model.fingerprint:
            n = min(batch.response.shape[2], response.shape[1])
            change = relative_difference(batch.response[0][:, :n] - response[:, :n], response[:, :n])
            found += check_same_response(change, name)
    return found


class _BestFit(NamedTuple):
    """The test of step and mesh at the best fit, the simulations of the search, and the best fit if it was found."""

    test: StepTest
    searched: float = np.nan
    found: tuple[Posterior, Mode] | None = None


def _check_best_fit(simulate: Any, posterior: Posterior, seconds: float) -> _BestFit:
    """The error of step and mesh at the best fit, where a search for it takes a minute at most."""
    n = len(posterior.likelihood.model.parameter_names)
    limit = min(MOST_SEARCHED, SECONDS / max(seconds, 1e-6))
    if limit < 10 * (n + 1):
        why = f"the test takes about {15 * (n + 1)} simulations of {seconds:.2g} s, in the run"
        return _BestFit(not_tested(posterior.likelihood, why))
    try:
        target = ResponseTarget(posterior)
        search = find_modes(posterior, starts=1, max_simulations=limit)
    except (ValueError, np.linalg.LinAlgError) as error:
        return _BestFit(not_tested(posterior.likelihood, f"no fit was found: {error}"))
    if not search.modes:
        return _BestFit(not_tested(posterior.likelihood, "no fit was found"), search.simulations)
    mode = search.modes[0]
    factor = np.linalg.cholesky(mode.covariance)
    around = target.parameters(mode.coords + np.random.default_rng(1).standard_normal((400, len(factor))) @ factor.T)
    test = halve_steps(posterior, mode.parameters, around.std(axis=0), simulate)
    # without convergence neither shares nor the cost of a search are known
    return _BestFit(test, search.simulations, (posterior, mode)) if mode.converged else _BestFit(test)
