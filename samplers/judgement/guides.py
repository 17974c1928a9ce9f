"""Findings of guides: may a search, and the draws that follow from it, have missed a part of the posterior?"""

import numpy as np

from ..finding import CARE, WRONG, Finding
from .rounds import USABLE_SHARE

UNSEEN = "A part of the posterior may be missing"
# Counted in 102 searches with limits of 100 to 400 simulations, on eight posteriors with 1 to 10 known modes.
# Share of further starts that would lead to modes not seen yet, above which a search goes on: where several modes were
# found, it spoke in 21 of 21 searches that had lost one, and in 17 of 62 that had not. No limit refuses a result: 0.3
# spoke in 20 and 12.
DOUBTED_SHARE = 0.05
# Starts that have to end at one mode, if a search simulated short records. Fewer than six, on whole ones, spoke in 9 of
# 9 searches that had found one of several modes, and in 6 of 10 that had found the only one. A single one of several is
# no reason to refuse a result: with starts in the order drawn and limits of 200 and 400, it was left in 3 of 22
# searches that had lost one of two modes, and in 29 of 40 right ones of a model that fails in a third of the prior.
GROWN_STARTS = 2
# Log-density below the best of a probable simulation, and above the emulated one of a simulation that is excluded.
# On ridges E h^3 with uniform priors, 20 runs: 4 of 7 wrong runs, among them the 2 that change little from round to
# round, and none of 12 right ones; none of 40 right runs with other priors and on four problems. Of 10 right runs with
# jumps of the response by the noise and more, 2: no reason to refuse a result.
PROBABLE, EXCLUDED = 3.0, 4.0
# Log-density of the highest draw above the tops of all modes of a search, from which on these have no weight: 28 to 68
# in 9 of 11 searches that ended where the frequency of a vibration has no effect (6 of them had no other reason), 490
# and 506 on two ridges that are refused for others as well, at most 0.9 in 60 right runs on 22 problems, 6.4 on one.
HIGHER = 15.0


def find_missing_part(text: str, severity: str = CARE) -> Finding:
    """A finding of a guide about parts of the posterior that may be missing."""
    return Finding(UNSEEN, severity, f"The guide says: {text}.")


def check_ends(ended: int, made: int, starts: int, grown: bool) -> list[Finding]:
    """Whether half of the `starts` that were asked for led to the only mode; `grown`: on short parts of a record."""
    if ended == 0 or ended >= (GROWN_STARTS if grown else (starts + 1) // 2):
        return []
    text = (
        f"only {ended} of {made} starts led to the one mode that was found, the others were given up far below it: "
        f"{1.0 - 0.05 ** (1.0 / ended):.0%} of such starts may lead to modes that were not found. Use more starts; "
        "for histories, let a function take n_steps, so that short parts of the record are cheap"
    )
    return [find_missing_part(text)]


def check_tops(excess: float) -> list[Finding]:
    """Whether a draw is higher than every mode that the search found, by this log-density: then these are no modes."""
    if not excess > HIGHER:
        return []
    text = (
        f"a draw has a log-density {excess:.3g} above the top of every mode that the search found, so the search ended "
        "far below the modes, where responses hardly depend on the parameters. Use narrower priors or more starts"
    )
    return [find_missing_part(text, WRONG)]


def check_unseen_modes(share: float, ended: int, modes: int) -> list[Finding]:
    """Whether further starts are expected to lead to more than the modes that were found."""
    if share <= DOUBTED_SHARE:
        return []
    text = (
        f"{ended} starts ended at {modes} points, as on one flat ridge or in several modes; about {share:.0%} of "
        "further starts would end elsewhere, perhaps in modes not found yet: use more starts, or a larger limit"
    )
    return [find_missing_part(text)]


def check_draws_in_memory(effective_share: float) -> list[Finding]:
    """Whether the draws of an emulated posterior cover it, by the share of them that is effective."""
    if effective_share >= USABLE_SHARE:
        return []
    text = (
        "the emulated posterior is curved and its draws in memory cover it badly (their effective sample "
        f"size is {100.0 * effective_share:.2g} % of their number): standard deviations and tails may be too small, by "
        "much more than their stated errors. Compare with a run without a guide, or with another seed"
    )
    return [find_missing_part(text)]


def check_excluded_runs(simulated: np.ndarray, emulated: np.ndarray) -> list[Finding]:
    """Whether an emulated posterior has all probable simulations; log-densities (n,) by responses and by emulators."""
    probable = simulated > np.max(simulated) - PROBABLE
    excluded = int(np.sum(probable & ~(emulated > simulated - EXCLUDED)))
    if excluded == 0:
        return []
    text = (
        f"the emulated posterior excludes {excluded} of {np.sum(probable)} probable simulations, as at the ends of a "
        "ridge of parameters that the data do not tell apart, or where the response is rough: it jumps by as much as "
        "the noise between parameters that hardly differ. Evidence and standard deviations may be wrong by more than "
        "their errors. Fix one of such parameters, or make the product the parameter; else use smaller steps or a "
        "tighter tolerance of the solver, and look at the data"
    )
    return [find_missing_part(text)]
