"""Results of finished runs as tables.

`summary` gives the moments of the posterior, `ladder_table` the tempering stages of a run, and `comparison_table` the
cost of several samplers. Figures are in `samplers.reporting.corner_figures`,
`pair_figures` and `run_figures`, data for arviz in `samplers.reporting.arviz_data`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..tempering.population import Stage
from .inspection import is_tempered, summary_of

__all__ = [
    "SamplerComparison",
    "Summary",
    "comparison_table",
    "finished_ladder",
    "ladder_table",
    "names_of_parameters",
    "summary",
]


class Summary(NamedTuple):
    """Moments of the posterior, one entry per parameter. ``str`` gives a table.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    mean, sd : ndarray, shape (ndim,)
        Mean and standard deviation, in the units of the parameters.
    cv : ndarray, shape (ndim,)
        Coefficient of variation ``sd / |mean|`` [-]; inf where the mean is zero and the standard deviation is not.
    mean_error : ndarray, shape (ndim,), or None
        Monte Carlo standard error of `mean`, in the units of the parameters; NaN where it is not known.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    cv: np.ndarray
    mean_error: np.ndarray | None = None

    def __str__(self) -> str:
        width = max(len("parameter"), *(len(name) for name in self.names))
        unknown = np.full(len(self.names), np.nan)
        errors = ["-" if np.isnan(e) else f"{e:.2g}" for e in (unknown if self.mean_error is None else self.mean_error)]
        rows = [f"{'parameter':<{width}} {'mean':>12} {'MC error':>10} {'sd':>12} {'CV':>10}"]
        for name, mean, error, sd, cv in zip(self.names, self.mean, errors, self.sd, self.cv, strict=True):
            rows.append(f"{name:<{width}} {mean:>12.5g} {error:>10} {sd:>12.4g} {cv:>10.3g}")
        return "\n".join(rows)


def names_of_parameters(names: Sequence[str] | None, ndim: int) -> tuple[str, ...]:
    """The given names, or theta_0, theta_1, ...; ValueError if there is not one per parameter."""
    names = tuple(f"theta_{i}" for i in range(ndim)) if names is None else tuple(names)
    if len(names) != ndim:
        raise ValueError(f"expected one name per parameter: {ndim} parameters, but {len(names)} names {names}")
    return names


def _samples(samples: np.ndarray) -> np.ndarray:
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) with n >= 2, as get_chain(flat=True) returns; got {samples.shape}"
        )
    return samples


def summary(
    samples: np.ndarray,
    names: Sequence[str] | None = None,
    weights: np.ndarray | None = None,
    mean_error: np.ndarray | None = None,
) -> Summary:
    """Posterior mean, its Monte Carlo error, standard deviation and coefficient of variation.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior.
    names : sequence of str, optional
        One name per parameter; theta_0, theta_1, ... by default.
    weights : array_like, shape (n,), optional
        Non-negative weights of the samples; they need not sum to one.
    mean_error : array_like, shape (ndim,), optional
        Standard error of the mean, as ``sampler.mean_error()`` returns it for the same chain. It cannot be computed
        from the samples alone, because copies made by resampling are correlated. NaN says that it is not known, as for
        a Markov chain that is too short for an estimate of its autocorrelation time.

    Returns
    -------
    Summary

    Raises
    ------
    ValueError
        If shapes do not match, or weights or errors are negative.
    """
    samples = _samples(samples)
    if mean_error is not None:
        mean_error = np.asarray(mean_error, dtype=float)
        if mean_error.shape != samples.shape[1:] or np.any(mean_error < 0.0):
            raise ValueError(
                f"mean_error must be {samples.shape[1]} numbers, each non-negative or NaN, as sampler.mean_error() "
                f"returns; got {mean_error}"
            )
    if weights is None:
        weights = np.full(len(samples), 1.0)
    weights = np.asarray(weights, dtype=float)
    if weights.shape != (len(samples),) or not np.all(weights >= 0.0) or not 0.0 < weights.sum() < np.inf:
        raise ValueError(
            f"weights must be {len(samples)} non-negative numbers with a positive sum; got shape {weights.shape}"
        )
    weights = weights / weights.sum()
    mean = weights @ samples
    sd = np.sqrt(weights @ (samples - mean) ** 2)
    cv = np.divide(sd, np.abs(mean), out=np.where(sd > 0.0, np.inf, 0.0), where=mean != 0.0)
    return Summary(names_of_parameters(names, samples.shape[1]), mean, sd, cv, mean_error)


def finished_ladder(sampler: Any) -> tuple[Stage, ...]:
    """Return the stages of a tempered sampler, or raise ValueError if there are none."""
    if not is_tempered(sampler):
        raise ValueError(f"expected a tempered sampler (SMCSampler or TMCMCSampler); got {type(sampler).__name__}")
    if not sampler.ladder:
        raise ValueError("the sampler has no tempering stages yet: call run_mcmc first")
    return sampler.ladder


