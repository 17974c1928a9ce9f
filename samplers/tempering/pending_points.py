"""Points that were submitted together for evaluation; some may still be running.

A synchronous density returns complete points. An asynchronous density lets the points arrive in any order. Points that
have arrived may shape further proposals, but only complete batches may become part of the result: if evaluation times
depend on the parameters, the first arrivals are not a fair sample of the proposal.
"""

import numpy as np

__all__ = ["PendingPoints"]

BASE_FIELDS = [("log_prob", np.float64), ("log_prior", np.float64)]


class PendingPoints:
    """Points (n, ndim) that were submitted, and their known records.

    `refused`: the limit of simulations refused further points. `base` (n,) are records with log_prior, and log_prob =
    -inf; `arrived` (n,) bool are the points with all records.
    """

    def __init__(self, coords: np.ndarray, log_prior: np.ndarray, refused: bool = False):
        self.coords, self.refused = coords, refused
        self.base = np.zeros(len(coords), BASE_FIELDS)
        self.base["log_prob"], self.base["log_prior"] = -np.inf, log_prior
        self.arrived = np.zeros(len(coords), dtype=bool)
        self._records = self.base.copy()

    @classmethod
    def known(cls, coords: np.ndarray, records: np.ndarray, refused: bool = False) -> "PendingPoints":
        """Points (n, ndim) whose records (n,) are all known."""
        pending = cls(coords, records["log_prior"], refused)
        pending.arrive(np.arange(len(coords)), records)
        return pending

    def arrive(self, rows: np.ndarray, records: np.ndarray) -> None:
        """Enter the records (m,) of points that have arrived, by their rows (m,)."""
        if self._records.dtype != records.dtype:  # the first blobs change the type
            earlier, self._records = self._records, np.zeros(len(self.coords), records.dtype)
            for name in earlier.dtype.names:
                self._records[name] = earlier[name]
        self._records[rows] = records
        self.arrived[rows] = True

    @property
    def running(self) -> int:
        """Number of points that have not arrived."""
        return int(np.sum(~self.arrived))

    @property
    def complete(self) -> bool:
        """Whether all points have arrived."""
        return bool(self.arrived.all())

    def arrived_part(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (m, ndim) that have arrived, and their records (m,), in the order of submission."""
        if self.complete:
            return self.coords, self._records
        return self.coords[self.arrived], self._records[self.arrived]
