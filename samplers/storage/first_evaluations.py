"""Checks of the first values that a user's function returns, for mistakes that give a wrong result without an error.

Two mistakes are looked for. A function may return an array where it should return a sum, which emcee reads as a number
and blobs. And a log-likelihood may be passed as log-posterior, or the reverse. An error is raised only where the values
prove the mistake. Two more points are evaluated for the first check, where the values are suspicious. The second check
needs two values of the method ``log_likelihood`` of an object that has one. It is left out for an object that also has
a method ``log_prob``, which is passed as `log_prob_fn`: such an object names all three densities.
"""

import logging
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from .journal import EvaluatedBatch
from .user_functions import UserFunctions

__all__ = ["Evaluates", "FirstEvaluations"]

logger = logging.getLogger(__name__)

POINTS = 2
ROUNDING = 1e-9
# Terms of single parameters show in the values of a batch: they follow their own parameter, so that their ranks, sorted
# by it, differ less from one to the next (the ratio of von Neumann 1941, 2 for independent values), or are nearly equal
# where they share a larger number.
FEWEST_POINTS = 8
LARGEST_RATIO = 1.0
LEAST_CORRELATION = 0.9


class Evaluates(Protocol):
    """An object that evaluates functions of points, `samplers.storage.evaluation.Evaluator`."""

    def compute(self, coords: np.ndarray) -> EvaluatedBatch:
        """The log-posterior and its blobs at points (n, ndim)."""

    def call(self, function: Callable, coords: np.ndarray) -> np.ndarray:
        """Values (n,) of another function at points (n, ndim)."""

    def log_prior(self, coords: np.ndarray) -> np.ndarray:
        """The log-prior (n,) at points (n, ndim)."""


class FirstEvaluations:
    """Checks the first batch of evaluated points.

    Parameters
    ----------
    functions : UserFunctions
        What the user gave.
    with_arguments : bool
        Whether the function takes further arguments, so that other methods cannot be called like it.
    any_blobs : bool
        Whether the user has declared blobs, so that arrays are not suspicious.
    """

    def __init__(self, functions: UserFunctions, with_arguments: bool, any_blobs: bool):
        self._functions, self._with_arguments, self._any_blobs = functions, with_arguments, any_blobs

    def __call__(self, evaluator: Evaluates, batch: EvaluatedBatch) -> None:
        """Raise ValueError where the values prove a mistake."""
        rows = np.flatnonzero(np.isfinite(batch.log_prob))
        if not self._any_blobs and (values := self._as_returned(evaluator, batch)) is not None:
            self._check_sum(evaluator, batch.coords, values, rows)
        if len(rows) >= POINTS and not self._with_arguments:
            self._check_prior_is_in(evaluator, batch.coords[rows[:POINTS]], batch.log_prob[rows[:POINTS]])

    # ------------------------------------------------------------------ arrays in place of sums

    def _as_returned(self, evaluator: Evaluates, batch: EvaluatedBatch) -> np.ndarray | None:
        """The rows (n, k) of numbers that the function returned, k > 1; None for anything else."""
        if batch.blobs is None or batch.blobs.dtype.kind not in "fiu":
            return None
        log_prob = batch.log_prob
        if self._functions.is_likelihood:
            log_prob = log_prob - evaluator.log_prior(batch.coords)
        return np.column_stack([log_prob, batch.blobs.reshape(len(log_prob), -1)])

    def _check_sum(self, evaluator: Evaluates, coords: np.ndarray, values: np.ndarray, rows: np.ndarray) -> None:
        name, (n, width) = self._functions.name, values.shape
        if width == n > 2 and len(rows) == n and _is_outer_sum(values):
            raise ValueError(
                f"{name} must return {n} numbers for {n} points; got an array of shape ({n}, {n}), the sum of each "
                f"value of one array and each value of another: add arrays of the shape ({n},), not ({n}, 1)"
            )
        if width != coords.shape[1] or len(rows) < FEWEST_POINTS or not _look_like_terms(values[rows], coords[rows]):
            return
        here, other = coords[rows[0]], coords[rows[1]]
        changed = np.stack([here, here])
        for row in (0, 1):
            changed[row, row] = other[row]
        if np.any(np.isneginf(evaluator.log_prior(changed))):
            return
        swapped = self._as_returned(evaluator, evaluator.compute(changed))
        if swapped is None or not np.all(np.isfinite(swapped)) or not np.all(np.isfinite(values[rows[0]])):
            return
        if all(_only_own_term(values[rows[0]], swapped[row], row) for row in (0, 1)):
            raise ValueError(
                f"{name} must return one number per point, and blobs after it; got an array of shape ({width},) whose "
                "values belong to the single parameters: each changes with its own parameter only. Return their sum, "
                "np.sum(..., axis=-1). If they are blobs, pass blobs_dtype"
            )

    # ------------------------------------------------------------------ posterior or likelihood

    def _check_prior_is_in(self, evaluator: Evaluates, coords: np.ndarray, log_prob: np.ndarray) -> None:
        functions = self._functions
        for owner in (functions.function, _owner(functions.function), _owner(functions.log_prior)):
            log_likelihood = getattr(owner, "log_likelihood", None)
            if callable(log_likelihood) and callable(getattr(owner, "log_prior", None)):
                break
        else:
            return
        names_all = callable(getattr(owner, "log_prob", None)) and functions.function in (owner, owner.log_prob)
        if names_all and not functions.is_likelihood:
            return
        log_prior = evaluator.log_prior(coords)
        returned = log_prob - log_prior if functions.is_likelihood else log_prob
        try:
            expected = returned if log_likelihood == functions.function else evaluator.call(log_likelihood, coords)
        except Exception as error:
            logger.debug("log_likelihood of %r is not compared with %s: %r", owner, functions.name, error)
            return
        if not np.all(np.isfinite(expected)) or np.any(_equal(log_prior, 0.0, expected)):
            return
        if functions.is_likelihood:
            if np.all(_equal(returned, log_prior + expected, expected)):
                raise ValueError(
                    "log_likelihood_fn returns its log_prior plus its log_likelihood: the log-prior would be counted "
                    "twice. Pass the object as log_prob_fn, or its method log_likelihood as log_likelihood_fn"
                )
            return
        if np.all(_equal(returned, expected, expected)):
            raise ValueError(
                "log_prob_fn returns the log-likelihood without the log-prior, so that the evidence would be wrong: "
                "pass None as log_prob_fn, and the function as log_likelihood_fn=; or add the log-prior to what it "
                "returns"
            )
        if owner is functions.function and functions.own_prior:
            if np.any(_equal(returned, log_prior + expected, expected)):
                return
            repeated = evaluator.compute(coords).log_prob, evaluator.call(log_likelihood, coords)
            if np.array_equal(repeated, (log_prob, expected)):  # not where the values contain random numbers
                raise ValueError(
                    "log_prob_fn must return log_prior + log_likelihood, and has methods of these names; got "
                    f"{returned[0]:.10g} at {coords[0]}, where log_prior is {log_prior[0]:.10g} and log_likelihood is "
                    f"{expected[0]:.10g}. Correct the method that is wrong"
                )


