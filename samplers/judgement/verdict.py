"""Verdict on the result of a run: converged, usable or not usable, with reasons.

``converged``
    Nothing that the run can observe speaks against the result.
``usable``
    Means and evidence have the stated errors, but something was not reached or could not be checked.
``not usable``
    The numbers may be far from the posterior, by more than their stated errors.

No run can see a part of the posterior in which it has no points. The reasons state the basis of the verdict.
"""

from collections.abc import Sequence
from functools import cached_property
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np

from ..estimates.genealogy import standard_error_of_mean
from ..estimates.importance import FIRST_ROUND_SHARE, USABLE_SHARE, fewest_points, usable
from ..estimates.pareto import LARGEST_SHAPE
from ..finding import CARE, NOTE, WRONG, Finding
from ..reports import AnnealingResult, EarlyStop, GuidedRound, GuidedStart
from .checks import LOST, OF_SHARES, find_unreached_part
from .clusters import Cluster, find_clusters
from .failures import NearFailures, check_failed_region
from .guides import UNSEEN
from .rounds import UNSETTLED

__all__ = [
    "CONVERGED",
    "NOT_USABLE",
    "USABLE",
    "Verdict",
    "describe_early_stop",
    "independent_points",
    "judge",
]

LONGEST_REASON = 200  # characters
CONVERGED = "converged"
USABLE = "usable"
NOT_USABLE = "not usable"
STATUSES = (CONVERGED, USABLE, NOT_USABLE)
SEVERITIES = (NOTE, CARE, WRONG)
LIMIT = "The limit of simulations ended the run"


class _Stored(NamedTuple):
    """The part of a verdict that is stored with the chain."""

    status: str
    reasons: tuple[str, ...]
    simulations: float
    more_simulations: float | None
    effective_sample_size: float
    sample: str
    findings: tuple[Finding, ...] = ()


