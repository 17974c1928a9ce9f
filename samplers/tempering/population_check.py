"""The population at the end of annealing by moves, compared with fresh draws from all parts that any stage has seen.

A mixture is fitted to the final points, and covers points of earlier stages that the final ones do not explain
(`samplers.proposals.basins`). The weights of draws from this mixture are exact, so they estimate the evidence without
the stages, and the share of each component in the posterior. If moves have lost a mode, or given it a wrong weight,
both differ from what the moves found.
"""

import numpy as np

from ..proposals.basins import cover_basins
from ..proposals.mixture import Mixture, fit_mixture, log_density, log_responsibilities
from ..proposals.support_bounds import find_support_bounds
from .evidence_check import EvidenceCheck, draw_inside, evidence_from_weights
from .genealogy import standard_error_of_mean
from .population import Doubt, Population
from .watched_density import WatchedDensity
from .weights import normalised_weights

__all__ = ["check_population", "check_shares"]

# Difference of two shares of a component, from which on it is reported if it is also significant.
LARGE_DIFFERENCE = 0.1


def check_population(
    population: Population,
    density: WatchedDensity,
    log_evidence: float,
    random: np.random.RandomState,
    draws: int | None,
) -> tuple[EvidenceCheck, list[Doubt]]:
    """Estimate evidence and shares of the posterior's parts by fresh draws.

    Parameters
    ----------
    population : Population
        The final points, at beta = 1 and equally weighted.
    density : WatchedDensity
        Evaluates points, and knows those of all stages.
    log_evidence : float
        Log-evidence of the stages.
    random : RandomState
        Source of random numbers.
    draws : int, optional
        Number of draws; by default as many as there are final points.

    Returns
    -------
    check : EvidenceCheck
        The evidence.
    doubts : list of Doubt
        See `check_shares`.
    """
    coords, n = population.coords, len(population.coords)
    mixture = fit_mixture(coords, np.full(n, 1.0 / n), bounds=find_support_bounds(density.inside, coords))
    visited, log_target = density.visited(1.0)
    mixture = cover_basins(mixture, visited, log_target - log_evidence)
    drawn, made = draw_inside(mixture, n if draws is None else draws, random, density.inside)
    log_weights = density.evaluate(drawn)["log_prob"] - log_density(mixture, drawn)
    return evidence_from_weights(log_weights, made), check_shares(mixture, population, drawn, log_weights)


def check_shares(mixture: Mixture, population: Population, coords: np.ndarray, log_weights: np.ndarray) -> list[Doubt]:
    """A doubt if a part of the posterior has another share among the final points than among weighted draws.

    The parts are the components of the mixture that the draws come from. Each draw and each point counts for the
    components by its responsibilities. A difference is reported if it exceeds 0.1 and three standard errors.

    Parameters
    ----------
    mixture : Mixture
        Proposal of the draws, which also covers points of earlier stages.
    population : Population
        The final points, equally weighted.
    coords, log_weights : (n, ndim) float, (n,) float
        Draws of the mixture and their log-weights.

    Returns
    -------
    list of Doubt
    """
    if len(mixture.weights) == 1 or not np.any(log_weights > -np.inf):
        return []
    weights = normalised_weights(log_weights)
    of_draws = np.exp(log_responsibilities(mixture, coords))
    of_points = np.exp(log_responsibilities(mixture, population.coords))
    expected, found = weights @ of_draws, of_points.mean(axis=0)
    error = np.hypot(
        np.sqrt(weights**2 @ (of_draws - expected) ** 2),
        standard_error_of_mean(of_points[None], population.founders[0]),
    )
    difference = np.abs(found - expected)
    wrong = difference > np.maximum(LARGE_DIFFERENCE, 3.0 * error)
    if not wrong.any():
        return []
    worst = int(np.argmax(np.where(wrong, difference, 0.0)))
    message = (
        f"a part of the posterior has the share {found[worst]:.2f} among the final points and {expected[worst]:.2f} "
        f"+- {error[worst]:.2f} among weighted draws from all parts that any stage has seen: a mode has been lost or "
        "has a wrong weight. Use more walkers or more moves, and compare two runs"
    )
    return [Doubt(message, True)]
