"""Results of finished runs as tables: moments, tempering stages, and a comparison of samplers."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from ..reports import Stage

__all__ = [
    "SamplerComparison",
    "Summary",
    "aligned",
    "comparison_table",
    "describe_sampler",
    "described_parameters_of",
    "finished_ladder",
    "is_tempered",
    "ladder_table",
    "log_posterior_of",
    "names_of_parameters",
    "summary",
    "verdict_summary_of",
]


class _NamedParameter(NamedTuple):
    """A parameter with a name only, with the members of ``posterior.parameters``."""

    name: str
    label: str
    factor: float = 1.0
    nominal: float = np.nan


def described_parameters_of(posterior: Any, ndim: int) -> Sequence[Any]:
    """Name, label, unit (``factor``) and nominal value for each of `ndim` parameters; ValueError for another number."""
    described = getattr(posterior, "parameters", None)
    if described is None:
        names = getattr(posterior, "parameter_names", None) or [f"x{i}" for i in range(ndim)]
        described = [_NamedParameter(str(name), str(name)) for name in names]
    if len(described) != ndim:
        raise ValueError(
            f"the posterior has {len(described)} parameters ({', '.join(each.name for each in described)}), but the "
            f"samples have {ndim} columns"
        )
    return described


def is_tempered(sampler: Any) -> bool:
    """Whether a sampler is a `samplers.tempered.TemperedSampler`, with a ladder and an evidence."""
    return hasattr(sampler, "ladder")


def log_posterior_of(sampler: Any) -> Any:
    """The user's function in a sampler (emcee wraps it); None for an object that is no sampler."""
    return getattr(getattr(sampler, "log_prob_fn", None), "f", None)


def verdict_summary_of(sampler: Any) -> str:
    """``sampler.verdict.summary``; empty for a pair of numbers, emcee's own sampler, or a sampler without a chain."""
    if not (is_tempered(sampler) and sampler.ladder and sampler.iteration):
        return ""
    return sampler.verdict.summary


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, from its cells: the first column is aligned to the left, others to the right."""
    columns = []
    for column in zip(*rows, strict=True):
        width, side = max(map(len, column)), ">" if columns else "<"
        columns.append([f"{cell:{side}{width}}" for cell in column])
    return ["  ".join(row) for row in zip(*columns, strict=True)]


class Summary(NamedTuple):
    """Moments of the posterior, one entry per parameter. ``str`` gives a table.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    mean, sd : ndarray, shape (ndim,)
        Mean and standard deviation.
    cv : ndarray, shape (ndim,)
        Coefficient of variation ``sd / |mean|`` [-]; inf where the mean is zero and the standard deviation is not.
    mean_error, sd_error : ndarray, shape (ndim,)
        Monte Carlo standard errors of `mean` and `sd`; NaN if they are not known.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    cv: np.ndarray
    mean_error: np.ndarray
    sd_error: np.ndarray

    def __str__(self) -> str:
        rows = [("parameter", "mean", "MC error", "sd", "MC error", "CV")]
        columns = self.names, self.mean, self.mean_error, self.sd, self.sd_error, self.cv
        for name, *values in zip(*columns, strict=True):
            cells = (f"{x:{form}}" for x, form in zip(values, (".5g", ".2g", ".4g", ".2g", ".3g"), strict=True))
            rows.append((name, *("-" if cell == "nan" else cell for cell in cells)))
        return "\n".join(aligned(rows))

    __repr__ = __str__


def names_of_parameters(names: Sequence[str] | None, ndim: int) -> tuple[str, ...]:
    """The given names, or theta_0, theta_1, ...; ValueError if there is not one per parameter."""
    names = tuple(names or (f"theta_{i}" for i in range(ndim)))
    if len(names) != ndim:
        raise ValueError(f"expected one name per parameter: {ndim} parameters, but {len(names)} names {names}")
    return names


