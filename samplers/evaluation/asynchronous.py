"""Points that arrive in any order, so that no worker waits for the slowest point of a batch.

The record of the run contains the finished points and, for each decision of the sampler (`AsynchronousEvaluator.wait`),
which points had arrived before it, so that an interrupted run, when repeated, makes the same decisions. Points that
were running when the process ended are submitted again.

A queue (``posterior.evaluation_queue()``, or made for a pool) is a `samplers.evaluation.point_queue.PointQueue` or has
its methods ``submit(coords)``, ``collect()`` and ``close()``, and its attribute ``workers``.
"""

import hashlib
import logging
from typing import Any

import numpy as np

from ..interrupts import deferred_interrupts
from ..tempering.population import PendingPoints
from .evaluator import Evaluator
from .point_queue import PointQueue, pool_queue
from .user_target import Target

__all__ = ["AsynchronousEvaluator", "check_asynchronous"]

logger = logging.getLogger(__name__)


def _has_queue(target: Target, pool: Any) -> bool:
    """Whether the function provides a queue, and no pool is given."""
    return pool is None and callable(getattr(target.function, "evaluation_queue", None))


def check_asynchronous(target: Target, pool: Any, draws: bool) -> None:
    """Raise ValueError if points cannot be submitted one by one, or are not made by the `draws` of recycling."""
    if not draws:
        raise ValueError(
            "asynchronous=True cannot act here: moves and guides wait for all points that they propose: pass "
            "recycle=True, or leave it out"
        )
    can_submit = callable(getattr(pool, "submit", None))
    if not (target.vectorize if _has_queue(target, pool) else can_submit and not target.vectorize):
        raise ValueError(
            "asynchronous=True needs points that can be submitted one by one: pass a posterior that has the method "
            "evaluation_queue (Posterior of fe_likelihoods, with its own pool) and vectorize=True, or a function of "
            "one point and a pool with the method submit (an executor of concurrent.futures, mpi4py or loky, a dask "
            f"client); got {type(target.function).__name__}, pool={type(pool).__name__}, vectorize={target.vectorize}"
        )


class AsynchronousEvaluator(Evaluator):
    """An evaluator whose `submit` returns without waiting."""

    asynchronous = True

    def __init__(self, *args: Any):
        super().__init__(*args)
        self._forget_running()

    def __getstate__(self) -> dict:
        return super().__getstate__() | {"_queue": None, "_running": {}, "_tickets": {}}

    def _forget_running(self) -> None:
        self._queue: Any = None
        self._submitted = 0
        self._running: dict[int, tuple[PendingPoints, int]] = {}  # points not yet arrived at a decision, by number
        self._tickets: dict[int, int] = {}  # number of the point by ticket of the queue

    def _opened(self) -> Any:
        if self._queue is None and _has_queue(self.target, self.pool):
            self._queue = self.target.function.evaluation_queue()
        elif self._queue is None:
            if self.pool is None:
                raise ValueError(
                    "this sampler was begun with a pool, which is not stored with it: set its attribute pool"
                )
            self._queue = pool_queue(self.target.caught, self.pool, self.target.as_points)
        return self._queue

    @property
    def workers(self) -> int:
        """Number of points that are evaluated at once."""
        return self._opened().workers or 1

    def submit(self, coords: np.ndarray) -> PendingPoints:
        """Begin to evaluate points (n, ndim); the limit of simulations may allow only the first points."""
        n = len(coords)
        coords = coords[: self._allowed(coords)]
        log_prior, asked, known = self._look_up(coords)
        self.record.submitted(coords[asked])
        self.evaluations += len(asked)
        pending = PendingPoints(coords, log_prior, refused=len(coords) < n)
        numbers = range(self._submitted, self._submitted + len(asked))
        self._submitted += len(asked)
        self._running.update((number, (pending, int(row))) for number, row in zip(numbers, asked, strict=True))
        if not known.all():
            self.count(int(sum(~known)))
            tickets = self._opened().submit(coords[asked[~known]])
            self._tickets.update(zip(tickets, np.array(numbers)[~known].tolist(), strict=True))
        return pending

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""
        if not self._running:
            return
        # by the points, since a search that goes on under a larger limit leads to other points
        points = self._points(self._running)
        key = f"arrived of {hashlib.blake2b(points.tobytes(), digest_size=16).hexdigest()}"
        by_batch: dict[int, list[int]] = {}
        for number in self.remember(key, lambda: [self._gather(most)])[0].tolist():
            by_batch.setdefault(id(self._running[number][0]), []).append(number)
        for numbers in by_batch.values():
            self._arrive(numbers)

    def _points(self, numbers: Any) -> np.ndarray:
        """Running points (m, ndim) by their numbers."""
        return np.array([pending.coords[row] for pending, row in map(self._running.__getitem__, numbers)])

    def _gather(self, most: int) -> np.ndarray:
        """Numbers (m,) of the points that have arrived when `most` other points are running."""
        while len(self._tickets) > most:
            self._take(self._opened().collect())
        return np.array(sorted(set(self._running) - set(self._tickets.values())), dtype=np.int64)

    def _take(self, collected: list[tuple[int, Any]]) -> None:
        """Enter values of the queue that are not known yet in the record."""
        new = {self._tickets[ticket]: (ticket, value) for ticket, value in collected if ticket in self._tickets}
        if not new:
            return
        batch = self.as_batch(self._points(new), [value for _, value in new.values()])
        with deferred_interrupts():
            self.record.evaluated(batch)
            for ticket, _ in new.values():
                del self._tickets[ticket]
        self.count(0, len(new))

    def _arrive(self, numbers: list[int]) -> None:
        """Let points that were submitted together arrive, and check how many have failed."""
        coords, pending = self._points(numbers), self._running[numbers[0]][0]
        rows = np.array([self._running.pop(number)[1] for number in numbers])
        counts = len(self.record.failed), self.record.count + len(self._running)
        self.check_failures(self.record.values(coords), *counts, len(numbers) == len(pending.coords))
        pending.arrive(rows, self._records(coords, pending.log_prior[rows], np.arange(len(rows))))

    def close(self) -> None:
        """End the evaluation of running points; points that have ended are entered in the record."""
        queue, self._queue = self._queue, None
        try:
            if isinstance(queue, PointQueue):
                self._take(queue.collect(wait=False))
        except Exception as error:  # another error or Ctrl-C is the reason why the run ends
            logger.warning("evaluations that have ended are not stored: %s", error)
        finally:
            self._forget_running()
            self.record.given_up()
            if queue is not None:
                queue.close()
