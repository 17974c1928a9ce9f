"""What a reader has to know before trusting a result: one judgement, and each doubt with what to do about it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..simulation.model import SimulationBatch, simulate_batch
from ..text_tables import listed
from .failed_simulations import Failures, failures
from .finding import CARE, NOTE, WRONG, Finding, Judgement, judge
from .fit import fit_gate
from .fit_results import SMALL_PROBABILITY, ChannelFit, Fit, Fits, fit_data_sets
from .run import LONGEST_AUTOCORRELATION, FinishedRun, read_run
from .steps import find_discretisation_error, find_unread_motion, simulations_of_the_test
from .table import ParameterRow, parameter_rows

__all__ = ["JudgedRun", "advise", "check_result", "judge_run", "residual_sentence"]

FEW_SAMPLES = 80.0  # effective, below which the ends of a 90 % interval rest on fewer than four samples each
LARGE_MEAN_ERROR = 0.2  # of the standard deviation
LARGE_FAILURE_SHARE = 0.05
LARGEST_TEST = 0.05  # of step and mesh, as a share of the simulations of the run
TEST_SECONDS = 10.0
STRONG_CORRELATION = 0.2  # lag-one correlation of residuals that changes the width of the posterior


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
        The mean, and draws of the prior, are simulated where they are not cached (`check_fit`).

    Raises
    ------
    ValueError
        If the sampler has no chain.

    Examples
    --------
    >>> judgement = check_result(sampler)
    >>> print(judgement)
    >>> for finding in judgement.findings:
    ...     print(finding)
    """
    return judge_run(read_run(sampler, posterior, discard=discard)).judgement


def judge_run(run: FinishedRun) -> JudgedRun:
    """Judge a run; simulates the points that `check_result` names, where they are not cached."""
    rows, fits = parameter_rows(run), fit_data_sets(run)
    of_model, made = check_model(run)
    failed = failures(run)  # those of the fits included
    fits = fits._replace(simulations=fits.simulations + made)
    return JudgedRun(rows, fits, failed, advise(run, rows, fits, failed, of_model))


def check_model(run: FinishedRun) -> tuple[list[Finding], int]:
    """Whether the model reads its motion, and the error of step and mesh, at the centre of the samples.

    Returns the findings, and the number of simulations that they took. The derivatives take one simulation for each
    parameter. Where these are more than a twentieth of the run's simulations and take longer than ten seconds, they are
    left out, and a remark says so.
    """
    if run.likelihood is None or run.prior is None:
        return [], 0
    known = {likelihood.model.fingerprint: likelihood for likelihood, _ in run.likelihood.parts()}
    before, others = run.likelihood.simulations, 0

    def simulate(model: Any, points: np.ndarray) -> SimulationBatch:
        nonlocal others
        if model.fingerprint in known:
            return known[model.fingerprint].simulate(points)
        others += len(points)
        return simulate_batch(model, points)

    found: list[Finding] = []
    for likelihood, columns in run.likelihood.parts():
        theta = run.centre[columns][: len(likelihood.model.parameter_names)]
        batch = likelihood.simulate(theta[None])
        if not batch.reasons[0]:
            unread = find_unread_motion(likelihood.model, theta, batch.response[0], simulate)
            found += [each for each in unread if each.severity == WRONG]  # failures are said where they are predicted
    if not found and not run.is_inconclusive:
        found = _of_discretisation(run, simulate)
    return found, run.likelihood.simulations - before + others


