"""Sequential Monte Carlo, as in Del Moral, Doucet & Jasra (2006), section 3: from draws of the prior to the posterior.

The equations of the five steps of a stage are in ``docs/theory/tempering``. Weights depend only on the points before
the moves, so steps 1 to 4 need no evaluation.
"""

from collections.abc import Generator

import numpy as np

from ..estimates.genealogy import trace_founders
from ..estimates.weights import (
    EvidenceError,
    coarse_weights,
    effective_sample_size,
    log_mean_weight,
    next_beta,
    normalised_weights,
)
from ..reports import Stage, Sweep
from .mutation import Kernel, grow_chains, move_together
from .population import Population, stop_at


def anneal_by_moves(
    population: Population, n: int, kernel: Kernel
) -> Generator[tuple[Population, Stage | Sweep], None, tuple[Population, float]]:
    """Carry evaluated draws of the prior, as many or more than the `n` points of later stages, to beta = 1.

    Yields the points as they are now with a report, and returns the points at beta = 1 and the
    log-evidence. Raises StoppedEarly at the limit of simulations.
    """
    m, (density, random, schedule, settings, visited) = len(population.coords), kernel
    target, log_evidence, error = float(n), 0.0, EvidenceError(m)
    while population.beta < 1.0:
        log_likelihood = population.records["log_prob"] - population.records["log_prior"]

        # 1. choose beta
        target = settings.target(target, n)
        beta = next_beta(log_likelihood, population.beta, target * (len(log_likelihood) / n))

        # 2. weigh
        log_weights = (beta - population.beta) * log_likelihood
        weights, ess = normalised_weights(log_weights), effective_sample_size(log_weights)

        # 3. estimate the evidence
        increment, standard_error = log_mean_weight(log_weights), error.weigh(weights)
        log_evidence += increment

        # fit the moves to the weighted points, and to parts of the target that this fit does not cover
        schedule.calibrate(population.coords, coarse_weights(log_weights), density.inside)
        coords, log_target = visited.at(beta)
        for move in schedule.mixtures:
            move.cover_basins(coords, log_target - log_evidence)

        # 4. resample
        ancestors = settings.resample(weights, random, n)
        error.resample(ancestors)
        founders = trace_founders(population.founders, ancestors)
        population = Population(beta, population.coords[ancestors], population.records[ancestors], ess, founders)
        distinct = len(np.unique(population.coords, axis=0))

        # 5. move
        schedule.follow(ancestors)
        if settings.chains == "leaders":
            moved = yield from grow_chains(population, ancestors, kernel)
        else:
            moved = yield from move_together(population, kernel)
        population = moved.population
        if moved.stopped:
            raise stop_at(population, log_evidence, standard_error**2, log_evidence - increment)
        yield population, Stage(beta, ess, moved.acceptance, moved.moves, distinct, increment, standard_error)
    return population, log_evidence
