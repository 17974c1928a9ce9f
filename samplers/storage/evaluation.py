"""Evaluation of a log-density at batches of points: calls, failures, and the records that travel with the points.

`Evaluator` calls a user's function as emcee does (batch, pool or map; dictionaries for named parameters). Points
outside the support of the prior are not evaluated. A point for which the function raises an exception or returns NaN
counts as -inf, and its reason is recorded.

The journal gets a batch when it is finished. Where a function takes one point at a time, it gets finished points about
once per second, so that a process that is killed loses the last second.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from emcee.ensemble import ndarray_to_list_of_dicts

from ..tempering.budget import Budget, BudgetExhausted
from ..tempering.failed_region import EvaluatedPoints
from ..tempering.flights import Flight, submit_and_wait
from .checkpoint import Checkpoint
from .first_evaluations import POINTS
from .journal import EvaluatedBatch, merge_batches
from .pool_queue import map_in, pool_size
from .returned_values import ErrorCapturing, log_densities, log_probabilities, outcomes

__all__ = ["CallingConvention", "EvaluationRecords", "Evaluator", "FailureLimit", "Failures", "Observer"]

KEPT_FAILURES = 1000
KEPT_REASONS = 100
SECONDS_BETWEEN_NOTES = 1.0


class Failures:
    """Failed evaluations of a run: their number, and parameters and reasons of the first thousand.

    Attributes
    ----------
    count : int
        Number of failures.
    kept : list of dict
        ``{"parameters": array (ndim,), "reason": str}`` of the first thousand failures.
    reasons : Counter
        How often each reason occurred; after a hundred different ones, others are counted together.
    """

    def __init__(self):
        self.count = 0
        self.kept: list[dict] = []
        self.reasons: Counter[str] = Counter()

    def add(self, batch: EvaluatedBatch) -> None:
        """Enter the failures of a batch."""
        for row, reason in batch.reasons.items():
            self.count += 1
            if len(self.kept) < KEPT_FAILURES:
                self.kept.append({"parameters": batch.coords[row].copy(), "reason": reason})
            known = reason in self.reasons or len(self.reasons) < KEPT_REASONS
            self.reasons[reason if known else "another reason"] += 1

    def most_common(self, number: int = 3) -> str:
        """The most frequent reasons as text."""
        return "; ".join(f"{count} x {reason}" for reason, count in self.reasons.most_common(number))


class FailureLimit(NamedTuple):
    """When failures stop a run.

    Attributes
    ----------
    share : float
        Largest share of the evaluations that may fail.
    nwalkers, ndim : int
        The share applies after `nwalkers` evaluations; a batch of ndim + 2 points or more may not fail as a whole.
    """

    share: float
    nwalkers: int
    ndim: int

    def check(
        self, batch: EvaluatedBatch, evaluations: int, failures: int, running: int = 0, whole: bool = True
    ) -> None:
        """Raise RuntimeError if the limit is exceeded by a batch that comes after the given numbers.

        Failures may be quicker or slower than successes. So points that are running count as successes, and a batch
        may fail as a whole if it is not `whole`.
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
                "file continues from there after the cause is fixed"
            )


class CallingConvention(NamedTuple):
    """How functions of points are called, as in emcee.

    Attributes
    ----------
    vectorize : bool
        Whether functions take a batch of points instead of one.
    parameter_names : dict, optional
        Names and indices of the parameters; functions then take dictionaries.
    blobs_dtype : dtype, optional
        dtype of the blobs.
    """

    vectorize: bool
    parameter_names: Mapping[str, Any] | None = None
    blobs_dtype: Any = None

    def as_points(self, coords: np.ndarray) -> Any:
        """Points (n, ndim) as functions take them: rows of an array, or dictionaries."""
        named = self.parameter_names
        return coords if named is None else ndarray_to_list_of_dicts(coords, named)

    def call(
        self,
        function: Callable,
        coords: np.ndarray,
        pool: Any = None,
        note: Callable[[list], None] | None = None,
        observer: "Observer | None" = None,
    ) -> Any:
        """Results of a function for points (n, ndim); `note` is called with the first of them about once per second.

        The observer hears of every result. A function of a batch has no first results, and neither has a pool whose
        ``map`` returns a list.
        """
        points = self.as_points(coords)
        if self.vectorize:
            return function(points)
        results, noted = [], time.perf_counter()
        for result in map_in(pool)(function, points):
            results.append(result)
            if observer is not None:
                observer.finished(1)
            if note is not None and time.perf_counter() - noted > SECONDS_BETWEEN_NOTES:
                note(results)
                noted = time.perf_counter()
        return results


