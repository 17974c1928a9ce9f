"""How much two simulations with the same parameters may differ."""

from typing import Any, NamedTuple

import numpy as np

from ..signals.comparison import Comparison, measured_values
from ..simulation.model import Model
from ..simulation.residual_statistics import Statistic, needs_response
from ..simulation.user_code import is_of_user

__all__ = ["DEFAULT_TOLERANCE", "VerifyingRun", "agree", "difference_of", "largest_difference", "response_tolerance"]

DEFAULT_TOLERANCE = 1e-9


class VerifyingRun(NamedTuple):
    """What a simulation for verification needs.

    Attributes
    ----------
    model : Model
    pool : executor or None
        Where the simulations of the likelihood run.
    measured : (n_channels, n_steps) float, or Comparison
        Measured response [SI].
    statistic : Statistic or None
        Statistic of the residuals that is stored; None for the sums of squares.
    n_numbers : int
        Length of the statistic.
    tolerance : float or None
        As for `SimulationCache`.
    """

    model: Model
    pool: Any
    measured: np.ndarray | Comparison
    statistic: Statistic | None
    n_numbers: int
    tolerance: float | None = None


def response_tolerance(model: Model) -> float:
    """Relative difference of responses with the same parameters that a model may have.

    It is the attribute ``response_tolerance`` of the model: zero for the compiled models of this library, whose
    responses are the same to the last bit on the same processor. For models without the attribute, and for subclasses
    of the user that do not define it, it is 1e-9, because sums of several threads may differ in their last digits.
    """
    cls = type(model)
    if is_of_user(cls.__module__):
        defined = [base for base in cls.__mro__ if "response_tolerance" in vars(base)]
        if (
            defined
            and not is_of_user(defined[0].__module__)
            and "response_tolerance" not in getattr(model, "__dict__", {})
        ):
            return DEFAULT_TOLERANCE
    return float(getattr(model, "response_tolerance", DEFAULT_TOLERANCE))


def difference_of(stored: np.ndarray, new: np.ndarray, run: VerifyingRun, tolerance: float) -> tuple[int, float] | None:
    """Channel and size of the largest difference of two rows beyond a tolerance; None if they agree."""
    return largest_difference(stored, new, run.measured, tolerance, needs_response(run.statistic))


def agree(stored: np.ndarray, new: np.ndarray, run: VerifyingRun, tolerance: float) -> bool:
    """Whether the statistics of two simulations with the same parameters agree."""
    return difference_of(stored, new, run, tolerance) is None


def largest_difference(
    stored: np.ndarray,
    new: np.ndarray,
    measured: np.ndarray | Comparison,
    tolerance: float,
    of_response: bool = False,
) -> tuple[int, float] | None:
    """The statistic that differs most between two simulations with the same parameters, if one differs too much.

    Parameters
    ----------
    stored, new : (n_numbers,) float
        Statistics of the residuals, the sums of squares (n_channels,) first; further numbers have the order and the
        scale of the sums.
    measured : (n_channels, n_steps) float, or Comparison
        Measured response [SI].
    tolerance : float
        Accepted change of the response in a channel, relative to the norm of the response.
    of_response : bool
        Whether sums of squares of the response are among the further numbers.

    Returns
    -------
    int, float
        Index of the number, and the change of the response that explains its difference, relative as for `tolerance`;
        None if all numbers agree.

    Notes
    -----
    The norm of a response is at most r, the sum of the norms of its residual and of the measured response. If the
    response changes by t r, the sum of squares s^2 changes by at most 2 s t r + (t r)^2, and so does a sum of products
    of two residuals of the channel. A sum of squares of the response changes by at most 2 r t r + (t r)^2.
    """
    if np.array_equal(stored, new):
        return None
    measured = measured_values(measured)
    channels = np.arange(len(stored)) % len(measured)
    sums = np.sort([stored[: len(measured)], new[: len(measured)]], axis=0)
    s = np.sqrt(sums[0])[channels]
    r = (np.sqrt(sums[1]) + np.linalg.norm(measured, axis=1))[channels]
    if of_response:
        s[len(measured) :] = r[len(measured) :]
    difference = np.abs(stored - new)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the positive root of (t r)^2 + 2 s (t r) = difference, in the form that does not cancel
        change = np.where(difference == 0.0, 0.0, difference / (s + np.sqrt(s**2 + difference)) / r)
    worst = int(np.argmax(np.nan_to_num(change, nan=np.inf)))
    return (worst, float(change[worst])) if not change[worst] <= tolerance else None
