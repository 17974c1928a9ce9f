"""Evaluation of a posterior without barriers: points go out when they are submitted, and come back when they are done.

A sampler that proposes points while others still run keeps all workers of a pool busy, however different the durations
of the simulations are. Each point is evaluated in a thread, which waits for its simulations.
"""

import os
import threading
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..priors.points import as_points
from ..simulation.local_pool import Threads
from ..simulation.model import has_batch_method

__all__ = ["EvaluationQueue"]

_MOST_THREADS = 200  # for a pool that does not say how many simulations run at once


class EvaluationQueue:
    """Queue of points at which a posterior is evaluated, see `Posterior.evaluation_queue`.

    Its methods are called from one thread. Duplicates are simulated once. If a data set has no pool, or one that has
    ``map`` only, `submit` waits for the simulations. With `responses`, the likelihood caches these as well, for its
    `simulate`.
    """

    def __init__(self, posterior: Any, responses: bool = False) -> None:
        self._parts = [part for part, _ in posterior.likelihood.parts()]
        self._names, self._closed = posterior.prior.names, False
        self._evaluate = partial(_evaluate, posterior, responses)
        self._streams = all(part.simulator.streams for part in self._parts)  # no model runs in threads of this process
        threads = Threads(self._most_threads)
        self._threads, self._arrived, self._submitted = threads, threading.Event(), 0
        self._futures: dict[int, Future] = {}  # of points that were not collected, by ticket
        self._handed: list[int] = []  # what the last `collect` returned: the caller may not have received it
        for part in self._parts if self._streams else ():  # failures may end sooner: points that wait may be successes
            part.simulator.pending = lambda: threads.pending

    def __enter__(self) -> "EvaluationQueue":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def workers(self) -> int | None:
        """Number of evaluations that run at once; None if a pool does not say."""
        pools = {id(part.simulator.pool): part.simulator.pool for part in self._parts}
        sizes = [getattr(pool, "n_workers", None) for pool in pools.values() if pool is not None]
        if not sizes:
            return (os.cpu_count() or 1) if any(has_batch_method(part.model) for part in self._parts) else 1
        return None if None in sizes else sum(sizes)

    def _most_threads(self) -> int:
        return (self.workers or _MOST_THREADS) if self._streams else 0

    def submit(self, coords: Any) -> list[int]:
        """Submit points (n, ndim); returns n tickets, each of which `collect` returns once.

        ValueError for another shape, RuntimeError if the queue is closed.
        """
        self._require_open()
        rows = np.array(as_points(coords, self._names))
        if rows.ndim != 2:
            raise ValueError(f"submit: expected points of shape (n, {len(self._names)}); got shape {rows.shape}")
        if not self._streams and len(rows):
            with suppress(Exception):  # raised by `collect`
                self._evaluate(rows)  # together, which is faster; their simulations are known then
        tickets = list(range(self._submitted, self._submitted + len(rows)))
        self._submitted += len(rows)
        for ticket, row in zip(tickets, rows, strict=True):
            self._futures[ticket] = self._threads.submit(self._evaluate, row[None])
            self._futures[ticket].add_done_callback(lambda _: self._arrived.set())
        return tickets

    @interrupts_end_the_run()
    def collect(self) -> list[tuple[int, float]]:
        """Wait until a point is finished; tickets and log-probabilities of all finished points.

        They are what `log_prob` returns for each point alone, to the last bit. RuntimeError if no point is pending or
        the queue is closed. What ends a call of the posterior (`TooManyFailures`, `StaleCache`, `ChangedModel`) is
        raised after the points that were finished before have been returned; simulations that have ended are cached.
        """
        self._require_open()
        if len(self._futures) == len(self._handed):
            raise RuntimeError("no point is pending: submit points before collect()")
        while self._handed:
            self._futures.pop(self._handed.pop(), None)
        while not any(future.done() for future in self._futures.values()):
            self._arrived.wait()
            self._arrived.clear()
        collected = self.ended()
        if not collected:
            raise next(future.exception() for future in self._futures.values() if future.done())
        self._handed = [ticket for ticket, _ in collected]
        return collected

    def ended(self) -> list[tuple[int, float]]:
        """Tickets and log-probabilities of points that have ended, including the last collected ones, without waiting.

        For a run that Ctrl-C ends, before `close`, so that finished points are kept. Errors are raised by `collect`.
        """
        done = [(ticket, future) for ticket, future in self._futures.items() if future.done()]
        return [(ticket, future.result()) for ticket, future in done if future.exception() is None]

    def close(self) -> None:
        """Cancel points that have not begun; simulations that run are cached when they end. May be called twice."""
        self._closed = True
        for future in self._futures.values():
            future.cancel()
        self._futures = {}
        for part in self._parts:
            part.simulator.pending = None

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError("the queue is closed: make another one with posterior.evaluation_queue()")


def _evaluate(posterior: Any, responses: bool, rows: np.ndarray) -> Any:
    """Log-probability of a point (1, ndim), or those of points (n, ndim)."""
    if responses:
        left = rows[posterior.possible(rows)]
        for part, columns in posterior.likelihood.parts():
            failed = part.simulate(left[:, columns[: part.simulator.n_structural]]).reasons if len(left) else []
            left = left[[not reason for reason in failed]]
    values = posterior.log_prob(rows)
    return values if len(values) > 1 else float(values[0])
