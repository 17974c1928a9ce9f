"""A cluster on a simulated clock: evaluations take a stated time on a stated number of workers, and nobody waits.

A point starts when a worker is free, in the order of submission. What the parent process does takes no time.
"""

import heapq
from collections.abc import Callable

import numpy as np


class SimulatedCluster:
    """A log-density of batches (n, ndim) on simulated workers.

    `length` is a function of points (n, ndim) that returns how long their evaluations take (n,). `now` is the time of
    the clock, `evaluations` the number of all evaluations so far.
    """

    def __init__(self, target, workers: int, length: Callable[[np.ndarray], np.ndarray]):
        self._target, self.workers, self._length = target, workers, length
        self.ndim, self.log_prior, self.sample_prior = target.ndim, target.log_prior, target.sample_prior
        self.fast_parameters = getattr(target, "fast_parameters", ())
        self.now = 0.0
        self.evaluations = 0
        self._free = [0.0] * workers
        self._running: list[tuple[float, int, float]] = []

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
