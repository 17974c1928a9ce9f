"""Points that were submitted together for evaluation, of which some may still be running.

A synchronous density returns a flight that is complete. An asynchronous one lets the points arrive in any order. What
has arrived may shape further proposals. The result may use complete flights only: where the time of an evaluation
depends on the parameters, the first arrivals are not a fair sample of the proposal.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from .budget import BudgetExhausted

__all__ = ["Flight", "submit_and_wait"]

BASE_FIELDS = [("log_prob", np.float64), ("log_prior", np.float64)]


class Flight:
    """Points (n, ndim) and what is known of them.

    Parameters
    ----------
    coords : (n, ndim) float
        The points.
    log_base : (n,) float
        Their log-density at beta = 0, -inf outside the support of the prior.
    refused : bool
        Whether the limit of simulations did not allow all points that were to be submitted; `coords` are the others.

    Attributes
    ----------
    coords : (n, ndim) float
        See above.
    base : (n,) structured array
        Records with log_prior = `log_base` and log_prob = -inf, known from the beginning.
    arrived : (n,) bool
        Which points have arrived.
    refused : bool
        See above.
    """

    def __init__(self, coords: np.ndarray, log_base: np.ndarray, refused: bool = False):
        self.coords, self.refused = coords, refused
        self.base = np.zeros(len(coords), BASE_FIELDS)
        self.base["log_prob"], self.base["log_prior"] = -np.inf, log_base
        self.arrived = np.zeros(len(coords), dtype=bool)
        self._records: np.ndarray | None = None

    @classmethod
    def landed(cls, coords: np.ndarray, records: np.ndarray, refused: bool = False) -> "Flight":
        """A flight of points (n, ndim) whose records (n,) are all known."""
        flight = cls(coords, records["log_prior"], refused)
        flight.arrive(np.arange(len(coords)), records)
        return flight

    def arrive(self, rows: np.ndarray, records: np.ndarray) -> None:
        """Enter the records (m,) of points that have arrived, by their rows (m,)."""
        if len(rows) == len(self.coords):
            self._records = records
        else:
            if self._records is None or self._records.dtype != records.dtype:  # the first blobs change the type
                earlier, self._records = self._records, np.zeros(len(self.coords), records.dtype)
                for name in () if earlier is None else earlier.dtype.names:
                    self._records[name] = earlier[name]
            self._records[rows] = records
        self.arrived[rows] = True

    @property
    def complete(self) -> bool:
        """Whether all points have arrived."""
        return bool(self.arrived.all())

    def landed_part(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (m, ndim) and records (m,) of those that have arrived, in the order of their submission."""
        if self._records is None:
            return self.coords[:0], self.base[:0]
        if self.complete:
            return self.coords, self._records
        return self.coords[self.arrived], self._records[self.arrived]


class _Evaluates(Protocol):
    evaluate: Callable[[np.ndarray], np.ndarray]
    evaluate_observed: Callable[[np.ndarray, Callable[[np.ndarray], None]], np.ndarray]


def submit_and_wait(
    density: _Evaluates, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None
) -> Flight:
    """Evaluate points (n, ndim), of which a limit of simulations may allow the first few only.

    `observe`, if given, is called with the points directly before they are evaluated.
    """
    try:
        records = density.evaluate(coords) if observe is None else density.evaluate_observed(coords, observe)
        return Flight.landed(coords, records)
    except BudgetExhausted as stop:
        return Flight.landed(coords[: len(stop.records)], stop.records, refused=True)
