"""What the command ``check`` rehearses: is a model what a sampler takes it for, and are its numerical errors small?

A model that returns something else the second time, or the same under every motion, ends in numbers that look like a
result. `check_model` simulates a few times what a run would simulate thousands of times.
"""

from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ..likelihood.posterior import Posterior
from ..simulation.model import SimulationBatch, simulate_batch
from .compared import Fit, compare, data_sets_of, draws_to_compare
from .finding import CARE, WRONG, Finding, grouped, percent
from .fit import check_responses, check_supports
from .screening import check_data, check_gaps
from .steps import (
    NO_STEP,
    NOTHING,
    check_stronger_motion,
    halved,
    motions_to_replace,
    relative_difference,
)

__all__ = ["ModelCheck", "check_model", "refuse_chance"]


class ModelCheck(NamedTuple):
    """What `check_model` has found, causes first."""

    findings: tuple[Finding, ...]
    steps: dict[str, str]  # what half of step and mesh changes at the mean of the prior, in words, by name
    simulations: int  # number of simulations made
    seconds: float  # per simulation [s]
    fits: tuple[Fit, ...]  # measurements beside the draws of the prior that were simulated


def check_model(posterior: Posterior, *, progress: bool = False) -> ModelCheck:
    """Try the model and the data of a posterior before a run.

    It simulates the mean of the prior twice, under twice the motion, with half of step and mesh, and draws of the
    prior, which are compared with the measurements as in `fe_likelihoods.check_fit`.
    `fe_likelihoods.check_data` looks at the data. Whether the steps are fine enough is judged after a run
    (`fe_likelihoods.check_result`), where the precision of the parameters is known.

    Parameters
    ----------
    posterior : Posterior
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
    mean, found, fits, seconds, before = posterior.prior.mean(), list[Finding](), list[Fit](), 0.0, _made(posterior)
    steps = dict[str, str]()
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
                found += chance or check_stronger_motion(model, theta, batch.response[0], simulate)
                if not chance and likelihood.measurements.is_history:
                    steps |= _halve_steps(simulate, model, theta, batch.response[0], key)
                found += check_supports(model) + list(check_data(likelihood.measurements, motions_to_replace(model)))
                found += check_gaps(likelihood.noise)
                seconds += took
        finally:
            posterior.when_simulated(None)
    found += [*check_responses(fits), *_check_failures(posterior)]
    return ModelCheck(sum(grouped(found).values(), ()), steps, made + _made(posterior) - before, seconds, tuple(fits))


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
    return [Finding("The model is not repeatable", WRONG, text, action, about="input")] if text else []


def _check_failures(posterior: Posterior) -> list[Finding]:
    """The most frequent reason of failed simulations, most of which are draws of the prior."""
    report = posterior.report()
    if not report["failure_count"]:
        return []
    often, count = max(report["failure_reasons"].items(), key=lambda each: each[1])
    text = f"{report['failure_count']} of the simulations of this check failed, {count} of them: {often}."
    action = "A failed simulation counts as impossible: mend the model where its parameters are plausible."
    return [Finding("Simulations failed", CARE, text, action, {"count": report["failure_count"]})]


def _halve_steps(simulate: Any, model: Any, theta: np.ndarray, response: np.ndarray, key: str) -> dict[str, str]:
    """What half of each step changes, in words, by name and data set."""
    found = {name: f"not tested: {why}" for name, why in NO_STEP.items()}
    for name, what, change, why in halved(model, theta, response, simulate):
        found[name] = f"not tested: {why}"
        if not why:
            share = percent(relative_difference(change, response))
            found[name] = f"half of {what} changes the response at the mean of the prior by {share}"
    return {f"{name} ({key})" if key else name: text for name, text in found.items()}