def _owner(function: Callable) -> Any:
    """The object that a bound method belongs to; None for another function."""
    return getattr(function, "__self__", None)


def _equal(first: np.ndarray, second: np.ndarray | float, scale: np.ndarray) -> np.ndarray:
    """Whether values are equal up to rounding errors of numbers of a scale."""
    return np.abs(first - second) <= ROUNDING * (1.0 + np.abs(scale))


def _is_outer_sum(values: np.ndarray) -> bool:
    """Whether values (n, n) are ``a[:, None] + b`` of two arrays, neither of them constant."""
    if not np.all(np.isfinite(values)):
        return False
    in_rows, in_columns = values[:, :1] - values[0, 0], values[:1] - values[0, 0]
    scale = np.max(np.abs(values))
    if np.all(_equal(in_rows, 0.0, scale)) or np.all(_equal(in_columns, 0.0, scale)):
        return False
    return bool(np.all(_equal(values, values[0, 0] + in_rows + in_columns, scale)))


def _look_like_terms(values: np.ndarray, coords: np.ndarray) -> bool:
    """Whether values (n, ndim) may be terms of the single parameters (n, ndim): see `LARGEST_RATIO`."""
    if not np.all(np.isfinite(values)) or np.any(np.ptp(values, axis=0) == 0.0):
        return False
    if np.min(np.corrcoef(values, rowvar=False)[0]) > LEAST_CORRELATION:
        return True
    ranks = np.argsort(np.argsort(values, axis=0), axis=0)
    followed = np.take_along_axis(ranks, np.argsort(coords, axis=0), axis=0)
    ratio = np.mean(np.diff(followed, axis=0) ** 2, axis=0) / np.var(ranks, axis=0)
    return bool(np.max(ratio) < LARGEST_RATIO)


def _only_own_term(before: np.ndarray, after: np.ndarray, changed: int) -> bool:
    """Whether a change of one parameter changes one of ndim values; the others may change by a common number."""
    difference = after - before
    others, scale = np.delete(difference, changed), np.max(np.abs(before))
    same = bool(np.all(_equal(others, others[0], scale)))
    common = 0.0 if len(others) == 1 else others[0]
    return same and bool(_equal(others[0], common, scale)) and not _equal(difference[changed], common, scale)
