"""Warnings of a run that has gone wrong without an error: a collapsed population, moves that do not move."""

import warnings
from collections.abc import Sequence

import numpy as np

from .importance import EvidenceCheck
from .ladder import Stage

__all__ = ["SamplingWarning", "check_evidence", "check_ladder", "sound"]

LOW_ACCEPTANCE = 0.01
LOW_YIELD = 0.05


class SamplingWarning(UserWarning):
    """Something in the run makes its result doubtful."""


def sound(message: str) -> None:
    """Warn the caller of the sampler."""
    warnings.warn(message, SamplingWarning, stacklevel=3)


def check_ladder(ladder: Sequence[Stage], nwalkers: int, ndim: int) -> None:
    """Warn if the last stage is the first one to be collapsed, or stuck: once a climb for each reason.

    Collapsed: fewer distinct points survived the resampling than 2 % of the walkers, or than span the parameters.
    Stuck: less than 1 % of the proposals were accepted.
    """
    few = max(ndim + 2, nwalkers // 50)
    stage, number = ladder[-1], len(ladder)
    collapsed = [s.distinct_ancestors < few for s in ladder]
    stuck = [s.acceptance < LOW_ACCEPTANCE for s in ladder]
    if collapsed[-1] and not any(collapsed[:-1]):
        sound(
            f"collapse at stage {number} (beta = {stage.beta:.3g}): only {stage.distinct_ancestors} distinct points of "
            f"{nwalkers} survived the resampling. Use more walkers, more moves or a larger ess_ratio"
        )
    if stuck[-1] and not any(stuck[:-1]):
        sound(
            f"stuck at stage {number} (beta = {stage.beta:.3g}): {100 * stage.acceptance:.2g} % of the proposals were "
            "accepted, so the points did not move. Use other moves or more of them"
        )


def check_evidence(log_evidence: float, error: float, check: EvidenceCheck) -> None:
    """Warn if an independent estimate says nothing, or differs from the ladder's by more than three joint errors."""
    if not check.reliable and check.effective_sample_size < LOW_YIELD * check.evaluations:
        sound(
            f"no mixture follows the final points: {check.evaluations} draws from the best one are worth "
            f"{check.effective_sample_size:.2g}, so the evidence and the posterior stand on the ladder alone. Use more "
            "walkers or more moves, and compare two runs"
        )
    joint = float(np.hypot(error, check.error))
    if check.reliable and abs(log_evidence - check.log_evidence) > 3.0 * joint + 1e-6:
        sound(
            f"the ladder gives the log-evidence {log_evidence:.2f} +- {error:.2f}, importance sampling of the final "
            f"points {check.log_evidence:.2f} +- {check.error:.2f}. The posterior may be right all the same; for the "
            "evidence use more walkers or more moves"
        )
