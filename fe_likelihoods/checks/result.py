"""What is judged before a run (`check_model`) and after it (`check_result`): data, model, fit, sampling, failures.

`read_run` reads what checks and a report need of a finished run from the sampler and the posterior. A posterior of this
package knows the units of its parameters, its prior and its data. A plain function knows none of them; what is missing
is empty or NaN then, and the report leaves it out.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from samplers.emcee_names import EnsembleSampler
from samplers.judgement.clusters import Cluster
from samplers.judgement.verdict import Verdict

from ..likelihood.failure_log import reason_without_numbers
from ..likelihood.fits import SECONDS, Fit, compare, draws_to_compare
from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..likelihood.parameters import Parameter
from ..likelihood.posterior import Posterior
from ..noise.marginal import sampled_noise
from ..priors.between_events import BETWEEN_EVENTS
from ..priors.priors import Prior
from ..signals.records import find_events
from ..text_tables import listed
from .finding import CARE, NOTE, TAIL, WRONG, Finding, Findings, Judgement, in_order, judge, percent
from .model import (
    STEP,
    at_mean,
    check_chance,
    check_motion,
    check_residuals,
    check_responses,
    check_stated_errors,
    check_supports,
    halve_steps,
    motions_to_replace,
)
from .screening import check_data

LONGEST_AUTOCORRELATION = 50.0  # iterations per autocorrelation time that emcee recommends
# effective, below which the interval between the 5 % and 95 % quantiles of n samples, which holds a further sample with
# the probability 0.9 (n - 1) / (n + 1), loses as much as a tail of it: 0.85; with 57 it is 0.87
FEW_SAMPLES = 2.0 / TAIL - 5.0


class FinishedRun(NamedTuple):
    """A run, as a report reads it; a tempered sampler has a ladder, an evidence and a verdict."""

    sampler: EnsembleSampler
    posterior: Any  # None if the sampler's log-density is a plain function
    likelihood: FELikelihood | JointLikelihood | None  # None without data of this package
    prior: Prior | None
    parameters: tuple[Parameter, ...]
    samples: np.ndarray  # (n, ndim) of the posterior [unit of the parameter]
    mean_error: np.ndarray  # (ndim,) Monte Carlo standard error of the mean; NaN where it is not known
    sd_error: np.ndarray  # (ndim,) the same of the standard deviation
    effective_sample_size: float  # independent samples with the same error of the mean, the smallest
    autocorrelation_time: float  # the largest, of emcee's own sampler [iterations]; else NaN
    discard: int  # iterations left out at the beginning of the chain
    tempered: bool
    verdict: Verdict | None
    modes: tuple[Cluster, ...]  # in which the run has points; none where that is not known

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def is_inconclusive(self) -> bool:
        """Whether nothing can be said about the parameters: the verdict is "not usable", or the chain is too short."""
        if self.tempered:
            return self.verdict.status == "not usable"
        return not self.sampler.iteration - self.discard >= LONGEST_AUTOCORRELATION * self.autocorrelation_time

    @property
    def n_modes(self) -> int:
        """Number of modes in which the run has points; one where that is not known."""
        return max(len(self.modes), 1)

    @property
    def centre(self) -> np.ndarray:
        """The point that stands for the posterior (ndim,): its mean, or the best sample.

        The mean of several modes stands for none, and the mean of a bent ridge may be beside it: less probable than
        half of the samples.
        """
        mean, values = self.samples.mean(axis=0), self.sampler.get_log_prob(flat=True, discard=self.discard)
        stands = self.n_modes == 1 and self.posterior.log_prob(mean) >= np.median(values)
        return mean if stands else self.samples[int(np.argmax(values))]


def read_run(
    sampler: EnsembleSampler,
    posterior: Any = None,
    *,
    names: Sequence[str] | None = None,
    discard: int = 0,
) -> FinishedRun:
    """Read a finished run of this project or of emcee; `discard` as in `emcee.EnsembleSampler.get_chain`.

    By default the posterior is the sampler's log-density. Names are for a posterior without them. ValueError if
    the sampler has no chain, or names or the posterior do not match it.
    """
    if not isinstance(sampler, EnsembleSampler):
        raise ValueError(
            f"report needs a sampler that has run (SMCSampler, TMCMCSampler or emcee.EnsembleSampler); got {sampler!r}"
        )
    if not 0 <= discard < sampler.iteration:
        raise ValueError(
            f"report needs a chain: the sampler has made {sampler.iteration} iterations, and discard={discard} leaves "
            "none. Call run_mcmc with one step or more, and discard fewer iterations"
        )
    posterior = getattr(sampler.log_prob_fn, "f", None) if posterior is None else posterior
    samples = sampler.get_chain(flat=True, discard=discard)
    described = getattr(posterior, "parameters", None) if names is None else None
    known = names or getattr(posterior, "parameter_names", None) or [f"x{i}" for i in range(samples.shape[1])]
    parameters = tuple(Parameter(str(name)) for name in known) if described is None else tuple(described)
    if len(parameters) != samples.shape[1]:
        raise ValueError(
            f"the chain has {samples.shape[1]} parameters, but the posterior or names= has {len(parameters)} "
            f"({', '.join(each.name for each in parameters)}): give the posterior that was sampled"
        )
    tempered = hasattr(sampler, "ladder") and bool(sampler.ladder)
    likelihood, prior = getattr(posterior, "likelihood", None), getattr(posterior, "prior", None)
    return FinishedRun(
        sampler,
        posterior,
        likelihood if isinstance(likelihood, FELikelihood | JointLikelihood) else None,
        prior if isinstance(prior, Prior) else None,
        parameters,
        samples,
        *_errors(sampler, samples, tempered, discard),
        discard,
        tempered,
        sampler.verdict if tempered else None,
        sampler.modes if tempered else (),
    )


def _errors(
    sampler: EnsembleSampler, samples: np.ndarray, tempered: bool, discard: int
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Errors of means and deviations, effective sample size, and autocorrelation time, NaN for a chain too short."""
    spread = samples.std(axis=0)
    if tempered:
        error = sampler.mean_error(discard=discard)
        size = float(np.min((spread[error > 0.0] / error[error > 0.0]) ** 2, initial=len(samples)))
        return error, sampler.sd_error(discard=discard), size, np.nan
    with np.errstate(all="ignore"):
        time = float(np.max(sampler.get_autocorr_time(discard=discard, tol=0)))  # NaN if one is
    size = min((sampler.iteration - discard) * sampler.nwalkers / time, float(len(samples)))  # min keeps a first NaN
    of_variance = np.square(samples - samples.mean(axis=0)).std(axis=0)
    sd_error = 0.5 * of_variance / np.where(spread > 0.0, spread, 1.0) / np.sqrt(size)
    return spread / np.sqrt(size), sd_error, float(size), time if np.isfinite(time) else np.nan


