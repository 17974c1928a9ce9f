"""Warnings of a run that has gone wrong without an error.

A collapsed population, moves that do not move or not enough, a rung that carries all, an evidence nobody confirms.
"""

import warnings
from collections.abc import Sequence

import numpy as np

from .evidence_check import EvidenceCheck
from .weights import Stage

__all__ = ["SamplingWarning", "check_climb", "check_evidence", "check_ladder", "warn"]

LOW_ACCEPTANCE = 0.01
LOW_YIELD = 0.05
# moves whose answers were right left correlations of up to 0.8, those of TMCMC as published 0.98 and more
HIGH_MEMORY = 0.9
LARGE_ERROR = 0.35
LARGE_SHARE = 0.8


class SamplingWarning(UserWarning):
    """Something in the run makes its result doubtful."""


def warn(message: str) -> None:
    """Warn the caller of the sampler."""
    warnings.warn(message, SamplingWarning, stacklevel=3)


def _collapsed(stage: Stage, nwalkers: int, ndim: int) -> bool:
    return stage.distinct_ancestors < max(ndim + 2, nwalkers // 50)


def check_ladder(ladder: Sequence[Stage], nwalkers: int, ndim: int) -> None:
    """Warn if the last stage is the first one to be collapsed, or stuck: once a climb for each reason.

    Collapsed: fewer distinct points survived the resampling than 2 % of the walkers, or than span the parameters.
    Stuck: less than 1 % of the proposals were accepted.
    """
    stage, number = ladder[-1], len(ladder)
    collapsed = [_collapsed(s, nwalkers, ndim) for s in ladder]
    stuck = [s.acceptance < LOW_ACCEPTANCE for s in ladder]
    if collapsed[-1] and not any(collapsed[:-1]):
        warn(
            f"collapse at stage {number} (beta = {stage.beta:.3g}): only {stage.distinct_ancestors} distinct points of "
            f"{nwalkers} survived the resampling. Use more walkers, more moves or a larger ess_ratio"
        )
    if stuck[-1] and not any(stuck[:-1]):
        warn(
            f"stuck at stage {number} (beta = {stage.beta:.3g}): {100 * stage.acceptance:.2g} % of the proposals were "
            "accepted, so the points did not move. Use other moves or more of them"
        )


def check_climb(ladder: Sequence[Stage], nwalkers: int, ndim: int, memory: float) -> None:
    """Warn if a finished climb by moves ended among points that had not moved enough, or stands on one bad rung.

    Not moved enough: the largest correlation of the last population with its resampled start, `memory`, is above 0.9.
    Left out where `check_ladder` found the moves stuck, which says as much.

    One bad rung: a stage whose weights alone give the ladder's log-evidence a standard error of some 0.35, and at least
    0.8 of the variance of all stages. The choice of beta keeps the stages alike, so this is a stage where no choice was
    left: most of the draws of the prior are impossible, say. Left out for a collapsed stage.
    """
    if memory > HIGH_MEMORY and not any(s.acceptance < LOW_ACCEPTANCE for s in ladder):
        warn(
            f"the points remember where they were resampled: after the moves at beta = {ladder[-1].beta:.3g} their "
            f"correlation with the start is {memory:.2f}, so copies are still copies, and modes keep the weights that "
            "resampling gave them. Use more moves (max_moves, burn_in) or longer ones"
        )
    variances = np.array([1.0 / s.effective_sample_size - 1.0 / nwalkers for s in ladder])
    worst = int(np.argmax(variances))
    stage, total = ladder[worst], float(variances.sum())
    dominated = total > LARGE_ERROR**2 and variances[worst] > LARGE_SHARE * total
    if dominated and not _collapsed(stage, nwalkers, ndim):
        if worst == 0:
            cause = "few draws of the prior are possible at all. Mend the runs that fail, narrow the prior or use"
        else:
            cause = "the likelihood falls off a cliff there. Use a larger ess_ratio or"
        warn(
            f"all stands on stage {worst + 1} (beta = {stage.beta:.3g}): its weights are worth "
            f"{stage.effective_sample_size:.2g} of {nwalkers} points, which alone makes an error of "
            f"{np.sqrt(variances[worst]):.2f} in the log-evidence; {cause} more walkers"
        )


def check_evidence(log_evidence: float, error: float, check: EvidenceCheck) -> None:
    """Warn if an independent estimate says nothing, or differs from the ladder's by more than three joint errors."""
    if not check.reliable and check.effective_sample_size < LOW_YIELD * check.evaluations:
        warn(
            f"no mixture follows the final points: {check.evaluations} draws from the best one are worth "
            f"{check.effective_sample_size:.2g}, so the evidence and the posterior stand on the ladder alone. Use more "
            "walkers or more moves, and compare two runs"
        )
    joint = float(np.hypot(error, check.error))
    if check.reliable and abs(log_evidence - check.log_evidence) > 3.0 * joint + 1e-6:
        warn(
            f"the ladder gives the log-evidence {log_evidence:.2f} +- {error:.2f}, importance sampling of the final "
            f"points {check.log_evidence:.2f} +- {check.error:.2f}. The posterior may be right all the same; for the "
            "evidence use more walkers or more moves"
        )
