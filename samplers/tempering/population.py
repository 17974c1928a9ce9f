"""Populations of points at one beta, points that wait for their values, and the end by the limit of simulations."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..estimates.importance import tail_variance
from ..estimates.weights import effective_sample_size, log_mean_weight
from ..reports import LIMIT

RECORD = [("log_prob", np.float64), ("log_prior", np.float64)]  # of an evaluated point without blobs


Density = Any  # a `samplers.evaluation.evaluator.Evaluator`, which imports this package


class Population(NamedTuple):
    """Points at one beta."""

    beta: float  # 0 for draws of the prior, 1 for draws of the posterior
    coords: np.ndarray  # (n, ndim)
    records: np.ndarray | None  # (n,), fields log_prob, log_prior and, where there are any, blobs; None: not evaluated
    effective_sample_size: float  # of the weights that led to this population
    founders: tuple[np.ndarray, ...] = ()  # of (n,) int, see `samplers.estimates.genealogy.trace_founders`
    log_weights: np.ndarray | None = None  # (n,), at `beta`; None for equally weighted points


class PendingPoints:
    """Points (n, ndim) that were submitted together for evaluation, and their known records; only those `arrived` (n,)
    shape proposals, and only complete batches become part of a result. `refused`: the limit refused further points.
    """

    def __init__(
        self, coords: np.ndarray, log_prior: np.ndarray, refused: bool = False, records: np.ndarray | None = None
    ):
        self.coords, self.log_prior, self.refused = coords, log_prior, refused
        self.arrived = (log_prior == -np.inf) | (records is not None)
        self._records = records

    def _none_known(self, dtype: Any) -> np.ndarray:
        records = np.zeros(len(self.coords), dtype)
        records["log_prob"], records["log_prior"] = -np.inf, self.log_prior
        return records

    def arrive(self, rows: np.ndarray, records: np.ndarray) -> None:
        """Enter the records (m,) of points that have arrived, by their rows (m,)."""
        self._records = self._none_known(records.dtype) if self._records is None else self._records
        self._records[rows] = records
        self.arrived[rows] = True

    @property
    def running(self) -> int:
        """Number of points that have not arrived."""
        return int(np.sum(~self.arrived))

    def arrived_part(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (m, ndim) that have arrived, and their records (m,), in the order of submission."""
        records = self._none_known(RECORD) if self._records is None else self._records
        return self.coords[self.arrived], records[self.arrived]


def check_size(nwalkers: int, ndim: int) -> None:
    """Raise ValueError for too few walkers or parameters."""
    if ndim < 1 or nwalkers < 2 * ndim:
        raise ValueError(
            "a population must span the parameters: at least 2 ndim walkers and one parameter are needed, some "
            f"hundreds of walkers are usual; got nwalkers={nwalkers} for ndim={ndim}"
        )


@dataclass(eq=False)
class StoppedEarly(Exception):
    """An annealing has ended with points that have log-weights at beta = 1."""

    population: Population
    log_evidence: float
    error: float
    of_stages: float = 0.0  # the part of the log-evidence that was reported before
    guided: bool = False  # whether the points are draws of a guide
    why: str = LIMIT  # it has ended; empty: as wanted


def stop_at(population: Population, log_evidence: float, variance: float, of_stages: float = 0.0) -> StoppedEarly:
    """The error to be raised: points with log-weights at beta = 1, or equally weighted at `population.beta`.

    `log_evidence` and its `variance` are what the points had before these weights; `of_stages` was already reported.
    """
    coords, log_weights, records = population.coords, population.log_weights, population.records
    if log_weights is None:
        alive = records["log_prob"] > -np.inf
        ratio = np.where(alive, records["log_prob"], 0.0) - np.where(alive, records["log_prior"], 0.0)
        log_weights = np.where(alive, (1.0 - population.beta) * ratio, -np.inf)
    unique, owner = np.unique(coords, axis=0, return_inverse=True)
    distinct = np.full(len(unique), -np.inf)  # the weights of copies are added
    np.logaddexp.at(distinct, owner.reshape(-1), log_weights)
    effective = effective_sample_size(distinct)
    population = population._replace(log_weights=log_weights, effective_sample_size=effective)
    if effective == 0.0:
        return StoppedEarly(population, float("-inf"), float("inf"), of_stages)
    variance = max(variance + 1.0 / effective - 1.0 / len(distinct), 0.0) + tail_variance(distinct)
    return StoppedEarly(population, log_evidence + log_mean_weight(log_weights), float(np.sqrt(variance)), of_stages)
