"""What is known when the limit of simulations ends an annealing: points with their weights at beta = 1."""

import numpy as np

from .population import Population
from .rounds import tail_variance
from .weights import effective_sample_size, log_mean_weight

__all__ = [
    "LARGEST_ERROR",
    "LARGEST_SHAPE",
    "NothingToReport",
    "StoppedEarly",
    "fewest_points",
    "stop_at",
    "usable",
]


# Weights of a larger Pareto shape have no useful mean (Vehtari et al. 2024, JMLR 25(72)).
LARGEST_SHAPE = 0.7
# Log-evidences with a larger standard error distinguish hardly any models, and the same weights give the means.
LARGEST_ERROR = 0.35
# Fewer effective points, or fewer per parameter (and one more), do not determine means and covariances.
FEWEST_POINTS = 20.0
POINTS_PER_DIMENSION = 3.0


def fewest_points(ndim: int) -> float:
    """Smallest effective sample size of weighted points from which a population is usable."""
    return max(FEWEST_POINTS, POINTS_PER_DIMENSION * (ndim + 1.0))


def usable(effective_sample_size: float, pareto_shape: float, error: float, ndim: int) -> bool:
    """Whether weighted points give means and an evidence with errors that can be stated."""
    enough = effective_sample_size >= fewest_points(ndim)
    return enough and pareto_shape < LARGEST_SHAPE and error <= LARGEST_ERROR


class NothingToReport(ValueError):
    """The limit of simulations has ended an annealing in which no possible point is known."""


class StoppedEarly(Exception):
    """The limit of simulations has ended an annealing.

    Parameters
    ----------
    population : Population
        The points that are known, with log-weights at beta = 1 unless `complete`.
    log_evidence, error : float
        Log-evidence of these weights, and its standard error.
    beta : float
        Tempering exponent that the points were made for.
    log_evidence_of_stages : float
        Part of the log-evidence that is in stages already reported.
    complete : bool
        Whether beta = 1 was reached and its stage reported; the population is then equally weighted.
    from_guide : bool
        Whether the points are the draws of a guide.
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
        """Of the weights at beta = 1, where copies of a point count as one point."""
        log_weights = self.population.log_weights
        if log_weights is None or len(log_weights) == 0:
            return self.population.effective_sample_size
        return effective_sample_size(_of_distinct_points(self.population.coords, log_weights))


def _of_distinct_points(coords: np.ndarray, log_weights: np.ndarray) -> np.ndarray:
    """Log-weights of the distinct points among (n, ndim); those of copies are added."""
    distinct, owner = np.unique(coords, axis=0, return_inverse=True)
    total = np.full(len(distinct), -np.inf)
    np.logaddexp.at(total, owner.reshape(-1), log_weights)
    return total


def stop_at(
    population: Population,
    log_evidence: float,
    error: float,
    log_evidence_of_stages: float = 0.0,
    log_start: np.ndarray | None = None,
) -> StoppedEarly:
    """Weigh equally weighted points at some beta by the posterior.

    Parameters
    ----------
    population : Population
        Equally weighted points at `population.beta`.
    log_evidence : float
        Log-evidence at this beta.
    error : float
        Its standard error.
    log_evidence_of_stages : float
        Part of it that is in stages already reported.
    log_start : (n,) float, optional
        Log-density at beta = 0; that of the prior by default.

    Returns
    -------
    StoppedEarly
        To be raised.
    """
    records = population.records
    alive = records["log_prob"] > -np.inf
    base = records["log_prior"] if log_start is None else log_start
    ratio = np.where(alive, records["log_prob"], 0.0) - np.where(alive, base, 0.0)
    log_weights = np.where(alive, (1.0 - population.beta) * ratio, -np.inf)
    population = population._replace(log_weights=log_weights)
    if not alive.any():
        return StoppedEarly(population, float("-inf"), float("inf"), population.beta, log_evidence_of_stages)
    increment = log_mean_weight(log_weights)
    distinct = _of_distinct_points(population.coords, log_weights)
    variance = error**2 + 1.0 / effective_sample_size(distinct) - 1.0 / len(distinct) + tail_variance(distinct)
    total = log_evidence + increment
    return StoppedEarly(population, total, float(np.sqrt(variance)), population.beta, log_evidence_of_stages)