class Observer(Protocol):
    """What is told of points while they are evaluated, such as `samplers.reporting.progress.Progress`."""

    def repeated(self, points: int) -> None:
        """Points of the interrupted run were taken from its journal."""

    def submitted(self, points: int) -> None:
        """Points begin to be evaluated."""

    def finished(self, points: int) -> None:
        """Points have been evaluated."""

    def settled(self) -> None:
        """All points that were submitted have been evaluated."""


class EvaluationRecords:
    """Evaluated points as structured arrays with the fields log_prob, log_prior and, if there are any, blobs.

    The field log_prior is the log-density at beta = 0, which is not that of the prior where the sampler has a
    `start_density`. In this form, a walker carries all three through moves and resampling.
    """

    def __init__(self):
        self._fields: list[tuple] = [("log_prob", np.float64), ("log_prior", np.float64)]

    def pack(self, log_prob: np.ndarray, log_prior: np.ndarray, blobs: np.ndarray | None = None) -> np.ndarray:
        """Records (n,) from their fields; NaN in `log_prob` becomes -inf."""
        if blobs is not None and len(self._fields) == 2:
            self._fields.append(("blobs", blobs.dtype, blobs.shape[1:]))
        records = np.zeros(len(log_prob), dtype=self._fields)
        records["log_prob"] = np.where(np.isnan(log_prob), -np.inf, log_prob)
        records["log_prior"] = log_prior
        if blobs is not None:
            records["blobs"] = blobs
        return records

    def pack_batch(self, log_prior: np.ndarray, inside: np.ndarray, batch: EvaluatedBatch | None) -> np.ndarray:
        """Records of n points with log-prior (n,), of which those `inside` (n,) have been evaluated."""
        log_prob = np.full(len(log_prior), -np.inf)
        blobs = None
        if batch is not None:
            log_prob[inside] = batch.log_prob
            if batch.blobs is not None:
                blobs = np.zeros((len(log_prior), *batch.blobs.shape[1:]), dtype=batch.blobs.dtype)
                blobs[inside] = batch.blobs
        return self.pack(log_prob, log_prior, blobs)

    @staticmethod
    def unpack(records: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """log_prob and blobs (or None), as emcee takes them."""
        return records["log_prob"].copy(), records["blobs"].copy() if "blobs" in records.dtype.names else None


class Evaluator:
    """A posterior density that is evaluated, counted and recorded (a `samplers.tempering.population.Density`).

    Parameters
    ----------
    function : ErrorCapturing
        The log-density, or the log-likelihood.
    log_prior_fn : callable
        The log-prior.
    convention : CallingConvention
        How both are called.
    checkpoint : Checkpoint, optional
        Where evaluations are stored, and looked up when a run is resumed.
    limit : FailureLimit, optional
        When failures stop the run; never by default.
    keep_blobs : bool
        Whether the records contain the blobs.
    budget : Budget, optional
        Counts simulations and limits them; no limit by default.
    name : str
        Name of the function in messages. The log-prior is added to the values of a "log_likelihood_fn".
    check : callable, optional
        Called with this object and the first batch that it evaluates; raises ValueError for a wrong function.
    start_density : callable, optional
        Log-density at beta = 0, which takes the place of the log-prior in the records; the log-prior by default.

    Attributes
    ----------
    budget : Budget
        See above.
    evaluates_parts : bool
        Whether the first points of a batch that does not fit into the limit of simulations are evaluated.
    evaluations : int
        Number of points evaluated so far, including those of the interrupted run that is continued.
    failures : Failures
        Those of them that failed.
    points : EvaluatedPoints
        The latest of them.
    new_evaluations : int
        Number of points that this object has evaluated itself.
    pool : object with a method map, optional
        Where functions of one point are called; set by the sampler.
    observer : Observer, optional
        Told of points while they are evaluated.
    asynchronous : bool
        Whether `submit` returns without waiting.
    """

    asynchronous = False

    def __init__(
        self,
        function: ErrorCapturing,
        log_prior_fn: Callable,
        convention: CallingConvention,
        checkpoint: Checkpoint | None = None,
        limit: FailureLimit | None = None,
        keep_blobs: bool = True,
        budget: Budget | None = None,
        name: str = "log_prob_fn",
        check: Callable[["Evaluator", EvaluatedBatch], None] | None = None,
        start_density: Callable | None = None,
    ):
        self._name, self._check, self._start_density = name, check, start_density
        self._function, self._log_prior_fn, self._convention = function, log_prior_fn, convention
        self._checkpoint, self._limit, self._keep_blobs = checkpoint, limit, keep_blobs
        self._records = EvaluationRecords()
        self.budget = Budget() if budget is None else budget
        self.evaluates_parts = True
        self.pool: Any = None
        self.observer: Observer | None = None
        self.new_evaluations = 0
        self.reset()

    def __getstate__(self):
        return {**self.__dict__, "pool": None, "observer": None}

    def reset(self) -> None:
        """Forget evaluations and failures; `budget` keeps its points."""
        self.evaluations, self.failures, self.points = 0, Failures(), EvaluatedPoints()

    @property
    def map(self) -> Callable:
        """``map``, or that of the pool."""
        return map_in(self.pool)

    def log_prior(self, coords: np.ndarray) -> np.ndarray:
        """Log-prior (n,) of points (n, ndim), always computed in this process; -inf for NaN."""
        results = self._convention.call(self._log_prior_fn, coords)
        log_prior = log_densities(results, len(coords), "log_prior_fn")
        return np.where(np.isnan(log_prior), -np.inf, log_prior)

    def log_base(self, coords: np.ndarray) -> np.ndarray:
        """Log-density (n,) at beta = 0 of points (n, ndim): of the prior, unless a `start_density` is given."""
        return self._with_start_density(coords, self.log_prior(coords))

    def _with_start_density(self, coords: np.ndarray, log_prior: np.ndarray) -> np.ndarray:
        inside = log_prior > -np.inf
        if self._start_density is None or not inside.any():
            return log_prior
        values = self._convention.call(self._start_density, coords[inside])
        log_start = log_densities(values, int(np.sum(inside)), "start_density")
        if not np.all(np.isfinite(log_start)):
            first = np.flatnonzero(~np.isfinite(log_start))[0]
            raise ValueError(
                "start_density must be finite wherever the log-prior is, since annealing cannot reach other points; "
                f"got {log_start[first]} at {coords[inside][first]}. Mix it with the prior: "
                "numpy.logaddexp(log(0.95) + start_density, log(0.05) + log_prior), for draws of this mixture"
            )
        log_base = np.full(len(coords), -np.inf)
        log_base[inside] = log_start
        return log_base

    def log_base_of_start(self, coords: np.ndarray) -> np.ndarray:
        """`log_base` (n,) of the points (n, ndim) that a run starts from; ValueError if one is outside the prior."""
        log_prior = self.log_prior(coords)
        outside = np.flatnonzero(log_prior == -np.inf)
        if len(outside) > 0:
            raise ValueError(
                f"{len(outside)} of {len(coords)} initial points lie outside the prior's support (log_prior -inf or "
                f"NaN), the first of them {coords[outside[0]]}: pass draws of the prior"
            )
        return self._with_start_density(coords, log_prior)

    def inside(self, coords: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) lies in the support of the prior."""
        return self.log_prior(coords) > -np.inf

    def evaluate(self, coords: np.ndarray) -> np.ndarray:
        """Records (n,) of points (n, ndim): of the interrupted run that is continued, or from new evaluations.

        Raises
        ------
        ValueError
            If a coordinate is not finite.
        BudgetExhausted
            If the points do not fit into the limit of simulations. With `evaluates_parts`, the first of them that fit
            are evaluated.
        """
        return self.evaluate_observed(coords, None)

    @property
    def workers(self) -> int:
        """0: `submit` waits for its points."""
        return 0

    @property
    def known_workers(self) -> int | None:
        """Number of points that are evaluated at once, if the pool says so."""
        return None if self.pool is None else pool_size(self.pool)

    def submit(self, coords: np.ndarray) -> Flight:
        """Evaluate points (n, ndim), of which the limit of simulations may allow the first few only."""
        return submit_and_wait(self, coords)

    def wait(self, most: int) -> None:
        """Nothing runs after `submit`."""

    def close(self) -> None:
        """Nothing runs after `submit`."""

    def evaluate_observed(self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None) -> np.ndarray:
        """As `evaluate`, but `observe` is called with the points directly before they are evaluated.

        It is called for points of the interrupted run as well, in the same parts as in that run.
        """
        if not np.all(np.isfinite(coords)):
            raise ValueError("At least one parameter value was infinite or NaN")
        log_base = self.log_base(coords)
        inside = log_base > -np.inf
        if not inside.any():
            return self._records.pack_batch(log_base, inside, None)
        points = coords[inside]
        parts = [(slice(None), None)] if self._checkpoint is None else self._checkpoint.find(points)
        batches: list[EvaluatedBatch] = []
        for rows, known in parts:
            wanted = points[rows]
            if known is None:
                fitting = self.budget.fitting(wanted)
                part = wanted if fitting == len(wanted) else wanted[: fitting if self.evaluates_parts else 0]
            else:
                part = wanted
            if observe is not None and len(part) > 0:
                observe(part)
            if len(part) > 0:
                if known is not None:
                    self._check = None  # the interrupted run has checked its first batch
                    if self.observer is not None:
                        self.observer.repeated(len(part))
                batches.append(self._compute_and_store(part) if known is None else known)
                self.count(batches[-1])
            if len(part) < len(wanted):
                raise BudgetExhausted(self._first_records(log_base, inside, batches))
        return self._records.pack_batch(log_base, inside, merge_batches(batches))

    def _compute_and_store(self, coords: np.ndarray) -> EvaluatedBatch:
        stored, storable = 0, self._checkpoint is not None

        def store_first(results: list) -> None:
            """Store what is known of a long batch: plain numbers, since a failure may yet end the run."""
            nonlocal stored, storable
            storable = storable and all(isinstance(r, float | np.floating) and r == r for r in results[stored:])
            if not storable:
                return
            part = self._as_batch(coords[stored : len(results)], results[stored:])
            if self._check is not None:
                if np.isfinite(part.log_prob).sum() < POINTS:
                    return
                self._check(self, part)
                self._check = None
            self._checkpoint.evaluated(part)
            self.new_evaluations += len(part.coords)
            stored = len(results)

        if self.observer is not None:
            self.observer.submitted(len(coords))
        results = self._convention.call(self._function, coords, self.pool, store_first, self.observer)
        if self.observer is not None:
            self.observer.settled()
        batch = self._as_batch(coords, results)
        if self._limit is not None:
            self._limit.check(batch, self.evaluations, self.failures.count)
        if self._check is not None:
            self._check(self, batch)
            self._check = None
        if self._checkpoint is not None and stored < len(coords):
            self._checkpoint.evaluated(batch.after(stored))
        self.new_evaluations += len(coords) - stored
        return batch

    def _first_records(self, log_base: np.ndarray, inside: np.ndarray, batches: list[EvaluatedBatch]) -> np.ndarray:
        """Records of the points before the first one that was not evaluated."""
        done = sum(len(batch.coords) for batch in batches)
        first = slice(0, int(np.flatnonzero(inside)[done]))
        batch = merge_batches(batches) if batches else None
        return self._records.pack_batch(log_base[first], inside[first], batch)

    def call(self, function: Callable, coords: np.ndarray) -> np.ndarray:
        """Values (n,) of another function of points (n, ndim) that is called like the log-density."""
        return log_densities(self._convention.call(function, coords, self.pool), len(coords), "the function")

    def compute(self, coords: np.ndarray) -> EvaluatedBatch:
        """Call the function for points (n, ndim), without counting or storing."""
        return self._as_batch(coords, self._convention.call(self._function, coords, self.pool))

    def _as_batch(self, coords: np.ndarray, results: Any) -> EvaluatedBatch:
        log_prob, blobs, reasons = outcomes(results, len(coords), self._convention.blobs_dtype, self._name)
        if self._name == "log_likelihood_fn":
            log_prob = log_prob + self.log_prior(coords)
        return EvaluatedBatch(coords, log_prob, blobs if self._keep_blobs else None, reasons)

    def count_again(self, batches: Sequence[EvaluatedBatch]) -> None:
        """Count the batches of the interrupted run that is continued, and nothing else."""
        self.reset()
        for batch in batches:
            self.count(batch)

    def count(self, batch: EvaluatedBatch) -> None:
        """Count the evaluations of a batch and its failures."""
        self.evaluations += len(batch.coords)
        self.failures.add(batch)
        self.points.add(batch.coords, batch.log_prob, list(batch.reasons))
        self.budget.count(batch.coords)

    def pack(self, log_prob: np.ndarray, log_prior: np.ndarray, blobs: np.ndarray | None) -> np.ndarray:
        """Records (n,) of points whose log-probabilities, log-priors and blobs are known."""
        log_prob, _ = log_probabilities(np.asarray(log_prob), len(log_prior), "the initial state's log_prob")
        return self._records.pack(log_prob, log_prior, blobs)

    def unpack(self, records: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """log_prob and blobs (or None), as emcee takes them."""
        return self._records.unpack(records)
