"""How the inputs of models are checked: what was expected, what came, what to do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real

import numpy as np

from ..signals.channels import Channel

__all__ = ["channel_rows", "number", "refuse", "theta_row", "theta_rows", "whole_number"]


def refuse(expected: str, got: object, advice: str) -> None:
    """ValueError in the words of all inputs of models."""
    raise ValueError(f"expected {expected}; got {got!r}; {advice}")


def number(name: str, value: object, *, zero: bool = False, any_sign: bool = False) -> None:
    """Refuse a `value` that is not a finite number, or not positive (`zero`: or zero; `any_sign`: either sign)."""
    kind = "finite" if any_sign else "zero or positive" if zero else "positive"
    is_number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if not is_number or not (any_sign or value > 0.0 or (zero and value == 0.0)):
        refuse(f"a {kind} {name}", value, "give one number in SI units (fe_likelihoods.units.to_si converts)")


def whole_number(name: str, value: object, low: int, high: int) -> None:
    """Refuse a `value` that is not a whole number from `low` to `high`."""
    if not isinstance(value, Integral) or isinstance(value, bool) or not low <= value <= high:
        refuse(f"{name} between {low} and {high}, a whole number", value, "see the documentation of the model")


def theta_row(theta: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Parameters of one run as floats (n_parameters,); ValueError for another shape."""
    theta = np.asarray(theta, dtype=float)
    if theta.shape != (len(names),):
        raise ValueError(f"expected one value for each of {tuple(names)}, shape ({len(names)},); got {theta.shape}")
    return theta


def theta_rows(thetas: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Parameters of a batch as floats (n, n_parameters); ValueError for another shape."""
    thetas = np.asarray(thetas, dtype=float)
    if thetas.ndim != 2 or thetas.shape[1] != len(names):
        raise ValueError(
            f"expected rows with one value for each of {tuple(names)}, shape (n, {len(names)}); got {thetas.shape}"
        )
    return thetas


def channel_rows(measured: np.ndarray, channels: Sequence[Channel], n_steps: int) -> np.ndarray:
    """Measured responses as floats (n_channels, n_steps); ValueError for another shape."""
    measured = np.asarray(measured, dtype=float)
    if measured.shape != (len(channels), n_steps):
        raise ValueError(
            f"expected measured responses of shape {(len(channels), n_steps)}, a row for each of "
            f"{[c.name for c in channels]}; got {measured.shape}; bring record and measurements to one step and length"
        )
    return measured
