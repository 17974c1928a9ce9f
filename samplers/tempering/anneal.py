"""Annealing from draws of the prior to beta = 1: by recycling where its result can be trusted, else by moves.

Annealing by moves is Sequential Monte Carlo: choose the next beta, weigh, resample, move. Annealing by recycling is
adaptive importance sampling (`samplers.tempering.adaptive_importance`); its weighted draws are resampled to as many
points as there are walkers, which are moved only where they are not independent draws already. Both end with an
estimate of the evidence from draws that were not used for the annealing. With a cheaper (coarse) model, recycling on
that model comes first, and recycling on the fine model starts from its proposals instead of from the prior
(`samplers.tempering.multilevel`). With a guide, its weighted draws replace the annealing (`samplers.tempering.guided`),
and only where they cannot be trusted does recycling start from them.

A limit of simulations ends the annealing wherever it is exceeded. The points known by then are weighted by the
posterior and resampled (`StoppedEarly`).

`anneal` is a generator of pairs (population, report). It keeps no reference to whoever consumes it: storing, timing and
showing are up to the consumer.
"""

import logging
from collections.abc import Generator, Iterator
from dataclasses import replace

import numpy as np

from .adaptive_importance import Recycled, recycle, stopped_at, submit_start
from .archive import StartingDensity
from .budget import BudgetExhausted
from .diagnostics import check_annealing, check_fallback, check_fit, check_stages, fits_poorly, warn
from .evidence_check import pareto_shape
from .flights import Flight
from .genealogy import trace_founders
from .guided import Guidance, RoundsOfGuide, better_of, draw_rounds, start_from_guide, stopped_rounds
from .inner_steps import and_last_population, only_sweeps
from .multilevel import draw_start
from .mutation import MoveSchedule, Mutated, grow_chains, move_together
from .population import Density, Doubt, GuidedStart, Halt, Population, Report, Restart, Stage, Sweep
from .population_check import check_population
from .repeated_runs import check_agreement, pool_runs
from .resampling import systematic
from .settings import Settings
from .stopping import NothingToReport, StoppedEarly, stop_at
from .watched_density import WatchedDensity
from .weights import (
    WHERE_TO_LOOK,
    EvidenceError,
    coarse_weights,
    effective_sample_size,
    log_mean_weight,
    next_beta,
    normalised_weights,
)

__all__ = ["anneal"]

logger = logging.getLogger(__name__)

# A start from the coarse model needs no weights of its own, and the draws at beta = 1 decide what the result is worth:
# half the walkers suffice, but not fewer points than these.
FEWEST_TO_START = 250
START_PER_DIMENSION = 10
# Share of distinct points after recycling from which on the population is as good as independent draws.
ENOUGH_DISTINCT = 0.9

Steps = Iterator[tuple[Population, Report]]


def anneal(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    coarse: Density | None = None,
    guidance: Guidance | None = None,
) -> Steps:
    """Carry draws of the prior to beta = 1.

    Parameters
    ----------
    population : Population
        Draws of the prior. They are evaluated if they have no records.
    density : Density
        The posterior.
    random : RandomState
        Source of random numbers.
    schedule : MoveSchedule
        The moves.
    settings : Settings
        How to anneal.
    coarse : Density, optional
        A cheaper version of the posterior, to recycle on first.
    guidance : Guidance, optional
        A guide to start from.

    Yields
    ------
    population : Population
        The points as they are now.
    report : Report
        `Sweep`: the points have been moved once. `Stage`: a stage is finished. `Restart`: all stages so far are void.
        `EvidenceCheck`: the independent estimate of the evidence (at most one, before or after the last stage).
        `GuidedRound`, `GuidedStart`: a round of a guide, and what all rounds are worth. `Halt`: the limit of
        simulations has ended the annealing. `Doubt`: the result is doubtful. The population of the last pair is at
        beta = 1, equally weighted.
    """
    try:
        yield from _without_limit(population, density, random, schedule, settings, coarse, guidance)
    except StoppedEarly as stop:
        searched = 0.0 if guidance is None else guidance.budget.of_guides
        yield from _finish_early(stop, len(population.coords), random, searched)


def _without_limit(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    coarse: Density | None,
    guidance: Guidance | None,
) -> Steps:
    """The annealing; raises `StoppedEarly` where it exceeds the limit of simulations."""
    if guidance is not None:
        found = yield from _from_guide(population, density, random, schedule, settings, guidance)
        if found is None:
            return
        try:
            yield from _without_limit(population, density, random, schedule, settings, coarse, None)
        except StoppedEarly as stop:
            raise better_of(stop, found) from None
        return
    if coarse is not None and (yield from _from_coarse(population, density, coarse, random, schedule, settings)):
        return
    if population.records is None:
        flight = submit_start(population.coords, density, whole=not settings.recycle)
    else:
        flight = Flight.landed(population.coords, population.records)
    recycled = None
    if settings.recycle:
        by_recycling = _by_recycling if settings.runs == 1 else _by_runs
        recycled = yield from by_recycling(population, flight, density, random, schedule, settings)
        if recycled.trusted:
            return
    population = population._replace(records=flight.landed_part()[1])
    yield from _by_moves(population, density, random, schedule, settings, recycled)


