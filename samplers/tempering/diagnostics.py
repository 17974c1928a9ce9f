"""Doubts about runs that ended without an error but whose result is doubtful.

Collapsed populations, moves that are rejected or too few, one stage that dominates the error, evidences that disagree.
"""

import sys
import warnings
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ..proposals.covariance import invert_roots, location_and_root
from ..proposals.mixture import Mixture
from .evidence_check import EvidenceCheck, expected_yield
from .population import Doubt, Stage

__all__ = [
    "SamplingWarning",
    "check_annealing",
    "check_evidence",
    "check_fallback",
    "check_fit",
    "check_stages",
    "fits_poorly",
    "warn",
]

LOW_ACCEPTANCE = 0.01
LOW_YIELD = 0.05
# runs with right answers ended with correlations of up to 0.8, those of TMCMC as published with 0.98 and more
HIGH_CORRELATION = 0.9
LARGE_ERROR = 0.35
LARGE_SHARE = 0.8
# Difference of two log-evidences that is reported even where the error of the second one is not known.
LARGE_DIFFERENCE = 1.0
# Excess of the log-evidence of recycling over that of the moves after it, from which on a mode may be lost: that of a
# mode with a quarter of the mass.
LOST_EVIDENCE = 0.3
# Yield of a fitted proposal, as a share of that expected for Gaussian modes, below which the fit misses a part: nearly
# Gaussian posteriors, also at bounds or with several modes, have 0.9 to 1.1, bent ones without a shear 0.4 to 0.93.
POOR_FIT = 0.85
# Correlation of log-weights with those of the nearest points, below which jumps of the likelihood explain a poor yield:
# 0.2 to 0.44 with jumps of standard deviation 1, 0.44 to 0.56 for Gaussian modes with the chance errors of a fit, and
# 0.7 to 0.97 for bent posteriors.
SMOOTH_WEIGHTS = 0.6
# The same among the draws of the check alone, below which jumps are the only cause: -0.07 to 0.18 with jumps of
# standard deviation 1 in 3 and 10 dimensions, 0.22 to 0.66 with jumps of 0.5 to 0.6, and 0.34 to 0.48 for heavy tails
# in 10 dimensions, where the nearest points are far away.
ROUGH_WEIGHTS = 0.25
NEIGHBOURS = 3
OUR_PACKAGES = ("samplers", "emcee")


class SamplingWarning(UserWarning):
    """The result of a run is doubtful; the message says why and what to do."""


