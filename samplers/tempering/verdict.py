"""What the result of a run is worth, in words: converged, usable or not usable, with reasons.

``converged``
    Nothing that the run can observe speaks against the result.
``usable``
    Means and evidence have the errors that are stated, but something was not reached or could not be checked.
``not usable``
    The numbers may be far from the posterior, by more than their stated errors.

No run can see a part of the posterior in which it has no points. The reasons say what the verdict rests on.
"""

from typing import NamedTuple

import numpy as np

from .failed_region import NearFailures, check_failed_region
from .genealogy import standard_error_of_mean
from .population import Doubt, GuidedRound, Halt
from .results import AnnealingResult
from .settings import GuidedSettings
from .stopping import LARGEST_ERROR, LARGEST_SHAPE, fewest_points, usable

__all__ = ["CONVERGED", "NOT_USABLE", "USABLE", "Verdict", "describe_halt", "independent_points", "judge"]

CONVERGED = "converged"
USABLE = "usable"
NOT_USABLE = "not usable"
STATUSES = (CONVERGED, USABLE, NOT_USABLE)


class Verdict(NamedTuple):
    """What the result of a run is worth. ``str`` gives sentences.

    Attributes
    ----------
    status : {"converged", "usable", "not usable"}
        The judgement.
    reasons : tuple of str
        Why, and what it rests on.
    simulations : float
        Simulations made (`samplers.tempering.budget`).
    more_simulations : float, optional
        About how many more simulations a converged result takes; 0 if it is converged, None if that is not known.
    effective_sample_size : float
        Of the points that `sample` names, when beta = 1 was reached.
    sample : str
        Which points these are: the walkers, or weighted ones that the walkers were resampled from.
    """

    status: str
    reasons: tuple[str, ...]
    simulations: float
    more_simulations: float | None
    effective_sample_size: float
    sample: str

    def __str__(self) -> str:
        first = (
            f"{self.status.capitalize()}: effective sample size {self.effective_sample_size:.0f} ({self.sample}) from "
            f"{self.simulations:.0f} simulations."
        )
        more = []
        if self.more_simulations is None:
            more = ["How many more simulations are needed is not known."]
        elif self.more_simulations > 0.0:
            more = [f"About {self.more_simulations:.0f} more simulations are needed."]
        return " ".join([first, *(f"{reason[0].upper()}{reason[1:]}." for reason in self.reasons), *more])


def judge(
    result: AnnealingResult,
    settings: GuidedSettings,
    nwalkers: int,
    ndim: int,
    simulations: float,
    missing_steps: int = 0,
    failures: str = "",
    searched: float = 0.0,
    near: NearFailures | None = None,
) -> Verdict:
    """Judge an annealing that has reached beta = 1.

    Parameters
    ----------
    result : AnnealingResult
        What the annealing has found.
    settings : GuidedSettings
        Constants of the rounds of a guide.
    nwalkers, ndim : int
        Size of the ensemble.
    simulations : float
        Simulations made.
    missing_steps : int
        Steps at beta = 1 that the limit of simulations did not allow.
    failures : str
        How many evaluations failed, for the reasons; empty if none did.
    searched : float
        Simulations that the guide made by itself.
    near : NearFailures, optional
        Failures in the region of the final points; None where they are not known.

    Returns
    -------
    Verdict
    """
    stage = result.ladder[-1]
    found = [*result.doubts, *(() if near is None else check_failed_region(near))]
    reasons: list[str] = []
    if searched > 0.0:
        reasons.append(f"the guide used {searched:.0f} of the {simulations:.0f} simulations for its search")
    more: float | None = 0.0
    halt = result.halt
    if halt is not None and not halt.complete:
        found += _of_halt(halt, stage.log_evidence_error, ndim)
        more = _missing_draws(result.rounds, nwalkers, settings) if halt.from_guide else None
    elif halt is not None:
        found.append(Doubt("the limit of simulations ended the run at beta = 1, before its last check", False))
        more = None
    if result.start is not None and result.start.used:
        last = result.rounds[-1]
        reasons.append(
            f"the latest {last.draws} draws of the guide, which shaped nothing that they are weighted with, have an "
            f"effective sample size of {100 * last.effective_share:.0f} % of their number; the Pareto shape of all "
            f"weights is {result.start.pareto_shape:.2f}"
        )
        if result.start.shortfall:
            found.append(Doubt(result.start.shortfall, False))
    elif result.start is not None:
        found.append(Doubt(f"the draws of the guide were not used ({result.start.doubt})", False))
    if result.start is not None or (halt is not None and halt.from_guide):
        found += [Doubt(f"concern of the guide: {concern}", False) for concern in result.concerns]
        if not result.concerns:
            reasons.append(result.basis or "parts of the posterior in which the guide makes no draws are not seen")
    if stage.log_evidence_error > LARGEST_ERROR and not result.has_better_check:
        found.append(
            Doubt(f"the standard error of the log-evidence is {stage.log_evidence_error:.2g}", halt is not None)
        )
    if missing_steps > 0:
        reasons.append(
            f"{missing_steps} of the steps at beta = 1 {'was' if missing_steps == 1 else 'were'} not made, which takes "
            f"up to {missing_steps * nwalkers} simulations"
        )
    if failures:
        reasons.append(f"{failures} failed and count as impossible")
    status = STATUSES[max((1 + doubt.grave for doubt in found), default=0)]
    if status == CONVERGED:
        more = 0.0
    elif halt is None:
        more = None
    return Verdict(
        status,
        (*(doubt.message.rstrip(".") for doubt in found), *reasons),
        float(simulations),
        None if more is None else float(more),
        float(stage.effective_sample_size if result.independent_points is None else result.independent_points),
        _sample(result, nwalkers),
    )


