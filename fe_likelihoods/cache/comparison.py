"""Repeated simulations, and how much two simulations with the same parameters may differ."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..noise.statistics import Statistic, needs_response
from ..signals.comparison import Comparison
from ..simulation.files import Opened, observing
from ..simulation.label import ModelLabel
from ..simulation.model import Model, misfit_of_responses, most_responses, simulate_batch

__all__ = [
    "Simulated",
    "VerifyingRun",
    "difference_in_words",
    "largest_difference",
    "observed",
    "simulate_again",
]

ROUNDING = 1e-13  # relative error of a sum of squares, since processors add the terms in different orders


@dataclass(eq=False)
class VerifyingRun:
    """What the simulations of one request need; the model has one `fingerprint` for all of them."""

    model: Model
    pool: Any  # where the simulations of the likelihood run
    measured: np.ndarray | Comparison  # response (n_channels, n_steps) [SI]
    statistic: Statistic | None  # that is stored; None: sums of squares
    n_numbers: int  # length of the statistic
    tolerance: float  # as for `SimulationCache`

    @cached_property
    def fingerprint(self) -> str:
        """Declared identity of the model, when it was first asked for."""
        return self.model.fingerprint


class Simulated(NamedTuple):
    """A simulation that was run again."""

    misfit: np.ndarray  # statistics (n_numbers,); NaN if it failed
    reason: str  # of the failure
    norm: np.ndarray  # (n_channels,) of the response [SI]


# new simulations ------------------------------------------------------------------------------------------------------


@contextmanager
def observed(label: ModelLabel, pool: Any) -> Iterator[None]:
    """Add what the simulations in a ``with`` block open to the label, if it observes simulations."""
    if not label.observes:
        yield
        return
    with observing() as observer:
        yield
    label.add(observer.result(label.opened) if pool is None else Opened(observer.noted))


def simulate_again(run: VerifyingRun, thetas: np.ndarray, label: ModelLabel) -> list[Simulated]:
    """New simulations; what they open is added to the model's label."""
    rows = []
    size = most_responses(run.model)
    for start in range(0, len(thetas), size):
        with observed(label, run.pool):
            batch = simulate_batch(run.model, thetas[start : start + size], run.pool)
        misfit, reasons = misfit_of_responses(run.model, batch, run.measured, run.statistic)
        with np.errstate(over="ignore", invalid="ignore"):
            norms = np.linalg.norm(batch.response, axis=2)
        rows += map(Simulated, misfit, reasons, norms)
    return rows


# differences ----------------------------------------------------------------------------------------------------------


def difference_in_words(earlier: np.ndarray, reason: str, new: Simulated, run: VerifyingRun) -> tuple[str, float]:
    """How a simulation differs from an earlier one, in words and relative to the response norm; empty if it agrees."""
    if reason or new.reason:
        was, now = (f"failed ({text})" if text else "succeeded" for text in (reason, new.reason))
        return ("" if reason and new.reason else f"it {was}; simulated again, it {now}"), 0.0
    found = largest_difference(earlier, new.misfit, new.norm, run.tolerance, needs_response(run.statistic))
    if found is None:
        return "", 0.0
    index, change = found
    names = [channel.name for channel in run.model.channels]
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
