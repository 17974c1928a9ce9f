"""From a finished run to what one reads: a summary, arviz data, the ladder as a table, samplers side by side.

Samples come in as arrays (n, ndim), ladders from the sampler. arviz is imported where it is used. Figures are drawn in
`samplers.reporting.figures`.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..tempering.weights import Stage

__all__ = ["Comparison", "Summary", "comparison_table", "finished_ladder", "ladder_table", "summary", "to_arviz"]


class Summary(NamedTuple):
    """Moments of the posterior, one entry a parameter.

    Attributes
    ----------
    names : tuple of str
    mean, sd : (ndim,) float — in the parameters' units.
    cv : (ndim,) float — ``sd / |mean|`` [-]; inf where the mean is zero and the sd is not.
    mean_error : (ndim,) float, or None — Monte-Carlo standard error of `mean`, in the parameters' units.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    cv: np.ndarray
    mean_error: np.ndarray | None = None

    def __str__(self) -> str:
        width = max(len("parameter"), *(len(name) for name in self.names))
        errors = ["-"] * len(self.names) if self.mean_error is None else [f"{error:.2g}" for error in self.mean_error]
        rows = [f"{'parameter':<{width}} {'mean':>12} {'MC error':>10} {'sd':>12} {'CV':>10}"]
        for name, mean, error, sd, cv in zip(self.names, self.mean, errors, self.sd, self.cv, strict=True):
            rows.append(f"{name:<{width}} {mean:>12.5g} {error:>10} {sd:>12.4g} {cv:>10.3g}")
        return "\n".join(rows)


def _names(names: Sequence[str] | None, ndim: int) -> tuple[str, ...]:
    names = tuple(f"theta_{i}" for i in range(ndim)) if names is None else tuple(names)
    if len(names) != ndim:
        raise ValueError(f"one name a parameter is needed: {ndim} parameters, {len(names)} names {names}")
    return names


def _samples(samples: np.ndarray) -> np.ndarray:
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) of draws, as get_chain(flat=True) gives; got {samples.shape}"
        )
    return samples


def summary(
    samples: np.ndarray,
    names: Sequence[str] | None = None,
    weights: np.ndarray | None = None,
    mean_error: np.ndarray | None = None,
) -> Summary:
    """Posterior mean, its Monte-Carlo error, standard deviation and coefficient of variation.

    Parameters
    ----------
    samples : (n, ndim) float
    names : one name a parameter.
    weights : (n,) float, optional — non-negative, need not sum to one.
    mean_error : (ndim,) float, optional — ``sampler.mean_error()`` of the chain that the samples are; samples alone do
        not tell which of them are copies.
    """
    samples = _samples(samples)
    if mean_error is not None:
        mean_error = np.asarray(mean_error, dtype=float)
        if mean_error.shape != samples.shape[1:] or not np.all(mean_error >= 0.0):
            raise ValueError(
                f"mean_error must be {samples.shape[1]} non-negative numbers, as sampler.mean_error() gives"
            )
    if weights is None:
        weights = np.full(len(samples), 1.0)
    weights = np.asarray(weights, dtype=float)
    if weights.shape != (len(samples),) or not np.all(weights >= 0.0) or not 0.0 < weights.sum() < np.inf:
        raise ValueError(f"weights must be {len(samples)} non-negative numbers with a positive sum")
    weights = weights / weights.sum()
    mean = weights @ samples
    sd = np.sqrt(weights @ (samples - mean) ** 2)
    cv = np.divide(sd, np.abs(mean), out=np.where(sd > 0.0, np.inf, 0.0), where=mean != 0.0)
    return Summary(_names(names, samples.shape[1]), mean, sd, cv, mean_error)


def to_arviz(sampler: Any, parameter_names: Sequence[str] | None = None) -> Any:
    """arviz data of one run or of several independent ones.

    A chain is an independent run: the walkers of one run share their proposals and ancestors, and are draws of one
    chain. (`arviz.from_emcee` makes every walker a chain.) The log-probability is ``lp`` in ``sample_stats``, whose
    attributes carry ``log_evidence`` and ``log_evidence_error``, one number a run, and ``ladder``: JSON, for each run a
    list of stages.

    Parameters
    ----------
    sampler : a sampler that has run, or a sequence of them with equally long chains; `emcee.EnsembleSampler` too.
    parameter_names : one a parameter; by default those of ``log_prob_fn``, else theta_0, theta_1, ...

    Returns
    -------
    arviz.InferenceData (a DataTree from arviz 1.0 on); ``.to_netcdf(path)`` writes it.
    """
    import inspect

    import arviz

    runs = list(sampler) if isinstance(sampler, Sequence) else [sampler]
    if parameter_names is None:
        parameter_names = getattr(runs[0].log_prob_fn.f, "parameter_names", None)
    names = _names(parameter_names, runs[0].ndim)
    chains = [run.get_chain(flat=True) for run in runs]
    if len({chain.shape for chain in chains}) > 1:
        raise ValueError(f"runs must have chains of one shape to stand side by side; got {[c.shape for c in chains]}")
    draws = np.stack(chains)
    groups = {
        "posterior": {name: draws[:, :, i] for i, name in enumerate(names)},
        "sample_stats": {"lp": np.stack([run.get_log_prob(flat=True) for run in runs])},
    }
    # arviz 1.0 takes the groups as one dictionary, its predecessors as keywords
    by_keyword = "posterior" in inspect.signature(arviz.from_dict).parameters
    data = arviz.from_dict(**groups) if by_keyword else arviz.from_dict(groups)

    if all(getattr(run, "ladder", ()) for run in runs):
        data["sample_stats"].attrs.update(
            log_evidence=np.array([run.log_evidence for run in runs]),
            log_evidence_error=np.array([run.log_evidence_error for run in runs]),
            ladder=json.dumps([[stage._asdict() for stage in run.ladder] for run in runs]),
        )
    return data


