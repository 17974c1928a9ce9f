"""What a prediction simulates: the model under its own or another motion, its channels, and samples with their noise.

A structure with memory, such as cracked concrete, responds to an earthquake according to what happened before. A
prediction under another record starts "virgin", as the model's own excitation does, or from the "end" of that
excitation: the model then runs its own excitation, a pause, and the new record, whose response alone is used.

A calibrated model predicts every floor of a building, but the posterior has noise parameters for the measured floors
only. An unmeasured channel gets the mean noise parameters of the measured channels with the same quantity. This is an
assumption: the calibration has made the error of the model small at the measured channels only.
"""

import math
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..likelihood.check_inputs import check_model
from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..likelihood.simulator import Simulator
from ..noise.draws import SampleNoise, sample_noise
from ..noise.gaussian import GaussianNoise
from ..noise.marginal import sampled_noise
from ..noise.protocol import follows_response, noise_channels, noise_title, noise_under
from ..priors.points import as_points
from ..signals.records import Record, find_events
from ..signals.sampling import SAME_TIME
from ..simulation.executors import as_executor
from ..simulation.model import Model, SimulationBatch, simulate_batch


class ModelError(NamedTuple):
    r"""Error of the model in every sample, without the sensor noise; a prediction uses it like a `SampleNoise`.

    A noise whose standard deviation follows the response has two parts, the sensor noise, which is no motion of the
    structure, and the model error: :math:`\sigma^2 = s^2 + \sigma_m^2`. The likelihood takes both as white, but the
    largest of many independent errors adds to each peak, while model errors change as slowly as the response. A draw
    has the Fourier amplitudes of the response, random phases, and the standard deviation :math:`\sigma_m` at each step.
    """

    noise: Any
    deviations: np.ndarray  # noise parameters (n, n_noise)
    dt: float  # time step of the responses [s]

    def of_response(self, parameters: np.ndarray, response: np.ndarray) -> np.ndarray:
        """Standard deviations (n_channels, n_steps) [SI] of one sample, without the sensor noise."""
        total = self.noise.response_deviations(parameters, response, dt=self.dt)
        sensor = getattr(self.noise, "sensor", None)
        if sensor is None:
            return total
        return np.sqrt(np.maximum(np.square(total) - np.square(np.array(sensor))[:, None], 0.0))

    def draw(self, sample: int, n_steps: int, rng: np.random.Generator, response: np.ndarray) -> np.ndarray:
        """Draw the error of one sample, shape (n_channels, n_steps) [SI]."""
        parameters, normal = self.deviations[sample], rng.standard_normal(response.shape)
        level = np.sqrt(np.sum(np.square(response), axis=1, keepdims=True))
        spectrum = np.abs(np.fft.rfft(response, axis=1)) / np.where(level > 0.0, level, 1.0)  # of mean square 1
        deviations = self.of_response(parameters, response)
        return deviations * np.fft.irfft(spectrum * np.fft.rfft(normal, axis=1), n=n_steps, axis=1)


def model_error(noise: Any, parameters: np.ndarray, dt: float) -> ModelError:
    """The model error for samples (n, n_noise) of the noise parameters, at a time step of the responses [s].

    The noise needs a method ``response_deviations``, and ``sensor``, the known standard deviations of the sensors or
    None. ValueError if the noise does not follow the response: its levels do not tell the model error from sensor
    noise.
    """
    if not follows_response(noise):
        raise ValueError(
            'noise="model" needs a noise that follows the response, such as GaussianNoise(..., shares_of="response"); '
            f"{noise_title(noise)} does not tell model error from sensor noise: use noise=True, or ratios="
        )
    return ModelError(noise, parameters, dt)


class PredictionSource(NamedTuple):
    """What a prediction is made with; a bare model has no noise and no likelihood."""

    model: Model
    noise: Any  # for a noise that was integrated out, the noise with its parameters
    likelihood: FELikelihood | None
    executor: Any  # where simulations run, None: in this process


