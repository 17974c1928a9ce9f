"""Model responses without measurements, stored in a cache on disk as soon as they are simulated.

An interrupted prediction finds them when it is run again. Likelihoods store their responses themselves
(`fe_likelihoods.likelihood.simulator`), under the same keys.
"""

import os
import time
from typing import Any

import numpy as np

from ..simulation.label import ModelLabel
from ..simulation.model import Model, SimulationBatch, simulate_batch
from .comparison import VerifyingRun, observed
from .simulation_cache import SimulationCache
from .verification import VerifiedCache

__all__ = ["StoredResponses"]

_SECONDS = 0.1  # of simulations between two writes, if one simulation is shorter


class StoredResponses:
    """Simulations of a model in a pool or here; each is run only once for all processes that use the cache.

    One or two stored responses per process are simulated again and compared.
    """

    def __init__(self, model: Model, pool: Any, cache: SimulationCache) -> None:
        self.model, self.pool, self.cache = model, pool, cache
        self.simulations = 0
        self._verified = VerifiedCache(cache, model, pool, ModelLabel(model))
        shape = len(model.channels), model.n_steps
        self._run = VerifyingRun(model, pool, np.zeros(shape), None, len(model.channels))
        self._least = 1
        if pool is not None:
            self._least = getattr(pool, "n_workers", None) or os.cpu_count() or 1
        elif hasattr(model, "simulate_batch"):
            self._least = os.cpu_count() or 1
        self._size = self._least

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses of distinct thetas (n, n_parameters), with reasons; `StaleCache` if a repeated one differs."""
        responses = np.full((len(thetas), len(self.model.channels), self.model.n_steps), np.nan)
        left = []
        for row, response in enumerate(self._verified.look_up_responses(thetas, self._run)):
            if response is None:
                left.append(row)
            else:
                responses[row] = response
        reasons = [""] * len(thetas)
        if left:
            for row, reason in zip(left, self._verified.look_up_failures(thetas[left], self._run), strict=True):
                reasons[row] = reason
            left = [row for row in left if not reasons[row]]
        while left:
            rows, left = left[: self._size], left[self._size :]
            start = time.perf_counter()
            batch = self._new(thetas[rows])
            seconds = time.perf_counter() - start
            self.simulations += len(rows)
            place = self.model.fingerprint, thetas[rows]
            self._verified.store(*place, None, batch.reasons, batch.response, 0.0, self._run)
            responses[rows] = batch.response
            for row, reason in zip(rows, batch.reasons, strict=True):
                reasons[row] = reason
            wanted = int(_SECONDS * len(rows) / max(seconds, 1e-9))
            self._size = max(self._least, min(4 * self._size, wanted))
        return SimulationBatch(responses, reasons)

    def _new(self, thetas: np.ndarray) -> SimulationBatch:
        """New simulations, which complete the label."""
        label = self._verified.label
        with observed(label, self.pool, self._verified.complete):
            batch = simulate_batch(self.model, thetas, self.pool)
        if self.pool is None:
            label.has_changed_itself(label.changed(self.model))
        return batch