class Verdict(_Stored):
    """Verdict on the result of a run. ``str`` gives the reasons in sentences, `summary` the results in one sentence.

    The attributes listed here are the judgement, which is stored, compared and pickled. Other attributes are computed
    on first use from the sampler that returned the verdict, and raise ValueError for a verdict without a sampler;
    `modes` and `summary` also do for an empty chain.

    Attributes
    ----------
    status : {"converged", "usable", "not usable"}
        The judgement.
    reasons : tuple of str
        The reasons for the judgement.
    simulations : float
        Simulations made (`samplers.budget`).
    more_simulations : float, optional
        How many more simulations a converged result takes at least, about; it may take several times as many. 0 if the
        result is converged, None if unknown.
    effective_sample_size : float
        Effective sample size of the points that `sample` names, when beta = 1 was reached.
    sample : str
        The points that `effective_sample_size` counts: the walkers, or weighted points that the walkers were resampled
        from.
    findings : tuple of `samplers.finding.Finding`
        What speaks against the result, each with its severity and what to do.

    Examples
    --------
    >>> sampler.verdict.status
    'converged'
    >>> print(sampler.verdict)
    Converged: effective sample size ... (of 100 walkers) from ... simulations.
    >>> sampler.verdict.reasons
    ()
    """

    _sampler: Any = None

    def of(self, sampler: Any) -> "Verdict":
        """This verdict with the sampler from which its other attributes are computed."""
        verdict = Verdict(*self)
        verdict._sampler = sampler
        return verdict

    def __reduce__(self):
        return Verdict, tuple(self)

    @property
    def _run(self) -> Any:
        if self._sampler is None:
            raise ValueError("this verdict has no run: read it from a sampler, as sampler.verdict")
        return self._sampler

    @property
    def unknown(self) -> tuple[str, ...]:
        """Questions that the run cannot answer."""
        return tuple(_unknown(self._run))

    @property
    def pareto_shape(self) -> float | None:
        """Largest Pareto shape of the weights from the check and from the draws of a guide; None without either.

        Weights with a shape above 0.7 have no useful mean.
        """
        result = self._run._result
        shapes = [] if result.check is None else [result.check.pareto_shape]
        if result.start is not None and result.start.used:
            shapes.append(result.start.pareto_shape)
        return max(shapes, default=None)

    @property
    def near_failures(self) -> NearFailures | None:
        """Failures in the region of the last walkers, on which the verdict depends; None for a chain read from a file.

        Values of -inf inside the support of the prior are failures if ``log_prob_fn.report()`` has a "failure_count",
        except if ``log_prob_fn.possible(points)`` is False: parameters that need no simulation are impossible there.
        """
        return self._run._near

    @cached_property
    def modes(self) -> tuple[Cluster, ...]:
        """Modes in which the run has points, with shares and their standard errors, the largest first."""
        run = self._run
        run._result.require_finished()
        if run.iteration == 0:
            raise ValueError("modes are found in a chain, which is empty: call run_mcmc with one step or more")
        lost = self.lost.get(OF_SHARES, 0.0)
        return find_clusters(run.get_chain(), run.founders, run._parents, run._result.error_by_resampling, lost)

    @property
    def lost(self) -> dict[str, float]:
        """How far shares and means of the walkers are from weighted draws, if a mode may be lost; else empty."""
        return next((each.numbers for each in self.findings if each.kind == LOST), {})

    @property
    def summary(self) -> str:
        """One sentence: status, modes, evidence, effective sample size and failures.

        The evidence is ``sampler.log_evidence``; the estimates that it was chosen from follow in parentheses.
        """
        if len(self.modes) == 1:
            found = "one mode"
        else:
            shares = ", ".join(f"{mode.share:.2f} +- {mode.share_error:.2g}" for mode in self.modes)
            found = f"{len(self.modes)} modes with shares {shares}"
        run, result, check = self._run, self._run._result, self._run._result.check
        stated = "{:.2f} +- {:.2g}".format(*result.evidence)
        others = []
        if check is not None:
            others = [("stages", result.log_evidence_ladder, result.ladder[-1].log_evidence_error, "")]
            others.append(("check", *check[:2], "" if check.reliable else ", uneven weights"))
        if others:
            stated += f" ({'; '.join(f'{name} {x:.2f} +- {error:.2g}{note}' for name, x, error, note in others)})"
        failed = f"{run.failure_count} of {run.evaluations} evaluations failed"
        if simulations := run._failed_simulations:
            failed = f"{simulations} simulations failed"
        elif not run.failure_count:
            failed = "no failed evaluations"
        if reasons := run._failure_reasons:
            failed += f" ({shorten(reasons, LONGEST_REASON)})"
        return (
            f"{self.status.capitalize()}: {found}; log-evidence {stated}; effective sample size "
            f"{self.effective_sample_size:.0f}; {failed}."
        )

    def __str__(self) -> str:
        first = (
            f"{self.status.capitalize()}: effective sample size {self.effective_sample_size:.0f} ({self.sample}) from "
            f"{self.simulations:.0f} simulations."
        )
        more = []
        if self.more_simulations is None:
            more = ["How many more simulations are needed is not known."]
        elif self.more_simulations > 0.0:
            needed = f"{self.more_simulations:.0f} more simulations are needed, possibly several times as many"
            more = [f"At least about {needed}."]
        return " ".join([first, *(f"{reason[0].upper()}{reason[1:]}." for reason in self.reasons), *more])

    __repr__ = __str__


