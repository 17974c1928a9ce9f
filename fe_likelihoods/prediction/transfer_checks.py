"""Whether a prediction goes beyond its calibration: amplitudes that were not measured, or a noise that is wrong.

Structural parameters depend on the response amplitude, and noise in SI units does not scale with it. A posterior under
white noise is too narrow where the residuals are correlated, and with a noise in shares of the simulated response the
fitted response may be too large. White errors make peaks too large. A prediction warns of these.
"""

import logging
import weakref
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..cache.verification import StaleCache
from ..likelihood.failure_log import TooManyFailures
from ..likelihood.joint import JointLikelihood
from ..noise.autoregressive import AutoregressiveNoise
from ..noise.gaussian import GaussianNoise
from ..noise.marginal import sampled_noise
from ..noise.protocol import follows_response
from ..noise.residuals import effective_samples, innovations, residual_checks
from ..priors.points import as_points
from ..signals.channels import Channel, Measurements
from ..signals.events import find_events, motions_of
from ..simulation.faults import ChangedModel
from .inputs import PredictionSource
from .prediction import Prediction
from .quantities import ChannelQuantity, MeanOfLast, measured_quantity, peak

__all__ = [
    "Calibrated",
    "Ends",
    "Peaks",
    "calibration_of",
    "sample_to_check",
    "is_first_warning",
    "remark_on_harmonic",
    "remark_on_level",
    "remark_on_peaks",
    "remark_on_same_response",
    "remark_on_white_peaks",
    "remarks_on_calibration",
]

logger = logging.getLogger(__name__)

_LARGEST_LEVEL_RATIO = 3.0  # predicted to calibrated response, beyond which noise in SI units does not transfer
_LARGEST_PEAK_RATIO = 2.0  # of a predicted peak to the largest calibrated one, or of the smallest one to it
_UNLIKELY = 0.01  # probability of a correlation under white noise, for all channels together
_WEAK = 0.2  # lag-one correlation that hardly changes intervals, as in `residual_checks`
_LARGEST_COUNT_RATIO = 2.0  # of independent samples: assumed by the noise, and found
_LARGEST_ADDED_PEAK = 1.1  # median peak with white errors, as a multiple of the median response peak
_TOO_LARGE = 0.75  # multiple of the response that fits best, below which the response is too large
_WORSE = 1.1  # RRMSE of the response divided by the RRMSE of its best multiple, beyond which this is said
_NARROW = 0.2  # bandwidth of a motion by that of the calibration; earthquakes of one structure differ by 0.38 or more
_LAST, _UNSETTLED = 2.0, 0.1  # seconds at the end; half the range there by the final value, beyond which it is told
_NO_MOTION = 0.01  # half the range by the largest response, up to which it does not matter
_SAME = 1e-6  # difference of two responses, relative to their norm, up to which a motion changes nothing
_OTHER_LEVEL = 1.3  # ratio of the residuals to the noise of the same sample, beyond which it is no sample of a fit
Calibrated = list[dict[str, np.ndarray]]  # measured histories of the channels [SI], of each event
# remarks on the residuals of each likelihood, and the likelihoods for which a warning was given
_FOUND: weakref.WeakKeyDictionary[Any, tuple[str, ...]] = weakref.WeakKeyDictionary()
_WARNED: weakref.WeakSet[Any] = weakref.WeakSet()


class Peaks:
    """Peaks of each channel, collected while responses are simulated."""

    def __init__(self) -> None:
        self._peaks: list[np.ndarray] = []

    def add(self, responses: np.ndarray, reasons: Sequence[str], members: Sequence[np.ndarray]) -> None:
        """Add responses (m, n_channels, n_steps) that did not fail, once for each sample that they stand for."""
        usable = [j for j, reason in enumerate(reasons) if not reason]
        if usable:
            peaks = np.maximum(responses.max(axis=2), -responses.min(axis=2))[usable]
            self._peaks.append(np.repeat(peaks, [len(members[j]) for j in usable], axis=0))

    def median(self) -> np.ndarray | None:
        """Median peak of each channel over the samples [SI]; None without a response."""
        return np.median(np.concatenate(self._peaks), axis=0) if self._peaks else None


