"""A cluster on a simulated clock: evaluations take a stated time on a stated number of workers, and nobody waits.

A point starts when a worker is free, in the order of submission. `SimulatedCluster` is called with a batch, as a
synchronous sampler does, or used as a queue of evaluations. The clock advances by the evaluations only; what the parent
process does takes no time.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from queue import SimpleQueue
from unittest.mock import patch

import numpy as np

from fe_likelihoods.likelihood import evaluation_queue, simulator
from fe_likelihoods.simulation.executors import PoolExecutor

__all__ = ["SimulatedCluster", "SimulatedPool"]

take_without_clock = simulator.take_all


class SimulatedCluster:
    """A log-density on simulated workers; `target` is the log-density of a batch of points (n, ndim).

    `length` is a function of points (n, ndim) that returns how long their evaluations take (n,). `now` is the time of
    the clock, `busy` the time of all evaluations so far, `evaluations` their number.
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


class SimulatedPool(PoolExecutor):
    """A pool of a likelihood on simulated workers, which evaluates the responses of its model.

    `length` is a function of parameters (n_parameters,) that returns how long a simulation of the whole record, of
    `n_steps`, takes; a part of it takes its share of the time, and counts as a fraction in `simulations`. Other
    attributes are as of a `SimulatedCluster`.
    """

    n_workers = 0
    submits = True
    other_processes = False

    def __init__(self, workers: int, length: Callable[[np.ndarray], float], n_steps: int):
        self.n_workers, self._length, self._n_steps = workers, length, n_steps
        self.now = self.busy = self.simulations = 0.0
        self._free = [0.0] * workers
        self._running: list[tuple[float, int, Future, object]] = []
        self._submitted = 0

    @property
    def utilisation(self) -> float:
        """Share of the time of all workers in which they were busy."""
        return self.busy / (self.n_workers * self.now)

    def submit_all(self, function: Callable, items: Sequence[np.ndarray]) -> list[Future]:
        """Futures that have a result when the clock has advanced to their end."""
        futures = []
        for item in items:
            outcome, future = function(item), Future()
            sent = getattr(function, "function", function)  # without the observer of opened files
            share = sent.args[-1].n_steps / self._n_steps
            length = share * float(self._length(np.asarray(item)))
            end = max(heapq.heappop(self._free), self.now) + length
            heapq.heappush(self._free, end)
            self._submitted += 1
            heapq.heappush(self._running, (end, self._submitted, future, outcome))
            self.busy += length
            self.simulations += share
            futures.append(future)
        return futures

    def advance(self) -> None:
        """Advance the clock to the end of the next simulation, and of all that end with it."""
        self.now = self._running[0][0]
        while self._running and self._running[0][0] == self.now:
            _, _, future, outcome = heapq.heappop(self._running)
            future.set_result(outcome)

    @contextmanager
    def clock(self) -> Iterator[None]:
        """Whoever waits for a simulation advances the clock."""

        def take_all(arrived: SimpleQueue, wait: bool) -> list:
            while wait and arrived.empty():
                self.advance()
            return take_without_clock(arrived, wait)

        with ExitStack() as stack:
            for module in (simulator, evaluation_queue):
                stack.enter_context(patch.object(module, "take_all", take_all))
            yield
