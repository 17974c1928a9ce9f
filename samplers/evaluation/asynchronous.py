"""Evaluation of points that arrive in any order, so that no worker waits for the slowest point of a batch.

Points are submitted to a queue as soon as they are proposed. The record of the run contains the finished points and,
for each decision of the sampler (`AsynchronousEvaluator.wait`), which points had arrived before it, so that an
interrupted run, when repeated, makes the same decisions and continues with the same bits. Points that were running when
the process ended are submitted again.
"""

import hashlib
import logging
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from ..interrupts import deferred_interrupts
from ..record import EvaluatedBatch, merge_batches
from ..tempering.pending_points import PendingPoints
from .evaluator import Evaluator

__all__ = ["AsynchronousEvaluator", "EvaluationQueue"]

logger = logging.getLogger(__name__)


class EvaluationQueue(Protocol):
    """Where points are evaluated: ``posterior.evaluation_queue()``, or `samplers.evaluation.pool_queue.PoolQueue`.

    A queue may also have a method ``ended()``, which returns numbers and values of all points that have ended, without
    waiting, including the points that the last `collect` has returned. It is called before `close`.
    """

    workers: int | None  # number of points that are evaluated at once, if it is known

    def submit(self, coords: np.ndarray) -> list[int]:
        """Begin to evaluate points (n, ndim) without waiting; returns a number for each, which is never used again."""

    def collect(self) -> list[tuple[int, Any]]:
        """Wait for a finished point; returns numbers and values of all finished points, in the order of completion."""

    def close(self) -> None:
        """Cancel the points that have not been started."""


class AsynchronousEvaluator(Evaluator):
    """An evaluator whose `submit` returns without waiting; ``open_queue(pool)`` is called before the first point."""

    asynchronous = True

    def __init__(self, *args: Any, open_queue: Callable[[Any], EvaluationQueue], **kwargs: Any):
        self._open_queue = open_queue
        super().__init__(*args, **kwargs)
        self._forget_running()

    def __getstate__(self) -> dict:
        return super().__getstate__() | {"_queue": None, "_running": {}, "_tickets": {}, "_known": {}}

    def _forget_running(self) -> None:
        self._queue: EvaluationQueue | None = None
        self._submitted = 0
        self._running: dict[int, tuple[PendingPoints, int]] = {}  # points not yet arrived at a decision
        self._tickets: dict[int, int] = {}  # number of the point by ticket of the queue
        self._known: dict[int, tuple[EvaluatedBatch, int]] = {}  # values of points that are still in `_running`

    def _opened(self) -> EvaluationQueue:
        if self._queue is None:
            self._queue = self._open_queue(self.pool)
        return self._queue

    @property
    def workers(self) -> int:
        """Number of points that are evaluated at once."""
        return self._opened().workers or 1

    def submit(self, coords: np.ndarray) -> PendingPoints:
        """Begin to evaluate points (n, ndim); the limit of simulations may allow only the first points."""
        if not np.all(np.isfinite(coords)):
            raise ValueError("At least one parameter value was infinite or NaN")
        log_prior = self.log_prior(coords)
        inside = log_prior > -np.inf
        points = np.flatnonzero(inside)
        parts = self.record.find(coords[points])
        numbers, refused, end = [], False, len(coords)
        for rows, known in parts:
            wanted = points[rows]
            if known is None:
                fitting = self.budget.fitting(coords[wanted])
                fitting = fitting if fitting == len(wanted) or self.evaluates_parts else 0
                if fitting < len(wanted):
                    refused, end, wanted = True, int(wanted[fitting]), wanted[:fitting]
            else:
                self._check_blobs(known)
                if self.observer is not None:
                    self.observer.repeated(len(wanted))
            self.budget.submitted(coords[wanted])
            self.evaluations += len(wanted)
            numbers.append((known, wanted))
            if refused:
                break
        pending = PendingPoints(coords[:end], log_prior[:end], refused)
        outside = np.flatnonzero(~inside[:end])
        if len(outside) > 0:
            pending.arrive(outside, pending.base[outside])
        for known, wanted in numbers:
            first = self._submitted
            self._submitted += len(wanted)
            for place, row in enumerate(wanted):
                self._running[first + place] = pending, int(row)
                if known is not None:
                    self._known[first + place] = known, place
            if known is None and len(wanted) > 0:
                if self.observer is not None:
                    self.observer.submitted(len(wanted))
                tickets = self._opened().submit(coords[wanted])
                self._tickets.update(zip(tickets, range(first, self._submitted), strict=True))
        return pending

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""
        if not self._running:
            return
        new: list[np.ndarray] = []

        def gather() -> list[np.ndarray]:
            new.append(self._gather(most))
            return new

        # by the points, since a search that goes on under a larger limit leads to other points
        points = np.array([pending.coords[row] for pending, row in self._running.values()])
        key = f"arrived of {hashlib.blake2b(points.tobytes(), digest_size=16).hexdigest()}"
        arrived = self.record.remember(key, gather)[0]
        by_batch: dict[int, list[int]] = {}
        for number in arrived.tolist():
            by_batch.setdefault(id(self._running[number][0]), []).append(number)
        for numbers in by_batch.values():
            self._arrive(numbers)

    def _arrive(self, numbers: list[int]) -> None:
        """Let points that were submitted together arrive, and count them."""
        pending = self._running[numbers[0]][0]
        rows = np.array([self._running.pop(number)[1] for number in numbers])
        batch = merge_batches([_single(*self._known.pop(number)) for number in numbers])
        if self._limit is not None:
            whole, counted = len(numbers) == len(pending.coords), self.record.count - len(numbers)
            failed = len(self.record.failed) - len(batch.reasons)
            self._limit.check(batch, counted, failed, len(self._running), whole)
        log_prior = pending.base["log_prior"][rows]
        pending.arrive(rows, self._pack(log_prior, np.ones(len(rows), dtype=bool), batch))

    def _gather(self, most: int) -> np.ndarray:
        """Numbers (m,) of the points that have arrived when `most` other points are running."""
        while len(self._running) - len(self._known) > most:
            self._take(self._opened().collect())
        return np.array(sorted(self._known), dtype=np.int64)

    def _take(self, collected: list[tuple[int, Any]]) -> None:
        """Enter values of the queue that are not known yet in the record."""
        new = [(ticket, self._tickets[ticket], value) for ticket, value in collected if ticket in self._tickets]
        if not new:
            return
        coords = np.array([self._running[number][0].coords[self._running[number][1]] for _, number, _ in new])
        batch = self._as_batch(coords, [value for _, _, value in new])
        with deferred_interrupts():
            self.record.evaluated(batch)
            for place, (ticket, number, _) in enumerate(new):
                self._known[number] = batch, place
                del self._tickets[ticket]
        self.new_evaluations += len(new)
        if self.observer is not None:
            self.observer.finished(len(new))

    def close(self) -> None:
        """End the evaluation of running points; points that have ended are entered in the record."""
        queue, self._queue = self._queue, None
        try:
            if hasattr(queue, "ended"):
                self._take(queue.ended())
        except Exception as error:  # another error or Ctrl-C is the reason why the run ends
            logger.warning("evaluations that have ended are not stored: %s", error)
        finally:
            self._forget_running()
            self.budget.closed()
            if queue is not None:
                queue.close()


def _single(batch: EvaluatedBatch, row: int) -> EvaluatedBatch:
    """One point of a batch."""
    return batch.rows([row])
