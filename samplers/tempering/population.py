"""Populations of points at one beta."""

from typing import Any, NamedTuple

import numpy as np

__all__ = ["RECORD", "Density", "PendingPoints", "Population", "check_size"]

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
    """Points (n, ndim) that were submitted together for evaluation, and their known records; some may still be running.

    Points that have arrived may shape further proposals, but only complete batches may become part of the result: if
    evaluation times depend on the parameters, the first arrivals are not a fair sample of the proposal. `refused`: the
    limit of simulations refused further points. `arrived` (n,) bool are the points with all records: of a synchronous
    density all, else at first those outside the support of the prior.
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
