"""Arrays of log-densities and blobs from what a user's function returns, or an error that says what is wrong.

emcee's conventions hold: one number per point, or a sequence of the number and blobs; blobs of several points are
stacked; text and blobs of different lengths become objects. Unlike in emcee, a point fails by NaN, and anything that is
not a number is refused with an explanation.
"""

import copy
import logging
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..blobs import stacked
from ..interrupts import interrupts, raise_if_interrupted, raise_if_it_ends_the_run

__all__ = ["Caught", "Failed", "log_densities", "most_common_reasons", "outcomes"]

logger = logging.getLogger(__name__)


def most_common_reasons(reasons: Iterable[str] | Mapping[str, int], number: int = 3) -> str:
    """The most frequent reasons of failures, given one by one or counted, as text."""
    return "; ".join(f"{count} x {reason}" for reason, count in Counter(reasons).most_common(number))


class Failed:
    """Takes the place of a result if a function raised an exception or reports a fault; `reason` is text."""

    def __init__(self, error: BaseException | str):
        self.reason = error if isinstance(error, str) else f"{type(error).__name__}: {error}"


class Caught:
    """A function that returns `Failed` instead of raising; it can be sent to a worker if the function can.

    Its method ``fault(point)``, or the method of the object of a method, says why a fault of the infrastructure (a
    killed process, a full disk) prevented the evaluation of a point: in this process, the records of workers are not
    seen. KeyboardInterrupt, SystemExit in this process, and exceptions whose attribute ``ends_run`` is true are raised.
    """

    def __init__(self, function: Callable, args: Sequence | None, kwargs: Mapping[str, Any] | None, vectorize: bool):
        self.function, self.args, self.kwargs, self.vectorize = function, args or (), kwargs or {}, vectorize

    def __call__(self, points: Any) -> Any:
        before, known = sys.exception(), interrupts()
        try:
            # a copy, since the points are needed after a function that changes them
            result = self.function(copy.deepcopy(points), *self.args, **self.kwargs)
            raise_if_interrupted(known)
            owner = getattr(self.function, "__self__", self.function)  # of a method such as log_likelihood
            fault = "" if self.vectorize or not hasattr(owner, "fault") else owner.fault(points)
            return Failed(fault) if fault else result
        except (Exception, SystemExit) as error:
            raise_if_it_ends_the_run(error, before)
            raise_if_interrupted(known)
            if not self.vectorize:
                return Failed(error)
            if len(points) == 1:
                return [Failed(error)]
            logger.warning(
                "log_prob_fn raised an exception for a batch of %d points: evaluating each point alone",
                len(points),
                exc_info=True,
            )
        results = [self(points[i : i + 1]) for i in range(len(points))]
        # a result that is not a sequence of one item stays as it is, and is refused with a message
        return [result[0] if _is_row(result) and len(result) == 1 else result for result in results]


def outcomes(results: Any, n: int, blobs_dtype: Any, name: str) -> tuple[np.ndarray, np.ndarray | None, dict[int, str]]:
    """Log-densities (n,), blobs (n, ...) or None, and reasons of failures by row, of what a function has returned.

    A point fails by an exception or a fault (`Caught`), by NaN, or if a pool lost every process that evaluated it. Its
    log-density is NaN; its blobs are zero or empty. Errors as in `_arrays`.
    """
    reasons = {}
    if isinstance(results, list):
        lost = (row if not _lost_in_pool(row) else Failed(row[1]) for row in results)
        reasons = {row: result.reason for row, result in enumerate(lost) if isinstance(result, Failed)}
    if not reasons:
        log_prob, blobs = _arrays(results, n, name, blobs_dtype)
    else:
        good = [row for row in range(len(results)) if row not in reasons]
        log_prob, blobs = np.full(n, np.nan), None
        if good:
            log_prob[good], found = _arrays([results[row] for row in good], len(good), name, blobs_dtype)
            if found is not None:
                blobs = np.zeros((n, *found.shape[1:]), dtype=found.dtype)
                blobs[good] = found
    for row in np.flatnonzero(np.isnan(log_prob)):
        reasons.setdefault(int(row), f"{name} returned NaN")
    return log_prob, blobs, reasons


def log_densities(results: Any, n: int, name: str) -> np.ndarray:
    """Log-densities (n,) from a function that must return one number per point, without blobs; -inf for NaN."""
    values, blobs = _arrays(results, n, name, None)
    if blobs is not None:
        row = next(row for row in results if _is_row(row) and len(row) > 1)
        raise ValueError(
            f"{name} must return one number per point; got {type(row).__name__} of shape {np.shape(row)} for a point. "
            "If these are the log-densities of the single parameters, return their sum, np.sum(..., axis=-1)"
        )
    return np.where(np.isnan(values), -np.inf, values)


def _arrays(results: Any, n: int, name: str, blobs_dtype: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Log-densities (n,), with NaN, and blobs (n, ...) or None, from what a function called `name` has returned.

    `results` are n numbers, or n sequences (number, blob, ...). Raises ValueError if there are not `n` results, one is
    not a number or is +inf, or `blobs_dtype` cannot hold a blob.
    """
    if hasattr(results, "__array__"):
        results = np.asarray(results)
    if n == 1 and isinstance(results, np.ndarray) and results.ndim == 0:
        results = results.reshape(1)  # functions of SciPy drop the axis of a batch of one point
    if not _is_row(results):
        raise ValueError(
            f"{name} must return {n} numbers for {n} points with vectorize=True; got {type(results).__name__}. "
            "A function of one point needs vectorize=False"
        )
    if len(results) != n:
        raise ValueError(f"{name} must return {n} numbers for {n} points; got {len(results)}")
    blobs = None
    if isinstance(results, np.ndarray) and results.ndim == 1 and results.dtype.kind in "fiu":
        log_prob = results.astype(float)
    else:
        log_prob = np.array([_number(row[0] if _is_row(row) else row, name) for row in results])
        tails = [row[1:] for row in results if _is_row(row) and len(row) > 1]
        if tails and len(tails) != n:
            raise ValueError(f"{name} must return blobs with every point or with none; got {len(tails)} of {n}")
        if tails:
            blobs = stacked(tails, blobs_dtype, name)
    if np.any(log_prob == np.inf):
        raise ValueError(f"{name} returned +inf for {np.sum(log_prob == np.inf)} of {n} points: no density is infinite")
    return log_prob, blobs


def _is_row(value: Any) -> bool:
    """Whether a value is a sequence or an array with items; text and single numbers are not."""
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, Sequence) and not isinstance(value, str | bytes) and len(value) > 0


def _number(value: Any, name: str) -> float:
    """One log-density as a float; ValueError for text, None and anything else that is not one number."""
    if isinstance(value, str | bytes) or value is None:
        raise ValueError(f"{name} must return a number (a log-density); got {value!r}")
    try:
        return float(np.asarray(value).item())
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must return one number per point; got {type(value).__name__} of shape {np.shape(value)}. "
            "A function of a whole batch needs vectorize=True"
        ) from None


def _lost_in_pool(result: Any) -> bool:
    """Whether a pool returned (None, reason) for a point, because every process that evaluated it died."""
    return isinstance(result, tuple) and len(result) == 2 and result[0] is None and isinstance(result[1], str)
