"""What the command ``check`` rehearses: model and data before a run."""

from collections import Counter
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ..likelihood.posterior import Posterior
from ..simulation.model import SimulationBatch, simulate_batch
from .compared import SECONDS, Fit, compare, data_sets_of, draws_to_compare
from .finding import CARE, Finding, grouped, percent
from .fit import check_responses, check_supports
from .model import NO_STEP, STEP, check_chance, check_stronger_motion, halved, motions_to_replace, relative_difference
from .screening import check_data, check_gaps
from .tables import MOST_DRAWS

__all__ = ["ModelCheck", "check_model"]


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
    steps, made = dict[str, str](), 0
    with tqdm(disable=not progress, unit="simulation", desc="check") as bar:
        posterior.when_simulated(bar.update)

        def simulate(model: Any, points: np.ndarray, pool: Any = None) -> SimulationBatch:
            nonlocal made
            made += len(points)
            bar.update(len(points))
            return simulate_batch(model, points, pool)

        try:
            for key, likelihood, columns in data_sets_of(posterior):
                model = likelihood.model
                theta = mean[columns][: len(model.parameter_names)]
                batch = likelihood.simulate(theta[None])
                if batch.reasons[0]:
                    raise ValueError(
                        f"the simulation at the mean of the prior has failed: {batch.reasons[0]}; check model, priors"
                    )
                response = batch.response[0]
                for _ in range(2):  # a first simulation may start a process, which would leave time for few draws
                    start = perf_counter()
                    again = simulate(model, theta[None])
                    if not SECONDS / MOST_DRAWS < (took := perf_counter() - start) < SECONDS:
                        break
                pool = likelihood.simulator.pool
                at_once = 1 if pool is None else pool.n_workers or 1
                fits += compare(likelihood, draws_to_compare(posterior, took / at_once)[:, columns], key)[0]
                # generators of workers have moved on meanwhile
                chance = check_chance(response, again) or check_chance(
                    response, simulate(model, np.tile(theta, (2, 1)), pool)
                )
                # where responses differ by chance, other differences say nothing
                found += chance or check_stronger_motion(model, theta, response, simulate)
                end = f" ({key})" if key else ""
                if likelihood.measurements.is_history and not chance:
                    steps[f"{STEP}{end}"] = f"not tested: {NO_STEP}"
                    for name, what, change, why in halved(model, theta, response, simulate):
                        share = "" if why else percent(relative_difference(change, response))
                        text = f"half of {what} changes the response at the mean of the prior by {share}"
                        steps[f"{name}{end}"] = f"not tested: {why}" if why else text
                found += check_supports(model) + list(check_data(likelihood.measurements, motions_to_replace(model)))
                found += check_gaps(likelihood.noise)
                seconds += took
        finally:
            posterior.when_simulated(None)
    found += check_responses(fits)
    report = posterior.report()
    for reason, count in Counter(report["failure_reasons"]).most_common(1):
        text = f"{report['failure_count']} of the simulations of this check failed, {count} of them: {reason}."
        action = "A failed simulation counts as impossible: mend the model where its parameters are plausible."
        found.append(Finding("Simulations failed", CARE, text, action, {"count": report["failure_count"]}))
    return ModelCheck(sum(grouped(found).values(), ()), steps, made + _made(posterior) - before, seconds, tuple(fits))


def _made(posterior: Posterior) -> int:
    """Simulations that a posterior has made, also for verification and with first parts of its records."""
    parts = [part for part, _ in posterior.likelihood.parts()]
    return sum(each.simulations + each.verifications for part in parts for each in (part, *part.shortened))