def summary(
    samples: np.ndarray,
    names: Sequence[str] | None = None,
    weights: np.ndarray | None = None,
    mean_error: np.ndarray | None = None,
    sd_error: np.ndarray | None = None,
) -> Summary:
    """Posterior mean, standard deviation, their Monte Carlo errors, and coefficient of variation.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior.
    names : sequence of str, optional
        One name per parameter; theta_0, theta_1, ... by default.
    weights : array_like, shape (n,), optional
        Non-negative weights of the samples, normalised or not.
    mean_error, sd_error : array_like, shape (ndim,), optional
        Standard errors of mean and standard deviation, from ``sampler.mean_error()`` and ``sampler.sd_error()``, since
        copies made by resampling are correlated; NaN where they are unknown.

    Returns
    -------
    Summary

    Examples
    --------
    >>> print(summary(samples, posterior.parameter_names))  # doctest: +SAMPLED
    parameter              mean  MC error         sd  MC error       CV
    stiffness            1.1022         -   0.002393         -  0.00217
    damping             0.86008         -    0.02466         -   0.0287
    sigma_acceleration  0.46343         -     0.0243         -   0.0524
    sigma_displacement  0.01823         -  0.0009417         -   0.0517
    """
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) with n >= 2, as get_chain(flat=True) returns; got {samples.shape}"
        )
    errors = []
    for name, given in (("mean_error", mean_error), ("sd_error", sd_error)):
        error = np.full(samples.shape[1], np.nan) if given is None else np.asarray(given, dtype=float)
        if error.shape != samples.shape[1:] or np.any(error < 0.0):
            raise ValueError(f"{name} must be {samples.shape[1]} numbers, each non-negative or NaN; got {given}")
        errors.append(error)
    weights = np.ones(len(samples)) if weights is None else np.asarray(weights, dtype=float)
    if weights.shape != (len(samples),) or not np.all(weights >= 0.0) or not 0.0 < weights.sum() < np.inf:
        raise ValueError(
            f"weights must be {len(samples)} non-negative numbers with a positive sum; got shape {weights.shape}"
        )
    weights = weights / weights.sum()
    mean = weights @ samples
    sd = np.sqrt(weights @ (samples - mean) ** 2)
    cv = np.divide(sd, np.abs(mean), out=np.where(sd > 0.0, np.inf, 0.0), where=mean != 0.0)
    return Summary(names_of_parameters(names, samples.shape[1]), mean, sd, cv, *errors)


def finished_ladder(sampler: Any) -> tuple[Stage, ...]:
    """Return the stages of a tempered sampler, or raise ValueError if there are none."""
    if not is_tempered(sampler):
        raise ValueError(f"expected a tempered sampler (SMCSampler or TMCMCSampler); got {type(sampler).__name__}")
    if not sampler.ladder:
        raise ValueError("the sampler has no tempering stages yet: call run_mcmc first")
    return sampler.ladder


# columns of `ladder_table`: heading, field of a stage, format
_STAGE = (
    ("ESS", "effective_sample_size", ".0f"),
    ("acceptance", "acceptance", ".3f"),
    ("sweeps", "moves", ""),
    ("distinct", "distinct_ancestors", ""),
    ("d log Z", "log_evidence_increment", ".3f"),
    ("evaluations", "evaluations", ""),
    ("time [s]", "seconds", ".3g"),
)


def ladder_table(sampler: Any) -> str:
    """Table of the tempering stages (`samplers.Stage`), estimates of the evidence, and summary of the verdict.

    ValueError if the sampler has no stages.

    Examples
    --------
    >>> print(ladder_table(sampler))  # doctest: +ELLIPSIS
    stage       beta   ESS  acceptance  sweeps  distinct  d log Z  evaluations  time [s]
    ...
    log evidence 376...
    Converged: one mode; ...
    """
    stages = finished_ladder(sampler)
    table = [("stage", "beta ", *(heading for heading, _, _ in _STAGE))]
    for number, stage in enumerate(stages, start=1):
        ended = sampler.ended_at is not None and number == len(stages)
        beta = f"{sampler.ended_at:.3e}*" if ended else f"{stage.beta:.3e} "
        table.append((str(number), beta, *(format(getattr(stage, name), form) for _, name, form in _STAGE)))
    rows = aligned(table)
    if sampler.ended_at is not None:
        rows.append("* the limit of simulations ended the run here: all points known then, weighted for beta = 1")
    evaluations, seconds = sum(s.evaluations for s in stages), sum(s.seconds for s in stages)
    rows.append(
        f"log evidence {sampler.log_evidence:.3f} +- {sampler.log_evidence_error:.3f}; "
        f"{evaluations} evaluations in {seconds:.3g} s"
    )
    check = sampler.log_evidence_check
    if check is not None:
        rows.append(
            f"log evidence of the ladder {sampler.log_evidence_ladder:.3f} +- {stages[-1].log_evidence_error:.3f}; "
            f"of {check.evaluations} independent draws {check.log_evidence:.3f} +- {check.error:.3f} "
            f"(effective sample size {check.effective_sample_size:.0f}, Pareto shape {check.pareto_shape:.2f})"
        )
    if (sample := sampler.signed_sample) is not None:
        error = np.nanmax(sample.expectation().error / sample.standard_deviation().value, initial=0.0)
        rows.append(
            f"largest error of a mean by sampler.signed_sample: {error:.2g} posterior standard deviations, from "
            f"{np.count_nonzero(sample.rounds)} weighted draws and {sampler.simulations:.0f} simulations"
        )
    if text := verdict_summary_of(sampler):
        rows.append(text)
    return "\n".join(rows)


