"""Simulations of a run: how many there were, and whether more fit into a limit.

An evaluation needs a simulation unless only fast parameters differ from an earlier point. Therefore distinct points in
the slow parameters are counted, and the simulations that a guide made by itself are added.

A limit never changes what a run does: it only ends it. So a run that is continued with a larger limit repeats the same
steps and goes on. The simulations of the interrupted run are counted from the start of its continuation, and cost
nothing more. A limit below their number acts as a limit of this number.
"""

from collections.abc import Iterable, Sequence
from numbers import Real
from typing import Any, Protocol

import numpy as np

__all__ = ["Budget", "BudgetExhausted", "CountsSimulations", "as_limit"]


# Odd, with bits spread evenly: the golden ratio times 2^64 (Knuth, The Art of Computer Programming 3, section 6.4)
MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)
# Sums of fractions of simulations, in another order, differ by less.
ROUNDING = 1e-6


class BudgetExhausted(Exception):
    """A batch does not fit into the limit of simulations.

    Parameters
    ----------
    records : (m,) structured array
        Records of the first m points of the batch, which were evaluated.

    Attributes
    ----------
    records : (m,) structured array
        See above.
    """

    def __init__(self, records: np.ndarray):
        super().__init__("the limit of simulations (max_simulations) does not allow this batch")
        self.records = records


def as_limit(value: Any) -> float | None:
    """A limit of simulations as float, or None for no limit; ValueError for anything but a positive number."""
    if value is None:
        return None
    if isinstance(value, bool | str) or not isinstance(value, Real) or not value > 0.0:
        raise ValueError(f"max_simulations must be a positive number, or None for no limit; got {value!r}")
    return float(value)


class CountsSimulations(Protocol):
    """An object that makes simulations by itself, such as a guide.

    Attributes
    ----------
    simulations : float
        Simulations made so far.
    """

    simulations: float


class Budget:
    """Counts simulations and compares them with a limit.

    Parameters
    ----------
    fast : sequence of int
        Indices of the fast parameters.
    limit : float, optional
        Largest number of simulations; no limit by default.

    Attributes
    ----------
    fast : sequence of int
        Indices of the fast parameters.
    limit : float, or None
        The limit.
    guide : object with an attribute simulations, or None
        The guide in use.
    refused : bool
        Whether `fits` has returned False.
    """

    def __init__(self, fast: Sequence[int] = (), limit: float | None = None):
        self.fast = fast
        self.limit = limit
        self.reset()

    def reset(self) -> None:
        """Forget all points and guides."""
        self._seen: set[int] = set()
        self.guide: CountsSimulations | None = None
        self.refused = False
        self._earlier, self._granted = 0.0, 0.0  # simulations of earlier guides, and those that `fits` has allowed
        self._made_before = 0.0

    def restore(self, batches: Iterable[np.ndarray], of_earlier_guides: float, of_guides: float) -> None:
        """Start again with the simulations of the interrupted run that is continued.

        Parameters
        ----------
        batches : iterable of (n, ndim) float
            All points that it has evaluated.
        of_earlier_guides : float
            Simulations of guides before the annealing that is repeated.
        of_guides : float
            Simulations of all its guides.
        """
        self.reset()
        for coords in batches:
            self.count(coords)
        self._earlier = of_earlier_guides
        self._made_before = len(self._seen) + of_guides + ROUNDING

    def begin(self, guide: CountsSimulations) -> None:
        """Count the simulations of a new guide from now on, besides those of earlier ones."""
        self._earlier = self.of_guides
        self.guide, self.refused, self._granted = guide, False, 0.0

    def slow_columns(self, ndim: int) -> np.ndarray:
        """Indices of the parameters that a simulation depends on; all where none is slow."""
        slow = np.setdiff1d(np.arange(ndim), np.asarray(self.fast, dtype=int))
        return slow if len(slow) > 0 else np.arange(ndim)

    def _keys(self, coords: np.ndarray) -> list[int]:
        """A hash of the slow parameters of each point, the same in every process."""
        bits = np.ascontiguousarray(coords[:, self.slow_columns(coords.shape[1])], dtype=float).view(np.uint64)
        keys = np.zeros(len(bits), dtype=np.uint64)
        for column in bits.T:
            for value in (column, keys >> np.uint64(32)):
                keys = (keys ^ value) * MULTIPLIER
        return (keys ^ (keys >> np.uint64(29))).tolist()

    @property
    def of_guides(self) -> float:
        """Simulations that guides have made by themselves."""
        return self._earlier + (0.0 if self.guide is None else self.guide.simulations)

    @property
    def of_guides_with_batch(self) -> float:
        """As `of_guides`, with the batch that `fits` has allowed last, which a guide counts after it is made."""
        return max(self.of_guides, self._granted)

    @property
    def simulations(self) -> float:
        """Distinct points in the slow parameters, and the simulations of guides."""
        return len(self._seen) + self.of_guides

    @property
    def remaining(self) -> float:
        """Simulations left; inf without a limit."""
        return np.inf if self.limit is None else max(max(self.limit, self._made_before) - self.simulations, 0.0)

    def fits(self, simulations: float) -> bool:
        """Whether that many more simulations of the guide fit; a refusal is noted in `refused`."""
        fit = simulations <= self.remaining
        if fit:
            self._granted = self.of_guides + simulations
        self.refused = self.refused or not fit
        return fit

    def count(self, coords: np.ndarray) -> None:
        """Enter evaluated points (n, ndim)."""
        self._seen.update(self._keys(coords))

    def fitting(self, coords: np.ndarray) -> int:
        """How many of the first points (n, ndim) fit."""
        if self.limit is None:
            return len(coords)
        remaining, new = self.remaining, set()
        for number, key in enumerate(self._keys(coords)):
            if key not in self._seen:
                new.add(key)
                if len(new) > remaining:
                    return number
        return len(coords)
