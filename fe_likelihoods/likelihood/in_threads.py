"""Evaluation of a posterior without barriers: each point waits in a thread for its own simulations.

A sampler that proposes points while others still run keeps all workers of a pool busy, however different the durations
of the simulations are.
"""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from ..simulation.executors import Job, Threads

__all__ = ["InThreads"]

_MOST_THREADS = 200  # for a pool that does not say how many simulations run at once


class InThreads:
    """An executor for functions that call a posterior, see `Posterior.executor`."""

    def __init__(self, posterior: Any) -> None:
        simulators = [part.simulator for part, _ in posterior.likelihood.data_sets()]
        pools = {id(each.pool): each.pool for each in simulators if each.pool is not None}
        sizes = [getattr(pool, "n_workers", None) for pool in pools.values()]
        self.n_workers: int | None = None if None in sizes else sum(sizes) or 1
        self._streams = all(each.streams for each in simulators)  # no model runs in threads of this process
        self._threads = Threads(lambda: _run)

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future:
        """Begin to call a function for an item; without pools that have ``submit``, the result is there on return."""
        job = Job(function, item)
        if self._streams:
            self._threads.submit_all([job], self.n_workers or _MOST_THREADS)
        else:
            job.settle(_run)
        return job


def _run(job: Job) -> Any:
    return job.function(job.item)
