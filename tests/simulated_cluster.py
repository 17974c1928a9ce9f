"""A cluster on a simulated clock: evaluations take a stated time on a stated number of workers, and nobody waits.

A point starts when a worker is free, in the order of submission. `SimulatedCluster` is called with a batch, as a
synchronous sampler does, or used as a queue of evaluations. The clock advances by the evaluations only; what the parent
process does takes no time.
"""

import heapq
from collections.abc import Callable

import numpy as np

__all__ = ["SimulatedCluster"]


class SimulatedCluster:
    """A log-density on simulated workers.

    Parameters
    ----------
    target : object
        Log-density of a batch of points (n, ndim), with ndim, log_prior and sample_prior.
    workers : int
        Number of workers.
    length : callable
        Function of points (n, ndim) that returns how long their evaluations take (n,).

    Attributes
    ----------
    workers : int
        See above.
    now : float
        Time of the clock.
    busy : float
        Time of all evaluations so far.
    evaluations : int
        Their number.
    """

    def __init__(self, target, workers: int, length: Callable[[np.ndarray], np.ndarray]):
        self._target, self.workers, self._length = target, workers, length
        self.ndim, self.log_prior, self.sample_prior = target.ndim, target.log_prior, target.sample_prior
        self.fast_parameters = getattr(target, "fast_parameters", ())
        self.now = self.busy = 0.0
        self.evaluations = 0
        self._free = [0.0] * workers
        self._running: list[tuple[float, int, float]] = []

    @property
    def utilisation(self) -> float:
        """Share of the time of all workers in which they were busy."""
        return self.busy / (self.workers * self.now)

    def __call__(self, coords: np.ndarray) -> np.ndarray:
        """Log-densities (n,) of a batch, when all of it is finished."""
        tickets = self.submit(coords)
        values = {}
        while self._running:
            values.update(self.collect())
        return np.array([values[ticket] for ticket in tickets])

    def evaluation_queue(self) -> "SimulatedCluster":
        """The queue: this object."""
        return self

    def submit(self, coords: np.ndarray) -> list[int]:
        """Begin to evaluate points (n, ndim); returns their numbers."""
        tickets = list(range(self.evaluations, self.evaluations + len(coords)))
        self.evaluations += len(coords)
        for ticket, value, length in zip(tickets, self._target(coords), self._length(coords), strict=True):
            end = max(heapq.heappop(self._free), self.now) + length
            heapq.heappush(self._free, end)
            heapq.heappush(self._running, (end, ticket, value))
            self.busy += length
        return tickets

    def collect(self) -> list[tuple[int, float]]:
        """Advance the clock to the end of the next evaluation; returns number and value of all that end then."""
        self.now = self._running[0][0]
        finished = []
        while self._running and self._running[0][0] == self.now:
            _, ticket, value = heapq.heappop(self._running)
            finished.append((ticket, value))
        return finished

    def close(self) -> None:
        """Drop what has not ended."""
        self._running = []
