r"""Scales of parameters: themselves, their logarithms, or their reciprocals, as flexibilities are of stiffnesses."""

from typing import NamedTuple

import numpy as np

__all__ = ["Scales"]


class Scales(NamedTuple):
    """Scales of several parameters, all of which rise with them."""

    power: np.ndarray  # (dim,) 1 for the parameter, 0 for its logarithm, -1 for minus its reciprocal

    @property
    def is_log(self) -> np.ndarray:
        """Whether each scale is logarithmic (dim,)."""
        return self.power == 0

    def to_scale(self, values: np.ndarray) -> np.ndarray:
        """Values (..., dim) on the scales; NaN for the logarithm of a negative value."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.select([self.power == 1, self.power == 0], [values, np.log(values)], -1.0 / values)

    def from_scale(self, points: np.ndarray) -> np.ndarray:
        """Parameters (..., dim) from points on the scales; infinite where a reciprocal is not negative."""
        with np.errstate(over="ignore", divide="ignore"):
            reciprocals = np.where(points < 0.0, -1.0 / points, np.inf)
            return np.select([self.power == 1, self.power == 0], [points, np.exp(points)], reciprocals)

    def log_jacobian(self, points: np.ndarray) -> np.ndarray:
        """Logarithms (..., dim) of the derivatives of the parameters at points on the scales."""
        with np.errstate(divide="ignore"):
            logarithms = np.log(np.abs(points))
        return np.select([self.power == 1, self.power == 0], [np.zeros_like(points), points], -2.0 * logarithms)
