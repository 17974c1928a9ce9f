"""Models with sensors: unknown gain, sign and lag of each output and each input, as parameters with priors.

A sensor that measures y shows ``gain * y(t - lag)``: a wrong unit, a calibration that has drifted and a reversed sensor
are gains, and a clock that differs is a lag. An output shows this of the response. An input is the record of a support:
the motion was ``record(t + lag) / gain``. A fit that cannot change them puts such a fault into the structure: a channel
with half of its true size makes damping several times too large.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..priors.distributions import Distribution
from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.sampling import SAME_TIME, interpolate, make_interpolation
from ..simulation.by_value import is_of_user
from ..simulation.model import Model, SimulationBatch, first_part, simulate_batch
from .base import code_within, digest
from .validation import check_theta

_OF_THE_MODEL = ("code_parts", "nominal", "nominal_units", "path_dependent", "range_remark", "time_limit")
ENDS = np.array([1e-6, 1.0 - 1e-6])  # probabilities of the prior's shortest and longest lags


@dataclass(frozen=True)
class Sensor:
    """What is not known of a sensor.

    Parameters
    ----------
    gain : Distribution, optional
        Prior of the ratio of what the sensor shows to what it measures [-], such as ``LogNormal(1, 0.05)`` for a
        calibration that is known to 5 %; negative for the opposite sign. Default: 1.
    lag : Distribution, optional
        Prior of the time by which it is late [s], such as ``TruncatedNormal(0, 0.02, -0.1, 0.1)``. Default: 0.

    Examples
    --------
    >>> Sensor(gain=LogNormal(1.0, 0.05)).gain
    LogNormal(median=1.0, log_sd=0.05)
    """

    gain: Distribution | None = None
    lag: Distribution | None = None

    def __post_init__(self) -> None:
        given = [each for each in (self.gain, self.lag) if each is not None]
        if not given or not all(isinstance(each, Distribution) for each in given):
            raise ValueError(
                "a Sensor needs a prior of its gain, of its lag, or both, such as Sensor(gain=LogNormal(1, 0.05)); got "
                f"gain={self.gain!r}, lag={self.lag!r}"
            )

    @property
    def priors(self) -> dict[str, Distribution]:
        """Priors by "gain" and "lag"."""
        return {name: each for name, each in (("gain", self.gain), ("lag", self.lag)) if each is not None}


class SensedModel:
    """A model whose sensors have unknown gains and lags.

    Its channels are what the sensors show. Samples of its posterior have the structural parameters first, so that
    ``propagate(sensed.model, ...)`` with these predicts the structure itself.

    Parameters
    ----------
    model : Model
    outputs : mapping of str to Sensor
        Sensors by the names of channels.
    inputs : mapping of int to Sensor
        Sensors by the numbers of supports, counted from 0; 0 is the record of a model with one. Each simulation is then
        one of ``model.with_record``.

    Attributes
    ----------
    priors : dict of str to Distribution
        Priors of the parameters of sensors: ``gain_deck`` and ``lag_deck`` of the output deck, ``gain_support_2`` and
        ``lag_support_2`` of an input.

    Examples
    --------
    >>> sensed = SensedModel(model, {"displacement": Sensor(LogNormal(1, 0.05))})  # a factor of about 1
    >>> posterior = Posterior(FELikelihood(sensed, measurements), prior | sensed.priors)

    Notes
    -----
    A response between its samples is interpolated by polynomials of the fifth degree, a record linearly, with zeros
    outside. Before its first and after its last sample a response is held: with an early sensor, leave out the
    measurements of the last moments. A gain and a stiffness can be told apart only if the data know both: a gain of the
    only input and of all outputs at once cannot be.
    """

    def __init__(
        self, model: Model, outputs: Mapping[str, Sensor] | None = None, inputs: Mapping[int, Sensor] | None = None
    ) -> None:
        self.model, self.outputs, self.inputs = model, dict(outputs or {}), dict(inputs or {})
        names = [channel.name for channel in model.channels]
        motions = _motions(model) if self.inputs else ()
        sensors = [*self.outputs.values(), *self.inputs.values()]
        if not sensors or not all(isinstance(each, Sensor) for each in sensors):
            raise ValueError(f"SensedModel: expected Sensors of outputs or inputs; got {outputs!r} and {inputs!r}")
        if unknown := [name for name in self.outputs if name not in names]:
            raise ValueError(f"SensedModel: the model has the channels {', '.join(names)}; got {', '.join(unknown)}")
        if self.inputs and not (hasattr(model, "with_record") and set(self.inputs) <= set(range(len(motions)))):
            raise ValueError(
                f"SensedModel: inputs need a model with with_record, and numbers of its {len(motions)} records, from "
                f"0; got {list(self.inputs)} and {type(model).__name__}"
            )
        self.priors = {
            f"{kind}_{place if isinstance(place, str) else f'support_{place}'}": prior
            for place, sensor in (self.outputs | self.inputs).items()
            for kind, prior in sensor.priors.items()
        }
        self.parameter_names = (*model.parameter_names, *self.priors)
        self.channels: tuple[Channel, ...] = tuple(model.channels)
        self.dt, self.n_steps = model.dt, model.n_steps

    @property
    def fingerprint(self) -> str:
        """Digest of the model and the places of sensors."""
        return digest(type(self).__name__, self.model.fingerprint, *self.priors, str(self.n_steps))

    @property
    def parameter_units(self) -> dict[str, str]:
        """Units of the parameters of sensors, and those that the model states."""
        own = {name: "s" if name.startswith("lag_") else "-" for name in self.priors}
        return dict(getattr(self.model, "parameter_units", {})) | own

    def __getattr__(self, name: str) -> Any:
        """Optional members of the model, such as `nominal`, and its excitation."""
        model = vars(self).get("model")
        if model is not None and name == "code_parts" and is_of_user(type(model).__module__):
            return lambda: code_within(model)
        if model is not None and name in (*_OF_THE_MODEL, "record", "loading", "supports"):
            return getattr(model, name)
        if model is not None and name == "with_record" and hasattr(model, "with_record"):
            return lambda record: SensedModel(model.with_record(record), self.outputs, self.inputs)
        if model is not None and name == "first" and _can_be_shortened(model):
            return self._first
        if model is not None and name == "simulate_batch" and hasattr(model, name):
            return self._batch
        raise AttributeError(f"{type(self).__name__} has no {name}")

    def _first(self, seconds: float) -> SensedModel:
        """The same model under the first part of its excitation, as `first_part`."""
        last = int(seconds / self.dt + SAME_TIME)
        later = sum(
            max((np.abs(each.lag.ppf(ENDS)).max() for each in sensors.values() if each.lag is not None), default=0.0)
            for sensors in (self.outputs, self.inputs)
        )
        whole = min(last + int(np.ceil(later / self.dt)) + 1, self.model.n_steps - 1)
        part = SensedModel(first_part(self.model, whole * self.dt), self.outputs, self.inputs)
        part.n_steps = min(last + 1, part.n_steps)
        return part

    def simulate(self, theta: ArrayLike) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] as the sensors show it; may raise `SimulationFailed`."""
        values = dict(zip(self.parameter_names, check_theta(theta, self.parameter_names), strict=True))
        structural = np.array([values[name] for name in self.model.parameter_names])
        return self._shown(self._under(values).simulate(structural), values)

    def _batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) for parameters (n, n_parameters), with the model's own batch method."""
        named = [dict(zip(self.parameter_names, row, strict=True)) for row in np.asarray(thetas).tolist()]
        n = len(self.model.parameter_names)
        if self.inputs:
            batches = [simulate_batch(self._under(v), t[None, :n]) for v, t in zip(named, thetas, strict=True)]
            raw, reasons = np.concatenate([each.response for each in batches]), [each.reasons[0] for each in batches]
        else:
            raw, reasons = simulate_batch(self.model, thetas[:, :n])
        return SimulationBatch(np.array([self._shown(r, v) for r, v in zip(raw, named, strict=True)]), reasons)

    def _under(self, values: Mapping[str, float]) -> Model:
        """The model under the motions that its records show."""
        if not self.inputs:
            return self.model
        motions = list(_motions(self.model))
        for k in self.inputs:
            record = motions[k]
            gain, lag = values.get(f"gain_support_{k}", 1.0), values.get(f"lag_support_{k}", 0.0)
            motion = np.interp(record.time + lag, record.time, record.acceleration, left=0.0, right=0.0) / gain
            motions[k] = Record(record.name, record.dt, motion, record.source)
        return self.model.with_record(motions if getattr(self.model, "supports", ()) else motions[0])

    def _shown(self, response: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        """What the sensors show of a response of the model (n_channels, n_steps of the model)."""
        shown, time = response[:, : self.n_steps].copy(), self.dt * np.arange(self.n_steps)
        for c, channel in enumerate(self.channels):
            lag = values.get(f"lag_{channel.name}", 0.0)
            if lag:
                times = np.clip(time - lag, 0.0, self.dt * (response.shape[1] - 1))
                shown[c] = interpolate(response[c], make_interpolation(self.dt, response.shape[1], times))
            shown[c] *= values.get(f"gain_{channel.name}", 1.0)
        return shown


def _motions(model: Model) -> tuple[Record, ...]:
    given = getattr(model, "supports", ()) or [getattr(model, "record", None)]
    return tuple(each for each in given if isinstance(each, Record))


def _can_be_shortened(model: Model) -> bool:
    return hasattr(model, "first") or (
        hasattr(model, "with_record") and hasattr(getattr(model, "record", None), "trim")
    )
