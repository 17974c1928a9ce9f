"""Populations of points at one beta."""

from typing import Any, NamedTuple

import numpy as np

__all__ = ["Density", "Population", "check_size"]


Density = Any  # a `samplers.evaluation.evaluator.Evaluator`, which imports this package


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