def finished_ladder(sampler: Any) -> tuple[Stage, ...]:
    """The ladder of a sampler; an error where there is none yet."""
    if not sampler.ladder:
        raise ValueError("the sampler has no ladder yet: call run_mcmc first")
    return sampler.ladder


def ladder_table(sampler: Any) -> str:
    """The ladder as text: one line a stage, the evidence, and the two estimates it was chosen from."""
    head = f"{'stage':>5} {'beta':>10} {'ESS':>7} {'accept':>7} {'moves':>6} {'distinct':>9} {'dlogZ':>10} "
    rows = [head + f"{'evaluations':>12} {'seconds':>9}"]
    for number, s in enumerate(finished_ladder(sampler), start=1):
        rows.append(
            f"{number:>5} {s.beta:>10.3e} {s.effective_sample_size:>7.0f} {s.acceptance:>7.3f} {s.moves:>6} "
            f"{s.distinct_ancestors:>9} {s.log_evidence_increment:>10.3f} {s.evaluations:>12} {s.seconds:>9.3g}"
        )
    total = sum(s.evaluations for s in sampler.ladder), sum(s.seconds for s in sampler.ladder)
    rows.append(
        f"log evidence {sampler.log_evidence:.3f} +- {sampler.log_evidence_error:.3f}; "
        f"{total[0]} evaluations in {total[1]:.3g} s"
    )
    if coarse := getattr(sampler, "coarse_evaluations", 0):
        rows.append(f"{coarse} evaluations of the coarse model, in the first stage's seconds")
    check = sampler.log_evidence_check
    if check is not None:
        rows.append(
            f"by the ladder {sampler.log_evidence_ladder:.3f} +- {sampler.ladder[-1].log_evidence_error:.3f}; "
            f"by {check.evaluations} independent draws {check.log_evidence:.3f} +- {check.error:.3f} "
            f"(worth {check.effective_sample_size:.0f}, Pareto shape {check.pareto_shape:.2f})"
        )
    return "\n".join(rows)


class Comparison(NamedTuple):
    """Samplers side by side, one entry a sampler; None where a figure is not known.

    Attributes
    ----------
    names : tuple of str
    evaluations : tuple of int — points handed to ``log_prob_fn``.
    seconds : tuple of float — wall time [s].
    effective_sample_size : tuple of float — independent draws that the mean of the worst parameter is worth.
    log_evidence, log_evidence_error : tuple of float
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
) -> Comparison:
    """What several samplers cost on one posterior, and what they gave for it.

    The effective sample size is that of the parameter for which it is smallest: (sd / Monte-Carlo error)^2 for our
    samplers, and for a chain of emcee's own sampler its length over its autocorrelation time, which a short chain
    underestimates. It says nothing about modes that were never found.

    Parameters
    ----------
    samplers : samplers that have run in this process, by name; `emcee.EnsembleSampler` too, whose evaluations are
        counted as iterations times walkers (a chain not thinned, moves that propose once a walker).
    seconds : wall times [s] of samplers that do not measure their own, by name.
    discard : int — first iterations left out of the chains of emcee's own sampler: its burn-in.

    Raises
    ------
    ValueError
        If a sampler has not run here, or a time is given for a name that is not there.
    """
    given = {} if seconds is None else dict(seconds)
    if not samplers:
        raise ValueError("no samplers to compare: give them by name")
    if unknown := set(given) - set(samplers):
        raise ValueError(f"seconds are given for {sorted(unknown)}, the samplers are {list(samplers)}")
    columns = []
    for name, sampler in samplers.items():
        tempered = hasattr(sampler, "mean_error")
        evaluations = sampler.evaluations if tempered else sampler.iteration * sampler.nwalkers
        if evaluations == 0 or sampler.iteration == 0:
            raise ValueError(
                f"sampler {name!r} has made no chain here: run it first (what a chain on file has cost is not kept)"
            )
        if tempered:
            spread, error = sampler.get_chain(flat=True).std(axis=0), sampler.mean_error()
            ess = float(np.min((spread / error)[error > 0.0] ** 2, initial=np.inf))
        else:
            chain = sampler.get_chain(discard=discard)
            time = sampler.get_autocorr_time(discard=discard, tol=0)
            ess = chain.shape[0] * chain.shape[1] / float(np.max(time))
        known = getattr(sampler, "seconds", None)
        columns.append(
            (
                name,
                evaluations,
                given.get(name, known),
                ess if np.isfinite(ess) else 0.0,
                sampler.log_evidence if tempered else None,
                sampler.log_evidence_error if tempered else None,
            )
        )
    return Comparison(*zip(*columns, strict=True))
