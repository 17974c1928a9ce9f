"""How much two simulations with the same parameters may differ."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["Simulated", "difference_in_words"]

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

    It agrees within the `tolerance` of a response, relative to its norm; zero is for equal bits. `names` are those of
    the channels, whose sums of squares come first; further numbers have the channel order and the scale of the sums,
    and contain sums of squared responses if `of_response`. If a response with norm r changes by t r, the sum of squared
    residuals s^2 changes by at most 2 s t r + (t r)^2, and so does a sum over products of two residuals of the channel;
    a sum of squared responses by at most 2 r t r + (t r)^2. Rounding errors in the sums do not count as changes.
    """
    if reason or new.reason:
        was, now = (f"failed ({text})" if text else "succeeded" for text in (reason, new.reason))
        return ("" if reason and new.reason else f"it {was}; simulated again, it {now}"), 0.0
    if np.array_equal(earlier, new.misfit):
        return "", 0.0
    n, channels = len(names), np.arange(len(earlier)) % len(names)
    s, r = np.sqrt(np.minimum(earlier[:n], new.misfit[:n]))[channels], new.norm[channels]
    if of_response:
        s[n:] = r[n:]
    difference = np.abs(earlier - new.misfit)
    if tolerance:
        difference = np.where(difference <= ROUNDING * s**2, 0.0, difference)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the positive root of (t r)^2 + 2 s (t r) = difference, in a form without cancellation
        change = np.where(difference == 0.0, 0.0, difference / (s + np.sqrt(s**2 + difference)) / r)
    worst = int(np.argmax(np.nan_to_num(change, nan=np.inf)))
    if change[worst] <= tolerance:
        return "", 0.0
    what = "sum of squared residuals" if worst < n else f"statistic {worst}"
    values = f"stored {earlier[worst]:.17g}, simulated again {new.misfit[worst]:.17g}"
    return f"channel {names[worst % n]!r}, {what}: {values}", float(change[worst])