def judge(
    result: AnnealingResult,
    nwalkers: int,
    ndim: int,
    simulations: float,
    missing_steps: int = 0,
    failures: str = "",
    searched: float = 0.0,
    near: NearFailures | None = None,
    names: Sequence[str] = (),
) -> Verdict:
    """Judge an annealing that has reached beta = 1.

    `searched` is the part of the `simulations` made by the guide for its search; `missing_steps` at beta = 1 were not
    allowed by the limit; `failures` says how many evaluations failed; `names` name the parameters.
    """
    stage = result.ladder[-1]
    found = [*result.findings, *(() if near is None else check_failed_region(near))]
    reasons: list[str] = []
    if searched > 0.0:
        reasons.append(f"the guide used {searched:.0f} of the {simulations:.0f} simulations for its search")
    more: float | None = 0.0
    stop = result.early_stop
    if stop is not None and not stop.complete:
        found.append(_of_early_stop(stop, result.start, stage.log_evidence_error, ndim))
        more = _missing_draws(result.rounds, nwalkers) if stop.from_guide else None
    elif stop is not None:
        found.append(Finding(LIMIT, CARE, "The limit of simulations ended the run at beta = 1, before its last check."))
        more = None
    if result.start is not None and result.start.used:
        last = result.rounds[-1]
        reasons.append(
            f"the latest {last.draws} draws of the guide, which it was not fitted to, have an "
            f"effective sample size of {100 * last.effective_share:.0f} % of their number; the Pareto shape of all "
            f"weights is {result.start.pareto_shape:.2f}"
        )
        if result.start.shortfall:
            unsettled = result.start.shortfall == UNSETTLED
            found.append(find_unreached_part(result.start.shortfall, WRONG if unsettled else CARE))
        found += _of_signed_sample(result, names)
    if result.start is not None or (stop is not None and stop.from_guide):
        if all(each.kind != UNSEEN for each in found):
            reasons.append(result.basis or "parts of the posterior in which the guide makes no draws are not seen")
    if missing_steps > 0:
        reasons.append(
            f"{missing_steps} of the steps at beta = 1 {'was' if missing_steps == 1 else 'were'} not made, which takes "
            f"up to {missing_steps * nwalkers} simulations"
        )
    if failures:
        reasons.append(f"{failures} failed and count as impossible")
    status = STATUSES[max((SEVERITIES.index(each.severity) for each in found), default=0)]
    if status == CONVERGED:
        more = 0.0
    elif stop is None:
        more = None
    return Verdict(
        status,
        (*(each.message.rstrip(".") for each in found), *reasons),
        float(simulations),
        None if more is None else float(more),
        float(stage.effective_sample_size if result.independent_points is None else result.independent_points),
        _sample(result, nwalkers),
        tuple(found),
    )


def _sample(result: AnnealingResult, nwalkers: int) -> str:
    """The points whose effective sample size is `independent_points`."""
    if result.early_stop is not None and not result.early_stop.complete:
        return f"of {result.early_stop.points} weighted points, resampled to {nwalkers} walkers"
    if result.start is not None and result.start.used:
        return f"of {sum(r.draws for r in result.rounds)} weighted draws, resampled to {nwalkers} walkers"
    return f"of {nwalkers} walkers"


def independent_points(result: AnnealingResult, coords: np.ndarray) -> float:
    """Effective sample size of the walkers (n, ndim) when beta = 1 was reached.

    For walkers resampled from weighted draws and not moved, the effective sample size of the weights. Otherwise the
    squared ratio of standard deviation to standard error of the mean, for the worst parameter, at most n.
    """
    if result.early_stop is not None and not result.early_stop.complete:
        return result.early_stop.effective_sample_size
    if result.start is not None and result.start.used:
        return result.ladder[-1].effective_sample_size
    founders = np.arange(len(coords)) if result.founders is None else result.founders
    spread, error = coords.std(axis=0), standard_error_of_mean(coords[None], founders)
    return float(np.min((spread / error)[error > 0.0] ** 2, initial=len(coords)))


