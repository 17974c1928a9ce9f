"""What checks and a report need of a finished run, read from the sampler and the posterior in one place.

A posterior of this package knows the units of its parameters, its prior and its data. A plain function knows none of
them; what is missing is empty or NaN here, and the report leaves it out.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from samplers.emcee_names import EnsembleSampler
from samplers.judgement.verdict import Verdict

from ..likelihood.failure_log import reason_without_numbers
from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..likelihood.parameters import Parameter
from ..priors.priors import Prior

LONGEST_AUTOCORRELATION = 50.0  # iterations per autocorrelation time that emcee recommends


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
        return 1 if self.verdict is None else len(self.verdict.modes)

    @property
    def centre(self) -> np.ndarray:
        """The point that stands for the posterior (ndim,): its mean, or the best sample of several modes."""
        if self.n_modes == 1:
            return self.samples.mean(axis=0)
        return self.samples[int(np.argmax(self.sampler.get_log_prob(flat=True, discard=self.discard)))]


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
