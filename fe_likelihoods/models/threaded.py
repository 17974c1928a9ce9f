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
    """Built-in model with compiled kernels, which release the interpreter lock.

    A subclass defines `_prepare`, the work that is the same for every theta, and `_respond`, which uses its result,
    `_prepared`.

    Attributes
    ----------
    runs_on_threads : bool
        Whether several simulations may run at once in this process.
    """

    runs_on_threads: ClassVar[bool] = True

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Simulate many sets of parameters on as many threads as numba uses.

        Parameters
        ----------
        thetas : ndarray[n, n_parameters]
            One set of parameters per row.

        Returns
        -------
        SimulationBatch
            Responses, NaN in rows that failed, and the reasons of the failures.
        """
        thetas = check_thetas(thetas, self.parameter_names)
        _ = self._prepared  # computed here, so that not every thread computes it
        return SimulationBatch(*map_threads(self._respond, thetas, (len(self.channels), self.n_steps)))

    def misfit_batch(self, thetas: np.ndarray, measured: np.ndarray) -> MisfitBatch:
        """Compute sums of squared residuals at many sets of parameters; responses are not stored.

        Parameters
        ----------
        thetas : ndarray[n, n_parameters]
            One set of parameters per row.
        measured : ndarray[n_channels, n_steps]
            Measured response [SI].

        Returns
        -------
        MisfitBatch
            Sums (n, n_channels), NaN in rows that failed, and the reasons of the failures.
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
