"""Evaluation of a target in rounds: a batch of points is sent, answered and remembered.

A point for which the user's function raises an exception or returns NaN counts as -inf, and its reason is recorded. A
batch is entered in the record of the run (`samplers.record`) when it is finished; if a function takes one point at a
time, finished points are entered every 0.05 s, so that a killed process loses only these.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from ..chain import check_storable
from ..interrupts import interrupts_end_the_run
from ..record import BudgetExhausted, EvaluatedBatch, Incomplete, Record, Remember
from ..tempering.population import RECORD, PendingPoints
from .pools import CLOSED, was_cancelled
from .user_target import Target

SECONDS_BETWEEN_NOTES = 0.05


class Evaluator:
    """A posterior density that is evaluated and recorded: points become structured arrays with the fields log_prob,
    log_prior and, if there are any, blobs. An `observer` is called when the number of points that are `done` or
    `running` changes.
    """

    asynchronous = False
    workers = 0  # `submit` waits for its points

    def __init__(self, target: Target, record: Record, nwalkers: int, failure_share: float):
        self.target, self.record = target, record
        self._nwalkers, self._failure_share = nwalkers, failure_share
        self._blobs: tuple | None = None  # their field in the records, empty without blobs; None while not known
        self.pool = self.observer = None
        self.remember: Remember | None = None  # of the present annealing (`Record.remembering`)
        self.evaluations = self.done = self.running = 0

    def __getstate__(self):
        return {**self.__dict__, "pool": None, "observer": None, "remember": None}

    def count(self, begun: int, ended: int = 0) -> None:
        """Count points that begin to be evaluated, and points that have been evaluated."""
        self.running += begun
        ended = min(ended, self.running)
        self.running, self.done = self.running - ended, self.done + ended
        if self.observer is not None:
            self.observer()

    def inside(self, coords: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) lies in the support of the prior."""
        return self.target.log_prior(coords) > -np.inf

    def submit(self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None) -> PendingPoints:
        """Evaluate points (n, ndim); the limit of simulations may allow only the first points.

        `observe` is called with points directly before they are evaluated.
        """
        allowed = coords[: self._allowed(coords)]
        records = self.evaluate(allowed, observe=observe)
        return PendingPoints(allowed, records["log_prior"], len(allowed) < len(coords), records)

    def wait(self, most: int) -> None:
        """Nothing runs after `submit`."""

    def close(self) -> None:
        """An annealing has ended: nothing runs after `submit`."""

    def evaluate(
        self,
        coords: np.ndarray,
        then: Callable[[np.ndarray, np.ndarray], Any] = lambda coords, records: records,
        observe: Callable[[np.ndarray], None] | None = None,
    ) -> Any:
        """Records (n,) of points (n, ndim), known or new; or what ``then(coords, records)`` makes of them.

        Raises BudgetExhausted, before any evaluation, if the points do not fit into the limit of simulations.
        """
        if self._allowed(coords) < len(coords):
            raise BudgetExhausted
        log_prior, asked, known = self._look_up(coords)
        new = coords[asked[~known]]
        if observe is not None:
            for part in filter(len, (*self.record.parts(coords[asked[known]]), new)):
                observe(part)
        if len(new) > 0:
            results, noted = [], time.perf_counter()
            self.count(len(new))
            try:
                with interrupts_end_the_run():
                    for answer in self.target.answers(new, self.pool):
                        if self.target.vectorize:
                            results = answer  # of all points
                            break
                        results.append(answer)
                        self.count(0, 1)
                        if time.perf_counter() - noted > SECONDS_BETWEEN_NOTES:
                            self._enter_successes(new, results)
                            noted = time.perf_counter()
                self.count(0, self.running)
                batch, before = self.as_batch(new, results), self.record.knows(new)
                rest = batch.rows(np.flatnonzero(~before))  # failures among them, since many of them end the run
                failed, total = np.count_nonzero(rest.failed), self.record.count + len(rest.coords)
                self.check_failures(rest, len(self.record.failed) + failed, total, not (known.any() or before.any()))
                self.record.evaluated(rest)
            except BaseException as error:  # Ctrl-C, a pool that cannot go on, or too many failures
                with suppress(TypeError, ValueError):  # of values that are none
                    self._enter_successes(new, results)
                if was_cancelled(error):
                    raise RuntimeError(CLOSED) from error
                raise
        self.evaluations += len(asked)
        return then(coords, self._records(coords, log_prior, asked))

    def _allowed(self, coords: np.ndarray) -> int:
        """Number of the first points among (n, ndim) that the limit of simulations allows."""
        if self.record.limit is None:
            return len(coords)
        inside = np.flatnonzero(self.inside(coords))
        return int([*inside, len(coords)][self.record.fitting(coords[inside])])

    def _look_up(self, coords: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Log-prior (n,) of points (n, ndim), rows (m,) of those inside, and which of these are known."""
        if not np.all(np.isfinite(coords)):
            raise ValueError("At least one parameter value was infinite or NaN")
        log_prior = self.target.log_prior(coords)
        asked = np.flatnonzero(log_prior > -np.inf)
        known = self.record.knows(coords[asked])
        if not known.all() and self.record.is_complete:
            raise Incomplete
        self.count(int(sum(known)), int(sum(known)))
        return log_prior, asked, known

    def _enter_successes(self, coords: np.ndarray, results: Any) -> None:
        """Enter the successes among the first points in the record, as far as it does not know them."""
        coords = coords[: len(results)]
        if len(coords) > 0:
            part = self.as_batch(coords, results)
            self.record.evaluated(part.rows(np.flatnonzero(~part.failed & ~self.record.knows(coords))))

    def check_failures(self, batch: EvaluatedBatch, count: int, total: int, whole: bool) -> None:
        """Raise RuntimeError if `count` of `total` evaluations with the latest `batch` have failed, and these are many.
        Failures may be quicker than successes, so running points count in the total, and only a `whole` batch may not
        fail as a whole.
        """
        failed, n = np.flatnonzero(batch.failed), len(batch.coords)
        all_failed = whole and len(failed) == n >= self.target.ndim + 2
        if all_failed or (total >= self._nwalkers and count > self._failure_share * total):
            what = f"all {n} evaluations of a batch" if all_failed else f"{count} of {total} evaluations"
            latest = [(batch.coords[row], batch.reasons[row]) for row in failed[:1]] or self.record.failed[-1:]
            raise RuntimeError(
                f"{what} failed, where max_failure_share={self._failure_share:g} of the run is allowed: "
                f"{latest[0][1]} at {latest[0][0]}. Earlier evaluations are kept (see "
                "failures), and a run with a backend in a file goes on from there after the cause is fixed"
            )

    def as_batch(self, coords: np.ndarray, results: Any) -> EvaluatedBatch:
        """Values of points (n, ndim) from what the function has returned."""
        return self.typed(self.target.evaluated(coords, results))

    def typed(self, batch: EvaluatedBatch) -> EvaluatedBatch:
        """A batch with blobs of the type that the first evaluations had; ValueError for another type, or some without.

        ValueError also for a type that the file of the record cannot hold.
        """
        if batch.failed.all():
            return batch._replace(blobs=None)
        name, blobs = self.target.name, batch.blobs
        found = () if blobs is None else (("blobs", blobs.dtype, blobs.shape[1:]),)
        if self._blobs is None:
            if blobs is not None and self.record.path is not None:
                check_storable(blobs.dtype)
            self._blobs = found
        if found != self._blobs:
            now, before = (f"{each[0][1]} of shape {each[0][2]}" if each else "none" for each in (found, self._blobs))
            raise ValueError(
                f"{name} must return blobs of one type and shape, with every point or with none; got {now} after "
                f"{before}: return numbers, as many for each point (numpy.nan for None), or pass blobs_dtype="
            )
        return batch

    def _records(self, coords: np.ndarray, log_prior: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Records (n,) of points (n, ndim), of which these `rows` are known."""
        batch = self.typed(self.record.values(coords[rows]))
        records = np.zeros(len(coords), dtype=[*RECORD, *(self._blobs or ())])
        records["log_prob"], records["log_prior"] = -np.inf, log_prior
        records["log_prob"][rows] = np.where(batch.failed, -np.inf, batch.log_prob)
        if batch.blobs is not None:
            records["blobs"][rows] = batch.blobs
        return records


def unpack(records: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """log_prob and blobs (or None) of records, as emcee takes them."""
    return records["log_prob"].copy(), records["blobs"].copy() if "blobs" in records.dtype.names else None
