"""Base class for the built-in models whose simulations are compiled kernels: batches are run on threads."""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ..simulation.model import MisfitBatch, SimulationBatch
from ..simulation.threads import map_threads
from .base import BuiltInModel
from .validation import check_measured, check_thetas

__all__ = ["ThreadedModel"]


class ThreadedModel(BuiltInModel):
    """Built-in model with compiled kernels, which release the interpreter lock: simulations may run at once in this
    process.

    A subclass defines `_prepare`, the work that is the same for every theta, and `_respond`, which uses its result,
    `_prepared`.
    """

    runs_on_threads: ClassVar[bool] = True

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Simulate rows of `thetas` (n, n_parameters) on as many threads as numba uses; rows that failed are NaN, with
        reasons.
        """
        thetas = check_thetas(thetas, self.parameter_names)
        _ = self._prepared  # computed here, so that not every thread computes it
        return SimulationBatch(*map_threads(self._respond, thetas, (len(self.channels), self.n_steps)))

    def misfit_batch(self, thetas: np.ndarray, measured: np.ndarray) -> MisfitBatch:
        """Sums (n, n_channels) of squared residuals to `measured` (n_channels, n_steps) [SI] at rows of `thetas`.

        Rows that failed are NaN, with reasons; responses are not stored.
        """
        thetas = check_thetas(thetas, self.parameter_names)
        measured = check_measured(measured, self.channels, self.n_steps)
        _ = self._prepared  # computed here, so that not every thread computes it
        return MisfitBatch(*map_threads(self._respond, thetas, (len(self.channels),), measured))

    def _prepare(self) -> Any:
        raise NotImplementedError

    @cached_property
    def _prepared(self) -> Any:
        return self._prepare()

    def __getstate__(self) -> dict[str, Any]:
        """State without cached properties, such as the prepared inputs: each process computes its own."""
        cls = type(self)
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(cls, name, None), cached_property)
        }
