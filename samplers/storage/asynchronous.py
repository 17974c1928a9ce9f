"""Evaluation of points that arrive in any order, so that no worker waits for the slowest point of a batch.

Points are submitted to a queue as soon as they are proposed. What has arrived is entered in the journal, and at each
decision of the sampler (`AsynchronousEvaluator.wait`) also which points had arrived by then. The decisions depend on
the order of arrival; a run that is continued repeats them from the journal, and goes on to the last bit as the one that
was interrupted. Points that were running when the process ended are submitted again. If Ctrl-C or an error ends the
run, points that have ended by then are entered in the journal first.
"""

import hashlib
import logging
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from ..tempering.flights import Flight
from .evaluation import Evaluator
from .journal import EvaluatedBatch, merge_batches
from .lenient_file import deferred_interrupts

__all__ = ["AsynchronousEvaluator", "EvaluationQueue"]

logger = logging.getLogger(__name__)

# Finite values that the check of the first evaluations needs.
FIRST_VALUES = 8


class EvaluationQueue(Protocol):
    """Where points are evaluated, such as ``posterior.evaluation_queue()`` or `samplers.storage.pool_queue.PoolQueue`.

    A queue may also have a method ``ended()``, which returns numbers and values of the points that have ended, without
    waiting, also of those that the last `collect` has returned. It is called before `close`.

    Attributes
    ----------
    workers : int or None
        Number of points that are evaluated at once, if it is known.
    """

    workers: int | None

    def submit(self, coords: np.ndarray) -> list[int]:
        """Begin to evaluate points (n, ndim) without waiting; returns a number for each, which is never used again."""

    def collect(self) -> list[tuple[int, Any]]:
        """Wait until a point is finished; returns numbers and values of all that are, in the order of completion."""

    def close(self) -> None:
        """Cancel the points that have not been started."""