def _of_discretisation(run: FinishedRun, simulate: Any) -> list[Finding]:
    """The error of step and mesh, or why it was not tested."""
    if run.n_modes > 1:
        text = "The samples have several modes, which have no common standard deviation."
        return [Finding("Step and mesh were not tested", NOTE, text, "Halve them, and run again.")]
    needed, report = simulations_of_the_test(run.posterior), run.posterior.report()
    seconds = report["seconds"] / max(report["simulations"], 1)
    if needed > LARGEST_TEST * report["simulations"] and needed * seconds > TEST_SECONDS:
        text = f"The test takes {needed} simulations of {seconds:.2g} s."
        action = "Halve the step and the mesh at the posterior mean, and compare the responses with the noise."
        return [Finding("Step and mesh were not tested", NOTE, text, action)]
    return find_discretisation_error(run.posterior, run.centre, run.samples.std(axis=0), simulate)


def advise(
    run: FinishedRun, rows: list[ParameterRow], fits: Fits, failed: Failures, of_model: Sequence[Finding] = ()
) -> Judgement:
    """The judgement of a run, with all that a reader has to know; `of_model` is about its motion, step and mesh.

    A run that says nothing about the parameters gets no notes that compare its samples with prior, truth or noise.
    """
    found = [
        *_of_the_verdict(run),
        *_of_the_chain(run, rows),
        *_of_failures(failed, run.is_inconclusive and not run.tempered),
        *(
            Finding("A response is missing", CARE, f"{text}.", "Use another point or mend the model.")
            for text in fits.failures
        ),
        *fit_gate(fits.compared, () if run.is_inconclusive else rows),
        *of_model,
        *_of_the_model(run),
        *_of_the_data(fits),
    ]
    if not run.is_inconclusive and all(each.severity != WRONG for each in found):  # a fault explains the residuals
        found += _of_the_noise(fits)
    return judge(found)


def _of_the_verdict(run: FinishedRun) -> list[Finding]:
    if not run.tempered:
        return []
    if run.verdict is None:
        text = "The file of this run holds no verdict, so nothing is known about its convergence."
        return [Finding("No verdict", CARE, text, "Run it again with this version.")]
    if run.verdict.status == "converged":
        return []
    severe = run.verdict.status == "not usable"
    title = "The sampling is not usable" if severe else "The sampling has limits"
    more = run.verdict.more_simulations
    action = "Compare with a second run of another seed and more walkers before you use the numbers."
    if more is None:
        action = "How many more simulations are needed is not known. " + action
    elif more > 0.0:
        action = (
            f"At least about {more:.0f} more simulations are needed, possibly several times as many: raise "
            "max_simulations and run again."
        )
    if severe and run.likelihood is not None:
        action += " Steps that are too coarse make a response rough and sampling hard: `check` (rehearse) tests them."
    reasons = " ".join(f"{reason[0].upper()}{reason[1:]}." for reason in run.verdict.reasons)
    return [Finding(title, WRONG if severe else CARE, reasons, action)]


def _of_the_chain(run: FinishedRun, rows: list[ParameterRow]) -> list[Finding]:
    found, size = [], run.effective_sample_size
    if not run.tempered:
        found += _of_a_markov_chain(run)
    if not size >= FEW_SAMPLES:
        text = (
            f"The {len(run.samples)} samples are worth about {size:.0f} independent ones: interval ends are rough, and "
            f"standard deviations have an error of about {100.0 / np.sqrt(2.0 * max(size, 1.0)):.0f} %."
        )
        if not np.isfinite(size):
            text = f"How many independent samples the {len(run.samples)} samples are worth is not known."
        found.append(Finding("Few independent samples", CARE, text, "Make more iterations, or use more walkers."))
    rough = [row.label for row in rows if row.mean_error > LARGE_MEAN_ERROR * row.sd]
    if rough and size >= FEW_SAMPLES:
        text = f"The error of the mean exceeds a fifth of the standard deviation for {', '.join(rough)}."
        found.append(Finding("Rough means", CARE, text, "Make more iterations, or use more walkers."))
    if run.n_modes > 1 and not run.is_inconclusive:
        shares = ", ".join(f"{mode.share:.2f} ± {mode.share_error:.2g}" for mode in run.verdict.modes)
        text = (
            f"The posterior has {run.n_modes} separate regions, with shares {shares}. Mean and standard deviation "
            "describe none of them, and the fit below is shown for the best sample."
        )
        action = "Look at the corner figure. Data of another kind, or a narrower prior, may tell the regions apart."
        found.append(Finding("Several modes", CARE, text, action))
    return found


