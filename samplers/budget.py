"""Simulations of a run: how many there were, and whether more fit into a limit.

An evaluation needs a simulation unless only fast parameters differ from an evaluated point in the record. A limit only
ends a run: one that is continued with a larger limit repeats the same steps from the record, and continues.
"""

from numbers import Real
from typing import Any

import numpy as np

from .record import Record

__all__ = ["Budget", "BudgetExhausted", "as_limit"]

# Guides count parts of a simulation as fractions: their sums, in another order, differ by less.
ROUNDING = 1e-6
OF_GUIDES = "simulations of guides"  # key in the record


class BudgetExhausted(Exception):
    """The limit of simulations (max_simulations) does not allow a batch, of which nothing was evaluated."""


def as_limit(value: Any) -> float | None:
    """A limit of simulations as float, or None for no limit; ValueError for anything but a positive number."""
    if value is None:
        return None
    if isinstance(value, bool | str) or not isinstance(value, Real) or not value > 0.0:
        raise ValueError(f"max_simulations must be a positive number, or None for no limit; got {value!r}")
    return float(value)


class Budget:
    """Counts simulations, from the evaluated points of a `record`, and compares them with a `limit` (None: no limit).

    Simulations that a guide makes by itself, its attribute ``simulations``, are counted in addition. `refused` says
    whether `fits` has returned False for the guide in use.
    """

    def __init__(self, record: Record, limit: float | None = None):
        self._record, self.limit = record, limit
        self._allowed = 0.0
        self._running: set[bytes] = set()  # points that were submitted, and may not be in the record yet
        self.restart(0.0)

    def restart(self, of_earlier_guides: float) -> None:
        """An annealing begins, after guides have made this number of simulations by themselves."""
        self._of_earlier_guides = of_earlier_guides
        self._guide: Any = None
        self.refused = False
        noted = self._record.noted(OF_GUIDES)
        self._of_record = 0.0 if noted is None else float(noted[0])
        self._running.clear()

    def take_from_record(self) -> None:
        """Guides have made the simulations that the record says: the annealing is not made again."""
        self._of_earlier_guides, self._guide = max(self._of_record, self._of_earlier_guides), None

    def note(self) -> None:
        """Note in the record how many simulations guides have made, including the last allowed batch."""
        self._record.note(OF_GUIDES, np.array([max(self.of_guides, self._allowed)]))

    def begin(self, guide: Any) -> None:
        """Count the simulations of a new guide from now on, in addition to the simulations of earlier guides."""
        self._of_earlier_guides = self.of_guides
        self._guide, self.refused = guide, False

    @property
    def of_guides(self) -> float:
        """Simulations that guides have made by themselves."""
        return self._of_earlier_guides + (0.0 if self._guide is None else self._guide.simulations)

    @property
    def simulations(self) -> float:
        """Distinct points in the slow parameters, and the simulations of guides."""
        simulated = self._record.simulated
        return len(simulated) + len(self._running - simulated) + self.of_guides

    @property
    def remaining(self) -> float:
        """Simulations left; inf without a limit."""
        return np.inf if self.limit is None else max(self.limit - self.simulations, 0.0)

    def fits(self, simulations: float) -> bool:
        """Whether this number of further simulations by the guide fits; `refused` notes a refusal.

        Simulations that the guide repeats from the record cost nothing, and always fit.
        """
        fit = self.of_guides + simulations <= self._of_record + ROUNDING or simulations <= self.remaining + ROUNDING
        self.refused = self.refused or not fit
        if fit:
            self._allowed = self.of_guides + simulations
        return fit

    def submitted(self, coords: np.ndarray) -> None:
        """Points (n, ndim) begin to be evaluated, and count from now on."""
        self._running = (self._running - self._record.simulated) | set(self._record.keys(coords))

    def closed(self) -> None:
        """Points that were running and are not in the record have been given up."""
        self._running.clear()

    def fitting(self, coords: np.ndarray) -> int:
        """Number of leading points among (n, ndim) that fit."""
        if self.limit is None:
            return len(coords)
        remaining, new, known = self.remaining, set(), self._record.simulated
        for number, key in enumerate(self._record.keys(coords)):
            if key not in known and key not in self._running:
                new.add(key)
                if len(new) > remaining:
                    return number
        return len(coords)
