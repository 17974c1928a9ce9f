"""Whether weighted draws are trusted: the check of recycling, and the rounds of a guide.

Their limits are stated here, and the reasons that a user reads when one is exceeded.
"""

from collections.abc import Sequence

import numpy as np

from ..estimates.importance import EvidenceCheck, KnownDensity, PooledRounds, Round
from ..estimates.pareto import LARGEST_SHAPE
from ..finding import Finding

# Recycling is given up when the mean efficiency of the last 6 rounds is smaller than 0.03 (moves then need fewer
# evaluations).
SMALLEST_EFFICIENCY, PATIENCE = 0.03, 6
# Reliable rounds, and the check of recycling, have at least this effective share, the latest round and the mean of
# three, and the latest one a Pareto shape below this value, for which the variance of its weights is finite. By the
# latest one alone, a cyclic test whose response has jumps was converged and wrong by 3.5 errors.
RELIABLE_SHARE, LARGEST_RELIABLE_SHAPE = 0.25, 0.5
# After the last round of a guide, the draws are used even if no round was reliable, provided that the last round has at
# least this effective share, all rounds together have an effective sample size equal to the number of walkers, and the
# Pareto shape of their weights is below 0.7. Draws of the emulated posterior itself had 0.01 to 0.07 in 10 of 10 runs
# on bananas in 10 to 12 dimensions that were too narrow, 0.12 and more in about 40 right runs with 2 to 30 parameters.
USABLE_SHARE = 0.1
# Rounds go on while more than this share of the guide's latest known density is hardly reached by the draws of all of
# them, or was not in the known density before; the result is not usable if that is so at the end. A smaller share that
# is hardly reached is an error of the log-evidence. Without the first, 1 of 10 ridges E h^3 is wrong (log Z off by .09
# with an error of .015), without the second another 1 of 21 (.23, .015); with both none of 21.
LARGEST_UNREACHED = 0.03
UNSETTLED = (
    "the posterior is larger than its draws: the density that the guide emulates has grown to the end, as along a "
    "ridge of parameters that the data do not tell apart, or the response is rough. Evidence and standard deviations "
    "may be wrong by far more than their errors. Fix one of such parameters, or make their product the parameter; a "
    "larger limit of simulations may suffice"
)
LIGHT_TAILS = (
    "the weights of the draws grow towards the tails: the tails of the guide are lighter than the posterior's, so "
    "standard deviations may be too small. Give the draws of the guide heavier tails, or use no guide"
)


def find_unreached_part(text: str, severity: str) -> Finding:
    """A finding about draws of a guide that hardly reached a part of the posterior."""
    return Finding("The guide missed a part of the posterior", severity, f"{text[0].upper()}{text[1:]}.")


def doubt_recycling(check: EvidenceCheck | None, efficiencies: list[float]) -> str:
    """Reason to give up, or not to use the result; empty if there is none."""
    recent = float(np.mean(efficiencies[-PATIENCE:]))
    if len(efficiencies) >= PATIENCE and recent < SMALLEST_EFFICIENCY:
        return f"the effective sample size of fresh draws is {100 * recent:.2g} % of their number"
    if check is None:
        return ""
    if not check.reliable:
        return f"the weights of fresh draws have a Pareto shape of {check.pareto_shape:.2g}"
    if efficiencies[-1] < RELIABLE_SHARE:
        return f"the effective sample size of the check is {100 * efficiencies[-1]:.2g} % of their number"
    return ""


def is_reliable(rounds: Sequence[Round]) -> bool:
    """Whether fresh rounds show that the guide describes the posterior."""
    shares = [each.effective_share for each in rounds[-3:]]
    return min(shares[-1], np.mean(shares)) >= RELIABLE_SHARE and rounds[-1].pareto_shape < LARGEST_RELIABLE_SHAPE


def is_even(pooled: PooledRounds) -> bool:
    """Whether the pooled result does not depend on a few weights: that the shape permits a useful mean is enough, since
    early rounds of a poor guide have heavy-tailed weights but a small share.
    """
    return pooled.pareto_shape < LARGEST_SHAPE and bool(np.isfinite(pooled.log_evidence_error))


def grown(pooled: PooledRounds, before: KnownDensity | None, latest: KnownDensity | None) -> float:
    """Share of the guide's latest known density by which it is larger than the one before.

    At the draws both follow the posterior, so that their normalised densities differ by what one of them lacks.
    """
    if before is None or latest is None:
        return 0.0
    coords = pooled.coords[pooled.log_weights > -np.inf]
    apart = before.log_density(coords) - latest.log_density(coords)
    return 1.0 - float(np.exp(-max(np.median(apart[np.isfinite(apart)]), 0.0)))


def all_impossible(rounds: Sequence[Round]) -> bool:
    """Whether no draw has a finite log-probability: the guide is given up after two such rounds. A small effective
    share is no reason: of 4 runs of a tested column, 3 had less than 5 % in 4 rounds, and ended right.
    """
    return all(np.max(r.log_weights) == -np.inf for r in rounds)


def describe_rounds(last: Round, pooled: PooledRounds, made: int) -> str:
    """Text on what the rounds have reached, and what is missing."""
    return (
        f"after {made} rounds, the effective sample size of fresh draws is "
        f"{100 * last.effective_share:.2g} % of their number with a Pareto shape of {last.pareto_shape:.2g}, and the "
        f"effective sample size of all draws is {pooled.effective_sample_size:.0f} with a shape of "
        f"{pooled.pareto_shape:.2g} (a share of at least {100 * RELIABLE_SHARE:g} %, as many effective draws as "
        f"walkers, and shapes below {LARGEST_RELIABLE_SHAPE:g} are needed)"
    )