def _of_a_markov_chain(run: FinishedRun) -> list[Finding]:
    iterations, time, found = run.sampler.iteration - run.discard, run.autocorrelation_time, []
    if not iterations >= LONGEST_AUTOCORRELATION * time:
        known = f"its autocorrelation time is about {time:.0f} iterations"
        if not np.isfinite(time):
            known = "its autocorrelation time is not known"
        text = (
            f"The chain has {iterations} iterations, and {known}. A chain of fewer than {LONGEST_AUTOCORRELATION:.0f} "
            "autocorrelation times gives no reliable error, and may still be on its way to the posterior."
        )
        found.append(
            Finding("The chain is short", WRONG, text, "Continue it, or use SMCSampler for the same posterior.")
        )
    if run.discard == 0:
        text = "All iterations are used, the first ones included, which depend on where the walkers started."
        action = "Give report(..., discard=n) the number of iterations of the burn-in, if there was one."
        found.append(Finding("No burn-in was left out", CARE, text, action))
    return found


def _of_failures(failed: Failures, inconclusive: bool) -> list[Finding]:
    if not failed.count:
        return []
    found, share = [], failed.count / max(failed.attempts, 1)
    of_prior = f", among them {failed.prior_failed} of {failed.prior_draws} draws of the prior"
    text = (
        f"{failed.count} of {failed.attempts} simulations failed ({100.0 * share:.2g} %)"
        f"{of_prior if failed.prior_draws else ''}. A failed simulation counts as impossible: the posterior has no "
        "samples there."
    )
    action = (
        "See the table of failures. If the parameters there are plausible, mend the model and run again; if they are "
        "not, a narrower prior saves these simulations."
    )
    largest = max(share, failed.prior_failed / max(failed.prior_draws, 1))
    found.append(Finding("Simulations failed", CARE if largest > LARGE_FAILURE_SHARE else NOTE, text, action))
    if failed.near.borders and failed.near.known and not inconclusive:
        text = (
            f"In the region of the samples, {failed.near.failed} of {failed.near.evaluated} simulated points failed. "
            "The failures, not the data, end the posterior there: its mean and its interval may be wrong."
        )
        action = (
            "See in the table of failures where they happen. Mend the model or the settings of its solver there, and "
            "run again. Only if these parameters are impossible, a bound of the prior may stand there instead."
        )
        found.append(Finding("Failures border on the samples", WRONG, text, action))
    elif failed.near.place == "edge" and not inconclusive:
        text = (
            f"{failed.near.adjoining} failed points adjoin the samples at an edge. If the posterior goes on there, its "
            "interval is too narrow."
        )
        action = "See in the table of failures where they happen, and in the figures whether the samples end there."
        found.append(Finding("Failures at an edge of the samples", CARE, text, action))
    elif failed.near.place == "scattered" and not inconclusive:
        text = (
            f"In the region of the samples, {failed.near.failed} of {failed.near.evaluated} simulated points failed, "
            "scattered among successful ones. The posterior is right if they do not depend on the parameters."
        )
        found.append(Finding("Failures among the samples", CARE, text, "See their reasons, and mend the model."))
    return found


