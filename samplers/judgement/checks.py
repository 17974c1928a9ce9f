"""What is found about runs that ended without an error but whose result may be wrong: evidences or shares that
disagree. How often each check speaks in wrong runs and in right ones is in ``docs/results``.
"""

from collections.abc import Callable

import numpy as np

from ..estimates.genealogy import standard_error_of_mean
from ..estimates.importance import LARGEST_ERROR, EvidenceCheck
from ..finding import CARE, WRONG, Finding
from ..proposals.mixture import Mixture, log_responsibilities
from ..reports import AnnealingResult
from .clusters import find_members

# Difference of the two log-evidences, from 1619 right and 297 wrong runs (docs/results). The limit is soft, as
# `LARGEST_ERROR`: with one of the 33 targets left out they wander from 0.8 to 1.5 and from 0.3 to 0.45.
LARGE_DIFFERENCE = 1.0
# The same from a check with even weights: 7 of 19 such runs were wrong, 14 had standard deviations off by a fifth.
TRUSTED_DIFFERENCE = 3.0
# Log-likelihoods are equal if they differ by less than this share of their size, the rounding error of 1e4 terms.
ROUNDING = 1e-12
# Error of the logarithm of a volume: it spoke in 440 of 440 starts of 11 box priors of 0, in none of 720 right ones.
VOLUME_ERROR = 0.5
# Smallest difference between two shares of a component that is reported if it is also significant: in 38 wrong and 25
# right of 1158 runs, and in 38 and 34 without it.
LARGE_SHARE_DIFFERENCE = 0.1
# A number of a finding that is an error of shares. Where it speaks in 72 runs of TMCMC, the shares of 18 modes are
# off by 0.75 stated errors (root mean square), and by 3.7 without this number.
OF_SHARES = "difference of shares"


def check_likelihood(log_prob: np.ndarray, log_prior: np.ndarray) -> list[Finding]:
    """A finding if the log-likelihood has one value at all points (n,) that a run begins with: it tells nothing. Beside
    -inf, one value may be right, of uniform errors, which is not severe; a value of 0 is an indicator.
    """
    known = np.isfinite(log_prob)
    if np.count_nonzero(known) < 2:
        return []
    values = log_prob[known] - log_prior[known]
    error = ROUNDING * (1.0 + np.abs([log_prob[known], log_prior[known]]).max())
    if np.ptp(values) > error or (not known.all() and np.abs(values).max() <= error):
        return []
    text = (
        f"The log-likelihood is {values[0]:.6g} at all {len(values)} points that the run began with and that neither "
        "failed nor have -inf: it is a penalty in place of a failure, or the model ignores its parameters, or the data "
        "are not used. The result is the prior, and a posterior elsewhere was not found."
    )
    action = (
        "Look at responses to a few draws of the prior; let failed simulations raise an exception or return NaN, and "
        "narrow the prior to where the model works. Beside -inf, one value may be right, of uniform errors."
    )
    return [Finding("The likelihood tells nothing", WRONG if known.all() else CARE, text, action)]


def check_prior(coords: np.ndarray, log_prior: np.ndarray) -> list[Finding]:
    """A finding if the log-prior is 0 at all draws of the prior (n, ndim), and the volume that they fill is not 1."""
    n, sides = len(coords), np.ptp(coords, axis=0)
    if n < 2 or np.any(log_prior != 0.0) or np.any(sides == 0.0):
        return []
    log_volume = float(np.sum(np.log(sides * (n + 1) / (n - 1))))  # uniform draws leave two of n + 1 parts of each side
    if abs(log_volume) < VOLUME_ERROR:
        return []
    text = (
        "The log-prior is 0 at all points that the run began with, which fill a box with a volume of about "
        f"{np.exp(log_volume):.2g}: it is not normalised. The samples are right, and the log-evidence is off by about "
        f"{log_volume:+.2g}."
    )
    return [Finding("The prior is not normalised", CARE, text, "Return -log(volume) inside the bounds instead of 0.")]