class SamplerComparison(NamedTuple):
    """Cost and results of several samplers, one entry per sampler. ``str`` gives a table.

    `evaluations` is the number of points for which ``log_prob_fn`` was called, and `effective_sample_size` the number
    of independent draws with the same error of the mean, for the worst parameter. `seconds` (wall time) is None if it
    was not measured; `log_evidence` and its standard error are None for samplers without an evidence.
    """

    names: tuple[str, ...]
    evaluations: tuple[int, ...]
    seconds: tuple[float | None, ...]
    effective_sample_size: tuple[float, ...]
    log_evidence: tuple[float | None, ...]
    log_evidence_error: tuple[float | None, ...]

    def __str__(self) -> str:
        rows = [("sampler", "evaluations", "seconds", "ESS", "ESS/evaluation", "log evidence")]
        for name, n, seconds, ess, value, error in zip(*self, strict=True):
            time = "-" if seconds is None else f"{seconds:.3g}"
            evidence = "-" if value is None else f"{value:.3f} +- {error:.3f}"
            rows.append((name, str(n), time, f"{ess:.0f}", f"{ess / n:.2e}", evidence))
        return "\n".join(aligned(rows))

    __repr__ = __str__


def comparison_table(
    samplers: Mapping[str, Any], seconds: Mapping[str, float] | None = None, discard: int = 0
) -> SamplerComparison:
    """Compare the cost and the effective sample size of several samplers on one posterior.

    The effective sample size is computed for the worst parameter. For tempered samplers it is (standard deviation /
    Monte Carlo error)^2; for emcee's sampler it is the chain length divided by the autocorrelation time, which is
    underestimated for short chains. Modes that were never visited have no effect on it.

    Parameters
    ----------
    samplers : mapping of str to sampler
        Samplers that have run in this process, by name. The evaluations of `emcee.EnsembleSampler` are iterations times
        walkers, which holds without thinning and for moves with one proposal per walker.
    seconds : mapping of str to float, optional
        Wall times [s] of samplers that do not measure them, by name.
    discard : int
        Burn-in of emcee's sampler: number of initial iterations that are left out.

    Examples
    --------
    >>> print(comparison_table({"SMC": sampler}))  # doctest: +ELLIPSIS
    sampler  evaluations  seconds  ESS  ESS/evaluation      log evidence
    SMC ...
    """
    given = {} if seconds is None else dict(seconds)
    if not samplers:
        raise ValueError("no samplers to compare: pass a mapping of names to samplers")
    if unknown := set(given) - set(samplers):
        raise ValueError(f"seconds are given for {sorted(unknown)}, but the samplers are {list(samplers)}")
    rows = []
    for name, sampler in samplers.items():
        tempered = is_tempered(sampler)
        evaluations = sampler.evaluations if tempered else sampler.iteration * sampler.nwalkers
        if evaluations == 0 or sampler.iteration == 0:
            raise ValueError(
                f"sampler {name!r} has made no chain in this process: run it first (the cost of a chain that was read "
                "from a file is not known)"
            )
        if tempered:
            spread, error = sampler.get_chain(flat=True).std(axis=0), sampler.mean_error()
            ess = float(np.min((spread / error)[error > 0.0] ** 2, initial=np.inf))
        else:
            chain = sampler.get_chain(discard=discard)
            time = sampler.get_autocorr_time(discard=discard, tol=0)
            ess = chain.shape[0] * chain.shape[1] / float(np.max(time))
        ess = ess if np.isfinite(ess) else 0.0
        evidence = (sampler.log_evidence, sampler.log_evidence_error) if tempered else (None, None)
        rows.append((name, evaluations, given.get(name, sampler.seconds if tempered else None), ess, *evidence))
    return SamplerComparison(*zip(*rows, strict=True))


def describe_sampler(sampler: Any) -> str:
    """HTML of a tempered sampler before or after runs: size, cost, evidence, verdict and moments of its chain."""
    lines, moments = [], ""
    if not sampler.ladder:
        lines.append("Not run yet: run_mcmc(None, 4) anneals draws of the prior and makes 4 sweeps of the posterior.")
    else:
        stages = f"{len(sampler.ladder)} stages to beta = {sampler.ladder[-1].beta:.3g}"
        failed = f", {sampler.failure_count} failed" if sampler.failure_count else ""
        lines.append(f"{stages}, {sampler.iteration} sweeps stored, {sampler.evaluations} evaluations{failed}")
        if sampler.ladder[-1].beta == 1.0:
            lines.append(f"Log-evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2g}")
            lines.append(str(sampler.verdict))
        if sampler.iteration > 0:
            described = described_parameters_of(log_posterior_of(sampler), sampler.ndim)
            labels, factors = [each.label for each in described], np.array([each.factor for each in described])
            errors = sampler.mean_error() / factors, sampler.sd_error() / factors
            moments = summary(sampler.get_chain(flat=True) / factors, labels, None, *errors)
    title = f"{type(sampler).__name__} of {sampler.nwalkers} walkers and {sampler.ndim} parameters"
    text = "".join(f"<div>{escape(line)}</div>" for line in lines)
    return f"<div><strong>{escape(title)}</strong>{text}<pre>{escape(str(moments))}</pre></div>"
