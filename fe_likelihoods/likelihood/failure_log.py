"""Record of the simulations that failed."""

import logging
import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from ..cache.memory import MemoryCache
from ..simulation.failure_reasons import TransientReason

__all__ = ["FailureLog", "reason_without_numbers"]

logger = logging.getLogger(__name__)

_MAX_RECORDS = 1000
_MAX_REASONS = 100
_MAX_POINTS = 100_000  # as many as simulations in memory by default, about 250 bytes each
_OTHER_REASONS = "other reasons"
# A point without digits after it belongs to the number in arrays, "[1. 2.]", and before an exponent, "2.e-3".
_DIGITS = r"\d+(?:\.\d+|\.(?=\s*(?:[-+\d\]),]|\.\d)|e[-+]?\d))?|\.\d+"
_NUMBER = re.compile(rf"(?:(?<![\w.])[-+])?(?<![\w.])(?:0x[0-9a-f]+|(?:{_DIGITS})(?:e[-+]?\d+)?)", re.IGNORECASE)


def reason_without_numbers(reason: str) -> str:
    """The reason of a failure with "#" in the place of each number, the same for all failures with one cause.

    Digits that are part of a name are kept.

    Examples
    --------
    >>> reason_without_numbers("Steel02: no convergence at step 31, residual 2.5e-03")
    'Steel02: no convergence at step #, residual #'
    """
    return _NUMBER.sub("#", reason)


class FailureLog:
    """Failed simulations of one likelihood: their number, their reasons, and the parameters of the first thousand.

    `outcomes` counts simulations with a known outcome (run here, read from the disk, or recalled), `count` failures,
    and `transient` failures whose cause is not the model, so that a later run simulates the point again. `records` has
    ``{"parameters": {name: value}, "reason": str}`` of the first 1000 failures of each of these two kinds, with
    ``"transient": True`` of the second. `reasons` counts failures per reason; after the first 100 reasons by their text
    without numbers, and after 100 of these together. `reason_at` knows the latest 100 000 failed points, however few
    simulations are cached in memory.
    """

    def __init__(self, parameter_names: Sequence[str]) -> None:
        self.outcomes = self.count = self.transient = 0
        self.records: list[dict] = []
        self.reasons: Counter[str] = Counter()
        self._names, self._points = tuple(parameter_names), MemoryCache(_MAX_POINTS)

    def count_outcomes(self, thetas: np.ndarray, reasons: Sequence[str]) -> None:
        """Count simulations at structural parameters (n, n_structural), and record those that have a reason."""
        self.outcomes += len(thetas)
        if not self.count and not any(reasons):
            return
        keys = [theta.tobytes() for theta in thetas + 0.0]  # adding zero makes 0.0 of -0.0
        known = self._points.look_up(keys)  # a transient failure may be followed by a success
        told = {key: reason for key, reason in zip(keys, reasons, strict=True) if reason or key in known}
        self._points.store(told, told.values())
        for theta, reason in zip(thetas, reasons, strict=True):
            if reason:
                self.add(theta, reason)

    def add(self, theta: np.ndarray, reason: str) -> None:
        """Record one failure at the structural parameters `theta` (n_structural,); the first one is logged."""
        parameters = dict(zip(self._names, theta.tolist(), strict=True))
        transient = isinstance(reason, TransientReason)
        if not self.count or (transient and not self.transient):
            logger.warning(
                "A simulation failed (%s) at %s%s. Further failures are counted without a message",
                reason,
                ", ".join(f"{name} = {value:.4g}" for name, value in parameters.items()),
                "; a later run simulates the point again" if transient else "",
            )
        self.count += 1
        self.transient += transient
        if (self.transient if transient else self.count - self.transient) <= _MAX_RECORDS:
            self.records.append({"parameters": parameters, "reason": reason})
            if transient:
                self.records[-1]["transient"] = True
        self.reasons[self._counted_under(reason)] += 1

    def reason_at(self, point: np.ndarray) -> str:
        """Reason of the failure at parameters (n,), the structural ones first; empty where none is known."""
        key = (point[: len(self._names)] + 0.0).tobytes()
        return self._points.look_up([key]).get(key, "")

    def report(self) -> dict:
        """The entries of `Posterior.report` on failures."""
        counts = {"failure_count": self.count, "transient_failures": self.transient}
        return counts | {"failures": list(self.records), "failure_reasons": dict(self.reasons)}

    def _counted_under(self, reason: str) -> str:
        """The text under which a reason is counted."""
        for text, most in ((reason, _MAX_REASONS), (reason_without_numbers(reason), 2 * _MAX_REASONS)):
            if text in self.reasons or len(self.reasons) < most:
                return text
        return _OTHER_REASONS
