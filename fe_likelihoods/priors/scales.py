r"""Scales on which parameters of a population have a normal distribution: their logarithms, or themselves."""

from typing import NamedTuple

import numpy as np

__all__ = ["Scales"]


class Scales(NamedTuple):
    """Scales of several parameters."""

    is_log: np.ndarray  # (dim,) bool

    def to_scale(self, values: np.ndarray) -> np.ndarray:
        """Values (..., dim) on the scales; NaN for the logarithm of a negative value."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.is_log, np.log(np.where(self.is_log, values, 1.0)), values)

    def from_scale(self, points: np.ndarray) -> np.ndarray:
        """Parameters (..., dim) from points on the scales."""
        with np.errstate(over="ignore"):
            return np.where(self.is_log, np.exp(np.where(self.is_log, points, 0.0)), points)

    def log_jacobian(self, points: np.ndarray) -> np.ndarray:
        """Logarithms (..., dim) of the derivatives of the parameters at points on the scales."""
        return np.where(self.is_log, points, 0.0)