def _finish_early(stop: StoppedEarly, size: int, random: np.random.RandomState, searched: float) -> Steps:
    """Resample the points that are known to `size` points at beta = 1; `searched`: simulations made by guides."""
    population = stop.population
    if stop.complete:
        yield population, Halt(1.0, len(population.coords), population.effective_sample_size, float("-inf"), True)
        return
    log_weights = population.log_weights
    if len(log_weights) == 0 or np.max(log_weights) == -np.inf:
        search = f", besides {searched:.0f} simulations of the search by the guide" if searched > 0.0 else ""
        advice = f", or {WHERE_TO_LOOK}" if len(log_weights) > 0 else ""
        raise NothingToReport(
            f"the limit of simulations (max_simulations) ended the run after {len(log_weights)} evaluated points, none "
            f"of which has a finite log-probability{search}: there is nothing to report. Call run_mcmc again with a "
            f"larger limit (the simulations made so far are kept){advice}"
        )
    ancestors = systematic(normalised_weights(log_weights), random, size)
    effective, known = stop.effective_sample_size, len(log_weights)
    population = Population(1.0, population.coords[ancestors], population.records[ancestors], effective, (ancestors,))
    yield population, Halt(stop.beta, known, effective, pareto_shape(log_weights), from_guide=stop.from_guide)
    yield (
        population,
        Stage(
            beta=1.0,
            effective_sample_size=effective,
            acceptance=effective / known,
            moves=0,
            distinct_ancestors=len(np.unique(ancestors)),
            log_evidence_increment=stop.log_evidence - stop.log_evidence_of_stages,
            log_evidence_error=stop.error,
        ),
    )


def _from_guide(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    guidance: Guidance,
) -> Generator[tuple[Population, Report], None, RoundsOfGuide | None]:
    """Draws of a guide, or recycling that starts from them; returns the draws if neither can be trusted."""
    size = len(population.coords)
    found = yield from draw_rounds(population, density, random, guidance, settings.guided)
    if found.stopped:
        raise stopped_rounds(found)
    if not found.doubt:
        weights = normalised_weights(found.pooled.log_weights)
        ancestors = systematic(weights, random, size)
        schedule.calibrate(found.pooled.coords, coarse_weights(found.pooled.log_weights), density.inside)
        effective = found.pooled.effective_sample_size
        coords, records = found.pooled.coords[ancestors], found.pooled.records[ancestors]
        population = Population(1.0, coords, records, effective, (ancestors,))
        yield population, GuidedStart("", found.shortfall, found.pooled.pareto_shape)
        yield (
            population,
            Stage(
                beta=1.0,
                effective_sample_size=effective,
                acceptance=found.last.effective_share,
                moves=0,
                distinct_ancestors=len(np.unique(ancestors)),
                log_evidence_increment=found.pooled.log_evidence,
                log_evidence_error=found.pooled.log_evidence_error,
            ),
        )
        return None
    if found.pooled.log_evidence == -np.inf:
        _check_prior(found, population, density, settings)
        warn(
            f"the draws of the guide are impossible ({found.doubt}), so the run goes on without them, by annealing "
            "from the prior, which needs more simulations. Use a better guide, or none"
        )
        yield population, GuidedStart(found.doubt, "", found.pooled.pareto_shape)
        return found
    warn(
        f"the draws of the guide are not close enough to the posterior ({found.doubt}), so the run goes on by "
        "recycling, which starts from them and needs more simulations. Use a better guide, or none"
    )
    yield population, GuidedStart(found.doubt, "", found.pooled.pareto_shape)
    try:
        started, start = start_from_guide(found.last, population, density, guidance.guide)
    except BudgetExhausted:
        raise stopped_rounds(found) from None
    try:
        flight = Flight.landed(started.coords, started.records)
        recycled = yield from _by_recycling(started, flight, density, random, schedule, settings, start, size, found)
    except StoppedEarly as stop:
        raise better_of(stop, found) from None
    return None if recycled.trusted else found


