"""Models of a structure whose stiffness depends on its temperature.

There is one more parameter, ``temperature_slope`` s [1/K], common to all modes and stiffnesses: at a temperature T,
frequencies are f (1 + s (T - 20 °C)). Masses do not depend on it, so stiffnesses are k (1 + s (T - 20 °C))², and the
displacements, rotations, curvatures and strains of a linear structure under known loads are divided by this square;
forces and stresses remain.
"""

from functools import partial
from typing import Any

import numpy as np

from ..models.base import digest
from ..signals.channels import Channel
from ..signals.sampling import array_digest
from ..simulation.model import Model, SimulationBatch
from ..simulation.user_code import code_within, is_of_user

__all__ = ["REFERENCE_TEMPERATURE", "SLOPE", "ModesWithSlope", "StaticAtTemperatures"]

SLOPE = "temperature_slope"
REFERENCE_TEMPERATURE = 20.0  # [°C], of the stiffnesses of a model
_REMAIN = "force", "moment", "stress"
_OF_THE_MODEL = "code_parts", "jacobian", "nominal", "nominal_units", "simulate_together", "time_limit"


class _WithSlope:
    """A model with the slope as its last parameter, whose response a subclass changes."""

    path_dependent = False
    _warmer = np.zeros(0)  # than the stiffnesses of the model [K]

    def __init__(self, model: Model) -> None:
        self.model, self.channels, self.dt, self.n_steps = model, tuple(model.channels), model.dt, model.n_steps
        self.parameter_names = (*model.parameter_names, SLOPE)
        self.parameter_units = dict(getattr(model, "parameter_units", {})) | {SLOPE: "1/K"}

    def __getattr__(self, name: str) -> Any:
        """Optional members of the model."""
        model = vars(self).get("model")
        if model is None or name not in _OF_THE_MODEL:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        if name == "code_parts" and is_of_user(type(model).__module__):
            return partial(code_within, model)
        member = getattr(model, name)
        return {"jacobian": self._jacobian, "simulate_together": self._together}.get(name, member)

    @property
    def fingerprint(self) -> str:
        """Digest of the model and the temperatures."""
        return digest(type(self).__name__, self.model.fingerprint, array_digest(self._warmer))

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) at the parameters (n_parameters,)."""
        return self._changed(np.asarray(self.model.simulate(theta[:-1])), theta[-1])

    def _together(self, thetas: np.ndarray, pool: Any = None) -> SimulationBatch:
        batch = self.model.simulate_together(thetas[:, :-1], pool)
        responses = [self._changed(*each) for each in zip(batch.response, thetas[:, -1], strict=True)]
        return SimulationBatch(np.array(responses), batch.reasons)

    def _jacobian(self, theta: np.ndarray) -> np.ndarray:
        response, slopes = self.model.simulate(theta[:-1]), np.asarray(self.model.jacobian(theta[:-1]))
        return self._slopes(np.asarray(response), slopes, theta[-1])


class ModesWithSlope(_WithSlope):
    """Modes at 20 °C, and the slope as one more channel."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.channels = (*self.channels, Channel(SLOPE, "dimensionless", "1"))

    def _changed(self, response: np.ndarray, slope: float) -> np.ndarray:
        return np.vstack([response, np.full(self.n_steps, slope)])

    def _slopes(self, response: np.ndarray, slopes: np.ndarray, slope: float) -> np.ndarray:
        found = np.zeros((len(slopes) + 1, len(self.channels), self.n_steps))
        found[:-1, :-1], found[-1, -1] = slopes, 1.0
        return found


class StaticAtTemperatures(_WithSlope):
    """Response (n_channels, n_cases) of a model of a load test, at the temperatures (n_cases,) of its cases [°C]."""

    def __init__(self, model: Model, temperatures: np.ndarray) -> None:
        super().__init__(model)
        moves = [each.dimension not in _REMAIN for each in self.channels]
        self._warmer = np.outer(moves, temperatures - REFERENCE_TEMPERATURE)

    def _changed(self, response: np.ndarray, slope: float) -> np.ndarray:
        return response / np.square(1.0 + slope * self._warmer)

    def _slopes(self, response: np.ndarray, slopes: np.ndarray, slope: float) -> np.ndarray:
        by_slope = -2.0 * self._warmer / (1.0 + slope * self._warmer) * response
        return self._changed(np.concatenate([slopes, by_slope[None]]), slope)
