"""Concerns about runs that ended without an error but whose result may be wrong.

Collapsed populations, moves that are rejected or too few, one stage that dominates the error, a poor fit, and evidences
or shares that disagree. Each check is a function of stages and arrays that returns a list of concerns.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from ..estimates.genealogy import standard_error_of_mean
from ..estimates.importance import EvidenceCheck, efficiencies, fits_poorly
from ..estimates.weights import LOWEST, normalised_weights
from ..proposals.mixture import Mixture, invert_roots, location_and_root, log_responsibilities
from ..reports import Concern, Stage
from .clusters import find_clusters

__all__ = [
    "check_agreement",
    "check_annealing",
    "check_evidence",
    "check_fallback",
    "check_fit",
    "check_guide_against_recycling",
    "check_likelihood",
    "check_mode_shares",
    "check_shares",
    "check_stages",
    "describe_unused_guide",
]

LOW_ACCEPTANCE = 0.01
LOW_EFFICIENCY = 0.05
# runs with right answers ended with correlations of up to 0.8, TMCMC as published with 0.98 and more
HIGH_CORRELATION = 0.9
# Two modes in 11 dimensions, 100 to 250 walkers: shares of the modes that are wrong by 0.06 to 0.3 ended with 0.3 to
# 0.98. Modes that the moves connect ended with 0.16 at most. A mode with few walkers is not found among them, so that
# higher correlations count by themselves.
SEPARATE_MODES, ANY_MODES = 0.25, 0.5
LARGE_ERROR = 0.35
LARGE_SHARE = 0.8
# Difference of two log-evidences that is reported even if the error of the second log-evidence is not known.
LARGE_DIFFERENCE = 1.0
# Log-evidence of recycling minus log-evidence of the moves after it, above which a mode may be lost: a mode with a
# quarter of the mass.
LOST_EVIDENCE = 0.3
# Correlation of log-weights with the log-weights of the nearest points, below which jumps of the likelihood explain a
# poor efficiency: 0.2 to 0.44 with jumps of standard deviation 1, 0.44 to 0.56 for Gaussian modes with the chance
# errors of a fit, and 0.7 to 0.97 for bent posteriors.
SMOOTH_WEIGHTS = 0.6
# The same among the draws of the check alone, below which jumps are the only cause: -0.07 to 0.18 with jumps of
# standard deviation 1 in 3 and 10 dimensions, 0.22 to 0.66 with jumps of 0.5 to 0.6, and 0.34 to 0.48 for heavy tails
# in 10 dimensions, where the nearest points are far away.
ROUGH_WEIGHTS = 0.25
NEIGHBOURS = 3
# Log-likelihoods are equal if they differ by less than this share of their size, the rounding error of a sum of 1e4
# terms. With 1e-9, right runs with a log-likelihood of 1e11 and a range of 100 were refused.
ROUNDING = 1e-12
# Smallest difference between two shares of a component that is reported if it is also significant.
LARGE_SHARE_DIFFERENCE = 0.1
# Differences of evidences and shares, and of means in many parameters, are reported beyond this many standard errors.
FAR, FAR_MEANS = 3.0, 4.0
ADVICE = (
    "The result contains what all runs have found. Where one run has lost a part of the posterior, all of them may "
    "have lost another: use more walkers"
)


class WeightedRun(Protocol):
    """Weighted draws (n, ndim) of the posterior with log-weights (n,), and the log-evidence with its standard error."""

    coords: np.ndarray
    log_weights: np.ndarray
    log_evidence: float
    log_evidence_error: float


def _collapsed(stage: Stage, nwalkers: int, ndim: int) -> bool:
    return stage.distinct_ancestors < max(ndim + 2, nwalkers // 50)


def check_likelihood(log_prob: np.ndarray, log_prior: np.ndarray) -> list[Concern]:
    """A concern if the log-likelihood has one value at all points that a run begins with, so that it tells nothing.

    The posterior is then the prior, or it is where none of these points is, and the value is a penalty or comes from a
    model that ignores its parameters. Beside -inf, one value may be the likelihood of uniform errors, which is right,
    or a penalty: the concern is not grave; for a value of 0, an indicator, there is none.

    Parameters
    ----------
    log_prob, log_prior : (n,) float
        Log-probabilities and log-priors of the first evaluated points, which are draws of the prior or of a guide.
    """
    known = np.isfinite(log_prob)
    if np.count_nonzero(known) < 2:
        return []
    values = log_prob[known] - log_prior[known]
    error = ROUNDING * (1.0 + np.abs([log_prob[known], log_prior[known]]).max())
    if np.ptp(values) > error or (not known.all() and np.abs(values).max() <= error):
        return []
    others, indicator = "", ""
    if not known.all():
        others = f" (the other {len(known) - len(values)} failed or have -inf)"
        indicator = " If errors are uniform, such a likelihood is right, and so is the result."
    message = (
        f"the log-likelihood is {values[0]:.6g} at all {len(values)} points that the run began with{others}: it is a "
        "penalty in place of a failure, or the model ignores its parameters, or the data are not used. The result is "
        "the prior, and a posterior elsewhere was not found. Look at responses to a few draws of the prior; let failed "
        f"simulations raise an exception or return NaN, and narrow the prior to where the model works.{indicator}"
    )
    return [Concern(message, bool(known.all()))]


def check_stages(stages: Sequence[Stage], nwalkers: int, ndim: int) -> list[Concern]:
    """Concerns if the last stage is collapsed or stuck, and no earlier stage was.

    Collapsed: the distinct points that survived the resampling are fewer than 2 % of the walkers, or too few to span
    the parameters. Stuck: less than 1 % of the proposals were accepted.
    """
    stage, number, concerns = stages[-1], len(stages), []
    collapsed = [_collapsed(s, nwalkers, ndim) for s in stages]
    stuck = [s.acceptance < LOW_ACCEPTANCE for s in stages]
    if collapsed[-1] and not any(collapsed[:-1]):
        message = (
            f"collapse at stage {number} (beta = {stage.beta:.3g}): only {stage.distinct_ancestors} distinct points of "
            f"{nwalkers} survived the resampling. Use more walkers, more moves or a larger ess_ratio"
        )
        concerns.append(Concern(message, True))
    if stuck[-1] and not any(stuck[:-1]):
        message = (
            f"stuck at stage {number} (beta = {stage.beta:.3g}): {100 * stage.acceptance:.2g} % of the proposals were "
            "accepted, so the points did not move. Use other moves or more of them"
        )
        concerns.append(Concern(message, True))
    return concerns


def check_annealing(stages: Sequence[Stage], nwalkers: int, ndim: int, correlation: float) -> list[Concern]:
    """Concerns if annealing by moves ended with points that had not moved enough, or if one stage dominates the error.

    Not moved enough: the largest correlation of the final population with its resampled start, `correlation`, is above
    0.9. Not reported if `check_stages` found the moves stuck.

    One dominant stage: its weights alone give the log-evidence a standard error of 0.35 or more, and at least 0.8 of
    the total variance. This happens if beta could not be chosen freely, for example because most draws of the prior
    have zero likelihood. Not reported for a collapsed stage.
    """
    concerns = []
    if correlation > HIGH_CORRELATION and not any(s.acceptance < LOW_ACCEPTANCE for s in stages):
        message = (
            f"the moves at beta = {stages[-1].beta:.3g} were too short: particles are still correlated "
            f"({correlation:.2f}) with their resampled start, so copies have not separated, and modes keep the weights "
            "that the resampling gave them. Use more moves (max_moves, burn_in) or longer ones"
        )
        concerns.append(Concern(message, True))
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
        concerns.append(Concern(message, False))
    return concerns


def check_mode_shares(coords: np.ndarray, founders: np.ndarray, correlation: float) -> list[Concern]:
    """A concern if the moves hardly connect modes that exist or may exist, so that the shares of modes are uncertain.

    All resamplings since the modes separated have changed the shares; the founders show only the latest resamplings.

    Parameters
    ----------
    coords : (n, ndim) float
        The final points.
    founders : (n,) int
        Their founders.
    correlation : float
        Largest correlation of the final points with their resampled start. Reported between 0.5 and 0.9, or between
        0.25 and 0.9 with several modes.
    """
    if not SEPARATE_MODES < correlation <= HIGH_CORRELATION:
        return []
    if correlation <= ANY_MODES and len(find_clusters(coords[None], founders)) == 1:
        return []
    message = (
        f"the walkers are still correlated ({correlation:.2f}) with their resampled start: the shares of separate "
        "modes, and with them the means, may be wrong by more than their errors. Use more walkers, recycling, or more "
        "moves (max_moves, burn_in)"
    )
    return [Concern(message, False)]


def check_evidence(log_evidence: float, error: float, check: EvidenceCheck) -> list[Concern]:
    """Concerns if the check of the evidence is unusable or differs from `log_evidence` +- `error` of the stages.

    They differ if a reliable check is more than three joint errors away, or any check more than 1. The second rule
    finds posteriors with heavy tails, whose weights are never reliable and whose tails the moves do not reach, and runs
    with too few walkers for their parameters, in which the errors of the stages accumulate.
    """
    difference, joint = abs(log_evidence - check.log_evidence), float(np.hypot(error, check.error))
    both = (
        f"the stages give the log-evidence {log_evidence:.2f} +- {error:.2f}, importance sampling from the final "
        f"points gives {check.log_evidence:.2f} +- {check.error:.2f} (log_evidence is the one with the smaller error)"
    )
    if check.reliable and difference > 3.0 * joint + 1e-6:
        message = (
            f"{both}. The posterior may still be right. Use more walkers or more moves for the evidence. Where "
            "log_prior is a function of your own, check that it is normalised: only the second estimate depends on this"
        )
        return [Concern(message, False)]
    if not check.reliable and difference > LARGE_DIFFERENCE:
        message = (
            f"{both}, and the weights of the second estimate are uneven (effective sample size "
            f"{check.effective_sample_size:.2g} of {check.evaluations}, Pareto shape {check.pareto_shape:.2f}). Either "
            "the errors of the stages have accumulated, as with many parameters and few walkers, or the posterior has "
            "heavier tails or more modes than the final points show. Evidence, means and standard deviations may be "
            "wrong by more than their errors. Use more walkers and more moves (min_moves, max_moves), and compare two "
            "runs. Where log_prior is a function of your own, check that it is normalised"
        )
        return [Concern(message, True)]
    if not check.reliable and check.effective_sample_size < LOW_EFFICIENCY * check.evaluations:
        message = (
            f"no mixture fits the final points: {check.evaluations} draws from the best one have an effective sample "
            f"size of {check.effective_sample_size:.2g}, so evidence and posterior could not be checked. Use more "
            "walkers or more moves, and compare two runs"
        )
        return [Concern(message, False)]
    return []


def check_fallback(
    stages: Sequence[Stage], check: EvidenceCheck | None, log_evidence: float, error: float, earlier: EvidenceCheck
) -> list[Concern]:
    """A concern if annealing by moves lost a part of the posterior that recycling before it had found.

    Recycling may have found more modes although its result was not reliable. Both evidence estimates of recycling must
    exceed the evidence of the moves: the estimate of their check if it is reliable, else of their stages.

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
    """
    now, own = sum(stage.log_evidence_increment for stage in stages), stages[-1].log_evidence_error
    if check is not None and check.reliable:
        now, own = check.log_evidence, check.error
    excess = min(log_evidence, earlier.log_evidence) - now
    if excess <= max(3.0 * float(np.hypot(own, max(error, earlier.error))), LOST_EVIDENCE):
        return []
    message = (
        f"annealing by moves gives the log-evidence {now:.2f} +- {own:.2f}, and recycling before it, which was not "
        f"reliable, gave {log_evidence:.2f} and {earlier.log_evidence:.2f}: the moves may have lost a mode. Use more "
        "walkers, so that recycling is reliable, and compare two runs"
    )
    return [Concern(message, True)]


def check_fit(
    check: EvidenceCheck, mixture: Mixture, points: int, coords: np.ndarray, log_weights: np.ndarray
) -> list[Concern]:
    """A concern if the proposal of recycling at beta = 1 describes the posterior poorly.

    If a bent posterior ends in a narrow tail, neither the points nor the draws of a fitted proposal reach the end of
    the tail, and their weights are even. The effective sample size is then still smaller than expected for Gaussian
    modes (`samplers.estimates.importance.expected_efficiency`), and neighbouring draws have similar weights. Large
    jumps of a likelihood, in contrast, make the weights of neighbours differ. Between these cases the cause is
    uncertain, and the concern is not grave.

    Parameters
    ----------
    check : EvidenceCheck
        The check with fresh draws of the proposal.
    mixture : Mixture
        The proposal.
    points : int
        Effective number of points that it was fitted to.
    coords, log_weights : (n, ndim) float, (n,) float
        Draws at beta = 1 and their log-weights; the draws of the check come last.
    """
    if not fits_poorly(check, mixture, points):
        return []
    found, expected = efficiencies(check, mixture, points)
    efficiency = (
        f"fresh draws have an effective sample size of {100 * found:.2g} % of their number, and {100 * expected:.2g} % "
        "are usual for Gaussian modes"
    )
    if _neighbour_correlation(coords, log_weights) < SMOOTH_WEIGHTS:
        last = slice(-check.evaluations, None)
        if _neighbour_correlation(coords[last], log_weights[last]) < ROUGH_WEIGHTS:
            return []
        message = (
            f"{efficiency}. Either the likelihood has small jumps, which do no harm, or the posterior is bent, or has "
            "tails, in a way that its approximation does not follow, and standard deviations are too small. Compare "
            "with more walkers, or with recycle=False"
        )
        return [Concern(message, False)]
    message = (
        f"the posterior is bent, or has tails, in a way that its approximation does not follow: {efficiency}. "
        "Ends of the posterior may be missing, so standard deviations may be too small and the errors "
        "of means and evidence too optimistic. Use more walkers, or recycle=False, and compare"
    )
    return [Concern(message, True)]


def _neighbour_correlation(coords: np.ndarray, log_weights: np.ndarray) -> float:
    """Correlation of log-weights (n,) with their mean over the three nearest points, in whitened parameters."""
    possible = log_weights > LOWEST
    weights = np.where(possible, np.exp(log_weights - log_weights.max()), 0.0)
    _, root = location_and_root(coords, weights / weights.sum())
    white, values = coords[possible] @ invert_roots(root[None])[0].T, log_weights[possible]
    values = np.maximum(values, np.quantile(values, 0.02))  # draws far out in the tails have any log-weight
    _, nearest = cKDTree(white).query(white, k=NEIGHBOURS + 1)
    return float(np.corrcoef(values, values[nearest[:, 1:]].mean(axis=1))[0, 1])


def check_shares(
    mixture: Mixture, points: np.ndarray, founders: np.ndarray, coords: np.ndarray, log_weights: np.ndarray
) -> list[Concern]:
    """A concern if a part of the posterior has different shares among the final points and among weighted draws.

    The parts are the components of the mixture that the draws come from. Each draw and each point counts for the
    components by its responsibilities. A difference is reported if it exceeds 0.1 and three standard errors.

    Parameters
    ----------
    mixture : Mixture
        Proposal of the draws, which also covers points of earlier stages.
    points : (n, ndim) float
        The final points, equally weighted.
    founders : (n,) int
        Their founders (`samplers.estimates.genealogy`).
    coords, log_weights : (m, ndim) float, (m,) float
        Draws of the mixture and their log-weights.
    """
    if len(mixture.weights) == 1 or not np.any(log_weights > -np.inf):
        return []
    weights = normalised_weights(log_weights)
    of_draws = np.exp(log_responsibilities(mixture, coords))
    of_points = np.exp(log_responsibilities(mixture, points))
    expected, found = weights @ of_draws, of_points.mean(axis=0)
    error = np.hypot(
        np.sqrt(weights**2 @ (of_draws - expected) ** 2),
        standard_error_of_mean(of_points[None], founders),
    )
    difference = np.abs(found - expected)
    wrong = difference > np.maximum(LARGE_SHARE_DIFFERENCE, 3.0 * error)
    if not wrong.any():
        return []
    worst = int(np.argmax(np.where(wrong, difference, 0.0)))
    message = (
        f"a part of the posterior has the share {found[worst]:.2f} among the final points and {expected[worst]:.2f} "
        f"+- {error[worst]:.2f} among weighted draws from all parts that any stage has seen: a mode has been lost or "
        "has a wrong weight. Use more walkers or more moves, and compare two runs"
    )
    return [Concern(message, True)]


def check_agreement(runs: Sequence[WeightedRun], mixture: Mixture, inherited: float) -> list[Concern]:
    """A concern if runs differ in the evidence, in the share of a posterior part, or in a mean.

    Parameters
    ----------
    runs : sequence of WeightedRun
        The runs, each with weighted draws made at beta = 1.
    mixture : Mixture
        Mixture that was fitted to all points; its components are the parts.
    inherited : float
        Variance of the log-evidence from the weights by which the proposals of a run were chosen: one over their
        effective sample size.

    Returns
    -------
    list of Concern
        Empty, or the most serious difference: of a share, else of the evidence, else of a mean.
    """
    shares, share_errors, means, mean_errors = [], [], [], []
    for run in runs:
        weights = normalised_weights(run.log_weights)
        parts = np.exp(log_responsibilities(mixture, run.coords))
        for values, centres, errors in ((parts, shares, share_errors), (run.coords, means, mean_errors)):
            centres.append(weights @ values)
            apart = (values - centres[-1]) ** 2
            errors.append(weights**2 @ apart + inherited * (weights @ apart))
    evidences = [run.log_evidence for run in runs]
    for a in range(len(runs)):
        for b in range(a + 1, len(runs)):
            name = f"the runs {a + 1} and {b + 1} of the annealing disagree"
            difference = np.abs(shares[a] - shares[b])
            limit = np.maximum(LARGE_SHARE_DIFFERENCE, FAR * np.sqrt(share_errors[a] + share_errors[b]))
            if np.any(difference > limit):
                k = int(np.argmax(np.where(difference > limit, difference, 0.0)))
                found = f"the share {shares[a][k]:.2f} in one and {shares[b][k]:.2f} in the other"
                return [Concern(f"{name}: a part of the posterior has {found}. {ADVICE}", True)]
            errors = np.array([runs[a].log_evidence_error, runs[b].log_evidence_error])
            if abs(evidences[a] - evidences[b]) > FAR * np.hypot(*errors):
                found = " and ".join(f"{evidences[k]:.2f} +- {runs[k].log_evidence_error:.2f}" for k in (a, b))
                return [Concern(f"{name}: their log-evidences are {found}. {ADVICE}", True)]
            difference = np.abs(means[a] - means[b]) / np.sqrt(mean_errors[a] + mean_errors[b])
            if np.any(difference > FAR_MEANS):
                k = int(np.argmax(difference))
                found = f"their means of parameter {k} differ by {difference[k]:.1f} standard errors"
                return [Concern(f"{name}: {found}. {ADVICE}", True)]
    return []


def check_guide_against_recycling(
    of_guide: float, error_of_guide: float, log_evidence: float, error: float
) -> list[Concern]:
    """A concern if the rounds of a guide and the recycling after them differ in the evidence: one has lost a part."""
    if abs(of_guide - log_evidence) <= FAR * float(np.hypot(error_of_guide, error)):
        return []
    message = (
        f"recycling gives the log-evidence {log_evidence:.2f} +- {error:.2f}, the draws of the guide before it give "
        f"{of_guide:.2f} +- {error_of_guide:.2f}: one of them has lost a part of the posterior. Use a better guide, or "
        "more walkers without one"
    )
    return [Concern(message, True)]


def describe_unused_guide(reason: str, impossible: bool) -> str:
    """The warning when the draws of a guide are not used; `impossible`: none has a finite log-probability."""
    if impossible:
        return (
            f"the draws of the guide are impossible ({reason}), so the run goes on without them, by annealing from the "
            "prior, which needs more simulations. Use a better guide, or none"
        )
    return (
        f"the draws of the guide are not close enough to the posterior ({reason}), so the run goes on by recycling, "
        "which starts from them and needs more simulations. Use a better guide, or none"
    )
