"""Checks of the first values of a user's function for mistakes that give a wrong result without an error.

A function may return an array in place of a sum, which emcee reads as a number and blobs; or a log-likelihood may be
passed as log-posterior, or the reverse. An error is raised only if the values prove the mistake. Suspicious arrays with
one number per parameter cost two more evaluations. The second check costs two calls of the method ``log_likelihood``,
if the object has it.
"""

import sys
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from ..interrupts import raise_if_it_ends_the_run
from ..record import EvaluatedBatch
from .user_functions import UserFunctions

__all__ = ["FirstEvaluations"]

POINTS = 2  # with finite values, which the checks need
POINTS_OF_TERMS = 8  # the same for the check of arrays with one number per parameter
ROUNDING = 1e-9


class FirstEvaluations(NamedTuple):
    """Checks the first batch of evaluated points.

    Attributes
    ----------
    functions : UserFunctions
        The functions of the user.
    with_arguments : bool
        Whether the function takes further arguments, so that other methods cannot be called like it.
    any_blobs : bool
        Whether the user has declared blobs, so that arrays are not suspicious.
    """

    functions: UserFunctions
    with_arguments: bool
    any_blobs: bool

    def __call__(self, evaluator: Any, batch: EvaluatedBatch) -> None:
        """Raise ValueError if the values of an `Evaluator` prove a mistake."""
        rows = np.flatnonzero(np.isfinite(batch.log_prob))
        if len(rows) < POINTS:
            return
        if not self.any_blobs and (values := self._as_returned(evaluator, batch)) is not None:
            self._check_sum(evaluator, batch.coords[rows], values[rows])
        if not self.with_arguments:
            self._check_prior(evaluator, batch.coords[rows[:POINTS]], batch.log_prob[rows[:POINTS]])

    def _as_returned(self, evaluator: Any, batch: EvaluatedBatch) -> np.ndarray | None:
        """The rows (n, k) of numbers that the function returned, k > 1; None for anything else."""
        if batch.blobs is None or batch.blobs.dtype.kind not in "fiu":
            return None
        added = evaluator.log_prior(batch.coords) if self.functions.is_likelihood else 0.0
        return np.column_stack([batch.log_prob - added, batch.blobs.reshape(len(batch.coords), -1)])

    def _check_sum(self, evaluator: Any, coords: np.ndarray, values: np.ndarray) -> None:
        name, (n, width), ndim = self.functions.name, values.shape, coords.shape[1]
        if not np.all(np.isfinite(values)):
            return
        if width == n > 2 and _is_outer_sum(values):
            raise ValueError(
                f"{name} must return {n} numbers for {n} points; got an array of shape ({n}, {n}), the sum of each "
                f"value of one array and each value of another: add arrays of the shape ({n},), not ({n}, 1)"
            )
        if width != ndim or n < POINTS_OF_TERMS or not _may_be_terms(values, coords):
            return
        changed = coords[[0, 0]]
        changed[[0, 1], [0, 1]] = coords[1, :2]
        if np.any(np.isneginf(evaluator.log_prior(changed))):
            return
        after = self._as_returned(evaluator, evaluator.compute(changed))
        known = after is not None and np.all(np.isfinite(after))
        if known and all(_only_own_term(values[0], after[j], j) for j in (0, 1)):
            raise ValueError(
                f"{name} must return one number per point, and blobs after it; got an array of shape ({ndim},) whose "
                "values belong to the single parameters: each changes with its own parameter only. Return their sum, "
                "np.sum(..., axis=-1). If they are blobs, pass blobs_dtype"
            )

    def _check_prior(self, evaluator: Any, coords: np.ndarray, log_prob: np.ndarray) -> None:
        function, is_likelihood = self.functions.function, self.functions.is_likelihood
        owners = (function, *(getattr(f, "__self__", None) for f in (function, self.functions.log_prior)))
        parts = ("log_prior", "log_likelihood")
        owner = next((o for o in owners if all(callable(getattr(o, part, None)) for part in parts)), None)
        if owner is None:
            return
        if not is_likelihood and callable(getattr(owner, "log_prob", None)) and function in (owner, owner.log_prob):
            return  # the object names all three densities
        log_prior = evaluator.log_prior(coords)
        returned = log_prob - log_prior if is_likelihood else log_prob
        before = sys.exception()
        try:
            same = owner.log_likelihood == function
            log_likelihood = returned if same else evaluator.call(owner.log_likelihood, coords)
        except Exception as error:  # a method with other arguments
            raise_if_it_ends_the_run(error, before)
            return
        if not np.all(np.isfinite(log_likelihood)) or np.any(_equal(log_prior, 0.0, log_likelihood)):
            return
        if is_likelihood and np.all(_equal(returned, log_prior + log_likelihood, log_likelihood)):
            raise ValueError(
                "log_likelihood_fn returns its log_prior plus its log_likelihood: the log-prior would be counted "
                "twice. Pass the object as log_prob_fn, or its method log_likelihood as log_likelihood_fn"
            )
        if not is_likelihood and np.all(_equal(returned, log_likelihood, log_likelihood)):
            raise ValueError(
                "log_prob_fn returns the log-likelihood without the log-prior, so that the evidence would be wrong: "
                "pass None as log_prob_fn, and the function as log_likelihood_fn=; or add the log-prior to what it "
                "returns"
            )


def _equal(first: np.ndarray, second: np.ndarray | float, scale: np.ndarray | float) -> np.ndarray:
    """Whether values are equal up to rounding errors at a given scale."""
    return np.abs(first - second) <= ROUNDING * (1.0 + np.abs(scale))


def _is_outer_sum(values: np.ndarray) -> bool:
    """Whether values (n, n) are ``a[:, None] + b`` for two arrays, neither of them constant."""
    column, row, scale = values[:, :1], values[:1], np.max(np.abs(values))
    constant = any(np.all(_equal(part, values[0, 0], scale)) for part in (column, row))
    return not constant and bool(np.all(_equal(values, column + row - values[0, 0], scale)))


def _may_be_terms(values: np.ndarray, coords: np.ndarray) -> bool:
    """Whether values (n, ndim) follow their own parameters (n, ndim), or nearly equal a shared number.

    Ranks of a value, in the order of its parameter, then differ little from one to the next (von Neumann's ratio, 2 for
    independent values).
    """
    if np.any(np.ptp(values, axis=0) == 0.0):
        return False
    ranks = np.take_along_axis(stats.rankdata(values, axis=0), np.argsort(coords, axis=0), axis=0)
    ratio = np.mean(np.diff(ranks, axis=0) ** 2, axis=0) / np.var(ranks, axis=0)
    return bool(np.max(ratio) < 1.0 or np.min(np.corrcoef(values.T)[0]) > 0.9)


def _only_own_term(before: np.ndarray, after: np.ndarray, changed: int) -> bool:
    """Whether a change of one parameter changes one of ndim values; the others may change by a common number."""
    difference, scale = after - before, np.max(np.abs(before))
    others = np.delete(difference, changed)
    common = others[0] if len(others) > 1 else 0.0
    return bool(np.all(_equal(others, common, scale)) and not _equal(difference[changed], common, scale))
