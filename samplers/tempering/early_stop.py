"""The end of an annealing by the limit of simulations: the known points with their weights at beta = 1."""

import numpy as np

from ..estimates.importance import tail_variance
from ..estimates.weights import effective_sample_size, log_mean_weight
from .population import Population

__all__ = ["StoppedEarly", "stop_at"]


class StoppedEarly(Exception):
    """The limit of simulations has ended an annealing at `beta`; the known points have log-weights at beta = 1.

    `log_evidence_of_stages` is the part that was already reported. If `complete`, beta = 1 was reached and the
    population is equally weighted. `from_guide`: the points are draws of a guide.
    """

    def __init__(
        self,
        population: Population,
        log_evidence: float,
        error: float,
        beta: float,
        log_evidence_of_stages: float = 0.0,
        complete: bool = False,
        from_guide: bool = False,
    ):
        super().__init__("the limit of simulations (max_simulations) ended the annealing")
        self.population, self.log_evidence, self.error, self.beta = population, log_evidence, error, beta
        self.log_evidence_of_stages, self.complete, self.from_guide = log_evidence_of_stages, complete, from_guide

    @property
    def effective_sample_size(self) -> float:
        """Effective sample size at beta = 1, where copies of a point count as one point."""
        log_weights = self.population.log_weights
        if log_weights is None or len(log_weights) == 0:
            return self.population.effective_sample_size
        return effective_sample_size(_of_distinct_points(self.population.coords, log_weights))


def _of_distinct_points(coords: np.ndarray, log_weights: np.ndarray) -> np.ndarray:
    """Log-weights of the distinct points among (n, ndim); the weights of copies are added."""
    distinct, owner = np.unique(coords, axis=0, return_inverse=True)
    total = np.full(len(distinct), -np.inf)
    np.logaddexp.at(total, owner.reshape(-1), log_weights)
    return total


def stop_at(
    population: Population, log_evidence: float, error: float, log_evidence_of_stages: float = 0.0
) -> StoppedEarly:
    """The error to be raised: equally weighted points at `population.beta`, weighted by the posterior.

    `log_evidence` and `error` belong to the beta of the points; `log_evidence_of_stages` was already reported.
    """
    records = population.records
    alive = records["log_prob"] > -np.inf
    ratio = np.where(alive, records["log_prob"], 0.0) - np.where(alive, records["log_prior"], 0.0)
    log_weights = np.where(alive, (1.0 - population.beta) * ratio, -np.inf)
    population = population._replace(log_weights=log_weights)
    if not alive.any():
        return StoppedEarly(population, float("-inf"), float("inf"), population.beta, log_evidence_of_stages)
    increment = log_mean_weight(log_weights)
    distinct = _of_distinct_points(population.coords, log_weights)
    variance = error**2 + 1.0 / effective_sample_size(distinct) - 1.0 / len(distinct) + tail_variance(distinct)
    total = log_evidence + increment
    return StoppedEarly(population, total, float(np.sqrt(variance)), population.beta, log_evidence_of_stages)