def check_evidence(
    log_evidence: float, error: float, check: EvidenceCheck | None, several: Callable[[], bool]
) -> list[Finding]:
    """Findings if the two estimates of the evidence disagree, or if its error is large; limits from 1916 known runs.
    `several()` says whether there are several modes, asked for only where it matters.
    """
    found, believed = [], check is not None and check.reliable
    difference = 0.0 if check is None else abs(log_evidence - check.log_evidence)
    if difference > (TRUSTED_DIFFERENCE if believed else LARGE_DIFFERENCE):
        text = (
            f"The stages give the log-evidence {log_evidence:.2f} +- {error:.2f}, importance sampling from the final "
            f"points gives {check.log_evidence:.2f} +- {check.error:.2f} (effective sample size "
            f"{check.effective_sample_size:.2g} of {check.evaluations}, Pareto shape {check.pareto_shape:.2f}). Means "
            "and standard deviations may be wrong by more than their errors too, as with many parameters and few "
            "walkers, heavy tails, or modes that the final points do not show."
        )
        action = (
            "Use more walkers or more moves (min_moves, max_moves), and compare two runs. Where log_prior is a "
            "function of your own, check that it is normalised."
        )
        found.append(Finding("The two estimates of the evidence differ", CARE if believed else WRONG, text, action))
    stated = min(error, check.error) if believed else error
    if stated > LARGEST_ERROR:
        text = f"The standard error of the log-evidence is {stated:.2g}."
        found.append(Finding("The evidence is rough", CARE, text, "Use more walkers."))
    elif error > LARGEST_ERROR and several():
        # errors of shares tell less: a mode that has lost points has a small share and a small error. With a limit of
        # these, 16 of 29 wrong shares were silent, now 7
        text = f"The standard error of the log-evidence of the stages is {error:.2g}: shares of modes may be wrong."
        found.append(Finding("The shares of the modes are rough", CARE, text, "Use more walkers."))
    return found


def check_end(result: AnnealingResult, coords: np.ndarray) -> list[Finding]:
    """Findings about the estimates of the evidence at the end, with the final points (n, ndim)."""
    weighted = result.weighted
    if weighted is not None and weighted.points and weighted.ended:
        return []  # its points are judged by their weights
    stages = result.log_evidence_ladder, result.ladder[-1].log_evidence_error
    return check_evidence(*stages, result.check, lambda: find_members(coords[None]).shape[1] > 1)


def check_shares(
    mixture: Mixture, points: np.ndarray, founders: np.ndarray, coords: np.ndarray, weights: np.ndarray
) -> list[Finding]:
    """A finding if a component of the `mixture` of the draws has different shares among final points (n, ndim) and
    draws (m, ndim) with `weights` of sum 1, which cover points of earlier stages too.
    """
    of_draws = np.exp(log_responsibilities(mixture, coords))
    of_points = np.exp(log_responsibilities(mixture, points))
    expected, found = weights @ of_draws, of_points.mean(axis=0)
    error = np.sqrt(weights**2 @ (of_draws - expected) ** 2)
    error = np.hypot(error, standard_error_of_mean(of_points[None], founders))
    difference = np.abs(found - expected)
    wrong = difference > np.maximum(LARGE_SHARE_DIFFERENCE, 3.0 * error)
    if not wrong.any():
        return []
    worst = int(np.argmax(np.where(wrong, difference, 0.0)))
    text = (
        f"A part of the posterior has the share {found[worst]:.2f} among the final points and {expected[worst]:.2f} "
        f"+- {error[worst]:.2f} among weighted draws from all parts that any stage has seen: a mode has been lost or "
        "has a wrong weight."
    )
    numbers = {OF_SHARES: float(difference[worst])}
    return [Finding("A mode may be lost", CARE, text, "Use more walkers or more moves, and compare two runs.", numbers)]
