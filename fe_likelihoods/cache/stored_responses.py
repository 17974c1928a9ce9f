"""Model responses without measurements, stored in a cache on disk as soon as they are simulated.

An interrupted prediction finds them when it is run again. Likelihoods store their responses themselves
(`fe_likelihoods.likelihood.simulator`), under the same keys.
"""

import os
import time
from typing import Any

import numpy as np

from ..simulation.label import ModelLabel
from ..simulation.model import Model, SimulationBatch, has_batch_method, simulate_batch
from .comparison import VerifyingRun, observed
from .simulation_cache import SimulationCache
from .verification import VerifiedCache

__all__ = ["StoredResponses"]

_SECONDS = 0.1  # of simulations between two writes, if one simulation is shorter


class StoredResponses:
    """Simulations of a model in a pool or here; each is run only once for all processes that use the cache."""

    def __init__(self, model: Model, pool: Any, cache: SimulationCache) -> None:
        self.model, self.pool = model, pool
        self._verified = VerifiedCache(cache, pool, ModelLabel(model), model)
        self._shape = len(model.channels), model.n_steps
        self._least = getattr(pool, "n_workers", None) or os.cpu_count() or 1
        if pool is None and not has_batch_method(model):
            self._least = 1
        self._size = self._least

    def simulate(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses of distinct thetas (n, n_parameters), with reasons; `StaleCache` if a repeated one differs."""
        run = VerifyingRun(self.model, self.pool, np.zeros(self._shape), None, len(self.model.channels))
        outcomes = self._verified.look_up_responses(thetas, run)
        left = [row for row, outcome in enumerate(outcomes) if outcome is None]
        while left:
            rows, left = left[: self._size], left[self._size :]
            start, label = time.perf_counter(), self._verified.label
            with observed(label, self.pool, self._verified.complete):
                batch = simulate_batch(self.model, thetas[rows], self.pool)
            if self.pool is None:
                label.has_changed_itself(label.changed(self.model))
            seconds = max(time.perf_counter() - start, 1e-9)
            self._verified.store("", thetas[rows], None, batch.reasons, batch.response, 0.0, run)
            for row, response, reason in zip(rows, batch.response, batch.reasons, strict=True):
                outcomes[row] = reason or response
            self._size = max(self._least, min(4 * self._size, int(_SECONDS * len(rows) / seconds)))
        reasons = [outcome if isinstance(outcome, str) else "" for outcome in outcomes]
        nothing = np.full(self._shape, np.nan)
        responses = [nothing if isinstance(outcome, str) else outcome for outcome in outcomes]
        return SimulationBatch(np.reshape(responses, (len(thetas), *self._shape)), reasons)
