"""Annealing from draws of the prior to beta = 1: by recycling where its result can be trusted, else by moves.

Annealing by moves is Sequential Monte Carlo: choose the next beta, weigh, resample, move. Annealing by recycling is
adaptive importance sampling (`samplers.tempering.adaptive_importance`); its weighted draws are resampled to as many
points as there are walkers, which then are moved. Both end with an estimate of the evidence from draws that were not
used for the annealing. With a cheaper (coarse) model, recycling on that model comes first, and recycling on the fine
model starts from its proposals instead of from the prior (`samplers.tempering.multilevel`).

`anneal` is a generator of pairs (population, report). It keeps no reference to whoever consumes it: storing, timing and
showing are up to the consumer.
"""

import logging
from collections.abc import Generator, Iterator

import numpy as np

from ..proposals.mixture import fit_mixture, log_density
from ..proposals.support_bounds import find_support_bounds
from .adaptive_importance import Recycled, StartingDensity, recycle
from .diagnostics import check_annealing, check_stages, warn
from .evidence_check import EvidenceCheck, draw_inside, evidence_from_weights
from .genealogy import trace_founders
from .multilevel import draw_start
from .mutation import MoveSchedule, Mutated, grow_chains, move_together
from .population import Density, Population, Report, Restart, Stage, Sweep
from .resampling import systematic
from .settings import Settings
from .weights import (
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

Steps = Iterator[tuple[Population, Report]]


def anneal(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    coarse: Density | None = None,
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

    Yields
    ------
    population : Population
        The points as they are now.
    report : Sweep, Stage, Restart or EvidenceCheck
        `Sweep`: the points have been moved once. `Stage`: a stage is finished. `Restart`: all stages so far are void.
        `EvidenceCheck`: the independent estimate of the evidence (at most one, before or after the last stage). The
        population of the last pair is at beta = 1, equally weighted.
    """
    if coarse is not None and (yield from _from_coarse(population, density, coarse, random, schedule, settings)):
        return
    if population.records is None:
        population = population._replace(records=density.evaluate(population.coords))
    if settings.recycle and (yield from _by_recycling(population, density, random, schedule, settings)).trusted:
        return
    yield from _by_moves(population, density, random, schedule, settings)


def _by_moves(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
) -> Steps:
    """Sequential Monte Carlo."""
    n, ndim = population.coords.shape
    target, stages = float(n), []
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

        ancestors = settings.resample(weights, random)
        error.resample(ancestors)
        founders = trace_founders(population.founders, ancestors)
        effective = effective_sample_size(log_weights)
        population = Population(beta, coords[ancestors], records[ancestors], effective, founders)
        distinct = len(np.unique(population.coords, axis=0))
        mutated = yield from _mutate(population, ancestors, density, random, schedule, settings)
        population = mutated.population
        stages.append(
            Stage(
                beta=beta,
                effective_sample_size=effective,
                acceptance=mutated.acceptance,
                moves=mutated.moves,
                distinct_ancestors=distinct,
                log_evidence_increment=log_mean_weight(log_weights),
                log_evidence_error=standard_error,
            )
        )
        yield population, stages[-1]
        check_stages(stages, n, ndim)
    check_annealing(stages, n, ndim, mutated.correlation)
    if settings.check_draws != 0:
        yield population, _check_evidence(population.coords, density, random, settings.check_draws)


def _by_recycling(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    start: StartingDensity | None = None,
    size: int | None = None,
) -> Generator[tuple[Population, Report], None, Recycled]:
    """Adaptive importance sampling, resampled to `size` points (the number of points by default) and moved."""
    size = len(population.coords) if size is None else size
    found = yield from recycle(population.coords, population.records, density, random, settings.recycling, start, size)
    if not found.trusted:
        logger.info("recycling is not trusted here, because %s", found.doubt)
        yield population, Restart(found.doubt)
        return found
    weights = normalised_weights(found.log_weights)
    schedule.calibrate(found.coords, coarse_weights(found.log_weights), density.inside)
    ancestors = systematic(weights, random, size)
    effective = effective_sample_size(found.log_weights)
    population = Population(1.0, found.coords[ancestors], found.records[ancestors], effective, (ancestors,))
    if settings.check_draws != 0:
        yield population, found.check
    mutated = yield from _mutate(population, ancestors, density, random, schedule, settings)
    yield (
        mutated.population,
        Stage(
            beta=1.0,
            effective_sample_size=effective,
            acceptance=mutated.acceptance,
            moves=mutated.moves,
            distinct_ancestors=len(np.unique(ancestors)),
            log_evidence_increment=found.log_evidence - found.log_evidence_below_one,
            log_evidence_error=found.log_evidence_error,
        ),
    )
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
    records = coarse.evaluate(coords[:few])
    found = yield from _only_sweeps(recycle(coords[:few], records, coarse, random, settings.recycling, finish=False))
    if found.doubt:
        warn(
            f"annealing on the coarse model failed ({found.doubt}), so the fine model alone is used. Check the coarse "
            "model, or pass none"
        )
        return False
    coarse_cost = few + sum(made for made, _ in found.proposals)
    drawn, start = draw_start(found.proposals, coords, few, random, density.inside)
    population = population._replace(coords=drawn, records=density.evaluate(drawn))
    found = yield from _by_recycling(population, density, random, schedule, settings, start, n)
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


def _only_sweeps(
    steps: Generator[tuple[Population, Report], None, Recycled],
) -> Generator[tuple[Population, Sweep], None, Recycled]:
    """The sweeps of a recycling on the coarse model; its stages are not stages of the run."""
    while True:
        try:
            population, report = next(steps)
        except StopIteration as end:
            return end.value
        if isinstance(report, Sweep):
            yield population, report


def _check_evidence(
    coords: np.ndarray, density: Density, random: np.random.RandomState, draws: int | None
) -> EvidenceCheck:
    """The evidence from fresh draws of a mixture fitted to the final points; by default as many draws as points."""
    n = len(coords)
    mixture = fit_mixture(coords, np.full(n, 1.0 / n), bounds=find_support_bounds(density.inside, coords))
    drawn, made = draw_inside(mixture, n if draws is None else draws, random, density.inside)
    return evidence_from_weights(density.evaluate(drawn)["log_prob"] - log_density(mixture, drawn), made)


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
