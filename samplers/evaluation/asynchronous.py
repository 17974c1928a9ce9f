"""Points that arrive in any order, so that no worker waits for the slowest point of a batch.

The record of the run contains the finished points and, for each decision of the sampler (`AsynchronousEvaluator.wait`),
which points had arrived before it, so that an interrupted run, when repeated, makes the same decisions. Points that
were running when the process ended are submitted again.
"""

import hashlib
import logging
import threading
from asyncio import CancelledError
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..interrupts import Ended, deferred_interrupts, interrupts_end_the_run
from ..tempering.population import PendingPoints
from .evaluator import Evaluator
from .pools import CLOSED, submit_all, was_cancelled, workers_of
from .user_target import Target
from .values import Caught, Failed

logger = logging.getLogger(__name__)

SECONDS_TO_FETCH = 10.0  # longest wait for the value of a point that has ended, when the run ends


def check_asynchronous(target: Target, pool: Any, draws: bool) -> None:
    """Raise ValueError if points cannot be submitted one by one, or are not made by the `draws` of recycling."""
    if not draws:
        raise ValueError(
            "asynchronous=True cannot act here: moves and guides wait for all points that they propose: pass "
            "recycle=True, or leave it out"
        )
    can_submit = callable(getattr(pool, "submit", None)) and not target.vectorize
    if not (can_submit if pool is not None else callable(getattr(target.function, "executor", None))):
        raise ValueError(
            "asynchronous=True needs points that can be submitted one by one: pass a posterior that has the method "
            "executor (Posterior of fe_likelihoods, with its own pool), or a function of one point and a pool with the "
            "method submit (an executor of concurrent.futures, mpi4py or loky, a dask client); got "
            f"{type(target.function).__name__}, pool={type(pool).__name__}, vectorize={target.vectorize}"
        )


class AsynchronousEvaluator(Evaluator):
    """An evaluator whose `submit` returns without waiting, with an executor or a dask client."""

    asynchronous = True

    def __init__(self, *args: Any):
        super().__init__(*args)
        self._forget_running()

    def __getstate__(self) -> dict:
        return super().__getstate__() | {"_ended": None, "_executor": None, "_running": {}, "_futures": {}}

    def _forget_running(self) -> None:
        self._ended, self._submitted = threading.Event(), 0
        self._executor: Any = None
        self._running: dict[int, tuple[PendingPoints, int]] = {}  # points not yet arrived at a decision, by number
        self._futures: dict[int, Any] = {}  # of points whose values were not collected, by number

    @property
    def workers(self) -> int:
        """Number of points that are evaluated at once."""
        return workers_of(self._opened()) or 1

    def _opened(self) -> Any:
        if self._executor is None:
            self._executor = self.target.function.executor() if self.pool is None else self.pool
        return self._executor

    def submit(self, coords: np.ndarray) -> PendingPoints:
        """Begin to evaluate points (n, ndim); the limit of simulations may allow only the first points."""
        n = len(coords)
        coords = coords[: self._allowed(coords)]
        log_prior, asked, known = self._look_up(coords)
        self.record.submitted(coords[asked])
        self.evaluations += len(asked)
        pending = PendingPoints(coords, log_prior, refused=len(coords) < n)
        numbers = np.arange(self._submitted, self._submitted + len(asked))
        self._submitted += len(asked)
        self._running.update((number, (pending, int(row))) for number, row in zip(numbers.tolist(), asked, strict=True))
        if not known.all():
            self.count(int(sum(~known)))
            of_point = Caught(*self.target.called, vectorize=False)
            futures = submit_all(self._opened(), of_point, self.target.as_points(coords[asked[~known]]))
            self._futures.update(zip(numbers[~known].tolist(), futures, strict=True))
            for future in futures:
                future.add_done_callback(lambda _, ended=self._ended: ended.set())
        return pending

    def wait(self, most: int) -> None:
        """Wait until at most this number of all submitted points is running, and let the others arrive."""
        if not self._running:
            return
        # by the points, since a search that goes on under a larger limit leads to other points
        points = self._points(self._running)
        key = f"arrived of {hashlib.blake2b(points.tobytes(), digest_size=16).hexdigest()}"
        by_batch: dict[int, list[int]] = {}

        def gather() -> list[np.ndarray]:
            while len(self._futures) > most:
                self._collect()
            return [np.array(sorted(self._running.keys() - self._futures.keys()), dtype=np.int64)]

        for number in self.remember(key, gather)[0].tolist():
            by_batch.setdefault(id(self._running[number][0]), []).append(number)
        for numbers in by_batch.values():
            self._arrive(numbers)

    def _points(self, numbers: Iterable[int]) -> np.ndarray:
        """Running points (m, ndim) by their numbers."""
        return np.array([pending.coords[row] for pending, row in map(self._running.__getitem__, numbers)])

    @interrupts_end_the_run()
    def _collect(self, wait: bool = True) -> None:
        """Enter the values of all points that have ended in the record, after a `wait` for one.

        What ends the run, as KeyboardInterrupt of a worker or a pool that cannot go on, is raised after that.
        """
        while wait and not any(future.done() for future in self._futures.values()):
            self._ended.wait()
            self._ended.clear()
        values, fault, seconds = {}, None, None if wait else SECONDS_TO_FETCH
        for number, future in [each for each in self._futures.items() if each[1].done()]:
            try:  # `exception` does not raise what the function raised, which may be KeyboardInterrupt
                error = future.exception(seconds)
                value = future.result(seconds) if error is None else None
            except (Exception, CancelledError) as raised:
                error, value = raised, None
                if not wait and isinstance(raised, TimeoutError):
                    break  # nothing can be fetched from this pool any more
            if type(error).__name__ == "KilledWorker":
                error, value = None, Failed("every process that evaluated this point died")
            error = value.error if isinstance(value, Ended) else error
            if error is None:
                values[number] = value
            fault = fault or error
        if values:
            batch = self.as_batch(self._points(values), list(values.values()))
            with deferred_interrupts():
                self.record.evaluated(batch)
                for number in values:
                    del self._futures[number]
            self.count(0, len(values))
        if wait and fault is not None:
            raise RuntimeError(CLOSED) if was_cancelled(fault) else fault

    def _arrive(self, numbers: list[int]) -> None:
        """Let points that were submitted together arrive, and check how many have failed."""
        coords, pending = self._points(numbers), self._running[numbers[0]][0]
        rows = np.array([self._running.pop(number)[1] for number in numbers])
        counts = len(self.record.failed), self.record.count + len(self._running)
        self.check_failures(self.record.values(coords), *counts, len(numbers) == len(pending.coords))
        pending.arrive(rows, self._records(coords, pending.log_prior[rows], np.arange(len(rows))))

    def close(self) -> None:
        """End the evaluation of running points; points that have ended are entered in the record."""
        try:
            self._collect(wait=False)
        except Exception as error:  # another error or Ctrl-C is the reason why the run ends
            logger.warning("evaluations that have ended are not stored: %s", error)
        finally:
            left = list(self._futures.values())
            self._forget_running()
            self.record.given_up()
            for future in left:
                future.cancel()
