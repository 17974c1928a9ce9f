"""A cluster on a simulated clock: evaluations take a stated time on a stated number of workers, and nobody waits.

A point starts when a worker is free, in the order of submission. What the parent process does takes no time.
"""

import heapq
from collections.abc import Callable
from concurrent.futures import Executor, Future

import numpy as np


class SimulatedFuture(Future):
    """The value of a point: who asks for it is told of the end of the next evaluation, to which the clock advances."""

    def __init__(self, running: list[float], end: float):
        super().__init__()
        self._running, self._end = running, end

    def done(self) -> bool:
        return self._end == self._running[0]

    def result(self, timeout=None):
        heapq.heappop(self._running)
        return super().result(timeout)

    def cancel(self) -> bool:
        self._running.remove(self._end)
        heapq.heapify(self._running)
        return True


class SimulatedCluster(Executor):
    """An executor of simulated workers: `length` is how long a function takes for an item."""

    def __init__(self, workers: int, length: Callable[[np.ndarray], float]):
        self.n_workers, self._length, self.evaluations = workers, length, 0
        self._free, self._running = [0.0] * workers, []

    def submit(self, function, item):
        self.evaluations += 1
        now = self._running[0] if self._running else 0.0
        end = max(heapq.heappop(self._free), now) + float(self._length(item))
        heapq.heappush(self._free, end)
        heapq.heappush(self._running, end)
        future = SimulatedFuture(self._running, end)
        future.set_result(function(item))
        return future

    def map(self, function, items):
        return [function(item) for item in items]
