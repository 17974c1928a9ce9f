"""One judgement over the result of a run: sampling, fit, residuals, failures, priors, data, and what was not tested."""

from typing import Any, NamedTuple

import numpy as np

from ..signals.events import find_events
from ..simulation.model import SimulationBatch, simulate_batch
from .compared import Fits, fit_data_sets
from .finding import CARE, NOTE, TAIL, WRONG, Finding, Judgement, judge
from .fit import (
    check_other_events,
    check_parameters,
    check_residuals,
    check_responses,
    check_stated_errors,
    check_supports,
)
from .model import STEP, halve_steps, has_steps, motions_to_replace
from .run import Failures, FinishedRun, ParameterRow, failures, moments_of, read_run, rows_of
from .screening import check_data

__all__ = ["JudgedRun", "check_failures", "check_result", "judge_run"]

# effective, below which the interval between the 5 % and 95 % quantiles of n samples, which holds a further sample with
# the probability 0.9 (n - 1) / (n + 1), loses as much as a tail of it: 0.85; with 57 it is 0.87
FEW_SAMPLES = 36.0
LARGEST_TEST, TEST_SECONDS = 0.05, 10.0  # of step and mesh: share of the simulations of the run, below which it is made


class JudgedRun(NamedTuple):
    """A judgement of a run, and what it is made from."""

    rows: list[ParameterRow]
    fits: Fits
    failures: Failures
    judgement: Judgement


def check_result(sampler: Any, posterior: Any = None, *, discard: int = 0) -> Judgement:
    """Judge the result of a run: sampling, fit, residuals, failures, priors and data.

    The report and ``fe-likelihoods run`` give the same judgement.

    Parameters
    ----------
    sampler : SMCSampler, TMCMCSampler or emcee.EnsembleSampler
        A sampler that has run.
    posterior : Posterior, optional
        Default: what was sampled.
    discard : int
        Iterations to leave out at the beginning of a Markov chain.

    Returns
    -------
    Judgement
        The mean, and draws of the prior, are simulated where they are not cached.

    Raises
    ------
    ValueError
        If the sampler has no chain.

    Examples
    --------
    >>> judgement = check_result(sampler)
    >>> print(judgement)
    Use...
    >>> [finding.kind for finding in judgement.findings if finding.severity == "wrong"]
    []
    """
    return judge_run(read_run(sampler, posterior, discard=discard)).judgement


def judge_run(run: FinishedRun) -> JudgedRun:
    """Judge a run; simulates the points that `check_result` names, where they are not cached.

    A run that says nothing about the parameters gets no findings that compare its samples with prior, truth or noise.
    """
    rows, fits = rows_of(run.parameters, run.prior, moments_of(run), run.truth), fit_data_sets(run)
    of_model, tested = _check_steps(run)
    failed = failures(run)  # those of the fits included
    found = check_responses(fits.fits) + of_model  # first, because they explain a sampling that is not good
    found += _check_sampling(run) + _check_chain(run) + check_failures(failed)
    parts = [] if run.likelihood is None else [likelihood for likelihood, _ in run.likelihood.parts()]
    for each in parts:
        found += check_supports(each.model)
        found += check_data(each.measurements, motions_to_replace(each.model))
        if text := getattr(each.model, "range_remark", ""):  # also of simulations that verify stored rows
            action = "See whether samples of the posterior are concerned, or only draws far from it."
            kind = "Beyond the range of a law of the model"
            found.append(Finding(kind, CARE, f"{text[0].upper()}{text[1:]}.", action))
    if not run.is_inconclusive:
        found += check_parameters(rows)
        if all(each.severity != WRONG for each in found):  # a fault explains the residuals
            found += check_residuals(fits.fits) + check_stated_errors(fits.fits)
            events = [find_events(each.model) for each in parts]
            if len(parts) == 1 and has_steps(run.likelihood) and (events[0] is None or len(events[0].names) == 1):
                found += check_other_events([row for row in rows if row.name in parts[0].model.parameter_names])
    checked = sum(each.checks is not None for fit in fits.fits for each in fit.channels)
    responses = max((len(each.modal.points if each.modal else each.draws) for each in fits.fits), default=0)
    alone = "the length of the chain alone: a Markov chain gives no verdict"
    tests = {
        "Sampling": "by the sampler" if run.tempered else alone,
        "Failed simulations": f"not tested: {failed.unknown}" if failed.unknown else f"{failed.attempts} simulations",
        "Faults of the data": f"{responses} responses were compared" if responses else "not tested",
        "Residuals": f"channels: {checked}" if checked else "not tested: there are none",
    }
    unique = dict.fromkeys(found)  # data sets may share a description or a motion
    return JudgedRun(rows, fits, failed, judge(unique, (tests | tested).items()))


