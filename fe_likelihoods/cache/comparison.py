"""How much two simulations with the same parameters may differ."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["Simulated", "difference_in_words", "largest_difference"]

ROUNDING = 1e-13  # relative error of a sum of squares, since processors add the terms in different orders


class Simulated(NamedTuple):
    """A simulation that was run again."""

    misfit: np.ndarray  # statistics (n_numbers,); NaN if it failed
    reason: str  # of the failure
    norm: np.ndarray  # (n_channels,) of the response [SI]


def difference_in_words(
    earlier: np.ndarray, reason: str, new: Simulated, names: Sequence[str], tolerance: float, of_response: bool
) -> tuple[str, float]:
    """How a simulation differs from an earlier one, in words and relative to the response norm; empty if it agrees.

    `names` are those of the channels, the other arguments as for `largest_difference`.
    """
    if reason or new.reason:
        was, now = (f"failed ({text})" if text else "succeeded" for text in (reason, new.reason))
        return ("" if reason and new.reason else f"it {was}; simulated again, it {now}"), 0.0
    found = largest_difference(earlier, new.misfit, new.norm, tolerance, of_response)
    if found is None:
        return "", 0.0
    index, change = found
    what = "sum of squared residuals" if index < len(names) else f"statistic {index}"
    values = f"stored {earlier[index]:.17g}, simulated again {new.misfit[index]:.17g}"
    return f"channel {names[index % len(names)]!r}, {what}: {values}", change


def largest_difference(
    stored: np.ndarray, new: np.ndarray, norm: np.ndarray, tolerance: float, of_response: bool = False
) -> tuple[int, float] | None:
    """Index of the statistic that differs most between two simulations, and the relative response change behind it.

    None if all agree within the `tolerance` of a response, relative to its norm (n_channels,) [SI]; zero is for equal
    bits. Sums of squares (n_channels,) come first; further numbers have the channel order and the scale of the sums,
    and contain sums of squared responses if `of_response`. If a response with norm r changes by t r, the sum of squared
    residuals s^2 changes by at most 2 s t r + (t r)^2, and so does a sum over products of two residuals of the channel;
    a sum of squared responses by at most 2 r t r + (t r)^2. Rounding errors in the sums do not count as response
    changes.
    """
    if np.array_equal(stored, new):
        return None
    n, channels = len(norm), np.arange(len(stored)) % len(norm)
    s, r = np.sqrt(np.minimum(stored[:n], new[:n]))[channels], norm[channels]
    if of_response:
        s[n:] = r[n:]
    difference = np.abs(stored - new)
    if tolerance:
        difference = np.where(difference <= ROUNDING * s**2, 0.0, difference)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the positive root of (t r)^2 + 2 s (t r) = difference, in a form without cancellation
        change = np.where(difference == 0.0, 0.0, difference / (s + np.sqrt(s**2 + difference)) / r)
    worst = int(np.argmax(np.nan_to_num(change, nan=np.inf)))
    return (worst, float(change[worst])) if not change[worst] <= tolerance else None
