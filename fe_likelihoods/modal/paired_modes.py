"""Modes of a model at the measured modes, as a response that a likelihood can compare.

Each measured mode is a channel. Its samples are, for each identification, the computed frequency as a multiple of the
measured one, and the projection of the measured shape on the computed one, at all sensors. They are smooth functions of
the parameters as long as the pairing stays, so emulators and searches of modes of the posterior need nothing else. The
residuals are the relative frequency errors and the vectors of squared length 1 - MAC.
"""

from functools import partial

import numpy as np

from ..models.base import digest
from ..signals.channels import Channel, Measurements
from ..signals.sampling import array_digest
from ..simulation.by_value import code_within, is_of_user
from ..simulation.model import Model, SimulationFailed, has_jacobian
from .modal_data import ModalData
from .modal_noise import ModeSums
from .mode_models import ABSENT
from .pairing import Paired, pair_modes
from .temperature import REFERENCE_TEMPERATURE, ModesWithSlope

__all__ = ["PairedModes", "sensor_rows"]


def sensor_rows(model: Model, data: ModalData) -> list[int]:
    """Rows of a model's response that are the sensors of the data; ValueError if the model has no modes at them."""
    model = model.model if isinstance(model, ModesWithSlope) else model
    names, kind = [channel.name for channel in model.channels], type(model).__name__
    if model.channels[0].dimension != "frequency":
        raise ValueError(
            f"expected a model that has modes, whose first channel is a frequency; the channels of {kind} are "
            f"{', '.join(names)}: use FunctionModes, or modal_channels(sensors) and modal_response"
        )
    if unknown := [name for name in data.sensors if name not in names[1:]]:
        raise ValueError(
            f"the model has no sensors {', '.join(unknown)}; its sensors are {', '.join(names[1:]) or 'none'}: rename "
            'them, or leave them out (read_modal_data(sensors=)); in a TOML file, columns = {sensor = "its column"}'
        )
    if max(data.n_modes, *np.where(data.has_shape.any(axis=0), 0, data.mode_numbers)) > model.n_steps:
        raise ValueError(
            f"the model has {model.n_steps} modes, and {data.n_modes} were measured, with the numbers "
            f"{data.mode_numbers}: compute more modes (n_modes), twice as many as were measured"
        )
    return [names.index(name) for name in data.sensors]