class AsynchronousEvaluator(Evaluator):
    """An evaluator whose `submit` returns without waiting.

    Parameters
    ----------
    *args, **kwargs
        As for `samplers.storage.evaluation.Evaluator`.
    open_queue : callable
        Called without arguments before the first point is submitted; returns an `EvaluationQueue`.
    """

    asynchronous = True

    def __init__(self, *args: Any, open_queue: Callable[[Any], EvaluationQueue], **kwargs: Any):
        self._open_queue = open_queue
        super().__init__(*args, **kwargs)

    def __getstate__(self) -> dict:
        return super().__getstate__() | {"_queue": None, "_running": {}, "_tickets": {}, "_known": {}, "_held": []}

    def reset(self) -> None:
        """Forget evaluations and failures; nothing runs afterwards."""
        super().reset()
        self._queue: EvaluationQueue | None = None
        self._submitted = 0
        self._running: dict[int, tuple[Flight, int]] = {}  # by number: points that have not arrived at a decision
        self._tickets: dict[int, int] = {}  # number of the point by ticket of the queue
        self._known: dict[int, tuple[EvaluatedBatch, int]] = {}  # values of points that are still in `_running`
        self._held: list[EvaluatedBatch] = []  # not stored before the first values are checked

    def _opened(self) -> EvaluationQueue:
        if self._queue is None:
            self._queue = self._open_queue(self.pool)
        return self._queue

    @property
    def workers(self) -> int:
        """Number of points that are evaluated at once."""
        return self._opened().workers or 1

    @property
    def known_workers(self) -> int | None:
        """Number of points that are evaluated at once, if the queue says so."""
        return self._opened().workers

    def submit(self, coords: np.ndarray) -> Flight:
        """Begin to evaluate points (n, ndim), of which the limit of simulations may allow the first few only."""
        if not np.all(np.isfinite(coords)):
            raise ValueError("At least one parameter value was infinite or NaN")
        log_base = self.log_base(coords)
        inside = log_base > -np.inf
        points = np.flatnonzero(inside)
        parts = [(slice(None), None)] if self._checkpoint is None else self._checkpoint.find(coords[points])
        numbers, refused, end = [], False, len(coords)
        for rows, known in parts:
            wanted = points[rows]
            if known is None:
                fitting = self.budget.fitting(coords[wanted])
                fitting = fitting if fitting == len(wanted) or self.evaluates_parts else 0
                if fitting < len(wanted):
                    refused, end, wanted = True, int(wanted[fitting]), wanted[:fitting]
            elif self.observer is not None:
                self.observer.repeated(len(wanted))
            self.budget.count(coords[wanted])
            numbers.append((known, wanted))
            if refused:
                break
        flight = Flight(coords[:end], log_base[:end], refused)
        outside = np.flatnonzero(~inside[:end])
        if len(outside) > 0:
            flight.arrive(outside, flight.base[outside])
        for known, wanted in numbers:
            first = self._submitted
            self._submitted += len(wanted)
            for place, row in enumerate(wanted):
                self._running[first + place] = flight, int(row)
                if known is not None:
                    self._known[first + place] = known, place
            if known is None and len(wanted) > 0:
                if self.observer is not None:
                    self.observer.submitted(len(wanted))
                tickets = self._opened().submit(coords[wanted])
                self._tickets.update(zip(tickets, range(first, self._submitted), strict=True))
        return flight

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""
        if not self._running:
            return
        if self._checkpoint is None:
            arrived = self._gather(most)
        else:
            new: list[np.ndarray] = []

            def gather() -> list[np.ndarray]:
                new.append(self._gather(most))
                return new

            # by the points, since a search that goes on under a larger limit leads to others
            points = np.array([flight.coords[row] for flight, row in self._running.values()])
            key = f"arrived of {hashlib.blake2b(points.tobytes(), digest_size=16).hexdigest()}"
            arrived = self._checkpoint.remember(key, gather, lambda: self.budget.of_guides)[0]
            if not new:
                self._check = None  # the interrupted run has checked its first values before it entered this
        by_flight: dict[int, list[int]] = {}
        for number in arrived.tolist():
            by_flight.setdefault(id(self._running[number][0]), []).append(number)
        for numbers in by_flight.values():
            self._land(numbers)

    def _land(self, numbers: list[int]) -> None:
        """Let points of one flight arrive, and count them."""
        flight = self._running[numbers[0]][0]
        rows = np.array([self._running.pop(number)[1] for number in numbers])
        batch = merge_batches([_single(*self._known.pop(number)) for number in numbers])
        if self._limit is not None:
            whole = len(numbers) == len(flight.coords)
            self._limit.check(batch, self.evaluations, self.failures.count, len(self._running), whole)
        self.count(batch)
        log_base = flight.base["log_prior"][rows]
        flight.arrive(rows, self._records.pack_batch(log_base, np.ones(len(rows), dtype=bool), batch))

    def _gather(self, most: int) -> np.ndarray:
        """Numbers (m,) of the points that have arrived by the time when `most` others are running."""
        while len(self._running) - len(self._known) > most:
            self._take(self._opened().collect())
            if self._check is None or self._finite() >= FIRST_VALUES:
                self._check_and_store()
        self._check_and_store()
        return np.array(sorted(self._known), dtype=np.int64)

    def _finite(self) -> int:
        """Number of finite values that are known and have not arrived at a decision."""
        return sum(bool(np.isfinite(batch.log_prob[row])) for batch, row in self._known.values())

    def _take(self, collected: list[tuple[int, Any]]) -> None:
        """Take values of the queue that are not known yet."""
        new = [(ticket, self._tickets[ticket], value) for ticket, value in collected if ticket in self._tickets]
        if not new:
            return
        coords = np.array([self._running[number][0].coords[self._running[number][1]] for _, number, _ in new])
        batch = self._as_batch(coords, [value for _, _, value in new])
        with deferred_interrupts():
            self._held.append(batch)
            for place, (ticket, number, _) in enumerate(new):
                self._known[number] = batch, place
                del self._tickets[ticket]
        self.new_evaluations += len(new)
        if self.observer is not None:
            self.observer.finished(len(new))

    def _check_and_store(self) -> None:
        """Check the first values, and enter arrivals in the journal."""
        if self._known and self._check is not None:
            try:
                self._check(self, merge_batches([_single(*known) for known in self._known.values()]))
            except ValueError:
                self._held, self._tickets = [], {}  # wrong values are not stored
                raise
            self._check = None
        self._store()

    def _store(self) -> None:
        """Enter arrivals in the journal."""
        with deferred_interrupts():
            if self._held and self._checkpoint is not None:
                self._checkpoint.evaluated(merge_batches(self._held))
            self._held = []

    def close(self) -> None:
        """End the evaluation of points that are running; those that have ended are entered in the journal.

        The first values are entered without a check, which may take evaluations; the next run makes it.
        """
        queue, self._queue = self._queue, None
        try:
            self._store()
            if hasattr(queue, "ended") and self._checkpoint is not None:
                self._take(queue.ended())
                self._store()
        except Exception as error:  # another error or Ctrl-C is the reason why the run ends
            logger.warning("evaluations that have ended are not stored: %s", error)
        finally:
            self._submitted = 0
            self._running, self._known, self._tickets, self._held = {}, {}, {}, []
            if queue is not None:
                queue.close()


def _single(batch: EvaluatedBatch, row: int) -> EvaluatedBatch:
    """One point of a batch."""
    blobs = None if batch.blobs is None else batch.blobs[row : row + 1]
    reasons = {0: batch.reasons[row]} if row in batch.reasons else {}
    return EvaluatedBatch(batch.coords[row : row + 1], batch.log_prob[row : row + 1], blobs, reasons)