def warn(message: str) -> None:
    """Issue a `SamplingWarning` that points at the line of the user's code that called the sampler."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in OUR_PACKAGES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, SamplingWarning, stacklevel=level)


def _collapsed(stage: Stage, nwalkers: int, ndim: int) -> bool:
    return stage.distinct_ancestors < max(ndim + 2, nwalkers // 50)


def check_stages(stages: Sequence[Stage], nwalkers: int, ndim: int) -> list[Doubt]:
    """Doubts if the last stage is the first one that is collapsed or stuck.

    Collapsed: fewer distinct points survived the resampling than 2 % of the walkers, or than span the parameters.
    Stuck: less than 1 % of the proposals were accepted.
    """
    stage, number, doubts = stages[-1], len(stages), []
    collapsed = [_collapsed(s, nwalkers, ndim) for s in stages]
    stuck = [s.acceptance < LOW_ACCEPTANCE for s in stages]
    if collapsed[-1] and not any(collapsed[:-1]):
        message = (
            f"collapse at stage {number} (beta = {stage.beta:.3g}): only {stage.distinct_ancestors} distinct points of "
            f"{nwalkers} survived the resampling. Use more walkers, more moves or a larger ess_ratio"
        )
        doubts.append(Doubt(message, True))
    if stuck[-1] and not any(stuck[:-1]):
        message = (
            f"stuck at stage {number} (beta = {stage.beta:.3g}): {100 * stage.acceptance:.2g} % of the proposals were "
            "accepted, so the points did not move. Use other moves or more of them"
        )
        doubts.append(Doubt(message, True))
    return doubts


def check_annealing(stages: Sequence[Stage], nwalkers: int, ndim: int, correlation: float) -> list[Doubt]:
    """Doubts if annealing by moves ended with points that had not moved enough, or if one stage dominates the error.

    Not moved enough: the largest correlation of the final population with its resampled start, `correlation`, is above
    0.9. Not reported where `check_stages` found the moves stuck.

    One dominant stage: its weights alone give the log-evidence a standard error of 0.35 or more, and at least 0.8 of
    the variance of all stages. The choice of beta keeps the stages alike, so there was no choice at this stage: for
    example, most draws of the prior have zero likelihood. Not reported for a collapsed stage.
    """
    doubts = []
    if correlation > HIGH_CORRELATION and not any(s.acceptance < LOW_ACCEPTANCE for s in stages):
        message = (
            f"the moves at beta = {stages[-1].beta:.3g} were too short: particles are still correlated "
            f"({correlation:.2f}) with their resampled start, so copies have not separated, and modes keep the weights "
            "that the resampling gave them. Use more moves (max_moves, burn_in) or longer ones"
        )
        doubts.append(Doubt(message, True))
    variances = np.array([1.0 / s.effective_sample_size - 1.0 / nwalkers for s in stages])
    worst = int(np.argmax(variances))
    stage, total = stages[worst], float(variances.sum())
    dominates = total > LARGE_ERROR**2 and variances[worst] > LARGE_SHARE * total
    if dominates and not _collapsed(stage, nwalkers, ndim):
        if worst == 0:
            cause = (
                "few draws of the prior have a likelihood above zero. Fix the runs that fail, narrow the prior or use"
            )
        else:
            cause = "the likelihood decreases steeply there. Use a larger ess_ratio or"
        message = (
            f"stage {worst + 1} (beta = {stage.beta:.3g}) dominates the error of the evidence: its effective sample "
            f"size is {stage.effective_sample_size:.2g} of {nwalkers}, which alone gives the log-evidence a standard "
            f"error of {np.sqrt(variances[worst]):.2f}; {cause} more walkers"
        )
        doubts.append(Doubt(message, False))
    return doubts


def check_evidence(log_evidence: float, error: float, check: EvidenceCheck) -> list[Doubt]:
    """Doubts if the independent estimate of the evidence is unusable or differs from that of the stages.

    They differ if a reliable check is more than three joint errors away, or any check more than 1. The second rule
    finds posteriors with heavy tails, whose weights are never reliable and whose tails the moves do not reach, and runs
    with too few walkers for their parameters, in which the errors of the stages accumulate.

    Parameters
    ----------
    log_evidence, error : float
        Log-evidence of the stages and its standard error.
    check : EvidenceCheck
        The independent estimate.

    Returns
    -------
    list of Doubt
    """
    difference, joint = abs(log_evidence - check.log_evidence), float(np.hypot(error, check.error))
    both = (
        f"the stages give the log-evidence {log_evidence:.2f} +- {error:.2f}, importance sampling from the final "
        f"points gives {check.log_evidence:.2f} +- {check.error:.2f}"
    )
    if check.reliable and difference > 3.0 * joint + 1e-6:
        message = (
            f"{both}. The posterior may still be right. Use more walkers or more moves for the evidence. Where "
            "log_prior is a function of your own, check that it is normalised: only the second estimate depends on this"
        )
        return [Doubt(message, False)]
    if not check.reliable and difference > LARGE_DIFFERENCE:
        message = (
            f"{both}, and the weights of the second estimate are uneven (effective sample size "
            f"{check.effective_sample_size:.2g} of {check.evaluations}, Pareto shape {check.pareto_shape:.2f}). Either "
            "the errors of the stages have accumulated, as with many parameters and few walkers, or the posterior has "
            "heavier tails or more modes than the final points show. Evidence, means and standard deviations may be "
            "wrong by more than their errors. Use more walkers and more moves (min_moves, max_moves), and compare two "
            "runs. Where log_prior is a function of your own, check that it is normalised"
        )
        return [Doubt(message, True)]
    if not check.reliable and check.effective_sample_size < LOW_YIELD * check.evaluations:
        message = (
            f"no mixture fits the final points: {check.evaluations} draws from the best one have an effective sample "
            f"size of {check.effective_sample_size:.2g}, so evidence and posterior could not be checked. Use more "
            "walkers or more moves, and compare two runs"
        )
        return [Doubt(message, False)]
    return []


def check_fallback(
    stages: Sequence[Stage], check: EvidenceCheck | None, log_evidence: float, error: float, earlier: EvidenceCheck
) -> list[Doubt]:
    """A doubt if annealing by moves lost a part of the posterior that recycling before it had found.

    Recycling that could not be trusted may still have found more modes. Both of its estimates of the evidence must
    exceed that of the moves: the one of their check if that is reliable, else that of the stages.

    Parameters
    ----------
    stages : sequence of Stage
        All stages of the annealing by moves.
    check : EvidenceCheck, optional
        The check after it.
    log_evidence, error : float
        Log-evidence of the recycling and its standard error.
    earlier : EvidenceCheck
        The check of the recycling.

    Returns
    -------
    list of Doubt
    """
    now, own = sum(stage.log_evidence_increment for stage in stages), stages[-1].log_evidence_error
    if check is not None and check.reliable:
        now, own = check.log_evidence, check.error
    excess = min(log_evidence, earlier.log_evidence) - now
    if excess <= max(3.0 * float(np.hypot(own, max(error, earlier.error))), LOST_EVIDENCE):
        return []
    message = (
        f"annealing by moves gives the log-evidence {now:.2f} +- {own:.2f}, and recycling before it, which could not "
        f"be trusted, gave {log_evidence:.2f} and {earlier.log_evidence:.2f}: the moves may have lost a mode. Use more "
        "walkers, so that recycling can be trusted, and compare two runs"
    )
    return [Doubt(message, True)]


def fits_poorly(check: EvidenceCheck, mixture: Mixture, points: int) -> bool:
    """Whether fresh draws of a proposal yield less than 85 % of what is usual for Gaussian modes.

    The parameters are those of `check_fit`.
    """
    found, expected = _yields(check, mixture, points)
    return found < POOR_FIT * expected


def _yields(check: EvidenceCheck, mixture: Mixture, points: int) -> tuple[float, float]:
    """Effective share of the draws of a check, and the one expected for Gaussian modes."""
    components, ndim = mixture.means.shape
    expected = expected_yield(ndim, mixture.dof, components, points)
    return check.effective_sample_size / max(check.evaluations, 1), expected


def check_fit(
    check: EvidenceCheck, mixture: Mixture, points: int, coords: np.ndarray, log_weights: np.ndarray
) -> list[Doubt]:
    """A doubt if the proposal of recycling at beta = 1 describes the posterior poorly.

    Where a bent posterior ends in a narrow tail, neither the points nor the draws of a proposal fitted to them reach
    the end of the tail, and their weights are even. The effective sample size of the draws is then still smaller than
    expected for Gaussian modes (`samplers.tempering.evidence_check.expected_yield`), and the weights of neighbouring
    draws are alike. Where a likelihood with large jumps makes the weights uneven, they are not. In between, the cause
    may be either, and the doubt is not grave.

    Parameters
    ----------
    check : EvidenceCheck
        The check with fresh draws of the proposal.
    mixture : Mixture
        The proposal.
    points : int
        Effective number of points that it was fitted to.
    coords, log_weights : (n, ndim) float, (n,) float
        Draws at beta = 1 and their log-weights; those of the check are the last ones.

    Returns
    -------
    list of Doubt
    """
    if not fits_poorly(check, mixture, points):
        return []
    found, expected = _yields(check, mixture, points)
    yields = (
        f"fresh draws have an effective sample size of {100 * found:.2g} % of their number, and {100 * expected:.2g} % "
        "are usual for Gaussian modes"
    )
    if _neighbour_correlation(coords, log_weights) < SMOOTH_WEIGHTS:
        last = slice(-check.evaluations, None)
        if _neighbour_correlation(coords[last], log_weights[last]) < ROUGH_WEIGHTS:
            return []
        message = (
            f"{yields}. Either the likelihood has small jumps, which do no harm, or the posterior is bent, or has "
            "tails, in a way that its approximation does not follow, and standard deviations are too small. Compare "
            "with more walkers, or with recycle=False"
        )
        return [Doubt(message, False)]
    message = (
        f"the posterior is bent, or has tails, in a way that its approximation does not follow: {yields}. "
        "Ends of the posterior may be missing, so standard deviations may be too small and the errors "
        "of means and evidence too optimistic. Use more walkers, or recycle=False, and compare"
    )
    return [Doubt(message, True)]


def _neighbour_correlation(coords: np.ndarray, log_weights: np.ndarray) -> float:
    """Correlation of log-weights (n,) with the mean of those of the three nearest points, in whitened parameters."""
    possible = log_weights > -np.inf
    weights = np.where(possible, np.exp(log_weights - log_weights.max()), 0.0)
    _, root = location_and_root(coords, weights / weights.sum())
    white, values = coords[possible] @ invert_roots(root[None])[0].T, log_weights[possible]
    values = np.maximum(values, np.quantile(values, 0.02))  # draws far out in the tails have any log-weight
    _, nearest = cKDTree(white).query(white, k=NEIGHBOURS + 1)
    return float(np.corrcoef(values, values[nearest[:, 1:]].mean(axis=1))[0, 1])
