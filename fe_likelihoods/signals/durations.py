"""Durations after which a record has reached given shares of its Arias intensity.

A search for parameters is more robust if it starts with a short first part of the record and continues with longer
parts: the misfit of a long record has many local minima, because response cycles that are out of phase by a whole
period nearly fit. The first part must contain enough strong motion to identify the parameters.
"""

from collections.abc import Sequence

import numpy as np

from .sampling import check_step

__all__ = ["growing_durations"]

_APART = 1.3  # smallest ratio of successive durations


def growing_durations(
    acceleration: np.ndarray,
    dt: float,
    shares: Sequence[float] = (0.35, 0.75, 0.95, 0.999),
) -> tuple[float, ...]:
    """Durations after which given shares of the Arias intensity have passed, and the full duration.

    Parameters
    ----------
    acceleration : (n_steps,) or (n_channels, n_steps) float
        Accelerations of a record, or measured responses if there is no record. Several channels have equal weight.
    dt : float
        Time step [s].
    shares : sequence of float
        Increasing shares of the integrated squared acceleration, between 0 and 1. Durations that
        are not 1.3 times shorter than the next one are left out.

    Returns
    -------
    tuple of float
        Increasing durations [s], each the time of a sample. The last one is the full duration.

    Raises
    ------
    ValueError
        If the samples are not finite or all zero, there are fewer than two, or an argument is out of range.

    References
    ----------
    A. Arias, A measure of earthquake intensity, in: Seismic Design for Nuclear Power Plants (ed. R. J. Hansen), MIT
    Press, 1970, pages 438-483.

    Examples
    --------
    >>> durations = growing_durations(record.acceleration, record.dt)
    >>> shorter = likelihood.first(durations[0])
    >>> likelihood.n_samples, shorter.n_samples
    (200, 16)
    """
    dt = check_step(dt, "the record")
    rows = np.atleast_2d(np.asarray(acceleration, dtype=float))
    if rows.ndim != 2 or rows.shape[1] < 2 or not np.isfinite(rows).all() or not rows.any():
        raise ValueError(
            "growing_durations: expected finite accelerations (n_steps,) or (n_channels, n_steps), two or more samples "
            f"that are not all zero; got an array of shape {np.shape(acceleration)}"
        )
    shares = np.asarray(shares, dtype=float)
    if shares.ndim != 1 or not ((shares > 0.0) & (shares < 1.0)).all() or not (np.diff(shares) > 0.0).all():
        raise ValueError(f"growing_durations: shares must increase between 0 and 1; got {shares}")
    rows = rows[np.abs(rows).max(axis=1) > 0.0]
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)  # so that squares do not overflow
    passed = np.cumsum(rows * rows, axis=1)
    passed = (passed / passed[:, -1:]).mean(axis=0)
    durations = [(rows.shape[1] - 1) * dt]
    for index in np.searchsorted(passed, shares)[::-1]:
        if index > 0 and index * dt * _APART <= durations[0]:
            durations.insert(0, float(index * dt))
    return tuple(durations)