def read_source(posterior_or_model: Any, pool: Any = None) -> PredictionSource:
    """Model, noise, likelihood and executor (default: the likelihood's pool) of a posterior, likelihood or model.

    ValueError if the object is none of the three.
    """
    likelihood = getattr(posterior_or_model, "likelihood", posterior_or_model)
    if hasattr(likelihood, "measurements") and hasattr(likelihood, "model"):
        executor = getattr(likelihood, "pool", None) if pool is None else as_executor(pool, likelihood.model)
        return PredictionSource(likelihood.model, sampled_noise(likelihood.noise), likelihood, executor)
    if not (hasattr(posterior_or_model, "simulate") and hasattr(posterior_or_model, "parameter_names")):
        raise ValueError(
            f"expected a Posterior, an FELikelihood or a model with simulate(theta); got {posterior_or_model!r}"
        )
    return PredictionSource(posterior_or_model, None, None, as_executor(pool, posterior_or_model))


def one_data_set(posterior_or_model: Any, samples: Any, data_set: str | None, noise: bool) -> tuple[Any, Any]:
    """The likelihood named `data_set` of a `JointLikelihood` and its samples; anything else as it is given.

    `noise` says whether the noise parameters are needed. ValueError if there is one model and `data_set` is given, or
    several and it is not.
    """
    likelihood = getattr(posterior_or_model, "likelihood", posterior_or_model)
    if not isinstance(likelihood, JointLikelihood):
        if data_set is not None:
            raise ValueError(f"data_set={data_set!r} is for a JointLikelihood; leave it out")
        return posterior_or_model, samples
    if data_set is None:
        raise ValueError(
            f"a prediction is of one model: give data_set= one of {', '.join(map(repr, likelihood.likelihoods))}"
        )
    return likelihood[data_set], likelihood.samples_of(data_set, samples, noise)


def split_samples(
    source: PredictionSource, samples: Any, noise: bool | str, other_record: bool = False
) -> tuple[np.ndarray, SampleNoise | ModelError | None]:
    """Structural parameters (n, n_structural) of samples, and the noise or model error of each if wanted, else None.

    `noise` is whether the noise is wanted; the name of an event for the noise that was calibrated with it
    (``groups="event"``); or "model" for the `model_error` alone. Without it, samples may be structural parameters
    alone. `other_record` says that the record is not the likelihood's. ValueError for samples of another shape, not
    finite, or with an impossible noise, and if the model is bare or the noise has no ``standard_deviations``.
    """
    model, noise_model = source.model, source.noise
    structural = tuple(model.parameter_names)
    names = structural + (() if noise_model is None else tuple(noise_model.parameter_names))
    if noise and noise_model is None:
        raise ValueError("noise=True needs a posterior, whose samples have the parameters of the noise; got a model")
    width = len(samples) if isinstance(samples, Mapping) else np.shape(samples)[-1:]
    structural_only = width in (len(structural), (len(structural),))
    if noise and structural_only and len(structural) < len(names):
        raise ValueError(
            f"noise={noise!r} needs {', '.join(names[len(structural) :])} of each sample; got only the "
            f"{len(structural)} structural parameters. Give all columns of the chain, or posterior.draw_noise(samples) "
            "where the noise was integrated out"
        )
    try:
        points = as_points(samples, structural if structural_only else names)
    except TypeError as error:
        raise ValueError(f"samples must be numbers, (n, {len(names)}): {error}") from error
    if points.ndim != 2 or len(points) == 0:
        raise ValueError(
            f"expected samples of shape (n, {len(names)}), as sampler.get_chain(flat=True) returns; got {points.shape}"
        )
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ValueError(
            f"samples must be finite: {bad.size} of {len(points)} are not, the first is sample {bad[0]}: "
            f"{points[bad[0]]}; leave them out"
        )
    thetas = points[:, : len(structural)]
    if not noise:
        return thetas, None
    parameters = points[:, len(structural) :]
    if hasattr(noise_model, "deviations_per_event"):
        return thetas, _noise_of_events(noise_model, parameters, model, noise, other_record)
    if isinstance(noise, str) and noise != "model":
        raise ValueError(
            f"noise={noise!r} names an event, and {noise_title(noise_model)} has no levels per event; give noise=True"
        )
    whole = sample_noise(noise_model, parameters, len(model.channels), model.dt)  # refuses impossible parameters
    return thetas, model_error(noise_model, parameters, model.dt) if noise == "model" else whole


