"""What is judged before a run (`check_model`) and after it (`check_result`): data, model, fit, sampling, failures."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ..likelihood.fits import SECONDS, Fit, compare
from ..likelihood.posterior import Posterior
from .finding import CARE, NOTE, TAIL, WRONG, Finding, Judgement, in_order, judge
from .fit import check_residuals, check_responses, check_stated_errors, check_supports
from .model import STEP, at_mean, check_chance, check_motion, halve_steps, motions_to_replace
from .run import Failures, FinishedRun, failures, read_run
from .screening import check_data

# effective, below which the interval between the 5 % and 95 % quantiles of n samples, which holds a further sample with
# the probability 0.9 (n - 1) / (n + 1), loses as much as a tail of it: 0.85; with 57 it is 0.87
FEW_SAMPLES = 36.0


class ModelCheck(NamedTuple):
    """What `check_model` has found, causes first."""

    findings: tuple[Finding, ...]
    fits: tuple[Fit, ...]  # measurements beside the draws of the prior that were simulated


class JudgedRun(NamedTuple):
    """A judgement of a run, and what it is made from."""

    fits: tuple[Fit, ...]
    failures: Failures
    judgement: Judgement


def check_model(posterior: Posterior) -> ModelCheck:
    """Try the model and the data of a posterior before a run.

    It simulates the mean of the prior three times, under twice the motion, and up to 100 draws of the prior (as many as
    ten seconds allow, and five at least), in which it looks for wrong units, signs, clocks and channels of the data.
    `fe_likelihoods.check_data` looks at the data alone. Whether step and mesh are fine enough is judged after a run
    (`fe_likelihoods.check_result`), where the precision of the parameters is known.

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
    first = list(at_mean(posterior))
    if failed := next((reason for _, _, reason, _ in first if reason), ""):
        raise ValueError(f"the simulation at the mean of the prior has failed: {failed}; check model, priors")
    fits = compare(posterior)
    found = _check_inputs(posterior.likelihood, fits)
    for part, theta, _, response in first:
        # generators of workers have moved on meanwhile; where responses differ by chance, other differences say nothing
        found += check_chance(part, theta, response) or check_motion(part.model, theta, response)
    report, attempts = posterior.report(), sum(part.simulator.failures.outcomes for part, *_ in first)
    reasons = report["failure_reasons"]
    found += check_failures(report["failure_count"], attempts, max(reasons, key=reasons.get, default=""))
    return ModelCheck(in_order(found), tuple(fits))


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
    parts = [] if run.likelihood is None else run.likelihood.data_sets()
    fits = tuple(compare(run.posterior, run.samples, run.centre)) if parts else ()
    histories = not parts or any(part.measurements.is_history for part, _ in parts)
    found, tested = _check_steps(run) if parts and histories else ([], "")
    failed = failures(run)  # those of the fits included
    found += _check_inputs(run.likelihood, fits) + _check_samples(run)
    found += check_failures(failed.count, failed.attempts, failed.rows[0][0] if failed.rows else "")
    if not run.is_inconclusive and all(each.severity != WRONG for each in found):  # a fault explains the residuals
        found += check_residuals(fits) + check_stated_errors(fits)
    checked = sum(each.checks is not None for fit in fits for each in fit.channels)
    responses = max((len(each.draws) for each in fits), default=0)
    alone = "the length of the chain alone: a Markov chain gives no verdict"
    tests = {
        "Sampling": "by the sampler" if run.tempered else alone,
        "Failed simulations": f"not tested: {failed.unknown}" if failed.unknown else f"{failed.attempts} simulations",
        "Faults of the data": f"{responses} responses were compared" if responses else "not tested",
        "Residuals": f"channels: {checked}" if checked else "not tested: there are none",
    }
    tests |= {STEP: tested} if tested else {}
    return JudgedRun(fits, failed, judge(dict.fromkeys(found), tests.items()))  # data sets may share a motion


def _check_inputs(likelihood: Any, fits: Iterable[Fit]) -> list[Finding]:
    """Findings about the data of a likelihood, or of none, by themselves and beside responses."""
    found = check_responses(fits)
    for part, _ in [] if likelihood is None else likelihood.data_sets():
        found += check_supports(part.model)
        found += check_data(part.measurements, motions_to_replace(part.model))
        if text := getattr(part.model, "range_remark", ""):  # also of simulations that verify stored rows
            action = "See whether samples of the posterior are concerned, or only draws far from it."
            kind = "Beyond the range of a law of the model"
            found.append(Finding(kind, CARE, f"{text[0].upper()}{text[1:]}.", action))
    return found


def _check_steps(run: FinishedRun) -> tuple[list[Finding], str]:
    """The error of step and mesh at the centre of the samples, and what was tested.

    This takes a simulation for each parameter and more; more than a twentieth of the run's that take long are not made.
    """
    if run.prior is None or run.is_inconclusive:
        return [], ""
    report = run.likelihood.report()
    needed = sum(2 + len(likelihood.model.parameter_names) for likelihood, _ in run.likelihood.data_sets())
    seconds = report["seconds"] / max(report["simulations"], 1)
    if run.n_modes > 1:
        return [], "not tested: the samples have several modes, which have no common standard deviation"
    if needed > TAIL * report["simulations"] and needed * seconds > SECONDS:
        return [], f"not tested: the test takes about {needed} simulations of {seconds:.2g} s"
    return halve_steps(run.posterior, run.centre, run.samples.std(axis=0))


def _check_samples(run: FinishedRun) -> list[Finding]:
    """What the sampler has found, and whether samples, of a Markov chain too, are many enough and have one mode."""
    found, n, size = list(run.verdict.findings if run.verdict else ()), len(run.samples), run.effective_sample_size
    if run.is_inconclusive and not run.tempered:
        time = f"{run.autocorrelation_time:.0f} iterations" if np.isfinite(run.autocorrelation_time) else "not known"
        text = f"The chain has {run.sampler.iteration - run.discard} iterations, its autocorrelation time is {time}: "
        text += "with fewer than 50 of these times it may still be on its way to the posterior."
        action = "Continue it, or use SMCSampler for the same posterior."
        found.append(Finding("The chain is short", WRONG, text, action))
    if not size >= FEW_SAMPLES:
        worth = f"about {size:.0f}" if np.isfinite(size) else "an unknown number of"
        text = f"The {n} samples are worth {worth} independent ones: interval ends are rough."
        found.append(Finding("Few independent samples", CARE, text, "Make more iterations, or use more walkers."))
    if run.n_modes > 1 and not run.is_inconclusive:
        shares = ", ".join(f"{mode.share:.2f} ± {mode.share_error:.2g}" for mode in run.verdict.modes)
        text = f"The posterior has {run.n_modes} regions (shares {shares}); mean and standard deviation describe none."
        action = "The fit is the best sample. Other data or a narrower prior may tell them apart."
        found.append(Finding("Several modes", CARE, text, action))
    return found


def check_failures(count: int, attempts: int, reason: str) -> list[Finding]:
    """How many simulations failed, most often for a `reason`; a verdict says whether they border on the samples."""
    share = count / max(attempts, 1)
    text = f"{count} of {attempts} simulations failed ({100.0 * share:.2g} %){reason and f', most often: {reason}'}."
    text += " A failed simulation counts as impossible: the posterior has no samples there."
    action = "Mend the model where its parameters are plausible, else narrow the prior."
    return [Finding("Simulations failed", CARE if share > TAIL else NOTE, text, action, {"share": share})] * bool(count)
