"""A density that keeps the points it has evaluated, as far as they may still show a part of the target.

While beta is small, a narrow mode has few points, and the next resampling replaces most of them. They are kept here,
with proposals that were not accepted, so that `samplers.proposals.basins` can propose draws there, and so that the
result can be compared with them.
"""

from collections.abc import Callable

import numpy as np

from .flights import Flight, submit_and_wait
from .mutation import tempered_log_prob
from .population import Density

__all__ = ["WatchedDensity"]

# Largest number of points that are kept.
MOST_POINTS = 10_000
KEPT_FIELDS = ("log_prior", "log_prob")


class WatchedDensity:
    """A density (`samplers.tempering.population.Density`) that keeps the points it has evaluated.

    Parameters
    ----------
    density : Density
        Evaluates points.
    """

    def __init__(self, density: Density):
        self._density = density
        self._coords: list[np.ndarray] = []
        self._records: list[np.ndarray] = []

    @property
    def evaluations(self) -> int:
        """Number of points evaluated so far, also before they were kept."""
        return self._density.evaluations

    @property
    def map(self) -> Callable:
        """How an emcee move that evaluates points by itself maps a function over them."""
        return self._density.map

    def inside(self, coords: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) lies in the support of the prior: (n,) bool."""
        return self._density.inside(coords)

    def evaluate(self, coords: np.ndarray) -> np.ndarray:
        """Records (n,) of points (n, ndim), which are kept."""
        records = self._density.evaluate(coords)
        self.add(coords, records)
        return records

    def evaluate_observed(self, coords: np.ndarray, observe: Callable[[np.ndarray], None]) -> np.ndarray:
        """As `evaluate`, but `observe` is called with the points directly before they are evaluated."""
        records = self._density.evaluate_observed(coords, observe)
        self.add(coords, records)
        return records

    @property
    def workers(self) -> int:
        """0: moves wait for the points that they propose."""
        return 0

    def submit(self, coords: np.ndarray) -> Flight:
        """As `evaluate`; the points have arrived."""
        return submit_and_wait(self, coords)

    def wait(self, most: int) -> None:
        """Nothing runs."""

    def add(self, coords: np.ndarray, records: np.ndarray) -> None:
        """Keep points (n, ndim) that were evaluated elsewhere; of their records (n,), log_prior and log_prob."""
        possible = records["log_prob"] > -np.inf
        kept = np.empty(np.count_nonzero(possible), [(name, float) for name in KEPT_FIELDS])
        for name in KEPT_FIELDS:
            kept[name] = records[name][possible]
        self._coords.append(coords[possible])
        self._records.append(kept)

    def visited(self, beta: float) -> tuple[np.ndarray, np.ndarray]:
        """The points (n, ndim) and the logarithm (n,) of the tempered target there, not normalised.

        If there are more than 10 000, those with the lowest target are dropped.
        """
        coords, records = np.concatenate(self._coords), np.concatenate(self._records)
        log_target = tempered_log_prob(records, beta)
        if len(coords) > MOST_POINTS:
            highest = np.sort(np.argpartition(-log_target, MOST_POINTS)[:MOST_POINTS])
            coords, records, log_target = coords[highest], records[highest], log_target[highest]
        self._coords, self._records = [coords], [records]
        return coords, log_target
