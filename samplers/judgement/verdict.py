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
from typing import NamedTuple

import numpy as np

from ..estimates.genealogy import standard_error_of_mean
from ..estimates.importance import fewest_points, usable
from ..estimates.pareto import LARGEST_SHAPE
from ..finding import CARE, NOTE, WRONG, Finding
from ..reports import LIMIT, AnnealingResult, Weighted
from .failures import NearFailures, check_failed_region
from .guides import UNSEEN

CONVERGED = "converged"
USABLE = "usable"
NOT_USABLE = "not usable"
INCOMPLETE = "The record is incomplete"
STATUSES = (CONVERGED, USABLE, NOT_USABLE)
SEVERITIES = (NOTE, CARE, WRONG)


class Verdict(NamedTuple):
    """Verdict on the result of a run; ``str`` gives the reasons in sentences.

    Examples
    --------
    >>> sampler.verdict.status
    'converged'
    >>> print(sampler.verdict)
    Converged: effective sample size ... (of 100 walkers) from ... simulations.
    >>> sampler.verdict.reasons
    ()
    """

    status: str  #: "converged", "usable" or "not usable"
    reasons: tuple[str, ...]  #: the reasons for the judgement
    simulations: float  #: simulations made (`samplers.record`)
    effective_sample_size: float  #: of the points that `sample` names, when beta = 1 was reached
    #: what `effective_sample_size` counts: the walkers, or weighted points that the walkers were resampled from
    sample: str
    findings: tuple[Finding, ...] = ()  #: what speaks against the result, each with its severity and what to do

    def __str__(self) -> str:
        first = (
            f"{self.status.capitalize()}: effective sample size {self.effective_sample_size:.0f} ({self.sample}) from "
            f"{self.simulations:.0f} simulations."
        )
        return " ".join([first, *(f"{reason[0].upper()}{reason[1:]}." for reason in self.reasons)])

    __repr__ = __str__


def judge(
    result: AnnealingResult,
    nwalkers: int,
    ndim: int,
    simulations: float,
    missing_steps: int = 0,
    failures: str = "",
    near: NearFailures | None = None,
    names: Sequence[str] = (),
) -> Verdict:
    """Judge an annealing that has reached beta = 1. `missing_steps` at beta = 1 were not allowed by the limit, and
    `failures` says how many simulations failed.
    """
    stage = result.ladder[-1]
    found = [*result.findings, *(() if near is None else check_failed_region(near))]
    reasons: list[str] = []
    weighted = result.weighted
    if weighted is not None and weighted.ended:
        found.append(_of_end(weighted, stage.log_evidence_error, ndim))
    if weighted is not None and weighted.guided:
        if not weighted.ended:
            found += _of_signed_sample(result, names)
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
    return Verdict(
        status,
        (*(each.message.rstrip(".") for each in found), *reasons),
        float(simulations),
        float(stage.effective_sample_size if result.independent_points is None else result.independent_points),
        _sample(result, nwalkers),
        tuple(found),
    )


def lost_simulations(stored: Verdict | None, simulations: float) -> float:
    """How many simulations a record has lost, by the verdict stored with its chain and the number that it has now."""
    if stored is None:
        return 0.0
    before = sum(each.numbers.get("lost", 0.0) for each in stored.findings if each.kind == INCOMPLETE)
    return before + max(stored.simulations - simulations, 0.0)


def with_lost_record(verdict: Verdict, lost: float) -> Verdict:
    """The verdict on a run whose record has lost a number of simulations."""
    text = f"The record of the run has lost {lost:.0f} simulations: failures among them are not judged."
    action = "The chain is whole; repeat the run in new files if simulations fail."
    finding = Finding(INCOMPLETE, CARE, text, action, {"lost": lost})
    if lost < 1.0 or finding in verdict.findings:
        return verdict
    status = STATUSES[max(STATUSES.index(verdict.status), SEVERITIES.index(finding.severity))]
    reasons, findings = (finding.message.rstrip("."), *verdict.reasons), (*verdict.findings, finding)
    return verdict._replace(status=status, reasons=reasons, findings=findings)


def _sample(result: AnnealingResult, nwalkers: int) -> str:
    """The points whose effective sample size is `independent_points`."""
    weighted = result.weighted
    if weighted is None or not weighted.points:
        return f"of {nwalkers} walkers"
    draws = "draws" if weighted.guided and not weighted.ended else "points"
    return f"of {weighted.points} weighted {draws}, resampled to {nwalkers} walkers"


def independent_points(result: AnnealingResult, coords: np.ndarray) -> float:
    """Effective sample size of the walkers (n, ndim) when beta = 1 was reached: of the weights that they were resampled
    by, or the squared ratio of standard deviation to error of the mean, for the worst parameter, at most n.
    """
    if result.weighted is not None and result.weighted.points:
        return result.weighted.effective_sample_size
    founders = np.arange(len(coords)) if result.founders is None else result.founders
    spread, error = coords.std(axis=0), standard_error_of_mean(coords[None], founders)
    return float(np.min((spread / error)[error > 0.0] ** 2, initial=len(coords)))


def describe_early_stop(verdict: Verdict, limit: float | None, result: AnnealingResult, made: int, missing: int) -> str:
    """The warning when a call ends early: `made` steps at beta = 1 were made, `missing` steps were not. What the
    annealing has warned of before is not repeated.
    """
    warned = [each.message.rstrip(".") for each in result.findings]
    verdict = verdict._replace(reasons=tuple(reason for reason in verdict.reasons if reason not in warned))
    if result.ended not in ("", LIMIT):
        return str(verdict)
    made_of = "ended the run" if result.ended else f"allowed {made} of {made + missing} steps at beta = 1"
    ended = f"max_simulations={limit:g} {made_of}, with {verdict.simulations:.0f} simulations"
    if verdict.status == CONVERGED:
        return f"{ended}. The chain holds draws of the posterior: no further simulation is necessary"
    return f"{ended}. {verdict} To go on from here, run again with a larger number, and the same file or folder"


def _of_end(weighted: Weighted, error: float, ndim: int) -> Finding:
    """What is found of a population that was made from the points known at the end: at the limit, or of a guide."""
    if not weighted.points:
        return Finding(LIMIT, CARE, f"{weighted.ended} at beta = 1, before its last check.")
    kind, action = LIMIT, ""
    if weighted.ended != LIMIT:
        kind = "The draws of the guide are not usable"
        action = "Run again without a guide, which takes some thousand simulations, or use a better guide."
    where = f"at beta = {weighted.beta:.3g} " if weighted.beta < 1.0 else ""
    text = (
        f"{weighted.ended} {where}with {weighted.points} weighted points, whose effective sample size is "
        f"{weighted.effective_sample_size:.2g} and whose weights have a Pareto shape of {weighted.pareto_shape:.2g}"
    )
    if usable(weighted.effective_sample_size, weighted.pareto_shape, error, ndim):
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