class Failures(NamedTuple):
    """All failures, with the number of attempts."""

    # the most frequent first: reason with "#" for numbers, count, and parameters of one (after its reason, if with "#")
    rows: tuple[tuple[str, int, str], ...]
    count: int
    attempts: int
    unknown: str = ""  # what is not known about them


def failures(run: FinishedRun) -> Failures:
    """Failed simulations by reason, counted in likelihoods, also of first parts of the record, or in the sampler."""
    parts, records, count, attempts, unknown = [], list[dict](), 0, 0, ""
    for likelihood, columns in [] if run.likelihood is None else run.likelihood.data_sets():
        points, parts = run.samples[:, columns[: len(likelihood.model.parameter_names)]], [*parts, likelihood]
        if likelihood.simulator.failures.outcomes < len(np.unique(points, axis=0)):
            unknown = "Not known: simulations of this run were made in another process, or are no longer in memory."
    for log in (each.simulator.failures for part in parts for each in (part, *part.shortened)):
        records, count, attempts = records + log.records, count + log.count, attempts + log.outcomes
    if run.likelihood is None and run.tempered:
        unknown = "Not known: whether a log-density of -inf is a failed simulation."
        records, count, attempts = run.sampler.failures, run.sampler.failure_count, run.sampler.evaluations
    elif run.likelihood is None:
        unknown = "Not known: neither the sampler nor the log-density counts failures."
    rows, examples = Counter[str](), dict[str, str]()  # reasons that differ in their numbers only are one
    for text, point in ((each["reason"], each["parameters"]) for each in records):
        named = point.items() if isinstance(point, dict) else zip(run.names, point, strict=True)
        reason, shown = reason_without_numbers(text), ", ".join(f"{name} = {value:.4g}" for name, value in named)
        examples.setdefault(reason, shown if text == reason else f"{text}: {shown}")
        rows[reason] += 1
    rows += Counter({"later ones, whose reasons are not kept": count - len(records)})  # if there are any
    table = tuple((reason, each, examples.get(reason, "")) for reason, each in rows.most_common())
    return Failures(table, count, max(attempts, count), unknown)


class ModelCheck(NamedTuple):
    """What `check_model` has found, causes first; ``str`` gives the findings."""

    findings: Findings
    fits: tuple[Fit, ...]  # measurements beside the draws of the prior that were simulated

    def __str__(self) -> str:
        return str(self.findings)

    __repr__ = __str__


class JudgedRun(NamedTuple):
    """A judgement of a run, and what it is made from."""

    fits: tuple[Fit, ...]
    failures: Failures
    judgement: Judgement


