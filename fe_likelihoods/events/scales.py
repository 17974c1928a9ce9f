r"""Scales on which parameters of a population have a normal distribution.

A parameter x has the value u on its scale, with the inverse and the derivative that the density of u needs:

========  =================================  ==================================  =======================================
scale     u                                  x                                   dx / du
========  =================================  ==================================  =======================================
linear    :math:`x`                          :math:`u`                           1
log       :math:`\ln x`                      :math:`e^u`                         :math:`e^u`
logit     :math:`\ln \frac{x - a}{b - x}`    :math:`a + \frac{b - a}{1+e^{-u}}`  :math:`\frac{(x - a)(b - x)}{b - a}`
========  =================================  ==================================  =======================================
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["SCALES", "Scales", "scales_of"]

SCALES = ("log", "linear", "logit")


class Scales(NamedTuple):
    """Scales of several parameters."""

    low: np.ndarray  # (dim,): a for the scale "logit", 0 for "log", -inf for "linear"
    high: np.ndarray  # (dim,): b for the scale "logit", inf for the others

    def first(self, n: int) -> "Scales":
        """Scales of the first n parameters."""
        return Scales(self.low[:n], self.high[:n])

    def to_scale(self, values: np.ndarray) -> np.ndarray:
        """Values (..., dim) on the scales; infinite at a bound, NaN beyond it."""
        is_bounded = np.isfinite(self.low)
        above = np.where(is_bounded, values - self.low, 1.0)
        below = np.where(np.isfinite(self.high), self.high - values, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(is_bounded, np.log(above) - np.log(below), values)

    def from_scale(self, points: np.ndarray) -> np.ndarray:
        """Parameters (..., dim) from points on the scales; with the scale "logit" they never reach their bounds."""
        is_logit = np.isfinite(self.high)
        with np.errstate(over="ignore", invalid="ignore"):
            found = np.where(np.isfinite(self.low), np.exp(np.where(np.isfinite(self.low), points, 0.0)), points)
            share = 1.0 / (1.0 + np.exp(-points))
            between = np.clip(
                self.low + (self.high - self.low) * share,
                np.nextafter(self.low, self.high),
                np.nextafter(self.high, self.low),
            )
        return np.where(is_logit, between, found)

    def log_jacobian(self, points: np.ndarray) -> np.ndarray:
        """Logarithms (..., dim) of the derivatives dx / du at points on the scales."""
        is_logit = np.isfinite(self.high)
        width = np.where(is_logit, self.high - np.where(is_logit, self.low, 0.0), 1.0)
        size = np.abs(points)
        logit = np.log(width) - size - 2.0 * np.log1p(np.exp(-size))
        return np.where(is_logit, logit, np.where(np.isfinite(self.low), points, 0.0))


def scales_of(kinds: Sequence[str], bounds: Sequence[tuple[float, float] | None] | None = None) -> Scales:
    """Scales from their names; "logit" needs finite bounds (a, b), which are not used for the others."""
    pairs = [None] * len(kinds) if bounds is None else bounds
    ends = {"log": (0.0, np.inf), "linear": (-np.inf, np.inf)}
    found = [pair if kind == "logit" else ends[kind] for kind, pair in zip(kinds, pairs, strict=True)]
    return Scales(*np.array(found, dtype=float).reshape(len(found), 2).T)
