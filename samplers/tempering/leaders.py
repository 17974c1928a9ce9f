"""Chains of transitional Markov chain Monte Carlo, which grow from the resampled points (``docs/theory/tempering``).

The first points of a chain have made few steps, and the leaders of long chains have large weights, so the new points
have a bias, which decreases with the steps that every chain makes before its points count (burn-in). If many points are
copies, the next fit and the next weights see too few distinct points: with 100 walkers and 12 parameters, the means
were wrong by 1 to 6 standard deviations. So all points are swept together afterwards, until they are nearly
uncorrelated with the resampled points. Without a burn-in, the algorithm is as published.
"""

from collections.abc import Generator

import numpy as np
from emcee import State

from ..budget import BudgetExhausted
from ..reports import Sweep
from ..settings import Settings
from .mutation import (
    MoveSchedule,
    Mutated,
    StartCorrelation,
    VisitedPoints,
    move_together,
    tempered_log_prob,
    tempered_model,
)
from .population import Density, Population

__all__ = ["grow_chains"]


def grow_chains(
    population: Population,
    ancestors: np.ndarray,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
    visited: VisitedPoints | None = None,
) -> Generator[tuple[Population, Sweep], None, Mutated]:
    """Grow a chain from each distinct point (leader), one step per copy of it, after ``settings.burn_in`` steps of all.

    The first step moves all chains together, later ones those that are long enough. With a burn-in, sweeps over all
    points follow if these are still correlated with the resampled points. `ancestors` (n,) are equal for copies.
    """
    beta, coords, records = population.beta, population.coords, population.records
    model = tempered_model(density, beta, random, visited)
    _, first, owner, counts = np.unique(ancestors, return_index=True, return_inverse=True, return_counts=True)
    place = np.argsort(owner, kind="stable")
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    chains = State(coords[first], log_prob=tempered_log_prob(records[first], beta), blobs=records[first])
    correlation = StartCorrelation(coords, records)
    coords, records = coords.copy(), records.copy()
    population = population._replace(coords=coords, records=records)
    accepted_steps, steps = 0, 0
    for length in range(-settings.burn_in, int(counts.max())):
        growing = np.flatnonzero(counts > length)
        schedule.follow(ancestors[first[growing]])
        move = schedule.choose(random)
        state = State(chains.coords[growing], log_prob=chains.log_prob[growing], blobs=chains.blobs[growing])
        try:
            state, accepted = move.propose(model, state)
        except BudgetExhausted:
            return Mutated(population, accepted_steps / max(steps, 1), 0, 1.0, True)
        move.tune(state, accepted)
        chains.coords[growing], chains.log_prob[growing] = state.coords, state.log_prob
        chains.blobs[growing] = state.blobs
        if length >= 0:
            rows = place[start[growing] + length]
            coords[rows], records[rows] = state.coords, state.blobs
        accepted_steps, steps = accepted_steps + int(np.sum(accepted)), steps + len(growing)
        yield population, Sweep(float(np.mean(accepted)))
    correlation.update(coords, records)
    grown = Mutated(population, accepted_steps / steps, settings.burn_in + 1, correlation.values[-1])
    if settings.burn_in == 0 or grown.correlation < settings.max_correlation:
        return grown
    schedule.follow(ancestors)
    arguments = density, random, schedule, settings, visited
    return (yield from move_together(population, *arguments, grown.moves, correlation))
