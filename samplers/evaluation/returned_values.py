"""Arrays of log-probabilities and blobs from the values of a user's function, or an error that says what is wrong.

emcee's conventions hold: one number per point, or a sequence of the number and blobs; blobs of several points are
stacked; text and blobs of different lengths become objects. Unlike in emcee, NaN is left to the caller to judge, and
anything that is not a number is refused with an explanation.
"""

import copy
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..blobs import stacked
from ..interrupts import interrupts, raise_if_interrupted, raise_if_it_ends_the_run

__all__ = ["ErrorCapturing", "Failed", "log_densities", "log_probabilities", "outcomes"]

logger = logging.getLogger(__name__)


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
        shape = np.shape(value)
        raise ValueError(
            f"{name} must return one number per point; got {type(value).__name__} of shape {shape}. "
            "A function of a whole batch needs vectorize=True"
        ) from None


def log_probabilities(
    results: Any, n: int, name: str = "log_prob_fn", blobs_dtype: Any = None
) -> tuple[np.ndarray, np.ndarray | None]:
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


def log_densities(results: Any, n: int, name: str) -> np.ndarray:
    """Log-densities (n,) of `n` points from a function that must return one number per point, without blobs.

    Parameters and errors as in `log_probabilities`.
    """
    values, blobs = log_probabilities(results, n, name)
    if blobs is not None:
        row = next(row for row in results if _is_row(row) and len(row) > 1)
        raise ValueError(
            f"{name} must return one number per point; got {type(row).__name__} of shape {np.shape(row)} for a point. "
            "If these are the log-densities of the single parameters, return their sum, np.sum(..., axis=-1)"
        )
    return values


class Failed:
    """Takes the place of a result if a function raised an exception or reports a fault; `reason` is text."""

    def __init__(self, error: Exception | str):
        self.reason = error if isinstance(error, str) else f"{type(error).__name__}: {error}"


def _lost_in_pool(result: Any) -> bool:
    """Whether a pool returned (None, reason) for a point, because every process that evaluated it died."""
    return isinstance(result, tuple) and len(result) == 2 and result[0] is None and isinstance(result[1], str)


class ErrorCapturing:
    """A function that returns `Failed` instead of raising; it can be sent to a worker if the function can.

    A function of one point, or the object of a method, may have a method ``fault(point)``. It returns a reason if a
    fault of the infrastructure (a killed process, a full disk) prevented the evaluation of the point, else an empty
    string. Such a point also gives `Failed`, because the records of a function in a worker are not seen in this
    process.

    An exception whose attribute ``ends_run`` is true is raised: the function cannot be used for any point, such as a
    posterior whose model has changed. KeyboardInterrupt and SystemExit are raised, even as the cause of another
    exception; SystemExit in a worker process gives `Failed`.
    """

    def __init__(
        self,
        function: Callable,
        args: Sequence = (),
        kwargs: Mapping[str, Any] | None = None,
        vectorize: bool = False,
    ):
        self.function, self.args, self.kwargs, self.vectorize = function, args, kwargs or {}, vectorize

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
            if getattr(error, "ends_run", False):
                raise
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
        # a result that is not a sequence of one item stays as it is: `log_probabilities` refuses it with a message
        return [result[0] if _is_row(result) and len(result) == 1 else result for result in results]


def outcomes(
    results: Any, n: int, blobs_dtype: Any = None, name: str = "log_prob_fn"
) -> tuple[np.ndarray, np.ndarray | None, dict[int, str]]:
    """Log-probabilities and blobs as in `log_probabilities`, and the reasons of failures by row.

    A point fails by an exception or a fault (`ErrorCapturing`), by NaN, or if a pool lost every process that evaluated
    it. Its log-probability is NaN; its blobs are zero or empty.
    """
    reasons = {}
    if isinstance(results, list):
        results = [Failed(result[1]) if _lost_in_pool(result) else result for result in results]
        reasons = {row: result.reason for row, result in enumerate(results) if isinstance(result, Failed)}
    if not reasons:
        log_prob, blobs = log_probabilities(results, n, name, blobs_dtype)
    else:
        good = [row for row in range(len(results)) if row not in reasons]
        log_prob, blobs = np.full(n, np.nan), None
        if good:
            log_prob[good], found = log_probabilities([results[row] for row in good], len(good), name, blobs_dtype)
            if found is not None:
                blobs = np.zeros((n, *found.shape[1:]), dtype=found.dtype)
                blobs[good] = found
    for row in np.flatnonzero(np.isnan(log_prob)):
        reasons.setdefault(int(row), f"{name} returned NaN")
    return log_prob, blobs, reasons
