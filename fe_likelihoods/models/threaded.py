"""Base class for the built-in models whose simulations are compiled kernels: batches are run on threads."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numba
import numpy as np

from ..simulation.model import SimulationBatch, SimulationFailed
from .base import BuiltInModel
from .validation import check_thetas

__all__ = ["ThreadedModel"]


class ThreadedModel(BuiltInModel):
    """Built-in model with compiled kernels, which release the interpreter lock: simulations may run at once in this
    process.

    A subclass defines `_prepare`, the work that is the same for every theta, and `_respond`, which uses its result,
    `_prepared`.
    """

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Simulate rows of `thetas` (n, n_parameters) on as many threads as numba uses; rows that failed are NaN, with
        reasons.
        """
        thetas = check_thetas(thetas, self.parameter_names)
        _ = self._prepared  # computed here, so that not every thread computes it
        response = np.full((len(thetas), len(self.channels), self.n_steps), np.nan)
        reasons = [""] * len(thetas)

        def one(i: int) -> None:
            try:
                values = self._respond(thetas[i])
                if np.iscomplexobj(values):  # the assignment would keep the real part
                    raise ValueError("expected real numbers, got complex ones")
                response[i] = values
            except SimulationFailed as failure:
                reasons[i] = failure.reason

        n_threads = min(numba.get_num_threads(), len(thetas), os.cpu_count() or 1)
        if n_threads <= 1:
            for i in range(len(thetas)):
                one(i)
            return SimulationBatch(response, reasons)
        with ThreadPoolExecutor(n_threads) as threads:
            try:
                list(threads.map(one, range(len(thetas))))
            except BaseException:  # Ctrl-C: cancel the simulations that have not begun
                threads.shutdown(wait=False, cancel_futures=True)
                raise
        return SimulationBatch(response, reasons)

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