def describe_early_stop(verdict: Verdict, limit: float | None, result: AnnealingResult, made: int, missing: int) -> str:
    """The warning when a call ends early: `made` steps at beta = 1 were made, `missing` steps were not.

    What the annealing has warned of before is not repeated.
    """
    warned = [each.message.rstrip(".") for each in result.findings]
    verdict = verdict._replace(reasons=tuple(reason for reason in verdict.reasons if reason not in warned))
    if result.start is not None and not result.start.used:
        return str(verdict)
    if result.early_stop is not None:
        ended = f"max_simulations={limit:g} ended the run"
    else:
        ended = f"max_simulations={limit:g} allowed {made} of {made + missing} steps at beta = 1"
    if verdict.simulations > limit:
        ended += f" (the stored run has made {verdict.simulations:.0f} simulations, which are kept)"
    if verdict.status == CONVERGED:
        return f"{ended}. The chain holds draws of the posterior: no further simulation is necessary"
    return (
        f"{ended}. {verdict} To go on from here, set max_simulations to a larger number and run again, "
        "with the same file or folder"
    )


def _of_early_stop(stop: EarlyStop, start: GuidedStart | None, error: float, ndim: int) -> Finding:
    """What is found of a population that was made from the points known at the end: at the limit, or of a guide."""
    kind, why, action = LIMIT, LIMIT, ""
    if start is not None:
        kind, why = "The draws of the guide are not usable", f"The rounds of the guide ended, because {start.reason},"
        action = "Run again without a guide, which takes some thousand simulations, or use a better guide."
    where = f"at beta = {stop.beta:.3g} " if stop.beta < 1.0 else ""
    text = (
        f"{why} {where}with {stop.points} weighted points, whose effective sample "
        f"size is {stop.effective_sample_size:.2g} and whose weights have a Pareto shape of {stop.pareto_shape:.2g}"
    )
    if usable(stop.effective_sample_size, stop.pareto_shape, error, ndim):
        return Finding(kind, CARE, f"{text}.", action)
    wanted = f"an effective sample size of {fewest_points(ndim):.0f} and a shape below {LARGEST_SHAPE:g} are needed"
    return Finding(kind, WRONG, f"{text} ({wanted}).", action)


def _of_signed_sample(result: AnnealingResult, names: Sequence[str]) -> list[Finding]:
    """A finding if the signed sample does not determine the standard deviation of some parameters."""
    if result.signed is None:
        return []
    unknown = np.flatnonzero(np.isnan(result.signed.standard_deviation().value))
    if len(unknown) == 0:
        return []
    named = ", ".join(names[j] if j < len(names) else f"parameter {j + 1}" for j in unknown)
    text = (
        f"The standard deviation of {named} is not determined: its variance by the "
        "signed sample is below its own standard error, as with a tail of the posterior in which the guide makes "
        "few draws."
    )
    action = "Use more walkers, a prior without this tail, or no guide."
    return [Finding("A standard deviation is not determined", CARE, text, action)]


def _missing_draws(rounds: tuple[GuidedRound, ...], nwalkers: int) -> float | None:
    """Draws that the guide still needs if later rounds are like the last round; None if the last round says nothing."""
    last = rounds[-1]
    if last.effective_share < USABLE_SHARE:
        return None
    missing = max(nwalkers - last.effective_sample_size, FIRST_ROUND_SHARE * nwalkers)
    return float(np.ceil(missing / last.effective_share))


def _unknown(run: Any) -> list[str]:
    """Questions that the run of a sampler cannot answer."""
    missing = [
        f"modes that none of the points came near, above all modes much narrower than those found and modes in a part "
        f"of the prior that holds less than about {3.0 / run.nwalkers:.2g} of its probability (3 / walkers); a run "
        "with another seed and more walkers is the test"
    ]
    if run._result.check is None:
        missing.append("whether the evidence is right, since there was no check by independent draws")
    if run._result.founders is None:
        missing.append(
            "which walkers are copies, since the chain was read from a file: errors and effective sample size treat "
            "them as independent"
        )
    if run.failure_count:
        missing.append("the posterior where evaluations failed, which counts as impossible")
    if run._near is not None and not run._near.known:
        # of 153 runs with such points, 9 were wrong, and the evidences told of these
        missing.append(
            f"whether the log-probability of -inf of {run._near.failed} of {run._near.evaluated} evaluated points in "
            "the region of the final points means impossible parameters or failed simulations, which should return NaN"
        )
    return missing
