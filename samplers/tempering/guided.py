"""Start from a guide: rounds of draws that are evaluated, weighted and used to refine the guide.

The density of a round is fixed before its draws are made, and each draw is weighted by it
(`samplers.tempering.rounds`). The rounds end with one that is *trusted*: its effective share and the Pareto shape of
its weights are good enough, although its draws had no part in the density that they are weighted with. All rounds
together must then have an effective sample size of the number of walkers.

A part of the posterior that a guide never proposes is not seen by its own draws. Guides with a share of the prior in
their density can find it; others rest on their search (`concerns`).
"""

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import numpy as np

from .adaptive_importance import most_running
from .archive import StartingDensity
from .budget import Budget
from .cohorts import Cohort, let_arrive, submit_cohort
from .guide import AdaptedGuide, GuideSession
from .population import Density, GuidedRound, GuideTick, Population, Report
from .rounds import PooledRounds, Round, pool_rounds, tails_are_light
from .settings import GuidedSettings
from .stopping import LARGEST_SHAPE, StoppedEarly, usable

__all__ = [
    "Guidance",
    "RoundsOfGuide",
    "better_of",
    "draw_rounds",
    "lend",
    "start_from_guide",
    "stopped_rounds",
    "trusted",
]

FEW_DRAWS = 100
# mean effective sample size of rounds below which the guide is given up
FEWEST_OF_ROUND = 1.5
LIGHT_TAILS = (
    "the weights of the draws grow towards the tails: those of the guide are lighter than those of the posterior, so "
    "standard deviations may be too small. Give the draws of the guide heavier tails, or use no guide"
)


class Guidance(NamedTuple):
    """A guide, and what it is lent.

    Attributes
    ----------
    guide : AdaptedGuide
        The guide.
    session : GuideSession
        What it is lent.
    budget : Budget
        Simulations so far, and their limit.
    """

    guide: AdaptedGuide
    session: GuideSession
    budget: Budget


def lend(
    guide: AdaptedGuide, random: np.random.RandomState, remember: Callable, budget: Budget, asynchronous: bool
) -> Guidance:
    """A fresh guide with what it is lent; its simulations count from now on."""
    budget.begin(guide)

    def remember_with_count(key: str, compute: Callable) -> list[np.ndarray]:
        return remember(key, compute, lambda: budget.of_guides_with_batch)

    session = GuideSession(random, remember_with_count, budget.fits, lambda: budget.remaining, asynchronous)
    return Guidance(guide, session, budget)


class RoundsOfGuide(NamedTuple):
    """Result of `draw_rounds`.

    Attributes
    ----------
    doubt : str
        Why the draws cannot be used; empty if they can.
    shortfall : str
        What was not reached although the draws can be used, or that their tails are too light; empty if all was.
    pooled : PooledRounds, or None
        All draws; None if the limit of simulations did not allow one.
    last : Round, or None
        The last round.
    stopped : bool
        Whether the limit of simulations ended the rounds.
    """

    doubt: str
    shortfall: str
    pooled: PooledRounds | None
    last: Round | None
    stopped: bool = False


def trusted(latest: Round, settings: GuidedSettings) -> bool:
    """Whether a fresh round shows that the guide describes the posterior."""
    share = latest.effective_share
    if share < settings.trusted_share:
        return False
    few = len(latest.log_weights) < FEW_DRAWS
    return latest.pareto_shape < settings.largest_pareto_shape or (few and share >= settings.short_tail_share)


