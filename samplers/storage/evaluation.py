"""What a user's function returned, as arrays: log-probabilities and blobs, or an error that says what is wrong.

emcee's conventions are kept: one number a point, or a sequence of the number and blobs; blobs of several points are
stacked, text and ragged blobs become objects. Differences: NaN is left to the caller to judge, and what is no number is
refused with an explanation.

`Records` keeps log_prob, log_prior and blobs of a point together in one structured array, so that a walker carries all
of them through moves and resampling.
"""

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .journal import Evaluated

__all__ = ["Failed", "Failures", "ErrorCapturing", "Memo", "Records", "log_probabilities", "outcomes"]

logger = logging.getLogger(__name__)

KEPT_FAILURES = 1000
KEPT_REASONS = 100


def _is_row(value: Any) -> bool:
    """Whether something has items: a sequence or an array, but neither text nor a single number."""
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, Sequence) and not isinstance(value, str | bytes) and len(value) > 0


def _number(value: Any, name: str) -> float:
    """One log-density as a float; text, None and anything that is not one number are refused."""
    if isinstance(value, str | bytes) or value is None:
        raise ValueError(f"{name} must return a number (a log-density); got {value!r}")
    try:
        return float(np.asarray(value).item())
    except (TypeError, ValueError):
        shape = np.shape(value)
        raise ValueError(
            f"{name} must return one number a point; got {type(value).__name__} of shape {shape}. "
            "A function of a whole batch needs vectorize=True"
        ) from None


def _stack(blobs: list, dtype: Any) -> np.ndarray:
    """Blobs of several points as one array (n, ...), as emcee stores them."""
    if dtype is None:
        try:
            dtype = np.atleast_1d(blobs[0]).dtype
        except ValueError:
            dtype = np.dtype(object)
        if dtype.kind in "US":  # a string type would cut longer text off
            dtype = np.dtype(object)
    try:
        stacked = np.array(blobs, dtype=dtype)
    except ValueError:
        # rows of different length: each becomes one object
        stacked = np.empty(len(blobs), dtype=object)
        stacked[:] = blobs
    single = tuple(axis for axis in range(1, stacked.ndim) if stacked.shape[axis] == 1)
    return np.squeeze(stacked, single) if single else stacked


