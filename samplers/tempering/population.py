"""Populations, and the posterior density as the annealing evaluates it."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from .pending_points import PendingPoints

__all__ = ["Density", "Population", "check_size"]


class Density(Protocol):
    """A posterior density with its prior, as annealing evaluates it.

    `map` is ``map`` or ``pool.map``, for emcee moves that evaluate points by themselves.
    """

    evaluations: int  # number of points evaluated so far
    workers: int  # number of points that are evaluated at once, if `submit` returns without waiting; else 0

    @property
    def map(self) -> Callable: ...

    def evaluate(
        self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None, then: Callable | None = None
    ) -> np.ndarray:
        """Records (n,) of points (n, ndim), with the fields log_prob, log_prior and, where there are any, blobs.

        `observe` is called with the points directly before they are evaluated, for a guide with a method `observe`. If
        `then` is given, ``then(coords, records)`` is returned.
        """

    def submit(self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None) -> PendingPoints:
        """Begin to evaluate points (n, ndim); a synchronous density returns when all are evaluated.

        With a limit of simulations, the first points that fit are submitted.
        """

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""

    def more_draws(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Draws (m, ndim) of the prior: m is `n`, or 0 if the density cannot be drawn from."""

    def inside(self, coords: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) lies in the support of the prior: (n,) bool."""


class Population(NamedTuple):
    """Points at one beta."""

    beta: float  # 0 for draws of the prior, 1 for draws of the posterior
    coords: np.ndarray  # (n, ndim)
    records: np.ndarray | None  # (n,), fields log_prob, log_prior and, where there are any, blobs; None: not evaluated
    effective_sample_size: float  # of the weights that led to this population
    founders: tuple[np.ndarray, ...] = ()  # of (n,) int, see `samplers.estimates.genealogy.trace_founders`
    log_weights: np.ndarray | None = None  # (n,), at `beta`; None for equally weighted points


def check_size(nwalkers: int, ndim: int) -> None:
    """Raise ValueError for too few walkers or parameters."""
    if ndim < 1 or nwalkers < 2 * ndim:
        raise ValueError(
            "a population must span the parameters: at least 2 ndim walkers and one parameter are needed, some "
            f"hundreds of walkers are usual; got nwalkers={nwalkers} for ndim={ndim}"
        )
