"""The points of adaptive importance sampling, and the mixture of all densities that they were drawn from.

Deterministic mixture weights: Owen & Zhou (2000), JASA 95(449), doi:10.1080/01621459.2000.10473909.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..proposals.mixture import Mixture, log_density
from .flights import Flight

__all__ = ["Archive", "StartingDensity", "starting_mixture"]


class StartingDensity(NamedTuple):
    """Density that the starting points were drawn from.

    Attributes
    ----------
    made : float
        Number of draws made from it, including those outside the support of the prior.
    log_density : callable
        Function of points (n, ndim) and their records (n,) that returns the logarithm of the density (n,).
    """

    made: float
    log_density: Callable[[np.ndarray, np.ndarray], np.ndarray]


def starting_mixture(n_prior: int, proposals: Sequence[tuple[float, Mixture]]) -> StartingDensity:
    """Density of draws of the prior and of proposals together, by their numbers.

    Parameters
    ----------
    n_prior : int
        Number of draws of the prior.
    proposals : sequence of (int, Mixture)
        Numbers of draws, including those outside the support of the prior, and what they were drawn from.
    """
    made = n_prior + sum(count for count, _ in proposals)

    def log_start(points: np.ndarray, records: np.ndarray) -> np.ndarray:
        total = np.log(n_prior / made) + records["log_prior"]
        for count, mixture in proposals:
            total = np.logaddexp(total, np.log(count / made) + log_density(mixture, points))
        return total

    return StartingDensity(made, log_start)


class Archive:
    """All points that have arrived, and the logarithm of the mixture of all densities that they were drawn from.

    The mixture counts every draw that was submitted, whether it has arrived or not. While some are running, the sum of
    the weights is therefore smaller than the evidence, by the part of the latest draws that is missing.

    Parameters
    ----------
    flight : Flight
        Starting points.
    start : StartingDensity
        What they were drawn from.

    Attributes
    ----------
    coords, records : (n, ndim) float, (n,) structured array
        The points that had arrived at the last `update`, and their records.
    proposals : list of (int, Mixture)
        The proposals in order, and how many draws were made from each.
    """

    def __init__(self, flight: Flight, start: StartingDensity):
        self._flights, self._start = [flight], start
        self.proposals: list[tuple[int, Mixture]] = []
        self._log_made = np.log(start.made)
        self._log_start_of_all = start.log_density(flight.coords, flight.base)
        self._log_mixture_of_all = self._log_made + self._log_start_of_all
        self.update()

    def add(self, mixture: Mixture, made: float, flight: Flight) -> None:
        """Add the draws inside the support, of `made` draws from a mixture."""
        coords = flight.coords
        log_start = self._start.log_density(coords, flight.base)
        log_mixture = self._log_made + log_start
        for count, earlier in self.proposals:
            log_mixture = np.logaddexp(log_mixture, np.log(count) + log_density(earlier, coords))
        self.proposals.append((made, mixture))
        self._flights.append(flight)
        self._log_start_of_all = np.concatenate([self._log_start_of_all, log_start])
        coords_of_all = np.concatenate([flight.coords for flight in self._flights])
        self._log_mixture_of_all = np.logaddexp(
            np.concatenate([self._log_mixture_of_all, log_mixture]), np.log(made) + log_density(mixture, coords_of_all)
        )
        self.update()

    def update(self) -> None:
        """Take in what has arrived."""
        parts = [flight.landed_part() for flight in self._flights]
        parts = [part for part in parts if len(part[0]) > 0] or parts[:1]
        self.coords = np.concatenate([coords for coords, _ in parts])
        self.records = np.concatenate([records for _, records in parts])
        if len(self.coords) == len(self._log_start_of_all):
            self._log_start, self._log_mixture = self._log_start_of_all, self._log_mixture_of_all
        else:
            arrived = np.concatenate([flight.arrived for flight in self._flights])
            self._log_start, self._log_mixture = self._log_start_of_all[arrived], self._log_mixture_of_all[arrived]

    def running(self, latest: bool = True) -> int:
        """Number of points that have not arrived; without those of the latest draws if not `latest`."""
        flights = self._flights if latest else self._flights[:-1]
        return sum(int(np.sum(~flight.arrived)) for flight in flights)

    @property
    def log_ratio(self) -> np.ndarray:
        """Logarithm of the posterior over the starting density; from the prior, the log-likelihood."""
        return self.records["log_prob"] - self._log_start

    def log_target(self, beta: float) -> np.ndarray:
        """Logarithm (n,) of the tempered target, not normalised."""
        alive = self.records["log_prob"] > -np.inf
        return np.where(alive, self._log_start + beta * np.where(alive, self.log_ratio, 0.0), -np.inf)

    def log_weights(self, beta: float) -> np.ndarray:
        """Logarithm of the tempered target over the mixture, (n,); the sum of the weights estimates the evidence."""
        return self.log_target(beta) - self._log_mixture
