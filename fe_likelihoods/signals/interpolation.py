"""Values of uniformly sampled histories at other times, by polynomials through the nearest samples.

Between two samples a history follows the fifth-degree polynomial through the three samples before and the three samples
after (Lagrange's form). At a sample it has exactly the value of the sample. For a sine with n samples per period, the
largest error is ``0.31 (pi / n)^6`` of its amplitude: 5e-6 for n = 20, 3e-4 for n = 10. Nothing is filtered.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["POINTS", "Interpolation", "interpolate", "make_interpolation"]

POINTS = 6
"""Number of samples that determine a value between two samples."""

_SAME_TIME = 1e-6  # in steps: times nearer to a sample than this are equal to the time of the sample


class Interpolation(NamedTuple):
    """Samples and weights that give a history at other times."""

    first: NDArray[np.intp]  # (n_times,) first sample of each polynomial
    weights: NDArray[np.float64] | None  # (n_points, n_times) of this and the next samples; None: all are sample times


def make_interpolation(dt: float, n_steps: int, times: NDArray[np.float64]) -> Interpolation:
    """Return samples and weights for times (n_times,) [s] within a history that begins at time zero."""
    position = np.asarray(times, dtype=float) / dt
    nearest = np.clip(np.rint(position), 0, n_steps - 1)
    same = np.abs(position - nearest) <= _SAME_TIME
    if same.all():
        return Interpolation(nearest.astype(np.intp), None)
    position = np.where(same, nearest, position)
    points = min(POINTS, n_steps)
    first = np.clip(np.floor(position).astype(np.intp) - (points // 2 - 1), 0, n_steps - points)
    local = position - first
    weights = np.ones((points, len(position)))
    for k in range(points):
        for j in range(points):
            if j != k:
                weights[k] *= (local - j) / (k - j)
    return Interpolation(first, weights)


def interpolate(history: NDArray[np.float64], at: Interpolation) -> NDArray[np.float64]:
    """Return the values (..., n_times) of histories (..., n_steps)."""
    if at.weights is None:
        return history[..., at.first]
    values = at.weights[0] * history[..., at.first]
    for k in range(1, len(at.weights)):
        values += at.weights[k] * history[..., at.first + k]
    return values