class Ends:
    """How much the channels of final values still move at the end, collected while responses are simulated.

    Examined are quantities by `final_value`, and `final_values` of others by name; tests with imposed deformations are
    not.
    """

    def __init__(self, quantities: Iterable[Any], model: Any) -> None:
        final: dict[str, ChannelQuantity] = {}
        for each in quantities if motions_of(model) else ():
            final |= getattr(each, "final_values", {})
            several = each if isinstance(each, list | tuple) else [each]
            final |= {one.channel: one for one in several if isinstance(getattr(one, "function", None), MeanOfLast)}
        names = [channel.name for channel in model.channels]
        self._final = {name: (names.index(one.channel), one.part, one.function) for name, one in final.items()}
        self._steps = max(2, round(_LAST / model.dt))
        self._found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in self._final}

    def add(self, responses: np.ndarray, reasons: Sequence[str]) -> None:
        """Add responses (m, n_channels, n_steps) that did not fail."""
        for name, (row, part, function) in self._final.items():
            for response in (each[row, part] for each, reason in zip(responses, reasons, strict=True) if not reason):
                samples = min(function.samples, len(response))  # the mean of so many, which ends at each of the last
                means = np.convolve(response[-(self._steps + samples - 1) :], np.full(samples, 1.0 / samples), "valid")
                self._found[name].append((0.5 * np.ptp(means), abs(function(response)), np.abs(response).max()))

    def remark(self) -> str:
        """Remark on final values during a vibration, by medians over the samples; empty if there are none."""
        medians = {name: np.median(found, axis=0) for name, found in self._found.items() if found}
        limits = {name: max(_UNSETTLED * value, _NO_MOTION * largest) for name, (_, value, largest) in medians.items()}
        moving = [f"{name} (+- {a / v:.0%})" for name, (a, v, _) in medians.items() if v > 0.0 and a > limits[name]]
        if not moving:
            return ""
        return (
            f"the structure still moves in the last {_LAST:g} s, by a part of its final value: {', '.join(moving)}. A "
            "residual value is what is left after free vibration: append rest to the record, "
            'record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0), or take the mean over whole '
            "periods, final_value(channel, samples=...) or damage_measures(settle=...)"
        )


def calibration_of(posterior_or_model: Any) -> Calibrated:
    """Calibration data: for each event, the measured history of each channel [SI].

    Takes a posterior, a likelihood, a sequence of `Measurements`, or a bare model, which has none.
    """
    if isinstance(posterior_or_model, Sequence):
        return [dict(zip(_names(each), each.values, strict=True)) for each in posterior_or_model]
    likelihood = getattr(posterior_or_model, "likelihood", posterior_or_model)
    if isinstance(likelihood, JointLikelihood):
        return [one for each in likelihood.likelihoods.values() for one in calibration_of(each)]
    if not (hasattr(likelihood, "measurements") and hasattr(likelihood, "model")):
        return []
    events, measured = find_events(likelihood.model), likelihood.measurements
    parts = [slice(None)]
    if events is not None and measured.simultaneous and measured.start == 0.0:
        parts = [slice(round(each.start / measured.dt), round(each.end / measured.dt) + 1) for each in events.windows]
    return [dict(zip(_names(measured), measured.values[:, part], strict=True)) for part in parts]


def _names(measured: Measurements) -> list[str]:
    return [channel.name for channel in measured.channels]


