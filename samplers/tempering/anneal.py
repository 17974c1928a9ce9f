"""Annealing from draws of the prior to beta = 1: which path to take, and what to do if it fails.

With a guide, its weighted draws replace the annealing; if they are not usable, the run ends with a verdict that says
so, since annealing takes ten times the simulations, which is for the user to decide. Recycling's weighted draws are
resampled to the walkers, which are moved unless they are independent already; if they are not reliable, moves start
again from the draws of the prior. A limit of simulations ends any path: the known points are weighted by the posterior
and resampled.
"""

import logging
from collections.abc import Generator, Iterator

import numpy as np

from ..estimates.importance import EvidenceCheck, evidence_from_weights
from ..estimates.pareto import pareto_shape
from ..estimates.weights import WHERE_TO_LOOK, coarse_weights, normalised_weights
from ..finding import Finding
from ..judgement.checks import check_shares
from ..proposals.basins import find_basins, with_components
from ..proposals.mixture import draw_inside, fit_mixture, log_density
from ..proposals.transforms import find_support_bounds
from ..record import BudgetExhausted
from ..reports import LIMIT, Report, Restart, Stage, Weighted
from ..resampling import systematic
from ..settings import Settings
from .guide import Guide, GuideSession
from .guided import draw_rounds
from .mutation import Kernel, MoveSchedule, Mutated, VisitedPoints, move_together
from .population import Density, Population, StoppedEarly
from .recycling import Recycled, first_draws, recycle, submit_start
from .smc_moves import anneal_by_moves

logger = logging.getLogger(__name__)

Steps = Iterator[tuple[Population, Report]]


def anneal(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    guided: tuple[Guide, GuideSession] | None = None,
) -> Steps:
    """Carry draws of the prior to beta = 1 by moves, recycling or a guide.

    Yields the points as they are now with a report (`samplers.reports`), or with a function of a guide's search, whose
    result is to be sent back; in the last pair, they are at beta = 1 and equally weighted.
    """
    size = len(population.coords)
    try:
        if guided is not None:
            yield from _from_guide(population, density, schedule, *guided)
            return
        coords, more = population.coords, first_draws(size) - size
        if more > 0 and (settings.recycle or schedule.mixtures):  # walks, as in papers, do not use what they reveal
            coords = np.concatenate([coords, density.target.more_draws(more, random)])
        start, recycled = submit_start(coords, density, whole=not settings.recycle), None
        kernel = Kernel(density, random, schedule, settings, VisitedPoints())
        if settings.recycle:
            recycled = yield from _by_recycling(recycle(start, size, density, random), population, size, kernel)
        if recycled is None or recycled.reason:
            for coords, records in (start.arrived_part(), *([] if recycled is None else [recycled.points[1:3]])):
                kernel.visited.add(coords, records)
            coords, records = start.arrived_part()
            population = population._replace(coords=coords, records=records)
            population, log_evidence = yield from anneal_by_moves(population, size, kernel)
            try:
                check, found = check_population(population, *kernel[:2], kernel.visited, log_evidence)
            except BudgetExhausted:
                yield population, Weighted(0, population.effective_sample_size, float("-inf"), ended=LIMIT)
                return
            yield from ((population, each) for each in (check, *found))
    except StoppedEarly as stop:
        yield from _end_with(stop, size, random, 0.0 if guided is None else density.record.of_guides)


def check_population(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    visited: VisitedPoints,
    log_evidence: float,
) -> tuple[EvidenceCheck, list[Finding]]:
    """Evidence, and findings about shares of the posterior's parts, by as many fresh draws as final points, of a
    mixture fitted to these. `visited` are the points of all stages, whose `log_evidence` is given.
    """
    coords, n = population.coords, len(population.coords)
    mixture = fit_mixture(coords, np.full(n, 1.0 / n), bounds=find_support_bounds(density.inside, coords))
    points, log_target = visited.at(1.0)
    mixture = with_components(mixture, find_basins(mixture, points, log_target - log_evidence))
    drawn, made = draw_inside(mixture, n, random, density.inside)
    log_weights = density.evaluate(drawn)["log_prob"] - log_density(mixture, drawn)
    check = evidence_from_weights(log_weights, made)
    if len(mixture.weights) == 1 or check.effective_sample_size == 0.0:
        return check, []
    weights = normalised_weights(log_weights)
    mean, findings = weights @ drawn, check_shares(mixture, coords, population.founders[0], drawn, weights)
    error = np.sqrt(weights**2 @ (drawn - mean) ** 2)
    return check._replace(mean=mean.tolist(), mean_error=error.tolist()), findings