def distinct_rows(thetas: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """The distinct rows, and the indices of the samples that each of them stands for."""
    distinct, row_of_sample, counts = np.unique(thetas, axis=0, return_inverse=True, return_counts=True)
    return distinct, np.split(np.argsort(row_of_sample.ravel(), kind="stable"), np.cumsum(counts)[:-1])


def _noise_of_events(
    noise_model: GaussianNoise, parameters: np.ndarray, model: Model, noise: bool | str, other_record: bool
) -> SampleNoise:
    """Noise with levels per event: each level at its steps, or one event's levels at all steps."""
    known = [each.name for each in noise_model.events]
    names = ", ".join(map(repr, known))
    rows = [[channel.name for channel in noise_model.channels].index(channel.name) for channel in model.channels]
    deviations = noise_model.deviations_per_event(parameters)[:, :, rows]
    if not (deviations[~np.isnan(deviations)] > 0.0).all() or np.isinf(deviations).any():
        raise ValueError("the noise needs positive standard deviations; some samples have others")
    if not isinstance(noise, str):
        events = find_events(model)
        if other_record or events is None or list(events.names) != known:
            raise ValueError(
                "the noise has levels per event, and the prediction is of another record: give the event whose levels "
                f"hold for it, noise= one of {names}"
            )
        steps = [(each.start / model.dt, each.end / model.dt) for each in events.windows]
        events = tuple(slice(math.ceil(start - SAME_TIME), math.floor(end + SAME_TIME) + 1) for start, end in steps)
        return SampleNoise(np.nan_to_num(deviations), None, events)
    if noise not in known:
        raise ValueError(f"noise={noise!r} is no event of the noise; give one of {names}")
    chosen = deviations[:, known.index(noise)]
    if np.isnan(chosen).any():
        without = [c.name for c, values in zip(model.channels, chosen.T, strict=True) if np.isnan(values).any()]
        raise ValueError(
            f"the channels {', '.join(without)} were not measured in {noise!r}, so their noise is not known; give "
            f"another event of {names}, or noise=False"
        )
    return SampleNoise(chosen, None)


STATES = ("virgin", "end")


class Excitation(NamedTuple):
    """A model under the whole excitation of a prediction."""

    model: Model
    first: int  # response sample at which the prediction begins
    n_steps: int  # samples in the prediction
    from_state: str  # at the beginning of the prediction, "virgin" or "end"

    def simulate(self, thetas: np.ndarray, pool: Any = None, stored: Simulator | None = None) -> SimulationBatch:
        """Responses (n, n_channels, n_steps) of the prediction at parameter sets (n, n_parameters).

        With `stored`, responses to the whole excitation are looked up in its cache and stored there.
        """
        batch = simulate_batch(self.model, thetas, pool) if stored is None else stored.run(thetas, full=True)[1]
        return SimulationBatch(np.ascontiguousarray(batch.response[:, :, self.first :]), batch.reasons)


def chosen_state(model: Model, record: Any, from_state: str | None, stacklevel: int = 3) -> str:
    """State from which a prediction starts, "virgin" by default, which a warning names if the model is path dependent.

    A model without the attribute ``path_dependent`` counts as such. ValueError for any other state, or "end" without a
    record.
    """
    if from_state is None:
        if record is not None and hasattr(model, "with_record") and getattr(model, "path_dependent", True):
            warnings.warn(
                f"the response of {type(model).__name__} may depend on earlier excitations; this prediction starts "
                'from the virgin structure, before any excitation. Give from_state="virgin" for this, or '
                'from_state="end" for the structure after the excitation of the model',
                UserWarning,
                stacklevel=stacklevel,
            )
        return "virgin"
    if from_state not in STATES:
        raise ValueError(f'from_state must be "virgin" or "end"; got {from_state!r}')
    if from_state == "end" and record is None:
        raise ValueError(
            'from_state="end" starts a new record from the end of the excitation of the model; give record=, or leave '
            "from_state out"
        )
    return from_state


def excite(model: Model, record: Any, from_state: str, rest: float) -> Excitation:
    """The model under a record (None: its own excitation), after a pause `rest` [s] if it starts from its "end".

    ValueError if the model has one excitation only, or cannot continue from the end of its own.
    """
    if record is None:
        return Excitation(model, 0, model.n_steps, from_state)
    alone = under_record(model, record)
    if from_state == "virgin":
        return Excitation(alone, 0, alone.n_steps, from_state)
    joined = _followed_by(model, record, rest)
    first = joined.n_steps - alone.n_steps
    if first < 1:
        raise ValueError(
            f"expected a response of {type(model).__name__} that ends with the {alone.n_steps} samples of the new "
            f"record, got {joined.n_steps} samples in all; correct its method followed_by or with_record"
        )
    return Excitation(joined, first, alone.n_steps, from_state)


def under_record(model: Model, record: Any) -> Model:
    """Return the model under another excitation; raise ValueError if it has no method ``with_record``."""
    if not hasattr(model, "with_record"):
        raise ValueError(
            f"{type(model).__name__} has one excitation only: give FunctionModel, OpenSeesModel or ExecutableModel "
            "record=, or write a model class with a method with_record(record) that returns the same model under "
            "another excitation (docs/own_model.rst)"
        )
    return model.with_record(record)


def _followed_by(model: Model, record: Any, rest: float) -> Model:
    """Return the model under its own excitation, a pause [s] and a further record."""
    if hasattr(model, "followed_by"):
        return model.followed_by(record, rest)
    own = getattr(model, "record", None)
    if isinstance(own, Record) and isinstance(record, Record):
        return model.with_record(own.followed_by(record, rest))
    raise ValueError(
        f'{type(model).__name__} cannot start from_state="end": it needs its Record in the attribute record, or a '
        "method followed_by(record, rest) that returns the same model under its own excitation, a pause of rest "
        "seconds and a further record"
    )


def predict_channels_of(
    model: Model, source: PredictionSource, samples: Any, noise: bool | str
) -> tuple[PredictionSource, Any]:
    """Source and samples with which a posterior predicts the channels of another model that has the same parameters.

    The samples get the noise parameters of these channels, if the noise is wanted (`noise` as for `split_samples`).
    ValueError if there is no likelihood; the model has other parameters; or, if the noise is wanted, a channel shares
    its quantity with no measured channel, a measured channel has another quantity, or the noise has no method
    ``with_channels``.
    """
    if source.likelihood is None:
        raise ValueError(
            "channels_of= predicts other channels of a posterior or likelihood; to predict with a model, give it alone"
        )
    check_model(model)
    names, own = tuple(model.parameter_names), tuple(source.model.parameter_names)
    if names != own:
        raise ValueError(
            f"channels_of= must have the parameters of the calibrated model in the same order, {', '.join(own)}; got "
            f"{', '.join(names)}"
        )
    if not noise:
        return source._replace(model=model), samples
    thetas, _ = split_samples(source, samples, noise)
    calibrated = source.noise
    if not hasattr(calibrated, "with_channels"):
        raise ValueError(
            f"{noise_title(calibrated)} does not say what the noise of other channels is: give it a method "
            "with_channels(channels, weights), see fe_likelihoods.noise.protocol.Noise, or predict with noise=False"
        )
    other, of_parameters = calibrated.with_channels(model.channels, _weights(model, source))
    points = as_points(samples, own + tuple(calibrated.parameter_names))
    samples = np.hstack([thetas, points[:, len(own) :] @ of_parameters.T])
    return source._replace(model=model, noise=noise_under(other, model)), samples


def _weights(model: Model, source: PredictionSource) -> np.ndarray:
    """Weights (n_channels, n_measured) of the measured channels in each channel of a model."""
    measured = noise_channels(source.noise, source.model.channels)
    rows = {channel.name: k for k, channel in enumerate(measured)}
    weights = np.zeros((len(model.channels), len(measured)))
    for row, channel in zip(weights, model.channels, strict=True):
        if channel.name in rows:
            known = measured[rows[channel.name]]
            if known.quantity != channel.quantity:
                raise ValueError(
                    f"the channel {channel.name!r} of channels_of= is {channel.quantity!r}, and was calibrated as "
                    f"{known.quantity!r}: give it another name"
                )
            row[rows[channel.name]] = 1.0
            continue
        alike = [k for k, known in enumerate(measured) if known.quantity == channel.quantity]
        if not alike:
            raise ValueError(
                f"the noise of the channel {channel.name!r} is not known: no measured channel is {channel.quantity!r}; "
                f"measured are {', '.join(f'{each.name} ({each.quantity})' for each in measured)}. Leave the channel "
                "out of channels_of=, or predict with noise=False"
            )
        row[alike] = 1.0 / len(alike)
    return weights