class PairedModes:
    """Model of the measured modes, the modes of another model paired with them; a call is a statistic of that one."""

    of_response = True  # as a statistic
    dt = 1.0
    path_dependent = False
    axis = "frequency, then components of the shape"

    def __init__(self, model: Model, data: ModalData) -> None:
        self.model, self.data, self.groups = model, data, data.groups()
        self._rows, self._there = sensor_rows(model, data), ~np.isnan(data.frequencies)
        # frequencies with a covariance are compared in coordinates in which their errors are independent
        self.frequency_cv, self._whitening = data.frequency_cv, np.eye(data.n_modes)
        if data.covariance is not None:
            factor = np.linalg.cholesky(data.covariance / np.outer(data.mean_frequencies, data.mean_frequencies))
            self.frequency_cv = np.diag(factor).copy()
            self._whitening = self.frequency_cv[:, None] * np.linalg.inv(factor)
        self._warmer = np.zeros(data.n_sets)
        if data.temperatures is not None and isinstance(model, ModesWithSlope):
            self._warmer = data.temperatures - REFERENCE_TEMPERATURE
        self.parameter_names = tuple(model.parameter_names)
        self.channels = tuple(Channel(f"mode {number}", "dimensionless", "1") for number in data.mode_numbers)
        self.n_steps = data.n_sets * (1 + data.n_sensors)
        sets = [f" of set {k + 1}" if data.n_sets > 1 else "" for k in range(data.n_sets)]
        points = [f"{what}{end}" for end in sets for what in ("frequency", *data.sensors)]
        text = " of ".join(filter(None, ["natural frequencies and mode shapes", data.description]))
        values = self._joined(self._there.astype(float), data.known_shapes)
        self.measurements = Measurements(self.channels, self.dt, values, text, axis=self.axis, points=points)
        for name in ("nominal", "nominal_units", "parameter_units", "time_limit"):
            if hasattr(model, name):
                setattr(self, name, getattr(model, name))
        if has_jacobian(model):
            self.jacobian = self._differentiate
        if hasattr(model, "code_parts") or is_of_user(type(model).__module__):
            self.code_parts = partial(code_within, model)

    def __repr__(self) -> str:
        arrays = map(array_digest, (self._whitening, self._warmer))
        return f"{type(self).__name__}({digest(self.data.fingerprint, repr(self.groups), *arrays)})"

    def __call__(self, residuals: np.ndarray, modes: np.ndarray) -> np.ndarray:
        """Statistic (n_numbers,) of modes (1 + n_sensors, n_modes): that of the residuals of the paired ones."""
        return ModeSums(self.data.n_sets)(self.response(modes) - self.measurements.values)

    @property
    def fingerprint(self) -> str:
        """Digest of the model, the data and the groups of close modes."""
        return digest(self.model.fingerprint, repr(self))

    def factors(self, modes: np.ndarray) -> np.ndarray:
        """Factors (..., n_sets) of frequencies by temperature, of modes (..., 1 + n_sensors, n_modes)."""
        return 1.0 + modes[..., -1, :1] * self._warmer

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (m, n_sets (1 + n_sensors)) at the parameters (n_parameters,)."""
        return self.response(np.asarray(self.model.simulate(np.asarray(theta, dtype=float))))

    def response(self, modes: np.ndarray) -> np.ndarray:
        """Response (m, n_sets (1 + n_sensors)) of modes (1 + n_sensors, n_modes), a response of the other model."""
        paired = self.pair(modes)
        return self._joined(self._ratios(paired.frequencies) * self.factors(modes)[:, None], paired.shapes)

    def pair(self, modes: np.ndarray) -> Paired:
        """Pair modes (1 + n_sensors, n_modes), a response of the model, with the measured ones."""
        if not (modes[0] > 0.0).all():
            raise SimulationFailed(f"natural frequencies must be positive; they are {modes[0]} Hz")
        paired = pair_modes(modes[0], modes[self._rows].T, self.data, self.groups)
        if (paired.frequencies >= ABSENT).any():
            raise SimulationFailed(
                f"the model has {np.count_nonzero(modes[0] < ABSENT)} modes, fewer than the measured modes "
                f"{self.data.mode_numbers} need"
            )
        return paired

    def _ratios(self, frequencies: np.ndarray) -> np.ndarray:
        """Frequencies (..., m) as multiples (..., n_sets, m) of the measured ones; zero where there is none."""
        return np.where(self._there, frequencies[..., None, :] / self.data.frequencies, 0.0)

    def _joined(self, ratios: np.ndarray, shapes: np.ndarray) -> np.ndarray:
        """Response (..., m, n_steps) of ratios (..., n_sets, m) and shapes (..., n_sets, m, n_sensors)."""
        blocks = np.concatenate([(ratios @ self._whitening.T)[..., None], shapes], axis=-1)
        return np.moveaxis(blocks, -3, -2).reshape(*blocks.shape[:-3], len(self.channels), self.n_steps)

    def _differentiate(self, theta: np.ndarray) -> np.ndarray:
        """Derivatives (n_parameters, m, n_steps) of the response while the pairing stays."""
        theta = np.asarray(theta, dtype=float)
        modes, slopes = self.model.simulate(theta), np.asarray(self.model.jacobian(theta))
        paired = self.pair(modes)
        shapes = np.zeros((len(slopes), *paired.shapes.shape))
        for mode, space in enumerate(paired.spaces):
            basis = modes[np.ix_(self._rows, space)]
            turned, inverse = slopes[:, self._rows][:, :, list(space)], np.linalg.pinv(basis)
            for k in np.flatnonzero(self.data.has_shape[:, mode]):
                target, projected = self.data.shapes[k, mode], paired.shapes[k, mode]
                # y = B c with c = B+ t: y' = (I - B B+) B' c + (B+)^T B'^T (t - y)
                moved = turned @ (inverse @ target)
                moved = moved - moved @ inverse.T @ basis.T
                shapes[:, k, mode] = moved + (target - projected) @ turned @ inverse
        ratios = self._ratios(slopes[:, 0, paired.columns]) * self.factors(modes)[:, None]
        ratios += self._ratios(paired.frequencies) * (self.factors(slopes) - 1.0)[..., None]
        return self._joined(ratios, shapes)