def _by_recycling(
    steps: Generator[tuple[Population, Report], None, Recycled], population: Population, size: int, kernel: Kernel
) -> Generator[tuple[Population, Report], None, Recycled]:
    """Make the `steps` of `recycle`, then resample the weighted draws to `size` points and move them."""
    found = yield from steps
    if found.reason:
        logger.info("the result of recycling is not reliable, because %s", found.reason)
        yield population, Restart(found.reason)
        return found
    # the last proposal, since it was not fitted to the draws of the check, which are most of the moved points
    points, schedule, effective = found.points, kernel.schedule, found.points.effective_sample_size
    schedule.calibrate(points.coords, coarse_weights(points.log_weights), kernel.density.inside, found.proposal)
    population, distinct = _resampled(points, size, kernel.random)
    yield population, found.check
    if found.independent:  # sweeps would cost evaluations and improve nothing
        for move in schedule.mixtures:
            move.expect_independence()
        moved = Mutated(population, effective / len(points.coords), 0)
    else:
        moved = yield from move_together(population, kernel)
    increment, error = found.log_evidence - found.log_evidence_below_one, found.log_evidence_error
    yield moved.population, Stage(1.0, effective, moved.acceptance, moved.moves, distinct, increment, error)
    if moved.stopped:
        yield moved.population, Weighted(0, effective, float("-inf"), ended=LIMIT)
    return found


def _resampled(points: Population, size: int, random: np.random.RandomState) -> tuple[Population, int]:
    """Weighted points resampled to `size` points at beta = 1, and the number of distinct points among them."""
    ancestors = systematic(normalised_weights(points.log_weights), random, size)
    walkers = points.coords[ancestors], points.records[ancestors], points.effective_sample_size, (ancestors,)
    return Population(1.0, *walkers), len(np.unique(ancestors))


def _from_guide(
    population: Population, density: Density, schedule: MoveSchedule, guide: Guide, session: GuideSession
) -> Steps:
    """Rounds of a guide's draws; raises StoppedEarly with all draws, also at the limit or if they are not usable."""
    found = yield from draw_rounds(population, density, guide, session)
    if found.signed is not None:
        yield population, found.signed
    yield from ((population, each) for each in found.findings)
    pooled = found.pooled
    if pooled is None:
        nothing = Population(1.0, np.empty((0, 0)), np.empty(0), 0.0, (), np.empty(0))
        raise StoppedEarly(nothing, -np.inf, np.inf, guided=True)
    if found.reason and pooled.log_evidence == -np.inf:
        raise ValueError(
            f"none of {len(pooled.coords)} draws of the guide has a finite log-probability: {WHERE_TO_LOOK}, use a "
            "better guide, or run without a guide"
        )
    ended = f"The rounds of the guide ended, because {found.reason}," if found.reason else ""
    why = ended or (LIMIT if found.stopped else "")
    if not why:
        schedule.calibrate(pooled.coords, coarse_weights(pooled.log_weights), density.inside)
    points = Population(1.0, *pooled[:2], pooled.effective_sample_size, (), pooled.log_weights)
    raise StoppedEarly(points, *found.evidence, guided=True, why=why)


def _end_with(end: StoppedEarly, size: int, random: np.random.RandomState, searched: float) -> Steps:
    """Resample weighted points to `size` points at beta = 1; `searched`: simulations made by guides."""
    points, log_weights, effective = end.population, end.population.log_weights, end.population.effective_sample_size
    if len(log_weights) == 0 or np.max(log_weights) == -np.inf:
        search = f", besides {searched:.0f} simulations of the search by the guide" if searched > 0.0 else ""
        advice = f", or {WHERE_TO_LOOK}" if len(log_weights) > 0 else ""
        raise ValueError(
            f"the limit of simulations (max_simulations) ended the run after {len(log_weights)} evaluated points, none "
            f"of which has a finite log-probability{search}: there is nothing to report. Call run_mcmc again with a "
            f"larger limit (the simulations made so far are kept){advice}"
        )
    population, distinct = _resampled(points, size, random)
    known, increment = len(log_weights), end.log_evidence - end.of_stages
    yield population, Weighted(known, effective, pareto_shape(log_weights), points.beta, end.why, end.guided)
    yield population, Stage(1.0, effective, effective / known, 0, distinct, increment, end.error)
