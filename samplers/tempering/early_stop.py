"""The end of an annealing by the limit of simulations: the known points with their weights at beta = 1."""

import numpy as np

from ..estimates.importance import tail_variance
from ..estimates.weights import effective_sample_size, log_mean_weight
from ..reports import LIMIT
from .population import Population

__all__ = ["StoppedEarly", "stop_at"]


class StoppedEarly(Exception):
    """The limit of simulations has ended an annealing at `beta`; the known points have log-weights at beta = 1.

    `of_stages` is the part of the log-evidence that was already reported. `guided`: the points are draws of a guide;
    `why` the run ended.
    """

    def __init__(
        self,
        population: Population,
        log_evidence: float,
        error: float,
        beta: float,
        of_stages: float = 0.0,
        guided: bool = False,
        why: str = LIMIT,
    ):
        super().__init__(why)
        self.population, self.log_evidence, self.error, self.beta = population, log_evidence, error, beta
        self.of_stages, self.guided, self.why = of_stages, guided, why

    @property
    def effective_sample_size(self) -> float:
        """Effective sample size at beta = 1, where copies of a point count as one point."""
        return effective_sample_size(_of_distinct_points(self.population.coords, self.population.log_weights))


def _of_distinct_points(coords: np.ndarray, log_weights: np.ndarray) -> np.ndarray:
    """Log-weights of the distinct points among (n, ndim); the weights of copies are added."""
    distinct, owner = np.unique(coords, axis=0, return_inverse=True)
    total = np.full(len(distinct), -np.inf)
    np.logaddexp.at(total, owner.reshape(-1), log_weights)
    return total


def stop_at(population: Population, log_evidence: float, error: float, of_stages: float = 0.0) -> StoppedEarly:
    """The error to be raised: equally weighted points at `population.beta`, weighted by the posterior.

    `log_evidence` and `error` belong to the beta of the points; `of_stages` was already reported.
    """
    records = population.records
    alive = records["log_prob"] > -np.inf
    ratio = np.where(alive, records["log_prob"], 0.0) - np.where(alive, records["log_prior"], 0.0)
    log_weights = np.where(alive, (1.0 - population.beta) * ratio, -np.inf)
    population = population._replace(log_weights=log_weights)
    if not alive.any():
        return StoppedEarly(population, float("-inf"), float("inf"), population.beta, of_stages)
    distinct = _of_distinct_points(population.coords, log_weights)
    variance = error**2 + 1.0 / effective_sample_size(distinct) - 1.0 / len(distinct) + tail_variance(distinct)
    total = log_evidence + log_mean_weight(log_weights)
    return StoppedEarly(population, total, float(np.sqrt(variance)), population.beta, of_stages)