def _of_the_noise(fits: Fits) -> list[Finding]:
    found, doubtful = [], [(fit, each) for fit in fits.fits for each in fit.channels if each.checks is not None]
    white = [_place(fit, each) for fit, each in doubtful if _is_correlated(each) and fit.noise == "white"]
    if white:
        text = (
            f"Successive residuals are correlated in {listed(white)}. The likelihood takes the errors as independent "
            "from sample to sample, so the data count as more than they are, and the intervals are too narrow."
        )
        action = (
            'Use AutoregressiveNoise (in a TOML file: kind = "autoregressive" in [noise]), or GaussianNoise with bands '
            "of frequency (groups = [1.0, 5.0]) or effective_samples=, and look at the residuals for an effect that "
            "the model lacks."
        )
        found.append(Finding("The errors are not white noise", CARE, text, action))
    coloured = ("autoregressive", "bands")
    left = [_place(fit, each) for fit, each in doubtful if _is_correlated(each) and fit.noise in coloured]
    if left:
        text = (
            "What the noise model does not predict (the innovations, or the whitened residuals) is still correlated "
            f"in {listed(left)}: the errors have another correlation than the noise model states."
        )
        action = (
            "Compare with GaussianNoise with bands of frequency (in a TOML file: groups = [1.0, 5.0] in [noise]) or "
            "effective_samples=, and look for an effect that the model lacks."
        )
        found.append(Finding("The noise model does not fit the errors", CARE, text, action))
    strange = [_place(fit, each) for fit, each in doubtful if each.checks.normal[0] < SMALL_PROBABILITY]
    if strange:
        text = f"The residuals of {listed(strange)} have heavier tails, or are more skew, than a normal distribution."
        action = "Look for spikes, clipped samples, or parts of the record that the model does not reproduce."
        found.append(Finding("The errors are not normal", NOTE, text, action))
    return found


def _is_correlated(each: ChannelFit) -> bool:
    return each.checks.white[0] < SMALL_PROBABILITY and abs(each.checks.lag_one[0]) > STRONG_CORRELATION


def _of_the_model(run: FinishedRun) -> list[Finding]:
    found, likelihoods = [], [] if run.likelihood is None else [each for each, _ in run.likelihood.parts()]
    for likelihood in likelihoods:
        text = getattr(likelihood.model, "range_remark", "")
        if (
            not text
            and isinstance(likelihood.simulator.cache, SimulationCache)
            and hasattr(likelihood.model, "range_remark")
        ):
            text = likelihood.simulator.cache.look_up_remark(likelihood.model)
        if text:
            action = "See whether samples of the posterior are concerned, or only draws far from it."
            found.append(
                Finding("Beyond the range of a law of the model", CARE, f"{text[0].upper()}{text[1:]}.", action)
            )
    return found


def _of_the_data(fits: Fits) -> list[Finding]:
    if not any("synthetic" in fit.measurements.description.lower() for fit in fits.fits):
        return []
    text = "The measurements were computed with a model, not measured. The result shows how the method works."
    return [Finding("Synthetic data", NOTE, text, "Say so wherever you show the numbers.")]


def residual_sentence(fit: Fit, each: ChannelFit) -> str:
    """What the residuals of one channel look like, in a sentence."""
    where = _place(fit, each)
    if each.checks is None:
        return f"{where}: the residuals could not be checked (too few samples, or an exact fit)."
    if fit.noise == "white":
        return f"{where}: {each.checks.sentences[0]}"
    lag, n = float(each.checks.lag_one[0]), float(each.checks.n_effective[0])
    shape = "normal" if each.checks.normal[0] >= SMALL_PROBABILITY else "not normal: look at the tails"
    if fit.noise == "effective":
        text = (
            f"{each.samples} samples are worth about {n:.0f} independent ones, and the likelihood counts fewer samples"
        )
        return f"{where}: the correlation from sample to sample is {lag:.2f}; {text}. Their distribution is {shape}."
    colour = "still correlated" if _is_correlated(each) else "white or nearly so"
    return (
        f"{where}: what the noise model does not predict (the innovations, or the whitened residuals) is {colour} "
        f"(correlation {lag:.2f}); its distribution is {shape}."
    )


def _place(fit: Fit, each: ChannelFit) -> str:
    return f"{each.channel.name} ({fit.title})" if fit.title else each.channel.name