def draw_rounds(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    guidance: Guidance,
    settings: GuidedSettings,
) -> Generator[tuple[Population, Report], None, RoundsOfGuide]:
    """Let the guide search, then draw, evaluate and refine until a fresh round is trusted.

    Parameters
    ----------
    population : Population
        Draws of the prior, as many as there are walkers. They are not evaluated.
    density : Density
        The posterior.
    random : RandomState
        Source of random numbers.
    guidance : Guidance
        The guide.
    settings : GuidedSettings
        Constants.

    Yields
    ------
    Population, GuideTick or GuidedRound
        The draws of the prior with the effective sample size of all rounds so far, and a tick of the progress bar or a
        round.

    Returns
    -------
    RoundsOfGuide
    """
    guide, session, budget = guidance
    size, population = len(population.coords), population._replace(effective_sample_size=0.0)
    rounds: list[Round] = []
    cohorts: list[Cohort] = []  # of which draws are running
    lessons: list[Cohort] = []  # of which the guide has not learned from all draws
    refused, pooled = False, None

    def tick(phase: str, finished: bool) -> tuple[Population, GuideTick]:
        return population, GuideTick(phase, budget.simulations, size, finished)

    def judge(most: int) -> Generator[tuple[Population, Report], None, RoundsOfGuide | None]:
        """Let draws arrive; returns how the rounds end, or None where another one follows."""
        nonlocal population, pooled
        while True:
            let_arrive(cohorts, most, density, guide, session)
            outcome = None
            while cohorts and cohorts[0].flight.complete:
                rounds.append(cohorts.pop(0).as_round())
                pooled = pool_rounds(rounds, guide.log_density_error)
                population = population._replace(effective_sample_size=pooled.effective_sample_size)
                yield population, _report(rounds[-1], pooled)
                yield tick(f"round {len(rounds)}", True)
                outcome = _outcome(rounds, pooled, size, settings)
            if refused or budget.refused:  # a search that was cut short goes on first, if the limit is raised
                outcome = RoundsOfGuide("", "", pooled, rounds[-1] if rounds else None, True)
            if not cohorts or (outcome is None and _too_few(rounds, cohorts, size, settings, guide)):
                return outcome
            most = 0  # what was submitted is part of the result

    yield tick("search", False)
    for _ in guide.prepare(session):
        yield tick("search", True)
    while True:
        yield tick(f"round {len(rounds) + len(cohorts) + 1}", False)
        coords = guide.draw(_next_size(rounds, cohorts, size, settings, guide), random)
        cohort = submit_cohort(coords, density, guide, session)
        refused = cohort.flight.refused
        if len(cohort) > 0:
            cohorts.append(cohort)
            lessons.append(cohort)
        outcome = yield from judge(0 if refused or budget.refused else most_running(density, len(coords)))
        if outcome is not None:
            return outcome
        parts = [each.take_lesson(guide.learns_from_parts) for each in lessons]
        lessons = [each for each in lessons if not each.learned]
        points, log_prob = (np.concatenate(column) for column in zip(*parts, strict=True))
        for _ in guide.refine(points, log_prob, session) if len(points) > 0 else ():
            yield tick(f"after round {len(rounds)}", True)
        if budget.refused:
            return (yield from judge(0))


def _report(last: Round, pooled: PooledRounds) -> GuidedRound:
    """What is reported of a round, with all before it."""
    return GuidedRound(
        len(last.coords),
        last.effective_share,
        last.pareto_shape,
        pooled.log_evidence,
        pooled.log_evidence_error,
        pooled.effective_sample_size,
    )


def _outcome(
    rounds: Sequence[Round], pooled: PooledRounds, size: int, settings: GuidedSettings
) -> RoundsOfGuide | None:
    """How the rounds end; None if they go on."""
    last, enough = rounds[-1], pooled.effective_sample_size >= size
    if enough and trusted(last, settings) and _even(pooled, settings):
        light = tails_are_light([r for r in rounds if trusted(r, settings)])
        return RoundsOfGuide("", LIGHT_TAILS if light else "", pooled, last)
    if doubt := _impossible(rounds) or _hopeless(rounds, settings):
        return RoundsOfGuide(doubt, "", pooled, last)
    if len(rounds) < settings.most_rounds:
        return None
    shortfall = _describe(last, pooled, settings)
    usable = last.effective_share >= settings.usable_share and pooled.pareto_shape < LARGEST_SHAPE
    return RoundsOfGuide("" if enough and usable else shortfall, shortfall, pooled, last)


def _too_few(
    rounds: Sequence[Round], cohorts: Sequence[Cohort], size: int, settings: GuidedSettings, guide: AdaptedGuide
) -> bool:
    """Whether more draws are made while some are running, since these will not be enough.

    A guide that has to learn, and does so from complete rounds only, would repeat draws of the density that it has.
    """
    if len(rounds) + len(cohorts) >= settings.most_rounds:
        return False
    if rounds and trusted(rounds[-1], settings):
        return _missing(rounds, cohorts, size, guide) > 0.0
    return guide.learns_from_parts and (not _all_impossible(rounds) or any(cohort.possible for cohort in cohorts))


def _missing(rounds: Sequence[Round], cohorts: Sequence[Cohort], size: int, guide: AdaptedGuide) -> float:
    """Effective draws that are missing, if those that are running have the effective share of the last round."""
    expected = rounds[-1].effective_share * sum(len(cohort) for cohort in cohorts)
    return size - pool_rounds(rounds, guide.log_density_error).effective_sample_size - expected


def _even(pooled: PooledRounds, settings: GuidedSettings) -> bool:
    """Whether no few weights of all rounds carry the result.

    The early rounds of a poor guide have weights of heavy tails, and their part in the result is small: the error of
    the log-evidence takes account of it, so that the shape need only be one for which a mean is useful.
    """
    n, share = len(pooled.log_weights), pooled.effective_sample_size / len(pooled.log_weights)
    even = pooled.pareto_shape < LARGEST_SHAPE or (n < FEW_DRAWS and share >= settings.short_tail_share)
    return even and bool(np.isfinite(pooled.log_evidence_error))