def remark_on_peaks(peaks: Peaks, channels: Sequence[Channel], calibrated: Calibrated, alone: bool) -> str:
    """Remark if a channel's median peak is beyond its calibration peaks by a factor of two.

    An empty text otherwise. `alone` is whether the parameters belong to one likelihood, not to a population.
    """
    predicted, far = peaks.median(), []
    if predicted is None:
        return ""
    for channel, value in zip(channels, predicted, strict=True):
        measured = [np.abs(history[~np.isnan(history)]).max() for history in _histories(calibrated, channel.name)]
        if not measured or not max(measured) > 0.0:
            continue
        if value > _LARGEST_PEAK_RATIO * max(measured):
            far.append(f"{channel.name} ({value / max(measured):.2g} times the largest calibrated one)")
        elif value < min(measured) / _LARGEST_PEAK_RATIO:
            far.append(f"{channel.name} ({value / min(measured):.2g} times the smallest calibrated one)")
    if not far:
        return ""
    # Several events show how parameters vary between them, but not at amplitudes that none of them had.
    other = ", or let parameters vary between events (in Python, Hierarchy)" if alone and len(calibrated) == 1 else ""
    return (
        f"the predicted peaks are outside of the range of the calibration by more than a factor of "
        f"{_LARGEST_PEAK_RATIO:g}: {', '.join(far)}. The parameters were calibrated at other amplitudes; where "
        "stiffness and damping depend on the amplitude, the prediction is beside the truth, and its spread does "
        f"not show it. Calibrate with events of this amplitude{other}"
    )


def remark_on_level(predictions: Iterable[Prediction], peaks: Peaks, source: PredictionSource) -> str:
    """Remark if noise in SI units was calibrated with a much stronger or weaker response than predicted.

    An empty text otherwise. It compares root mean squares of histories or, where only numbers are predicted, channel
    peaks without noise.
    """
    if follows_response(source.noise):
        return ""
    histories = [each for each in predictions if each.dt is not None]
    measurements, far = source.likelihood.measurements, []
    if histories:
        known = {channel.name for channel in measurements.channels}
        names = [channel.name for channel in histories[0].channels]
        kept = [k for k, name in enumerate(names) if name in known]
        names = [names[k] for k in kept]
        levels = np.sqrt(np.mean(np.square(histories[0].mean[kept]), axis=1))
        measured = [np.sqrt(np.nanmean(np.square(measurements.channel(name)))) for name in names]
    else:
        names = list(dict.fromkeys(name for each in _of_channels(predictions) for name in each.channel_names))
        levels = _of_names(peaks, source.model.channels, names)
        measured = [_measured_peak(name, measurements) for name in names]
    for name, level, reference in zip(names, levels, measured, strict=True):
        ratio = abs(level / reference) if reference else 1.0
        if not 1.0 / _LARGEST_LEVEL_RATIO <= ratio <= _LARGEST_LEVEL_RATIO:
            far.append(f"{name} ({ratio:.2g} times)")
    if not far:
        return ""
    return (
        "the predicted response has another level than the measurements of the calibration: "
        f"{', '.join(far)}. The noise keeps its level in SI units, so that the bands are too wide for a weaker and "
        'too narrow for a stronger motion; shares of the response scale with it: level="response" of GaussianNoise'
    )


def remark_on_white_peaks(predictions: Iterable[Prediction], peaks: Peaks, source: PredictionSource) -> str:
    """Remark if peaks with white model errors are much larger than the response peaks.

    An empty text otherwise, and for a noise with a spectrum, or in SI units, which may be sensor noise.
    """
    if not follows_response(source.noise) or hasattr(source.noise, "response_errors"):
        return ""
    added = {}
    for each in predictions:
        if each.values is None:  # several numbers of all samples did not fit into memory
            continue
        wanted = [one for one in _of_channels([each]) if one.name == "peak" and one.part == slice(None)]
        for one in wanted:
            place = 0 if isinstance(each.quantity, ChannelQuantity) else list(each.quantity).index(one)
            found = np.median(each.values.reshape(len(each.values), -1)[:, place])
            (without,) = _of_names(peaks, source.model.channels, [one.channel])
            if found > _LARGEST_ADDED_PEAK * without > 0.0:
                added[one.channel] = f"{one.channel} ({found / without:.2g} times)"
    if not added:
        return ""
    return (
        f"the predicted peaks with noise=True are larger than the response peaks: {', '.join(added.values())}. The "
        "noise is drawn independently at each sample, and the largest of many draws adds to the peak. Sensor noise "
        "adds to measured peaks as well, but model errors change as slowly as the response. "
        'Predict peaks of the structure with noise="model" in Python, noise = false in a TOML file '
        "(docs/predictions.rst)"
    )


