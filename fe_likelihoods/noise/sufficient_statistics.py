"""Statistics of simulation residuals: the few numbers that a likelihood needs instead of the response."""

from collections.abc import Callable

import numpy as np

from ..signals.comparison import Comparison

__all__ = ["Statistic", "apply_statistic", "needs_response", "reduce_response", "statistic_width", "sums_of_squares"]

Statistic = Callable[..., np.ndarray]
"""Function of residuals (n_channels, n_samples) that returns (n_numbers,), the sums of squares (n_channels,) first.

Residuals of missing samples are NaN; the same samples are missing for all residuals of a likelihood. A function with a
true attribute ``of_response`` also takes the response at the samples (n_channels, n_samples), NaN where one is missing,
as second argument. It must be defined at the top level of a module, so that it can be sent to workers.
"""


def needs_response(statistic: Statistic | None) -> bool:
    """Whether a statistic takes the response as well as the residuals."""
    return bool(getattr(statistic, "of_response", False))


def apply_statistic(statistic: Statistic, residuals: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Numbers (n_numbers,) from a statistic; residuals and response (n_channels, n_samples) are NaN where missing."""
    return statistic(residuals, response) if needs_response(statistic) else statistic(residuals)


def statistic_width(measured: np.ndarray | Comparison, statistic: Statistic | None = None) -> int:
    """How many numbers a statistic returns; by default for the sums of squares."""
    values = measured.values if isinstance(measured, Comparison) else measured
    return len(apply_statistic(sums_of_squares if statistic is None else statistic, values, values))


def sums_of_squares(residuals: np.ndarray) -> np.ndarray:
    """Sums of squares (n_channels,) of residuals (n_channels, n_samples)."""
    return np.square(residuals).sum(axis=-1)


def reduce_response(response: np.ndarray, measured: np.ndarray | Comparison, reduce: Statistic) -> np.ndarray:
    """Statistic `reduce` (n_numbers,) for a response (n_channels, n_steps) [SI]; NaN for a failed simulation."""
    with np.errstate(over="ignore", invalid="ignore"):
        if isinstance(measured, Comparison):
            if not np.isfinite(response).all():  # also where no sample is affected
                return np.full(statistic_width(measured, reduce), np.nan)
            if reduce is sums_of_squares:
                return reduce(measured.known_residuals(response))
            residuals = measured.residuals(response)
            if not needs_response(reduce):
                return reduce(residuals)
            return reduce(residuals, np.where(measured.missing, np.nan, measured.at_samples(response)))
        # contiguous rows, because the order of summation, and so the last bit, must not depend on the array's layout
        residuals = np.ascontiguousarray(response - measured)
        if reduce is not sums_of_squares and np.isnan(residuals).any():
            # a failed simulation: for a statistic, NaN marks a missing sample
            return np.full(statistic_width(measured, reduce), np.nan)
        return apply_statistic(reduce, residuals, np.ascontiguousarray(response))