def _next_size(
    rounds: Sequence[Round], cohorts: Sequence[Cohort], size: int, settings: GuidedSettings, guide: AdaptedGuide
) -> int:
    """Number of draws of the next cohort; of the `cohorts` that are running, only their number of draws matters."""
    first = max(settings.fewest_draws, int(np.ceil(settings.first_round_share * size)))
    if not rounds and not cohorts:
        return first
    if rounds and _all_impossible(rounds):  # perhaps all simulations fail: find out with few more
        return settings.fewest_draws
    if rounds and trusted(rounds[-1], settings):
        missing = _missing(rounds, cohorts, size, guide)
        return int(np.clip(np.ceil(missing / rounds[-1].effective_share), first, max(size, first)))
    return max(settings.fewest_draws, int(np.ceil(settings.round_share * size)))


def _all_impossible(rounds: Sequence[Round]) -> bool:
    """Whether no draw has a finite log-probability."""
    return all(np.max(r.log_weights) == -np.inf for r in rounds)


def _impossible(rounds: Sequence[Round]) -> str:
    """Why to give up after two rounds without one possible draw; empty if there is no reason."""
    if len(rounds) < 2 or not _all_impossible(rounds):
        return ""
    return f"none of their first {sum(len(r.coords) for r in rounds)} has a finite log-probability"


def _hopeless(rounds: Sequence[Round], settings: GuidedSettings) -> str:
    """Why to give up; empty if there is no reason."""
    recent = rounds[-settings.hopeless_rounds :]
    share = np.mean([r.effective_share for r in recent])
    # a round of few draws has an effective share of at least one over their number
    hopeless = share < settings.hopeless_share or np.mean([r.effective_sample_size for r in recent]) < FEWEST_OF_ROUND
    if len(recent) < settings.hopeless_rounds or not hopeless:
        return ""
    return f"the effective sample size of the last {len(recent)} rounds is {100 * share:.2g} % of their draws"


def _describe(last: Round, pooled: PooledRounds, settings: GuidedSettings) -> str:
    """What the rounds have reached, and what they lack."""
    return (
        f"after {settings.most_rounds} rounds, the effective sample size of fresh draws is "
        f"{100 * last.effective_share:.2g} % of their number with a Pareto shape of {last.pareto_shape:.2g}, and that "
        f"of all draws is {pooled.effective_sample_size:.0f} with a shape of {pooled.pareto_shape:.2g} (a share of at "
        f"least {100 * settings.trusted_share:g} %, as many effective draws as walkers, and shapes below "
        f"{settings.largest_pareto_shape:g} are needed)"
    )


def start_from_guide(
    last: Round, prior: Population, density: Density, guide: AdaptedGuide
) -> tuple[Population, StartingDensity]:
    """Points to start recycling from: the last round of the guide and as many draws of the prior.

    Parameters
    ----------
    last : Round
        Draws of the guide as it is now.
    prior : Population
        Draws of the prior.
    density : Density
        The posterior.
    guide : AdaptedGuide
        The guide, which must not change any more.

    Returns
    -------
    population : Population
        The points.
    start : StartingDensity
        The mixture that they were drawn from.
    """
    few = prior.coords[: max(len(last.coords), prior.coords.shape[1] + 2)]
    coords = np.concatenate([last.coords, few])
    records = np.concatenate([last.records, density.evaluate(few)])
    made = len(coords)
    log_share, log_rest = np.log(len(last.coords) / made), np.log(len(few) / made)

    def log_density(points: np.ndarray, records: np.ndarray) -> np.ndarray:
        return np.logaddexp(log_share + guide.log_density(points), log_rest + records["log_prior"])

    return Population(0.0, coords, records, float(made)), StartingDensity(made, log_density)


def better_of(stop: StoppedEarly, found: RoundsOfGuide) -> StoppedEarly:
    """Of the points known at a stop and the rounds of the guide before it, those that are worth more.

    The rounds if they are usable, since each has a proposal of its own, and no mode is lost from one to the next.
    """
    rounds, pooled = stopped_rounds(found), found.pooled
    rounds.log_evidence_of_stages = stop.log_evidence_of_stages
    ndim, effective = pooled.coords.shape[1], pooled.effective_sample_size
    if stop.complete:
        return stop
    if usable(effective, pooled.pareto_shape, pooled.log_evidence_error, ndim):
        return rounds
    return stop if stop.effective_sample_size >= effective else rounds


def stopped_rounds(found: RoundsOfGuide) -> StoppedEarly:
    """All rounds of a guide, as the points from which the limit of simulations makes a population."""
    if found.pooled is None:
        nothing = Population(1.0, np.empty((0, 0)), np.empty(0), 0.0, (), np.empty(0))
        return StoppedEarly(nothing, float("-inf"), float("inf"), 1.0, from_guide=True)
    pooled = found.pooled
    known = Population(1.0, pooled.coords, pooled.records, pooled.effective_sample_size, (), pooled.log_weights)
    return StoppedEarly(known, pooled.log_evidence, pooled.log_evidence_error, 1.0, from_guide=True)