def _measured_peak(name: str, measurements: Measurements) -> float:
    """Peak of a measured channel [SI]; zero if it was not measured or samples are missing, so that it is not known."""
    try:
        return float(measured_quantity(peak(name), measurements))
    except ValueError:
        return 0.0


def _of_channels(predictions: Iterable[Prediction]) -> list[ChannelQuantity]:
    """The predicted quantities that are numbers of channels."""
    wanted = [each.quantity for each in predictions]
    several = [one for each in wanted for one in (each if isinstance(each, list | tuple) else [each])]
    return [one for one in several if isinstance(one, ChannelQuantity)]


def _of_names(peaks: Peaks, channels: Sequence[Channel], names: Sequence[str]) -> np.ndarray:
    """Median peaks of these channels [SI]."""
    known = [channel.name for channel in channels]
    return peaks.median()[[known.index(name) for name in names]]


def sample_to_check(source: PredictionSource, samples: Any) -> int | None:
    """Index of the sample nearest to the mean, whose residuals are compared with the noise.

    None if there is nothing to check: without a likelihood, for a noise that is not listed in `propagate`, and for
    samples of the structural parameters alone.
    """
    known = isinstance(source.noise, GaussianNoise | AutoregressiveNoise) and hasattr(
        source.noise, "standard_deviations"
    )
    if source.likelihood is None or not (known or hasattr(source.noise, "whitened")):
        return None
    names = (*source.model.parameter_names, *source.noise.parameter_names)
    if (len(samples) if isinstance(samples, Mapping) else np.shape(samples)[-1]) != len(names):
        return None
    points = as_points(samples, names)
    spread = points.std(axis=0)
    scaled = (points - points.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    return int(np.argmin(np.square(scaled).sum(axis=1)))


def remarks_on_calibration(source: PredictionSource, point: np.ndarray, response: np.ndarray | None) -> tuple[str, ...]:
    """Remarks if the residuals of a likelihood contradict the noise with which it was sampled.

    They are judged at one sample (ndim,) with its response (n_channels, n_steps) [SI] to the calibration excitation,
    looked up or simulated where it is None. Samples that do not fit, such as draws of the prior, are not judged. The
    latest result for a likelihood is kept, so that predictions under other excitations need no simulation for it.
    """
    likelihood = source.likelihood
    n_structural = len(source.model.parameter_names)
    if response is None:
        if likelihood in _FOUND:
            return _FOUND[likelihood]
        response = _response(likelihood, point[:n_structural])
    if response is None:
        return ()
    residuals, parameters = likelihood.residuals_of(response, point), point[None, n_structural:]
    if not (np.isfinite(residuals).sum(axis=1) > 1).all() or not np.nanmax(np.abs(residuals), axis=1).all():
        return ()
    noise = sampled_noise(likelihood.noise)  # for the calibration excitation; `source` may have the noise of another
    simulated = likelihood.measurements.values - residuals
    if hasattr(noise, "whitened"):
        checked, stated = noise.whitened(residuals, simulated, parameters[0]), 1.0
    else:
        checked, stated = residuals, noise.standard_deviations(parameters)[0]
    found = np.sqrt(np.nanmean(np.square(checked), axis=1))
    if (np.maximum(found / stated, stated / found) > _OTHER_LEVEL).any():
        return ()
    channels = source.model.channels
    remarks = (
        _too_large(noise, channels, residuals, simulated),
        _contradiction(noise, channels, checked, parameters),
    )
    _FOUND[likelihood] = tuple(filter(None, remarks))
    return _FOUND[likelihood]


def remark_on_same_response(
    source: PredictionSource, other: Any, point: np.ndarray, response: np.ndarray | None
) -> str:
    """Remark if the response to another motion equals the response to the calibration motion; empty if not.

    The first samples of both are compared, for one sample (ndim,) and its response (n_channels, n_steps) [SI] of
    `other`, the virgin model under the other motion. Not if the motions have the same first samples, or without a
    response.
    """
    if response is None or other.fingerprint == source.model.fingerprint:
        return ""
    motions = [_motion(model) for model in (source.model, other)]
    if all(each is not None for each in motions):
        n = min(len(each) for each in motions)
        if np.array_equal(motions[0][:n], motions[1][:n]):  # a part of the calibration, or more of it
            return ""
    known = _response(source.likelihood, point[: len(source.model.parameter_names)])
    if known is None:
        return ""
    n = min(known.shape[1], response.shape[1])
    if np.linalg.norm(known[:, :n] - response[:, :n]) > _SAME * np.linalg.norm(known[:, :n]):
        return ""
    return (
        "this motion changes nothing: the response equals the response to the motion of the calibration, so that the "
        "prediction repeats the calibration. Check that the model reads the motion that it is given, not one file that "
        "is always the same (rehearse, or `fe-likelihoods check`, finds this before a run)"
    )


def remark_on_harmonic(calibrated: Any, other: Any) -> str:
    """Remark if the power of a motion is in a much narrower band than in the calibration; empty if not.

    The bandwidth is (sum P)^2 / sum P^2 times the frequency step, for the power P of the Fourier transform: the width
    of a band with constant power. The mean over the supports is compared.
    """
    found = [[_bandwidth(each) for each in motions_of(model)] for model in (calibrated, other)]
    if not all(found):
        return ""
    before, now = (float(np.mean(each)) for each in found)
    if not now < _NARROW * before:
        return ""
    return (
        f"this motion has its power in a band of {now:.2g} Hz, as a harmonic has; {before:.2g} Hz in the calibration. "
        "Near a resonance the response depends on frequency and damping far more than in the calibration, which hardly "
        "speaks for it: the spread of the posterior is too narrow. Calibrate with a motion of this kind, or predict "
        "with the spread between several events (in Python, predict_new_event)"
    )


def _bandwidth(motion: Any) -> float:
    """Width of a band with the same power [Hz]; inf for a motion without power."""
    power = np.square(np.abs(np.fft.rfft(motion.acceleration)))
    squares = np.square(power).sum()
    return float(power.sum() ** 2 / squares / (motion.n_steps * motion.dt)) if squares > 0.0 else np.inf


def _motion(model: Any) -> np.ndarray | None:
    """Accelerations (n_steps, ...) of the motion of a model; None where they are not known."""
    found = [each.acceleration for each in motions_of(model)]
    return np.stack(found, axis=-1) if found else None


def is_first_warning(likelihood: Any) -> bool:
    """Whether the residuals of a likelihood are to be warned of: once, while every prediction keeps the remarks."""
    first = likelihood not in _WARNED
    _WARNED.add(likelihood)
    return first


def _too_large(noise: Any, channels: Sequence[Channel], residuals: np.ndarray, simulated: np.ndarray) -> str:
    """Remark if a fraction of the simulated response (n_channels, n_steps) fits much better; empty if not.

    Only for a noise in shares of the simulated response: with other noises the response that fits best is also the most
    probable one.
    """
    if not getattr(getattr(noise, "statistic", None), "of_response", False):
        return ""
    far = []
    for channel, residual, response in zip(channels, residuals, simulated, strict=True):
        there = np.isfinite(residual)
        residual, response = residual[there], response[there]
        power, measured = response @ response, response + residual
        factor = max(measured @ response / power, 0.0) if power > 0.0 else 1.0
        if factor >= _TOO_LARGE:
            continue
        errors = [np.sqrt(np.sum((measured - f * response) ** 2) / (measured @ measured)) for f in (1.0, factor)]
        if errors[0] > _WORSE * errors[1]:  # not so where the response is below the noise of the sensor
            far.append(
                f"{channel.name} (RRMSE {errors[0]:.2f}; {errors[1]:.2f} if the response is multiplied by {factor:.2f})"
            )
    if not far:
        return ""
    smaller = "a smaller local=, such as 0.25 or 0, " if getattr(noise, "local", None) else ""
    return (
        f"the simulated response of the calibration is too large: {', '.join(far)}. The noise is a share of the "
        "simulated response, so that the likelihood may prefer a response that is larger or lasts longer than the "
        "measured one, because it permits larger errors; the evidence and the verdict of the sampler do not show it. "
        f'Calibrate with {smaller}level="measured" or level="si", and compare the RRMSE (in Python, fit_measures)'
    )


def _contradiction(noise: Any, channels: Sequence[Channel], residuals: np.ndarray, parameters: np.ndarray) -> str:
    """How residuals (n_channels, n_steps) contradict a noise with parameters (1, n_noise), in words; empty if they do
    not.

    The residuals are whitened where the noise has shares of the response or a spectrum.
    """
    autoregressive, whitened = isinstance(noise, AutoregressiveNoise), hasattr(noise, "whitened")
    if autoregressive:
        residuals = innovations(residuals, noise.lag_one_correlations(parameters)[0])
    try:
        checks = residual_checks(residuals)
    except ValueError:  # no two successive samples of a channel: nothing to check
        return ""
    independent = effective_samples(residuals)
    assumed = getattr(noise, "effective_samples", None)
    assumed = checks.n_samples if assumed is None else np.minimum(assumed, checks.n_samples)
    wrong = (checks.white < _UNLIKELY / len(channels)) & (np.abs(checks.lag_one) > _WEAK)
    wrong &= np.asarray(assumed) > _LARGEST_COUNT_RATIO * independent
    if not wrong.any():
        return ""
    names = ", ".join(
        f"{channel.name} (correlation {lag:.2f} from sample to sample, {count:.0f} samples are worth {worth:.0f})"
        for channel, lag, count, worth, is_wrong in zip(
            channels, checks.lag_one, np.broadcast_to(assumed, wrong.shape), independent, wrong, strict=True
        )
        if is_wrong
    )
    what, other = "residuals", 'AutoregressiveNoise (kind = "autoregressive" in a TOML file) or effective_samples='
    if autoregressive:
        what, other = "innovations", "fewer samples, GaussianNoise with bands of frequency, or effective_samples="
    elif whitened:
        bands = "other bands" if getattr(noise, "n_bands", 1) > 1 else "GaussianNoise with bands"
        what, other = "whitened residuals", f"fewer samples or {bands} of frequency"
    # the information of independent samples is proportional to their number
    factors = np.sqrt(np.broadcast_to(assumed, wrong.shape)[wrong] / independent[wrong])
    least, most = (f"{each:.2g}" for each in (factors.min(), factors.max()))
    about = least if least == most else f"{least} to {most}"
    return (
        f"the {what} of the calibration are not independent, as the noise says they are: {names}. The posterior is too "
        f"narrow by a factor of about {about}, and so is the spread of the predictions between its samples. Calibrate "
        f"with {other}, or predict with the spread between several calibrated events (in Python, predict_new_event; "
        "residual_checks has the figures)"
    )


def _response(likelihood: Any, theta: np.ndarray) -> np.ndarray | None:
    """The response of one simulation, which the likelihood counts; None if it fails."""
    try:
        batch = likelihood.simulate(theta[None])
    except (ChangedModel, StaleCache, TooManyFailures) as error:  # concerns the next sampling, not this prediction
        logger.warning("the residuals of the calibration are not checked: %s", error)
        return None
    return None if batch.reasons[0] else batch.response[0]


def _histories(calibrated: Calibrated, name: str) -> list[np.ndarray]:
    """The measured histories of a channel that have samples."""
    found = [each[name] for each in calibrated if name in each]
    return [history for history in found if np.isfinite(history).any()]