def _check_prior(found: RoundsOfGuide, population: Population, density: Density, settings: Settings) -> None:
    """Raise ValueError if a few draws of the prior are as impossible as those of the guide."""
    few = population.coords[: settings.guided.fewest_draws]
    try:
        records = density.evaluate(few)
    except BudgetExhausted:
        raise stopped_rounds(found) from None
    if np.max(records["log_prob"]) == -np.inf:
        raise ValueError(
            f"none of {len(found.pooled.coords)} draws of the guide and of {len(few)} draws of the prior has a finite "
            f"log-probability: {WHERE_TO_LOOK}"
        )


def _disagreement(population: Population, found: RoundsOfGuide, log_evidence: float, error: float) -> Steps:
    """A doubt if recycling and the rounds of the guide before it have different evidences: one has lost a part."""
    value, joint = found.pooled.log_evidence, float(np.hypot(found.pooled.log_evidence_error, error))
    if abs(value - log_evidence) > 3.0 * joint:
        message = (
            f"recycling gives the log-evidence {log_evidence:.2f} +- {error:.2f}, the draws of the guide before it "
            f"give {value:.2f} +- {found.pooled.log_evidence_error:.2f}: one of them has lost a part of the posterior. "
            "Use a better guide, or more walkers without one"
        )
        yield population, Doubt(message, True)


def _by_moves(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    recycled: Recycled | None,
) -> Steps:
    """Sequential Monte Carlo. Its evidence is compared with that of `recycled`, which could not be trusted."""
    n, ndim = population.coords.shape
    target, stages, density = float(n), [], WatchedDensity(density)
    density.add(population.coords, population.records)
    if recycled is not None:
        density.add(recycled.coords, recycled.records)
    error = EvidenceError(n)
    while population.beta < 1.0:
        coords, records = population.coords, population.records
        log_likelihood = records["log_prob"] - records["log_prior"]
        target = settings.target(target, n)
        beta = next_beta(log_likelihood, population.beta, target)
        log_weights = (beta - population.beta) * log_likelihood
        weights = normalised_weights(log_weights)
        standard_error = error.weigh(weights)
        schedule.calibrate(coords, coarse_weights(log_weights), density.inside)
        increment = log_mean_weight(log_weights)
        log_evidence = sum(stage.log_evidence_increment for stage in stages) + increment
        visited, log_target = density.visited(beta)
        schedule.cover_basins(visited, log_target - log_evidence)

        ancestors = settings.resample(weights, random)
        error.resample(ancestors)
        founders = trace_founders(population.founders, ancestors)
        effective = effective_sample_size(log_weights)
        population = Population(beta, coords[ancestors], records[ancestors], effective, founders)
        distinct = len(np.unique(population.coords, axis=0))
        mutated = yield from _mutate(population, ancestors, density, random, schedule, settings)
        population = mutated.population
        if mutated.stopped:
            raise stop_at(population, log_evidence, standard_error, log_evidence - increment)
        stages.append(
            Stage(
                beta=beta,
                effective_sample_size=effective,
                acceptance=mutated.acceptance,
                moves=mutated.moves,
                distinct_ancestors=distinct,
                log_evidence_increment=increment,
                log_evidence_error=standard_error,
            )
        )
        yield population, stages[-1]
        for doubt in check_stages(stages, n, ndim):
            yield population, doubt
    for doubt in check_annealing(stages, n, ndim, mutated.correlation):
        yield population, doubt
    check = None
    if settings.check_draws != 0:
        try:
            check, doubts = check_population(population, density, log_evidence, random, settings.check_draws)
        except BudgetExhausted:
            raise StoppedEarly(population, 0.0, 0.0, 1.0, complete=True) from None
        yield population, check
        for doubt in doubts:
            yield population, doubt
    if recycled is not None and recycled.check is not None:
        for doubt in check_fallback(stages, check, recycled.log_evidence, recycled.log_evidence_error, recycled.check):
            yield population, doubt


