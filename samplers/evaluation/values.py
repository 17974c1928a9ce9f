"""Arrays of log-densities and blobs from what a user's function returns, or an error that says what is wrong.

emcee's conventions hold: one number per point, or a sequence of the number and blobs. Unlike in emcee, a point fails by
NaN; blobs that are numbers are floats, all others Python objects, unless the user declares a type, and a value that it
cannot hold is refused: text and numbers are never cut, except floats of fewer declared digits.
"""

import copy
import logging
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..interrupts import interrupts, raise_if_interrupted, raise_if_it_ends_the_run

logger = logging.getLogger(__name__)

LARGEST_EXACT = 2**53  # integers above are rounded in a float, and stay Python's


def most_common_reasons(reasons: Iterable[str] | Mapping[str, int], number: int = 3) -> str:
    """The most frequent reasons of failures, given one by one or counted, as text."""
    return "; ".join(f"{count} x {reason}" for reason, count in Counter(reasons).most_common(number))


class Failed:
    """Takes the place of a result that failed; `reason` is text. `log_prob` is -inf if the function counts failures."""

    def __init__(self, error: BaseException | str, log_prob: float = np.nan):
        self.reason, self.log_prob = error if isinstance(error, str) else f"{type(error).__name__}: {error}", log_prob


class Caught:
    """A function that returns `Failed` instead of raising; it can be sent to a worker if the function can. Its method
    ``failure(point)``, or its object's, returns the reason of a failure in this process, and its log-density.
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
            failure = ("",) if self.vectorize or not hasattr(owner, "failure") else owner.failure(points)
            return Failed(*failure) if failure[0] else result
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
    """Log-densities (n,), NaN where one failed; blobs or None, and reasons of failures by row, from what a function has
    returned for n points. ValueError if these are no numbers, or blobs of `dtype`.
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
    reasons: dict[int, str] = {}
    blobs, log_prob = None, np.full(n, np.nan)
    if isinstance(results, np.ndarray) and results.ndim == 1 and results.dtype.kind in "fiu":
        log_prob[:] = results
    else:
        for row, each in enumerate(results):
            if isinstance(each, Failed):
                reasons[row], log_prob[row] = each.reason, each.log_prob
            elif isinstance(each, tuple) and len(each) == 2 and each[0] is None and isinstance(each[1], str):
                reasons[row] = each[1]  # every process of a pool that evaluated the point has died
            else:
                log_prob[row] = _number(each[0] if _is_row(each) else each, name)
        good = [row for row in range(n) if row not in reasons]
        tails = [results[row][1:] for row in good if _is_row(results[row]) and len(results[row]) > 1]
        if tails and len(tails) != len(good):
            raise ValueError(f"{name} must return blobs with every point or with none; got {len(tails)} of {len(good)}")
        if tails:
            found = _stacked(tails, blobs_dtype, name)
            blobs = np.zeros((n, *found.shape[1:]), dtype=found.dtype)
            blobs[good] = found
    if np.any(log_prob == np.inf):
        raise ValueError(f"{name} returned +inf for {np.sum(log_prob == np.inf)} of {n} points: no density is infinite")
    for row in np.flatnonzero(np.isnan(log_prob)).tolist():
        reasons.setdefault(row, f"{name} returned NaN")
    return log_prob, blobs, reasons


def log_densities(results: Any, n: int, name: str) -> np.ndarray:
    """Log-densities (n,) from a function that must return one number per point, without blobs; -inf for NaN."""
    values, blobs, _ = outcomes(results, n, None, name)
    if blobs is not None:
        first = results[0]
        raise ValueError(
            f"{name} must return one number per point; got {type(first).__name__} of shape {np.shape(first)} for a "
            "point. If these are the log-densities of the single parameters, return their sum, np.sum(..., axis=-1)"
        )
    return np.where(np.isnan(values), -np.inf, values)


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


def _stacked(blobs: list, dtype: Any, name: str) -> np.ndarray:
    """Blobs of several points, a sequence for each, as one array (n, ...), as emcee stores them.

    ValueError if a declared dtype cannot hold a value.
    """
    try:
        with np.errstate(all="ignore"):
            if dtype is None:
                found = np.array(blobs)
                found = found.astype(np.result_type(found.dtype, float)) if found.dtype.kind in "biufc" else None
                if found is None or (np.any(np.abs(found) >= LARGEST_EXACT) and not _holds(found.tolist(), blobs)):
                    found = np.array(blobs, object)
            else:
                found = np.array(blobs, dtype)
    except (TypeError, ValueError, OverflowError) as error:  # no type holds all values, or rows of several lengths
        if dtype is not None and np.dtype(dtype).kind != "O":
            raise ValueError(f"{name} must return blobs of the declared type, blobs_dtype={dtype}: {error}") from error
        found = np.empty(len(blobs), dtype=object)
        for place, row in enumerate(blobs):
            found[place] = row
    lost = [] if dtype is None else [i for i, kept in enumerate(found.tolist()) if not _holds(kept, blobs[i])]
    if lost:
        raise ValueError(
            f"{name} must return blobs of the declared type, blobs_dtype={dtype}; got {blobs[lost[0]]!r}, which this "
            "type cannot hold. Declare a wider one"
        )
    single = tuple(axis for axis in range(1, found.ndim) if found.shape[axis] == 1)
    return np.squeeze(found, single) if single else found


def _holds(kept: Any, given: Any) -> bool:
    """Whether an item of an array, as Python's value, is what was given; a float may have fewer digits."""
    kept, given = (each.tolist() if isinstance(each, np.ndarray | np.generic) else each for each in (kept, given))
    if isinstance(given, list | tuple):
        return all(map(_holds, kept if isinstance(kept, list | tuple) else [kept], given))
    if isinstance(given, float | complex) and isinstance(kept, float | complex):
        return bool(np.isfinite(kept) or not np.isfinite(given))
    given = given.encode() if isinstance(given, str) and isinstance(kept, bytes) else given
    return given is kept or kept == given or (kept != kept and given is None)
