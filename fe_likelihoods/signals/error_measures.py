"""Measures of the difference between a predicted and a measured history."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .sampling import expect

__all__ = ["relative_errors", "rrmse"]


def rrmse(
    predicted: ArrayLike, measured: ArrayLike, names: Sequence[str] | None = None
) -> NDArray[np.float64] | np.float64:
    r"""Relative root mean square error of predicted histories.

    .. math:: \mathrm{RRMSE} = \sqrt{\frac{\sum_k (\hat y_k - y_k)^2}{\sum_k y_k^2}}

    Parameters
    ----------
    predicted : (..., n_steps) array_like
        Predicted values :math:`\hat y`.
    measured : (..., n_steps) array_like
        Measured values :math:`y` in the same unit, of the same shape. Samples that are NaN are left out of the sums.
    names : sequence of str, optional
        Names of the histories, for the message of an error.

    Returns
    -------
    ndarray, shape (...,)
        The error of each history [-]: 0 for a perfect prediction, 1 for a prediction of zero.

    Raises
    ------
    ValueError
        If the shapes differ, or a measured history has no sample or only zeros.

    Examples
    --------
    >>> round(float(rrmse([1.1, 2.2], [1.0, 2.0])), 3)
    0.1
    """
    predicted, measured = np.asarray(predicted, dtype=float), np.asarray(measured, dtype=float)
    got = f"{predicted.shape} and {measured.shape}"
    expect(predicted.shape == measured.shape and measured.ndim, "rrmse", "histories of one shape, (..., n_steps)", got)
    zero = np.flatnonzero(np.nansum(np.square(measured), axis=-1) == 0.0)
    rows = ", ".join(f"row {row}" if names is None else repr(names[row]) for row in zero)
    expect(not rows, "rrmse", "measured histories that are not zero", f"{rows} is zero at all samples", "leave it out")
    unknown = (np.isnan(predicted) & ~np.isnan(measured)).any(axis=-1)
    return np.where(unknown, np.nan, relative_errors(predicted - measured, measured))[()]


def relative_errors(residuals: np.ndarray, measured: np.ndarray) -> NDArray[np.float64]:
    """RRMSE (...,) of residuals (..., n_steps); NaN is left out, and a measured history of zeros has the error NaN."""
    there = np.isfinite(residuals) & np.isfinite(measured)
    squares, power = (np.square(np.where(there, each, 0.0)).sum(axis=-1) for each in (residuals, measured))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.where(power > 0.0, squares / power, np.nan))