def _sample(result: AnnealingResult, nwalkers: int) -> str:
    """The points that `independent_points` gives the effective sample size of."""
    if result.halt is not None and not result.halt.complete:
        return f"of {result.halt.points} weighted points, resampled to {nwalkers} walkers"
    if result.start is not None and result.start.used:
        return f"of {sum(r.draws for r in result.rounds)} weighted draws, resampled to {nwalkers} walkers"
    return f"of {nwalkers} walkers"


def independent_points(result: AnnealingResult, coords: np.ndarray) -> float:
    """Effective sample size of the walkers (n, ndim) when beta = 1 was reached.

    That of the weights if the walkers were resampled from weighted draws, and were not moved after that. Otherwise the
    smallest squared ratio, over the parameters, of standard deviation and standard error of the mean, at most n.
    """
    if result.halt is not None and not result.halt.complete:
        return result.halt.effective_sample_size
    if result.start is not None and result.start.used:
        return result.ladder[-1].effective_sample_size
    founders = np.arange(len(coords)) if result.founders is None else result.founders
    spread, error = coords.std(axis=0), standard_error_of_mean(coords[None], founders)
    return float(np.min((spread / error)[error > 0.0] ** 2, initial=len(coords)))


def describe_halt(verdict: Verdict, limit: float, result: AnnealingResult, made: int, missing: int) -> str:
    """The warning when the limit of simulations has ended a call.

    Parameters
    ----------
    verdict : Verdict
        The verdict.
    limit : float
        The limit.
    result : AnnealingResult
        What the annealing has found.
    made, missing : int
        Steps at beta = 1 that were made, and that were not.
    """
    if result.halt is not None:
        ended = f"max_simulations={limit:g} ended the run"
    else:
        ended = f"max_simulations={limit:g} allowed {made} of {made + missing} steps at beta = 1"
    if verdict.simulations > limit:
        ended += f" (the stored run has made {verdict.simulations:.0f} simulations, which are kept)"
    if verdict.status == CONVERGED:
        return f"{ended}. The chain holds draws of the posterior: no further simulation is necessary"
    return (
        f"{ended}. {verdict} To go on from here, set the attribute max_simulations of the sampler to a larger number, "
        "or make a new sampler with the same file, and call run_mcmc again"
    )


def _of_halt(halt: Halt, error: float, ndim: int) -> list[Doubt]:
    """Doubts about a population that was made from the points known when the limit of simulations was reached."""
    where = f"at beta = {halt.beta:.3g} " if halt.beta < 1.0 else ""
    text = (
        f"the limit of simulations ended the run {where}with {halt.points} weighted points, whose effective sample "
        f"size is {halt.effective_sample_size:.2g} and whose weights have a Pareto shape of {halt.pareto_shape:.2g}"
    )
    if usable(halt.effective_sample_size, halt.pareto_shape, error, ndim):
        return [Doubt(text, False)]
    wanted = f"an effective sample size of {fewest_points(ndim):.0f} and a shape below {LARGEST_SHAPE:g} are needed"
    return [Doubt(f"{text} ({wanted})", True)]


def _missing_draws(rounds: tuple[GuidedRound, ...], nwalkers: int, settings: GuidedSettings) -> float | None:
    """Draws that the guide still needs if its later rounds are like the last one; None if that one says nothing."""
    last = rounds[-1]
    if last.effective_share < settings.usable_share:
        return None
    missing = max(nwalkers - last.effective_sample_size, settings.first_round_share * nwalkers)
    return float(np.ceil(missing / last.effective_share))