def ladder_table(sampler: Any) -> str:
    """Table of the tempering stages, then the two estimates of the evidence, and a sentence of the diagnostics.

    The columns are the fields of `samplers.tempering.population.Stage`: exponent, effective sample size, acceptance,
    sweeps of the ensemble, distinct points after the resampling, increment of the log-evidence, evaluations, and wall
    time [s].

    Parameters
    ----------
    sampler : TemperedSampler
        A sampler that has run.

    Returns
    -------
    str
        One line per stage.

    Raises
    ------
    ValueError
        If the sampler has no stages.
    """
    stages = finished_ladder(sampler)
    rows = [
        f"{'stage':>5} {'beta':>10}  {'ESS':>6} {'acceptance':>10} {'sweeps':>6} {'distinct':>8} {'d log Z':>10} "
        f"{'evaluations':>11} {'time [s]':>9}"
    ]
    for number, s in enumerate(stages, start=1):
        ended = sampler.ended_at is not None and number == len(stages)
        beta = f"{sampler.ended_at:.3e}*" if ended else f"{s.beta:.3e} "
        rows.append(
            f"{number:>5} {beta:>11} {s.effective_sample_size:>6.0f} {s.acceptance:>10.3f} {s.moves:>6} "
            f"{s.distinct_ancestors:>8} {s.log_evidence_increment:>10.3f} {s.evaluations:>11} {s.seconds:>9.3g}"
        )
    if sampler.ended_at is not None:
        rows.append("* the limit of simulations ended the run here: all points known then, weighted for beta = 1")
    evaluations, seconds = sum(s.evaluations for s in stages), sum(s.seconds for s in stages)
    rows.append(
        f"log evidence {sampler.log_evidence:.3f} +- {sampler.log_evidence_error:.3f}; "
        f"{evaluations} evaluations in {seconds:.3g} s"
    )
    if sampler.coarse_evaluations:
        rows.append(
            f"{sampler.coarse_evaluations} evaluations of the coarse model, their time included in the first stage"
        )
    check = sampler.log_evidence_check
    if check is not None:
        rows.append(
            f"log evidence of the ladder {sampler.log_evidence_ladder:.3f} +- {stages[-1].log_evidence_error:.3f}; "
            f"of {check.evaluations} independent draws {check.log_evidence:.3f} +- {check.error:.3f} "
            f"(effective sample size {check.effective_sample_size:.0f}, Pareto shape {check.pareto_shape:.2f})"
        )
    if text := summary_of(sampler):
        rows.append(text)
    return "\n".join(rows)


class SamplerComparison(NamedTuple):
    """Cost and results of several samplers, one entry per sampler. ``str`` gives a table.

    Attributes
    ----------
    names : tuple of str
        Names of the samplers.
    evaluations : tuple of int
        Number of points for which ``log_prob_fn`` was called.
    seconds : tuple of (float or None)
        Wall time [s]; None if it was not measured.
    effective_sample_size : tuple of float
        Number of independent draws with the same error of the mean, for the parameter where it is smallest.
    log_evidence, log_evidence_error : tuple of (float or None)
        Log-evidence and its standard error; None for samplers that give no evidence.
    """

    names: tuple[str, ...]
    evaluations: tuple[int, ...]
    seconds: tuple[float | None, ...]
    effective_sample_size: tuple[float, ...]
    log_evidence: tuple[float | None, ...]
    log_evidence_error: tuple[float | None, ...]

    @property
    def efficiency(self) -> tuple[float, ...]:
        """Effective sample size per evaluation."""
        return tuple(ess / n for ess, n in zip(self.effective_sample_size, self.evaluations, strict=True))

    def __str__(self) -> str:
        width = max(len("sampler"), *(len(name) for name in self.names))
        head = f"{'sampler':<{width}} {'evaluations':>12} {'seconds':>9} {'ESS':>8} {'ESS/evaluation':>15} "
        rows = [head + f"{'log evidence':>20}"]
        for name, n, seconds, ess, value, error in zip(*self, strict=True):
            time = "-" if seconds is None else f"{seconds:.3g}"
            evidence = "-" if value is None else f"{value:.3f} +- {error:.3f}"
            rows.append(f"{name:<{width}} {n:>12} {time:>9} {ess:>8.0f} {ess / n:>15.2e} {evidence:>20}")
        return "\n".join(rows)


def comparison_table(
    samplers: Mapping[str, Any], seconds: Mapping[str, float] | None = None, discard: int = 0
) -> SamplerComparison:
    """Compare the cost and the effective sample size of several samplers on one posterior.

    The effective sample size is that of the parameter for which it is smallest: (standard deviation / Monte Carlo
    error)^2 for tempered samplers, and the length of the chain divided by its autocorrelation time for emcee's own
    sampler. The autocorrelation time of a short chain is underestimated. The effective sample size contains no
    information about modes that were never visited.

    Parameters
    ----------
    samplers : mapping of str to sampler
        Samplers that have run in this process, by name. For `emcee.EnsembleSampler`, evaluations are counted as
        iterations times walkers, which holds for chains that are not thinned and moves with one proposal per walker.
    seconds : mapping of str to float, optional
        Wall times [s] of samplers that do not measure their own, by name.
    discard : int
        Burn-in of emcee's own sampler: number of initial iterations that are left out.

    Returns
    -------
    SamplerComparison

    Raises
    ------
    ValueError
        If a sampler has not run in this process, or a time is given for an unknown name.
    """
    given = {} if seconds is None else dict(seconds)
    if not samplers:
        raise ValueError("no samplers to compare: pass a mapping of names to samplers")
    if unknown := set(given) - set(samplers):
        raise ValueError(f"seconds are given for {sorted(unknown)}, but the samplers are {list(samplers)}")
    columns = []
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
        columns.append(
            (
                name,
                evaluations,
                given.get(name, sampler.seconds if tempered else None),
                ess if np.isfinite(ess) else 0.0,
                sampler.log_evidence if tempered else None,
                sampler.log_evidence_error if tempered else None,
            )
        )
    return SamplerComparison(*zip(*columns, strict=True))