def log_probabilities(
    results: Any, n: int, name: str = "log_prob_fn", blobs_dtype: Any = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Log-densities and blobs of `n` points.

    Parameters
    ----------
    results : what the function returned: (n,) numbers, or n sequences (number, blob, ...).
    n : number of points asked for.
    name : the function's name in messages.
    blobs_dtype : dtype of the blobs, as in emcee; guessed from the first by default.

    Returns
    -------
    log_prob : (n,) float — NaN kept as it came.
    blobs : (n, ...) array, or None without blobs.

    Raises
    ------
    ValueError
        If the number of results is not `n`, one of them is not a number, or one is +inf.
    """
    if hasattr(results, "__array__"):
        results = np.asarray(results)
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
            blobs = _stack(tails, blobs_dtype)
    if np.any(log_prob == np.inf):
        raise ValueError(f"{name} returned +inf for {np.sum(log_prob == np.inf)} of {n} points: no density is infinite")
    return log_prob, blobs


class Failed:
    """What stands in the place of a result where ``log_prob_fn`` raised an exception."""

    def __init__(self, reason: str):
        self.reason = reason


class ErrorCapturing:
    """A function of one point that returns `Failed` instead of raising; it can be sent to a worker if the function can.

    Parameters
    ----------
    function, args, kwargs : called as ``function(point, *args, **kwargs)``.
    """

    def __init__(self, function: Callable, args: Sequence = (), kwargs: Mapping[str, Any] | None = None):
        self.function, self.args, self.kwargs = function, args, kwargs or {}

    def __call__(self, point: Any) -> Any:
        try:
            return self.function(point, *self.args, **self.kwargs)
        except Exception as error:
            return Failed(_told(error))

    def of_batch(self, points: Any) -> Any:
        """Results of a whole batch; where it raises, each point is tried alone, so that one does not take all along."""
        try:
            return self.function(points, *self.args, **self.kwargs)
        except Exception as error:
            if len(points) == 1:
                return [Failed(_told(error))]
            logger.warning("log_prob_fn raised for a batch of %d points: trying each alone", len(points), exc_info=True)
        results = [self.of_batch(points[i : i + 1]) for i in range(len(points))]
        # an answer to one point that is not a sequence of one is of no use: it is refused as that of any batch
        return [result[0] if _is_row(result) and len(result) == 1 else result for result in results]


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def outcomes(results: Any, n: int, blobs_dtype: Any = None) -> tuple[np.ndarray, np.ndarray | None, dict[int, str]]:
    """Log-probabilities and blobs as in `log_probabilities`, and the reasons of failures by row.

    A point fails by an exception (see `ErrorCapturing`) or by NaN; its log-probability is NaN, its blobs are zero or empty.
    """
    reasons = {}
    if isinstance(results, list):
        reasons = {row: result.reason for row, result in enumerate(results) if isinstance(result, Failed)}
    if not reasons:
        log_prob, blobs = log_probabilities(results, n, "log_prob_fn", blobs_dtype)
    else:
        good = [row for row in range(len(results)) if row not in reasons]
        log_prob, blobs = np.full(n, np.nan), None
        if good:
            log_prob[good], found = log_probabilities(
                [results[row] for row in good], len(good), blobs_dtype=blobs_dtype
            )
            if found is not None:
                blobs = np.zeros((n, *found.shape[1:]), dtype=found.dtype)
                blobs[good] = found
    for row in np.flatnonzero(np.isnan(log_prob)):
        reasons.setdefault(int(row), "log_prob_fn returned NaN")
    return log_prob, blobs, reasons


class Failures:
    """Failed evaluations of a run: counted, the first thousand kept with their parameters.

    Attributes
    ----------
    count : int
    kept : list of dict — ``{"parameters": array (ndim,), "reason": str}`` of the first thousand.
    reasons : Counter — how often each reason occurred; beyond a hundred different ones they are counted together.
    """

    def __init__(self):
        self.count = 0
        self.kept: list[dict] = []
        self.reasons: Counter[str] = Counter()

    def add(self, coords: np.ndarray, reasons: Mapping[int, str]) -> None:
        """Enter the failures of a batch (n, ndim), by row."""
        for row, reason in reasons.items():
            self.count += 1
            if len(self.kept) < KEPT_FAILURES:
                self.kept.append({"parameters": coords[row].copy(), "reason": reason})
            known = reason in self.reasons or len(self.reasons) < KEPT_REASONS
            self.reasons[reason if known else "another reason"] += 1

    def told(self, most: int = 3) -> str:
        """The most frequent reasons, in words."""
        return "; ".join(f"{count} x {reason}" for reason, count in self.reasons.most_common(most))


class Memo:
    """Evaluations of an earlier run, found again by their points, bit for bit.

    Parameters
    ----------
    batches : list of Evaluated — what the journal holds.
    """

    def __init__(self, batches: Sequence[Evaluated]):
        self._batches = batches
        self._place = {
            row.tobytes(): (number, index)
            for number, batch in enumerate(batches)
            for index, row in enumerate(batch.coords)
        }

    def recall(self, coords: np.ndarray) -> Evaluated | None:
        """The evaluation of points (n, ndim), or None unless all are known."""
        found = [self._place.get(row.tobytes()) for row in np.ascontiguousarray(coords)]
        if None in found:
            return None
        log_prob = np.array([self._batches[number].log_prob[index] for number, index in found])
        reasons = {
            row: self._batches[number].reasons[index]
            for row, (number, index) in enumerate(found)
            if index in self._batches[number].reasons
        }
        blobs = None
        if self._batches[found[0][0]].blobs is not None:
            blobs = np.stack([self._batches[number].blobs[index] for number, index in found])
        return Evaluated(coords, log_prob, blobs, reasons)


class Records:
    """Evaluated points as structured arrays with the fields log_prob, log_prior and, if there are any, blobs."""

    def __init__(self):
        self._fields: list[tuple] = [("log_prob", np.float64), ("log_prior", np.float64)]

    def pack(self, log_prob: np.ndarray, log_prior: np.ndarray, blobs: np.ndarray | None = None) -> np.ndarray:
        """Records from their fields, each of length n; NaN in `log_prob` becomes -inf."""
        if blobs is not None and len(self._fields) == 2:
            self._fields.append(("blobs", blobs.dtype, blobs.shape[1:]))
        records = np.zeros(len(log_prob), dtype=self._fields)
        records["log_prob"] = np.where(np.isnan(log_prob), -np.inf, log_prob)
        records["log_prior"] = log_prior
        if blobs is not None:
            records["blobs"] = blobs
        return records

    def evaluated(self, log_prior: np.ndarray, inside: np.ndarray, batch: Evaluated | None) -> np.ndarray:
        """Records of n points of given log-prior (n,), of which those `inside` (n,) have been evaluated."""
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
        """log_prob and blobs (or None), as emcee wants them."""
        return records["log_prob"].copy(), records["blobs"].copy() if "blobs" in records.dtype.names else None
