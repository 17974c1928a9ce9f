"""What the command ``check`` rehearses: model and data before a run."""

from collections import Counter
from time import perf_counter
from typing import NamedTuple

import numpy as np

from ..likelihood.posterior import Posterior
from ..simulation.model import simulate_batch
from .compared import SECONDS, Fit, compare, data_sets_of, draws_to_compare
from .faults import MOST_DRAWS
from .finding import CARE, Finding, in_order
from .fit import check_responses, check_supports
from .model import check_chance, check_stronger_motion, motions_to_replace
from .screening import check_data

__all__ = ["ModelCheck", "check_model"]


class ModelCheck(NamedTuple):
    """What `check_model` has found, causes first."""

    findings: tuple[Finding, ...]
    seconds: float  # per simulation [s]
    fits: tuple[Fit, ...]  # measurements beside the draws of the prior that were simulated


def check_model(posterior: Posterior) -> ModelCheck:
    """Try the model and the data of a posterior before a run.

    It simulates the mean of the prior twice, under twice the motion, and up to 100 draws of the prior (fewer if a
    simulation takes longer than 0.1 s), in which it looks for wrong units, signs, clocks and channels of the data.
    `fe_likelihoods.check_data` looks at the data alone. Whether step and
    mesh are fine enough is judged after a run (`fe_likelihoods.check_result`), where the precision of the parameters
    is known.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    ModelCheck

    Raises
    ------
    ValueError
        If the simulation at the mean of the prior fails.

    Examples
    --------
    >>> wrong_sign = Measurements(measurements.channels, record.dt, -measurements.values)
    >>> checked = check_model(Posterior(FELikelihood(model, wrong_sign), prior))
    >>> [finding.kind for finding in checked.findings if finding.severity == "wrong"]
    ['A sign may be wrong']
    """
    mean, found, fits, seconds = posterior.prior.mean(), list[Finding](), list[Fit](), 0.0
    for key, likelihood, columns in data_sets_of(posterior):
        model, pool = likelihood.model, likelihood.simulator.pool
        theta = mean[columns][: len(model.parameter_names)]
        batch = likelihood.simulate(theta[None])
        if batch.reasons[0]:
            raise ValueError(
                f"the simulation at the mean of the prior has failed: {batch.reasons[0]}; check model, priors"
            )
        for _ in range(2):  # a first simulation may start a process, which would leave time for few draws
            start = perf_counter()
            again = simulate_batch(model, theta[None])
            if not SECONDS / MOST_DRAWS < (took := perf_counter() - start) < SECONDS:
                break
        seconds += took
        at_once = 1 if pool is None else pool.n_workers or 1
        fits += compare(likelihood, draws_to_compare(posterior, took / at_once)[:, columns], key)
        # generators of workers have moved on meanwhile
        response, later = batch.response[0], simulate_batch(model, np.tile(theta, (2, 1)), pool)
        chance = check_chance(response, again) or check_chance(response, later)
        # where responses differ by chance, other differences say nothing
        found += chance or check_stronger_motion(model, theta, response)
        found += check_supports(model) + list(check_data(likelihood.measurements, motions_to_replace(model)))
    found += check_responses(fits)
    report = posterior.report()
    for reason, count in Counter(report["failure_reasons"]).most_common(1):
        text = f"{report['failure_count']} of the simulations of this check failed, {count} of them: {reason}."
        action = "A failed simulation counts as impossible: mend the model where its parameters are plausible."
        found.append(Finding("Simulations failed", CARE, text, action, {"count": report["failure_count"]}))
    return ModelCheck(in_order(found), seconds, tuple(fits))