def check_model(posterior: Posterior) -> ModelCheck:
    """Try the model and the data of a posterior before a run.

    It simulates the mean of the prior three times, under twice the motion, and up to 100 draws of the prior (as many as
    ten seconds allow, and five at least), in which it looks for wrong units, signs, clocks and channels of the data.
    `fe_likelihoods.check_data` looks at the data alone. For histories with white noise it halves step and mesh at the
    best draw (a simulation for each parameter and two more, if ten seconds allow it), and names what moves parameters
    by one posterior standard deviation; `fe_likelihoods.check_result` knows these and names half of one.

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
    >>> check_model(Posterior(FELikelihood(model, wrong_sign), prior))
    CAUTION: A channel drifts: ...
    CAUTION: A sign may be wrong: ...
    """
    first = list(at_mean(posterior))
    if failed := next((reason for _, _, reason, _ in first if reason), ""):
        raise ValueError(f"the simulation at the mean of the prior has failed: {failed}; check model, priors")
    fits = compare(posterior)
    found = _check_inputs(posterior.likelihood, fits)
    for part, theta, _, response in first:
        # generators of workers have moved on meanwhile; where responses differ by chance, other differences say nothing
        found += check_chance(part, theta, response) or check_motion(part.model, theta, response)
    noises = [sampled_noise(part.noise) for part, *_ in first if part.measurements.is_history]
    white = len(noises) == len(first) and all(getattr(each, "effective_samples", 0) is None for each in noises)
    if white and isinstance(posterior.prior, Prior) and all(each.severity != WRONG for each in found):
        draws = draws_to_compare(posterior)[: min(len(each.draws) for each in fits)]
        found += _check_steps(posterior, draws[np.argmax(posterior(draws))])[0] if len(draws) else []
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
    found, tested = list[Finding](), ""
    if parts and histories and run.prior is not None and not run.is_inconclusive:
        tested = "not tested: the samples have several modes, which have no common standard deviation"
        if run.n_modes == 1:
            found, tested = _check_steps(run.posterior, run.centre, run.samples.std(axis=0))
    failed = failures(run)  # those of the fits included
    found += _check_inputs(run.likelihood, fits) + _check_samples(run)
    found += check_failures(failed.count, failed.attempts, failed.rows[0][0] if failed.rows else "")
    if not run.is_inconclusive and all(each.severity != WRONG for each in found):  # a fault explains the residuals
        found += check_residuals(fits) + check_stated_errors(fits)
        events = [find_events(part.model) for part, _ in parts]
        if len(parts) == 1 and histories and (events[0] is None or len(events[0].names) == 1):
            found += _check_other_events(run, len(parts[0][0].model.parameter_names))
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


def _check_steps(posterior: Posterior, *point: np.ndarray) -> tuple[list[Finding], str]:
    """`halve_steps`, and what was tested.

    This takes a simulation for each parameter and more; more than a twentieth of all that take long are not made.
    """
    report = posterior.likelihood.report()
    needed = sum(2 + len(likelihood.model.parameter_names) for likelihood, _ in posterior.likelihood.data_sets())
    seconds = report["seconds"] / max(report["simulations"], 1)
    if needed > TAIL * report["simulations"] and needed * seconds > SECONDS:
        return [], f"not tested: the test takes about {needed} simulations of {seconds:.2g} s"
    return halve_steps(posterior, *point)


def _check_other_events(run: FinishedRun, n: int) -> list[Finding]:
    """By which factors the standard deviations of the first n parameters, from one event, are too small for another."""
    factors, differing = dict[str, float](), list[str]()
    for parameter, values in zip(run.parameters[:n], run.samples.T, strict=False):
        spread = next((sd for kind, sd in BETWEEN_EVENTS.items() if parameter.name.startswith(kind)), 0.0)
        if spread and values.std() > 0.0:
            # both events differ from the structure's median, each by the spread
            factors[parameter.label] = float(np.hypot(1.0, np.sqrt(2.0) * spread * abs(values.mean()) / values.std()))
            differing.append(f"{parameter.label} by about {percent(spread)} (factor {factors[parameter.label]:.3g})")
    text = f"For another event the standard deviations are too small: parameters differ, {listed(differing)}."
    action = "Predict another event with this spread (in Python, predict_new_event), or calibrate several events."
    return [Finding("Another event differs", NOTE, text, action, factors)] if factors else []


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
        worth = f"{size:.0f}" if np.isfinite(size) else "unknown"
        text = f"The effective sample size of the {n} samples is {worth}: interval ends are rough."
        found.append(Finding("Few independent samples", CARE, text, "Make more iterations, or use more walkers."))
    if run.n_modes > 1 and not run.is_inconclusive:
        shares = ", ".join(f"{mode.share:.2f} ± {mode.share_error:.2g}" for mode in run.modes)
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
