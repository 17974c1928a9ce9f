"""Moving at a fixed beta: the tempered density, and when a population has moved enough."""

import numpy as np

from .settings import Settings

__all__ = ["Memory", "tempered_log_prob"]

STALL_SWEEPS = 3


def tempered_log_prob(records: np.ndarray, beta: float) -> np.ndarray:
    """(1 - beta) log_prior + beta log_prob of records (n,) with these fields; -inf outside the prior's support."""
    outside = records["log_prior"] == -np.inf
    log_prior = np.where(outside, 0.0, records["log_prior"])
    return np.where(outside, -np.inf, (1.0 - beta) * log_prior + beta * records["log_prob"])


class Memory:
    """How well a population still remembers where it started, sweep after sweep.

    Remembered are the parameters and the log-likelihood, which the next weights depend on. The measure is the largest
    of their correlations, over the walkers, between start and now.

    Parameters
    ----------
    coords : (n, ndim) float — points right after the resampling, of finite log-likelihood.
    records : (n,) with the fields log_prob and log_prior.
    """

    def __init__(self, coords: np.ndarray, records: np.ndarray):
        self._start = self._centred(coords, records)
        self.correlations: list[float] = []

    @staticmethod
    def _centred(coords: np.ndarray, records: np.ndarray) -> np.ndarray:
        remembered = np.column_stack([coords, records["log_prob"] - records["log_prior"]])
        return remembered - remembered.mean(axis=0)

    def update(self, coords: np.ndarray, records: np.ndarray) -> None:
        """Enter the population after a sweep."""
        now = self._centred(coords, records)
        scale = np.sqrt(np.sum(self._start**2, axis=0) * np.sum(now**2, axis=0))
        varied = scale > 0.0
        correlation = np.abs(np.sum(self._start * now, axis=0)[varied] / scale[varied])
        self.correlations.append(float(np.max(correlation, initial=0.0)))

    def enough(self, settings: Settings) -> bool:
        """Whether to stop: the most moves made, the start forgotten, or nothing more forgotten for three sweeps."""
        sweeps = self.correlations
        if len(sweeps) < settings.min_moves:
            return False
        if len(sweeps) >= settings.max_moves or sweeps[-1] < settings.max_correlation:
            return True
        return len(sweeps) > STALL_SWEEPS and min(sweeps[:-STALL_SWEEPS]) <= min(sweeps[-STALL_SWEEPS:])
