"""Evaluation of a log-density at batches of points: calls, failures, and the records that travel with the points.

Functions are called as emcee calls them. A point for which the function raises an exception or returns NaN counts as
-inf, and its reason is recorded. A batch is entered in the record of the run (`samplers.record`) when it is finished;
if a function takes one point at a time, finished points are entered every 0.05 s, so that a killed process loses only
these.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from emcee.ensemble import ndarray_to_list_of_dicts

from ..blobs import converted
from ..budget import Budget, BudgetExhausted
from ..interrupts import Ended, SentFunction, interrupts_end_the_run
from ..record import EvaluatedBatch, Record, merge_batches
from ..tempering.pending_points import PendingPoints
from .pool_queue import map_in
from .returned_values import ErrorCapturing, log_densities, outcomes

__all__ = ["CallingConvention", "Evaluator", "FailureLimit", "Observer", "most_common_reasons"]

SECONDS_BETWEEN_NOTES = 0.05


def most_common_reasons(failed: Sequence[tuple[np.ndarray, str]], number: int = 3) -> str:
    """The most frequent reasons of failed evaluations (point, reason) as text."""
    reasons = Counter(reason for _, reason in failed)
    return "; ".join(f"{count} x {reason}" for reason, count in reasons.most_common(number))


class FailureLimit(NamedTuple):
    """The share of the evaluations that may fail before a run stops.

    It applies after `nwalkers` evaluations; a batch of ndim + 2 points or more may not fail as a whole.
    """

    share: float
    nwalkers: int
    ndim: int

    def check(
        self, batch: EvaluatedBatch, evaluations: int, failures: int, running: int = 0, whole: bool = True
    ) -> None:
        """Raise RuntimeError if the limit is exceeded by a batch that comes after the given numbers.

        Failures may be quicker or slower than successes. So running points count as successes, and a batch that is not
        `whole` may fail completely.
        """
        n, count = len(batch.coords), failures + len(batch.reasons)
        total = evaluations + n + running
        all_failed = whole and len(batch.reasons) == n >= self.ndim + 2
        if all_failed or (total >= self.nwalkers and count > self.share * total):
            what = f"all {n} evaluations of a batch" if all_failed else f"{count} of {total} evaluations"
            first = min(batch.reasons)
            raise RuntimeError(
                f"{what} failed, where max_failure_share={self.share:g} of the run is allowed: {batch.reasons[first]} "
                f"at {batch.coords[first]}. Earlier evaluations are kept (see failures), and a run with a backend in a "
                "file goes on from there after the cause is fixed"
            )


class CallingConvention(NamedTuple):
    """How functions are called, as in emcee: one point or a batch, arrays or dictionaries; type of blobs."""

    vectorize: bool
    parameter_names: Mapping[str, Any] | None = None
    blobs_dtype: Any = None

    @property
    def argument(self) -> str:
        """The argument of functions, in words."""
        points = "an array (n, ndim) of points" if self.vectorize else "an array (ndim,), one point"
        if self.parameter_names is None:
            return f"{points} (vectorize={self.vectorize})"
        return f"a {'list of dictionaries' if self.vectorize else 'dictionary'} of parameters by name (parameter_names)"

    def as_points(self, coords: np.ndarray) -> Any:
        """Points (n, ndim) as functions take them: rows of an array, or dictionaries.

        They are copies, since a function may change its argument.
        """
        named = self.parameter_names
        return coords.copy() if named is None else ndarray_to_list_of_dicts(coords.copy(), named)

    @interrupts_end_the_run()
    def call(
        self,
        function: Callable,
        coords: np.ndarray,
        pool: Any = None,
        note: Callable[[list], None] | None = None,
        observer: "Observer | None" = None,
    ) -> Any:
        """Results of a function for points (n, ndim); `note` is called with the first results every 0.05 s.

        The observer is told of every result. There are no first results for a function of a batch, or for a pool whose
        ``map`` returns a list.
        """
        points = self.as_points(coords)
        if self.vectorize:
            return function(points)
        results, noted = [], time.perf_counter()
        try:
            for result in map_in(pool)(function if pool is None else SentFunction(function), points):
                if isinstance(result, Ended):
                    raise result.error
                results.append(result)
                if observer is not None:
                    observer.finished(1)
                if note is not None and time.perf_counter() - noted > SECONDS_BETWEEN_NOTES:
                    note(results)
                    noted = time.perf_counter()
        except BaseException:  # Ctrl-C, or a pool that cannot go on
            if note is not None:
                note(results)
            raise
        return results


class Observer(Protocol):
    """Object that is told of points while they are evaluated, such as `samplers.reporting.progress.Progress`."""

    def repeated(self, points: int) -> None:
        """Points were found in the record of the run."""

    def submitted(self, points: int) -> None:
        """Points begin to be evaluated."""

    def finished(self, points: int) -> None:
        """Points have been evaluated."""

    def settled(self) -> None:
        """All points that were submitted have been evaluated."""


class Evaluator:
    """A posterior density that is evaluated and recorded (a `samplers.tempering.population.Density`).

    Evaluated points are structured arrays with the fields log_prob, log_prior and, if there are any, blobs: a walker
    carries all three through moves and resampling. Points outside the support of the prior are not evaluated. The
    log-prior is added to the values of a function whose `name`, also in messages, is "log_likelihood_fn".

    `evaluations` counts the points that were asked for, `new_evaluations` those that this object has evaluated instead
    of finding them in the record. `evaluates_parts` says whether the first points of a batch that does not fit into the
    limit of simulations are evaluated. `on_unknown` is called once, before the first evaluation of a point that is not
    in the record. The sampler sets `pool`, where functions of one point are called.
    """

    asynchronous = False

    def __init__(
        self,
        function: ErrorCapturing,
        log_prior_fn: Callable,
        convention: CallingConvention,
        record: Record | None = None,
        limit: FailureLimit | None = None,
        budget: Budget | None = None,
        name: str = "log_prob_fn",
    ):
        self._name = name
        self._function, self._log_prior_fn, self._convention = function, log_prior_fn, convention
        self.record, self._limit = Record() if record is None else record, limit
        self._fields: list[tuple] = [("log_prob", np.float64), ("log_prior", np.float64)]
        self._has_blobs: bool | None = None  # whether the function returns blobs; None while this is not known
        self.budget = Budget(self.record) if budget is None else budget
        self.evaluates_parts = True
        self.pool: Any = None
        self.observer: Observer | None = None
        self.on_unknown: Callable[[], None] | None = None
        self.evaluations = self.new_evaluations = 0

    def __getstate__(self):
        return {**self.__dict__, "pool": None, "observer": None}

    def __deepcopy__(self, memo):
        return self  # moves that are copied go on with the same density

    @property
    def map(self) -> Callable:
        """Python's ``map``, or the ``map`` of the pool."""
        return map_in(self.pool)

    def log_prior(self, coords: np.ndarray) -> np.ndarray:
        """Log-prior (n,) of points (n, ndim), always computed in this process; -inf for NaN."""
        results = self._convention.call(self._log_prior_fn, coords)
        log_prior = log_densities(results, len(coords), "log_prior_fn")
        return np.where(np.isnan(log_prior), -np.inf, log_prior)

    def log_prior_of_start(self, coords: np.ndarray) -> np.ndarray:
        """Log-prior (n,) of the points (n, ndim) that a run starts from; ValueError if one is outside the support."""
        try:
            log_prior = self.log_prior(coords)
        except Exception as error:
            raise ValueError(
                f"log_prior_fn failed with {error!r}. It is called as log_prob_fn is: with {self._convention.argument}"
            ) from error
        outside = np.flatnonzero(log_prior == -np.inf)
        if len(outside) > 0:
            raise ValueError(
                f"{len(outside)} of {len(coords)} initial points lie outside the prior's support (log_prior -inf or "
                f"NaN), the first of them {coords[outside[0]]}: pass draws of the prior"
            )
        return log_prior

    def inside(self, coords: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) lies in the support of the prior."""
        return self.log_prior(coords) > -np.inf

    @property
    def workers(self) -> int:
        """0: `submit` waits for its points."""
        return 0

    def submit(self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None) -> PendingPoints:
        """Evaluate points (n, ndim); the limit of simulations may allow only the first points."""
        try:
            return PendingPoints.known(coords, self.evaluate(coords, observe))
        except BudgetExhausted as stop:
            return PendingPoints.known(coords[: len(stop.records)], stop.records, refused=True)

    def wait(self, most: int) -> None:
        """Nothing runs after `submit`."""

    def close(self) -> None:
        """An annealing has ended: nothing runs after `submit`."""
        self.on_unknown = None

    def evaluate(self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None) -> np.ndarray:
        """Records (n,) of points (n, ndim): from the record of the run, or from new evaluations.

        `observe` is called with points directly before they are evaluated; points of the record are passed in the same
        parts. Raises ValueError if a coordinate is not finite, and BudgetExhausted if the points do not fit into the
        limit of simulations. With `evaluates_parts`, the first points that fit are evaluated.
        """
        if not np.all(np.isfinite(coords)):
            raise ValueError("At least one parameter value was infinite or NaN")
        log_prior = self.log_prior(coords)
        inside = log_prior > -np.inf
        if not inside.any():
            return self._pack(log_prior, inside, None)
        points = coords[inside]
        batches: list[EvaluatedBatch] = []
        for rows, known in self.record.find(points):
            part = points[rows] if known is not None else self._fitting(points[rows])
            if observe is not None and len(part) > 0:
                observe(part)
            if known is not None:
                self._check_blobs(known)
                if self.observer is not None:
                    self.observer.repeated(len(part))
                batches.append(known)
            elif len(part) > 0:
                if self.on_unknown is not None:
                    self.on_unknown()
                    self.on_unknown = None
                batches.append(self._compute_and_store(part, whole=len(part) == len(points)))
            self.evaluations += len(part)
            if len(part) < rows.stop - rows.start:
                raise BudgetExhausted(self._first_records(log_prior, inside, batches))
        return self._pack(log_prior, inside, merge_batches(batches))

    def _fitting(self, coords: np.ndarray) -> np.ndarray:
        """The points (n, ndim), or the first points that the limit of simulations allows."""
        fitting = self.budget.fitting(coords)
        return coords if fitting == len(coords) else coords[: fitting if self.evaluates_parts else 0]

    def _compute_and_store(self, coords: np.ndarray, whole: bool) -> EvaluatedBatch:
        """Evaluate points that are not in the record: the `whole` of a batch, or a part of it."""
        stored, failed = 0, []

        def store_first(results: list) -> None:
            """Store the first results of a long batch except failures, which may yet end the run."""
            nonlocal stored
            if len(results) == stored:
                return
            part = self._as_batch(coords[stored : len(results)], results[stored:])
            failed.extend(stored + row for row in part.reasons)
            self._enter(_successes(part))
            stored = len(results)

        if self.observer is not None:
            self.observer.submitted(len(coords))
        results = self._convention.call(self._function, coords, self.pool, store_first, self.observer)
        if self.observer is not None:
            self.observer.settled()
        batch = self._as_batch(coords, results)
        new = batch.rows([*failed, *range(stored, len(coords))])
        self._check_failures(new, whole=whole and stored == 0)
        self._enter(new)
        return batch

    def _check_failures(self, batch: EvaluatedBatch, whole: bool) -> None:
        """Raise RuntimeError if too many evaluations have failed; successful evaluations are kept."""
        if self._limit is None:
            return
        try:
            self._limit.check(batch, self.record.count, len(self.record.failed), whole=whole)
        except RuntimeError:
            self._enter(_successes(batch))
            raise

    def _enter(self, batch: EvaluatedBatch) -> None:
        if len(batch.coords) > 0:
            self.record.evaluated(batch)
            self.new_evaluations += len(batch.coords)

    def _pack(self, log_prior: np.ndarray, inside: np.ndarray, batch: EvaluatedBatch | None) -> np.ndarray:
        """Records of points with log-prior (n,); only the points `inside` (n,) are evaluated."""
        blobs = None if batch is None else self.typed(batch.blobs)
        records = np.zeros(len(log_prior), dtype=self._fields)
        records["log_prob"], records["log_prior"] = -np.inf, log_prior
        if batch is not None:
            records["log_prob"][inside] = np.where(np.isnan(batch.log_prob), -np.inf, batch.log_prob)
            if blobs is not None:
                records["blobs"][inside] = blobs
        return records

    def typed(self, blobs: np.ndarray | None) -> np.ndarray | None:
        """Blobs (n, ...) in the type of all blobs of the run, which the first evaluations have, or which is declared.

        Raises ValueError if this type cannot hold one of them.
        """
        if blobs is None:
            return None
        declared = self._convention.blobs_dtype
        if len(self._fields) == 2:
            dtype = blobs.dtype if declared is None or np.dtype(declared).itemsize == 0 else np.dtype(declared)
            self.record.check_blobs(dtype)
            self._fields.append(("blobs", dtype, blobs.shape[1:]))
        return converted(blobs, *self._fields[2][1:], declared is not None)

    def _check_blobs(self, batch: EvaluatedBatch) -> None:
        """Raise ValueError if points that have not failed have blobs and others have none."""
        if len(batch.reasons) == len(batch.coords):
            return
        has_blobs = batch.blobs is not None
        self._has_blobs = has_blobs if self._has_blobs is None else self._has_blobs
        if has_blobs != self._has_blobs:
            this, before = ("blobs", "none") if has_blobs else ("no blobs", "some")
            raise ValueError(f"{self._name} must return blobs with every point or with none; got {this} after {before}")

    def _first_records(self, log_prior: np.ndarray, inside: np.ndarray, batches: list[EvaluatedBatch]) -> np.ndarray:
        """Records of the points before the first point that was not evaluated."""
        done = sum(len(batch.coords) for batch in batches)
        first = slice(0, int(np.flatnonzero(inside)[done]))
        batch = merge_batches(batches) if batches else None
        return self._pack(log_prior[first], inside[first], batch)

    def compute(self, coords: np.ndarray) -> EvaluatedBatch:
        """Call the function for points (n, ndim), without counting or storing."""
        return self._as_batch(coords, self._convention.call(self._function, coords, self.pool))

    def _as_batch(self, coords: np.ndarray, results: Any) -> EvaluatedBatch:
        log_prob, blobs, reasons = outcomes(results, len(coords), self._convention.blobs_dtype, self._name)
        if self._name == "log_likelihood_fn":
            log_prob = log_prob + self.log_prior(coords)
        batch = EvaluatedBatch(coords, log_prob, blobs, reasons)
        self._check_blobs(batch)
        return batch

    def unpack(self, records: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """log_prob and blobs (or None), as emcee takes them."""
        return records["log_prob"].copy(), records["blobs"].copy() if "blobs" in records.dtype.names else None


def _successes(batch: EvaluatedBatch) -> EvaluatedBatch:
    """The points of a batch that have not failed."""
    return batch.rows([row for row in range(len(batch.coords)) if row not in batch.reasons])
