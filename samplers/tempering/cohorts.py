"""Draws of a guide that were submitted together and arrive in any order.

The density of a cohort is fixed, and its number of draws is chosen, before any of them is submitted. A cohort becomes a
round (`samplers.tempering.rounds`) when all its draws have arrived. Until then, its draws shape no weight, no share of
a round and no decision on what the result is worth: the first arrivals are those with short evaluations, and not a fair
sample. They may train a guide that says so (`learns_from_parts`), since whatever the density of the next cohort was
made of, its own draws are weighted by it.
"""

from collections.abc import Sequence

import numpy as np

from .flights import Flight, submit_and_wait
from .guide import AdaptedGuide, GuideSession
from .population import Density
from .rounds import Round

__all__ = ["Cohort", "let_arrive", "submit_cohort"]

# The check of the first values of a run needs some that arrive together.
FIRST_TOGETHER = 8


class Cohort:
    """Draws of one density of a guide.

    Parameters
    ----------
    flight : Flight
        The draws.
    log_density : (n,) float
        Logarithm of the density that they were drawn from.

    Attributes
    ----------
    flight : Flight
        See above.
    """

    def __init__(self, flight: Flight, log_density: np.ndarray):
        self.flight, self._log_density = flight, log_density
        self._learned = np.zeros(len(flight.coords), dtype=bool)
        self._observed = flight.arrived.copy()

    def __len__(self) -> int:
        return len(self.flight.coords)

    @property
    def running(self) -> int:
        """Number of draws that have not arrived."""
        return int(np.sum(~self.flight.arrived))

    @property
    def possible(self) -> bool:
        """Whether a draw with a finite log-probability has arrived."""
        return bool(np.any(self.flight.landed_part()[1]["log_prob"] > -np.inf))

    def as_round(self) -> Round:
        """The round of the draws, which have all arrived."""
        coords, records = self.flight.landed_part()
        log_prob = records["log_prob"]
        alive = log_prob > -np.inf
        log_density = self._log_density[self.flight.arrived]
        log_weights = np.where(alive, np.where(alive, log_prob, 0.0) - log_density, -np.inf)
        return Round(coords, records, log_weights)

    def take_observable(self) -> np.ndarray:
        """Draws (m, ndim) that have arrived since the last call or the submission."""
        new = self.flight.arrived & ~self._observed
        self._observed |= new
        return self.flight.coords[new]

    def take_lesson(self, parts: bool) -> tuple[np.ndarray, np.ndarray]:
        """Draws (m, ndim) for the guide to learn from, and their log-probabilities (m,): each draw is taken once.

        `parts`: whether draws are taken before all of the cohort have arrived.
        """
        coords, records = self.flight.landed_part()
        new = ~self._learned[self.flight.arrived] & (parts or self.flight.complete)
        self._learned[np.flatnonzero(self.flight.arrived)[new]] = True
        return coords[new], records["log_prob"][new]

    @property
    def learned(self) -> bool:
        """Whether the guide has learned from all draws."""
        return bool(self._learned.all())


def submit_cohort(coords: np.ndarray, density: Density, guide: AdaptedGuide, session: GuideSession) -> Cohort:
    """Begin to evaluate draws (n, ndim) of the guide, of which a limit of simulations may allow the first few only.

    Raises
    ------
    ValueError
        If the density of the guide is zero at one of its own draws.
    """
    log_density = guide.log_density(coords)
    if np.any(log_density == -np.inf):
        raise ValueError(
            f"guide.log_density is -inf at {int(np.sum(log_density == -np.inf))} of {len(coords)} draws of the guide: "
            "it must return the logarithm of the density that guide.draw draws from"
        )
    observe = guide.observe
    if observe is None or session.asynchronous:
        flight = density.submit(coords)
    else:
        flight = submit_and_wait(density, coords, lambda points: observe(points, session))
    return Cohort(flight, log_density[: len(flight.coords)])


def let_arrive(
    cohorts: Sequence[Cohort], most: int, density: Density, guide: AdaptedGuide, session: GuideSession
) -> None:
    """Wait until at most this number of the latest cohort is running, and nothing of the earlier ones.

    The guide observes draws as they arrive, a few at a time, so that a run that is killed has kept nearly all of them.
    """
    while cohorts:
        running = [cohort.running for cohort in cohorts]
        if sum(running[:-1]) == 0 and running[-1] <= most:
            return
        step = 1 if density.evaluations > 0 else FIRST_TOGETHER
        density.wait(max(sum(running) - step, 0))
        for cohort in cohorts if guide.observe is not None else ():
            arrived = cohort.take_observable()
            if len(arrived) > 0:
                guide.observe(arrived, session)
