"""Modes of a structure whose stiffness depends on its temperature.

There is one more parameter, ``temperature_slope`` s [1/K], common to all modes: at a temperature T, frequencies are
f (1 + s (T - 20 °C)). Stiffnesses are their squares, as masses do not depend on the temperature.
"""

from functools import partial
from typing import Any

import numpy as np

from ..models.base import digest
from ..signals.channels import Channel
from ..simulation.by_value import code_within, is_of_user
from ..simulation.model import Model, SimulationBatch

__all__ = ["REFERENCE_TEMPERATURE", "SLOPE", "ModesWithSlope"]

SLOPE = "temperature_slope"
REFERENCE_TEMPERATURE = 20.0  # [°C], of the stiffnesses of a model
_OF_THE_MODEL = "code_parts", "jacobian", "nominal", "nominal_units", "simulate_together", "time_limit"


class ModesWithSlope:
    """Modes at 20 °C, with the slope as the last parameter and as one more channel."""

    path_dependent = False

    def __init__(self, model: Model) -> None:
        self.model, self.dt, self.n_steps = model, model.dt, model.n_steps
        self.channels = (*model.channels, Channel(SLOPE, "dimensionless", "1"))
        self.parameter_names = (*model.parameter_names, SLOPE)
        self.parameter_units = dict(getattr(model, "parameter_units", {})) | {SLOPE: "1/K"}
        self.fingerprint = digest(type(self).__name__, model.fingerprint)

    def __getattr__(self, name: str) -> Any:
        """Optional members of the model."""
        model = vars(self).get("model")
        if model is None or name not in _OF_THE_MODEL:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        if name == "code_parts" and is_of_user(type(model).__module__):
            return partial(code_within, model)
        member = getattr(model, name)
        return {"jacobian": self._jacobian, "simulate_together": self._together}.get(name, member)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) at the parameters (n_parameters,)."""
        return np.vstack([self.model.simulate(theta[:-1]), np.full(self.n_steps, theta[-1])])

    def _together(self, thetas: np.ndarray, pool: Any = None) -> SimulationBatch:
        batch = self.model.simulate_together(thetas[:, :-1], pool)
        slopes = np.broadcast_to(thetas[:, -1:, None], (len(thetas), 1, self.n_steps))
        return SimulationBatch(np.concatenate([batch.response, slopes], axis=1), batch.reasons)

    def _jacobian(self, theta: np.ndarray) -> np.ndarray:
        found = np.zeros((len(theta), len(self.channels), self.n_steps))
        found[:-1, :-1], found[-1, -1] = self.model.jacobian(theta[:-1]), 1.0
        return found
