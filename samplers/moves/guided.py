"""Independence Metropolis-Hastings with the draws of a guide.

A point x is replaced by a draw y of density q with the probability min(1, [p(y) / q(y)] / [p(x) / q(x)]), where p is
the posterior density. This is exact for any density q that does not change, since the normalising constants cancel.
Each walker needs at most one evaluation per sweep.

Reference: Tierney, L. (1994), Markov chains for exploring posterior distributions, Annals of Statistics 22(4),
doi:10.1214/aos/1176325750 (section 2.3.3, independence chains).
"""

from typing import Protocol

import numpy as np
from emcee.moves import MHMove

__all__ = ["DrawsWithDensity", "GuideMove"]


class DrawsWithDensity(Protocol):
    """A distribution with independent draws and a normalised log-density (`samplers.tempering.guide.Guide`)."""

    def draw(self, n: int, random: np.random.RandomState) -> np.ndarray:
        """Independent draws (n, ndim)."""

    def log_density(self, coords: np.ndarray) -> np.ndarray:
        """Log-density (n,) at points (n, ndim); -inf is allowed."""


class GuideMove(MHMove):
    """Propose one independent draw of a guide for each walker.

    A walker at a point where the density of the guide is zero does not move.

    Parameters
    ----------
    guide : object with methods draw and log_density
        The proposal distribution, which must not change.
    """

    def __init__(self, guide: DrawsWithDensity):
        super().__init__(self._draw)
        self._guide = guide

    @property
    def guide(self) -> DrawsWithDensity:
        """The proposal distribution."""
        return self._guide

    def _draw(self, coords: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        proposed = self._guide.draw(len(coords), random)
        here, there = self._guide.log_density(coords), self._guide.log_density(proposed)
        possible = (here > -np.inf) & (there > -np.inf)
        factors = np.full(len(coords), -np.inf)
        factors[possible] = here[possible] - there[possible]
        return proposed, factors