def _check_steps(run: FinishedRun) -> tuple[list[Finding], dict[str, str]]:
    """The error of step and mesh at the centre of the samples, and what was tested.

    This takes a simulation for each parameter and more; where they are many and take long, it is not tested.
    """
    if run.likelihood is None or run.prior is None or run.is_inconclusive or not has_steps(run.likelihood):
        return [], {}
    known = {likelihood.model.fingerprint: likelihood for likelihood, _ in run.likelihood.parts()}
    report = run.likelihood.report()
    needed = sum(2 + len(likelihood.model.parameter_names) for likelihood, _ in run.likelihood.parts())
    seconds = report["seconds"] / max(report["simulations"], 1)
    if run.n_modes > 1:
        return [], {STEP: "not tested: the samples have several modes, which have no common standard deviation"}
    if needed > LARGEST_TEST * report["simulations"] and needed * seconds > TEST_SECONDS:
        return [], {STEP: f"not tested: the test takes about {needed} simulations of {seconds:.2g} s"}

    def simulate(model: Any, points: np.ndarray) -> SimulationBatch:
        cached = known.get(model.fingerprint)
        return simulate_batch(model, points) if cached is None else cached.simulate(points)

    return halve_steps(run.posterior, run.centre, run.samples.std(axis=0), simulate)


def _check_sampling(run: FinishedRun) -> list[Finding]:
    """What the sampler has found, as it has said it."""
    if not run.tempered:
        return []
    if run.verdict is None:
        text = "The file of this run holds no verdict, so nothing is known about its convergence."
        return [Finding("No verdict", CARE, text, "Run it again with this version.")]
    return list(run.verdict.findings)


def _check_chain(run: FinishedRun) -> list[Finding]:
    """Whether the samples are many enough, for a Markov chain too, and have one mode."""
    found, n, size = list[Finding](), len(run.samples), run.effective_sample_size
    if run.is_inconclusive and not run.tempered:
        time = f"{run.autocorrelation_time:.0f} iterations" if np.isfinite(run.autocorrelation_time) else "not known"
        text = (
            f"The chain has {run.sampler.iteration - run.discard} iterations, its autocorrelation time is {time}: with "
            "fewer than 50 of these times it may still be on its way to the posterior."
        )
        action = "Continue it, or use SMCSampler for the same posterior."
        found.append(Finding("The chain is short", WRONG, text, action))
    if not size >= FEW_SAMPLES:
        text = f"How many independent samples the {n} samples are worth is not known."
        if np.isfinite(size):
            text = (
                f"The {n} samples are worth about {size:.0f} independent ones: interval ends are rough, and standard "
                f"deviations have an error of about {100.0 / np.sqrt(2.0 * max(size, 1.0)):.0f} %."
            )
        found.append(Finding("Few independent samples", CARE, text, "Make more iterations, or use more walkers."))
    if run.n_modes > 1 and not run.is_inconclusive:
        shares = ", ".join(f"{mode.share:.2f} ± {mode.share_error:.2g}" for mode in run.verdict.modes)
        text = f"The posterior has {run.n_modes} regions (shares {shares}); mean and standard deviation describe none."
        action = (
            "See the corner figure; the fit is the best sample. Other data or a narrower prior may tell them apart."
        )
        found.append(Finding("Several modes", CARE, text, action))
    return found


def check_failures(failed: Failures) -> list[Finding]:
    """How many simulations failed; the verdict of a sampler says whether they border on the samples."""
    if not failed.count:
        return []
    share = failed.count / max(failed.attempts, 1)
    text = (
        f"{failed.count} of {failed.attempts} simulations failed ({100.0 * share:.2g} %). A failed simulation counts "
        "as impossible: the posterior has no samples there."
    )
    action = "See the table of failures: mend the model where its parameters are plausible, else narrow the prior."
    return [Finding("Simulations failed", CARE if share > TAIL else NOTE, text, action, {"share": share})]
