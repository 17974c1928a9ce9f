"""What `CachedSimulations` passes between its steps: simulations that are requested, and results of new ones."""

from typing import NamedTuple

import numpy as np

__all__ = ["Requested", "Simulated"]


class Simulated(NamedTuple):
    """Statistics and reasons of new simulations, and their responses if these were requested."""

    misfit: np.ndarray
    reasons: list[str]
    response: np.ndarray | None


class Requested(NamedTuple):
    """Distinct simulations that were requested, with arrays that are filled in.

    Attributes
    ----------
    keys : list of n bytes
        See `distinct_keys`.
    thetas : (n, n_structural) float
        Structural parameters.
    misfit : (n, n_numbers) float
        Statistics of the residuals; NaN where they are not known.
    known : (n,) bool
        Whether the statistics are known, those of failures included.
    reasons : list of n str
        Reasons of failures.
    response : (n, n_channels, n_steps) float, optional
        Responses, if they were requested.
    cached, on_disk : (n,) bool
        Whether no simulation was needed, and whether the result came from the disk.
    """

    keys: list[bytes]
    thetas: np.ndarray
    misfit: np.ndarray
    known: np.ndarray
    reasons: list[str]
    response: np.ndarray | None
    cached: np.ndarray
    on_disk: np.ndarray
