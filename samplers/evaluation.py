"""What a user's function returned, as arrays: log-probabilities and blobs, or an error that says what is wrong.

emcee's conventions are kept: one number a point, or a sequence of the number and blobs; blobs of several points are
stacked, text and ragged blobs become objects. Differences: NaN is left to the caller to judge, and what is no number is
refused with an explanation.

`Records` keeps log_prob, log_prior and blobs of a point together in one structured array, so that a walker carries all
of them through moves and resampling.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

__all__ = ["Records", "log_probabilities"]


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


class Records:
    """Evaluated points as structured arrays with the fields log_prob, log_prior and, if there are any, blobs.

    Parameters
    ----------
    blobs_dtype : dtype of the blobs, as in emcee; guessed by default.

    Attributes
    ----------
    evaluations : int — points evaluated.
    nan_count : int — how many of them gave NaN, which is taken as -inf.
    """

    def __init__(self, blobs_dtype: Any = None):
        self.blobs_dtype = blobs_dtype
        self.evaluations = 0
        self.nan_count = 0
        self._fields: list[tuple] = [("log_prob", np.float64), ("log_prior", np.float64)]

    def evaluate(self, coords: np.ndarray, log_prior: np.ndarray, log_prob_fn: Callable) -> np.ndarray:
        """Records of points (n, ndim); `log_prob_fn` gets those of finite log-prior (n,) only, as a batch."""
        inside = log_prior > -np.inf
        log_prob = np.full(len(coords), -np.inf)
        blobs = None
        if inside.any():
            points = coords[inside]
            self.evaluations += len(points)
            log_prob[inside], found = log_probabilities(
                log_prob_fn(points), len(points), "log_prob_fn", self.blobs_dtype
            )
            if found is not None:
                blobs = np.zeros((len(coords), *found.shape[1:]), dtype=found.dtype)
                blobs[inside] = found
        self.nan_count += int(np.isnan(log_prob).sum())
        return self.pack(log_prob, log_prior, blobs)

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

    @staticmethod
    def unpack(records: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """log_prob and blobs (or None), as emcee wants them."""
        return records["log_prob"].copy(), records["blobs"].copy() if "blobs" in records.dtype.names else None