def _by_recycling(
    population: Population,
    flight: Flight,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    start: StartingDensity | None = None,
    size: int | None = None,
    earlier: RoundsOfGuide | None = None,
) -> Generator[tuple[Population, Report], None, Recycled]:
    """Adaptive importance sampling, resampled to `size` points (the number of points by default) and moved.

    `flight`: the points of the population, some of which may be running. The evidence is compared with that of
    `earlier` rounds of a guide, if there were any.
    """
    size = len(population.coords) if size is None else size
    found = yield from recycle(flight, density, random, settings.recycling, start, size)
    if not found.trusted:
        logger.info("recycling is not trusted here, because %s", found.doubt)
        yield population, Restart(found.doubt)
        return found
    weights = normalised_weights(found.log_weights)
    # the last proposal, since it was not fitted to the draws of the check, most of the points that are moved
    proposal = found.proposals[-1][1]
    schedule.calibrate(found.coords, coarse_weights(found.log_weights), density.inside, proposal)
    ancestors = systematic(weights, random, size)
    effective = effective_sample_size(found.log_weights)
    population = Population(1.0, found.coords[ancestors], found.records[ancestors], effective, (ancestors,))
    if settings.check_draws != 0:
        yield population, found.check
    for doubt in check_fit(found.check, proposal, size, found.coords, found.log_weights):
        yield population, doubt
    if earlier is not None:
        yield from _disagreement(population, earlier, found.log_evidence, found.log_evidence_error)
    distinct = len(np.unique(ancestors))
    poor = distinct < ENOUGH_DISTINCT * size or fits_poorly(found.check, proposal, size)
    if settings.recycling.closing_sweeps or poor:
        mutated = yield from _mutate(population, ancestors, density, random, schedule, settings)
    else:
        # the draws are independent already: sweeps would cost evaluations and improve nothing
        schedule.expect_independence()
        mutated = Mutated(population, effective / len(found.coords), 0, 0.0)
    yield (
        mutated.population,
        Stage(
            beta=1.0,
            effective_sample_size=effective,
            acceptance=mutated.acceptance,
            moves=mutated.moves,
            distinct_ancestors=distinct,
            log_evidence_increment=found.log_evidence - found.log_evidence_below_one,
            log_evidence_error=found.log_evidence_error,
        ),
    )
    if mutated.stopped:
        raise StoppedEarly(mutated.population, 0.0, 0.0, 1.0, complete=True)
    return found


def _by_runs(
    population: Population,
    flight: Flight,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
) -> Generator[tuple[Population, Report], None, Recycled]:
    """Several runs of recycling, then one that begins with all their points; they are compared at the end."""
    runs: list[Recycled] = []
    for _ in range(settings.runs):
        try:
            run = yield from only_sweeps(recycle(flight, density, random, settings.recycling, finish=False))
        except StoppedEarly as stop:
            stop.log_evidence_of_stages = 0.0  # the stages of these runs are not reported
            raise (stopped_at(runs[0].archive, 1.0, 0.0, 0.0) if runs else stop) from None
        if not run.trusted:
            yield population, Restart(run.doubt)
            return run
        runs.append(run)
    coords, records, start = pool_runs(runs, len(population.coords))
    pooled = Population(0.0, coords, records, float(len(coords)))
    share = settings.recycling.target_share * len(population.coords) / len(coords)
    settings = replace(settings, recycling=replace(settings.recycling, target_share=share))
    flight = Flight.landed(coords, records)
    steps = _by_recycling(pooled, flight, density, random, schedule, settings, start, len(population.coords))
    found, population = yield from and_last_population(steps)
    if found.trusted:
        for doubt in check_agreement(runs, found.proposals[-1][1], 1.0 / (share * len(coords))):
            yield population, doubt
    return found


def _from_coarse(
    population: Population,
    density: Density,
    coarse: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
) -> Generator[tuple[Population, Report], None, bool]:
    """Recycle on a cheaper model, then from there to the posterior; returns whether the result can be trusted."""
    coords = population.coords
    n, ndim = coords.shape
    few = min(n, max(FEWEST_TO_START, n // 2, START_PER_DIMENSION * (ndim + 1)))
    flight = coarse.submit(coords[:few])
    found = yield from only_sweeps(recycle(flight, coarse, random, settings.recycling, finish=False))
    if found.doubt:
        warn(
            f"annealing on the coarse model failed ({found.doubt}), so the fine model alone is used. Check the coarse "
            "model, or pass none"
        )
        return False
    coarse_cost = few + sum(made for made, _ in found.proposals)
    drawn, start = draw_start(found.proposals, coords, few, random, density.inside)
    population, flight = population._replace(coords=drawn), submit_start(drawn, density, start)
    found = yield from _by_recycling(population, flight, density, random, schedule, settings, start, n)
    if not found.trusted:
        warn(
            "the coarse posterior is too far from the fine one to lead to it, so annealing starts again on the fine "
            "model alone. Use a closer coarse model, or none"
        )
    elif found.evaluations_below_one > coarse_cost:
        warn(
            f"the coarse posterior is far from the fine one: the way from it took {found.evaluations_below_one} "
            f"evaluations of the fine model, more than the annealing on the coarse model ({coarse_cost}). A closer "
            "coarse model may be worth its cost"
        )
    return found.trusted


def _mutate(
    population: Population,
    ancestors: np.ndarray,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
) -> Generator[tuple[Population, Sweep], None, Mutated]:
    """Generator that moves resampled points at their beta."""
    if settings.chains == "leaders":
        return grow_chains(population, ancestors, density, random, schedule, settings)
    return move_together(population, density, random, schedule, settings)
