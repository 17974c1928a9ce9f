"""Durations after which a record has reached given shares of its Arias intensity.

A search that continues with longer parts is more robust: the misfit of a long record has many local minima, because
response cycles that are out of phase by a whole period nearly fit.
"""

from collections.abc import Sequence

import numpy as np

__all__ = ["growing_durations"]

_APART = 1.3  # smallest ratio of successive durations


def growing_durations(acceleration: np.ndarray, dt: float, shares: Sequence[float]) -> tuple[float, ...]:
    """Durations [s] after which increasing shares of the Arias intensity have passed, and the full duration.

    Accelerations are (n_channels, n_steps) and not all zero; channels have equal weight. Durations that are not 1.3
    times shorter than the next one are left out.
    """
    rows = acceleration[np.abs(acceleration).max(axis=1) > 0.0]
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)  # so that squares do not overflow
    passed = np.cumsum(rows * rows, axis=1)
    passed = (passed / passed[:, -1:]).mean(axis=0)
    durations = [(rows.shape[1] - 1) * dt]
    for index in np.searchsorted(passed, shares)[::-1]:
        if index > 0 and index * dt * _APART <= durations[0]:
            durations.insert(0, float(index * dt))
    return tuple(durations)
