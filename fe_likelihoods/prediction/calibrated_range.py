"""Numbers that compare a prediction with its calibration: peaks, bandwidths, ends of histories, the same response.

`fe_likelihoods.checks.transfer` judges them.
"""

import logging
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..cache.verification import StaleCache
from ..checks.model import relative_difference
from ..likelihood.joint import JointLikelihood
from ..signals.events import find_events, motions_of
from ..simulation.failure_reasons import ChangedModel
from .model_and_samples import PredictionSource
from .quantities import ChannelQuantity, MeanOfLast

__all__ = ["Calibrated", "Ends", "Peaks", "bandwidth", "calibration_of", "difference_of_responses"]

logger = logging.getLogger(__name__)

_LAST = 2.0  # seconds at the end in which a final value must not move
Calibrated = list[dict[str, float]]  # measured peaks of the channels [SI], of each event


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

    def medians(self, names: Iterable[str]) -> dict[str, float]:
        """Median peak of each channel over the samples [SI], by name; empty without a response."""
        if not self._peaks:
            return {}
        return dict(zip(names, np.median(np.concatenate(self._peaks), axis=0).tolist(), strict=True))


class Ends:
    """How much the channels of final values still move at the end, collected while responses are simulated.

    Examined are means of last samples, such as `final_value`; tests with imposed deformations are not.
    """

    def __init__(self, quantities: Iterable[Any], model: Any) -> None:
        final: dict[str, ChannelQuantity] = {}
        for each in quantities if motions_of(model) else ():
            several = each if isinstance(each, Sequence) else [each]
            final |= {str(one): one for one in several if isinstance(getattr(one, "function", None), MeanOfLast)}
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

    def medians(self) -> dict[str, np.ndarray]:
        """Medians over the samples, by name: half the range in the last two seconds, final value, largest response."""
        return {name: np.median(found, axis=0) for name, found in self._found.items() if found}


def calibration_of(posterior_or_model: Any) -> Calibrated:
    """Measured peaks of the channels [SI] in each event of the calibration; channels without samples are left out.

    Takes a posterior, a likelihood, a sequence of `Measurements`, or a bare model, which has none.
    """
    if isinstance(posterior_or_model, Sequence):
        return [_peaks_of(each, slice(None)) for each in posterior_or_model]
    likelihood = getattr(posterior_or_model, "likelihood", posterior_or_model)
    if isinstance(likelihood, JointLikelihood):
        return [one for each in likelihood.likelihoods.values() for one in calibration_of(each)]
    if not (hasattr(likelihood, "measurements") and hasattr(likelihood, "model")):
        return []
    events, measured = find_events(likelihood.model), likelihood.measurements
    parts = [slice(None)]
    if events is not None and measured.simultaneous and measured.start == 0.0:
        parts = [slice(round(each.start / measured.dt), round(each.end / measured.dt) + 1) for each in events.windows]
    return [_peaks_of(measured, part) for part in parts]


def _peaks_of(measured: Any, part: slice) -> dict[str, float]:
    histories = zip(measured.channels, measured.values[:, part], strict=True)
    return {c.name: float(np.nanmax(np.abs(row))) for c, row in histories if np.isfinite(row).any()}


def bandwidth(model: Any) -> float | None:
    """Width of a band with the power of a model's motions, the mean over its supports [Hz]; None without a motion.

    It is (sum P)^2 / sum P^2 times the frequency step, for the power P of the Fourier transform: the width of a band
    with constant power. A motion without power has no limit.
    """
    widths = []
    for motion in motions_of(model):
        power = np.square(np.abs(np.fft.rfft(motion.acceleration)))
        squares = np.square(power).sum()
        widths.append(power.sum() ** 2 / squares / (motion.n_steps * motion.dt) if squares > 0.0 else np.inf)
    return float(np.mean(widths)) if widths else None


def difference_of_responses(
    source: PredictionSource, other: Any, theta: np.ndarray, response: np.ndarray
) -> float | None:
    """Difference of a response (n_channels, n_steps) to another motion and the response to the calibration motion.

    It is the norm over the first samples of both, relative to the latter, at the parameters `theta` (n_structural,);
    None if the motions have the same first samples, or the simulation under the calibration motion fails. The
    likelihood counts this simulation.
    """
    if other.fingerprint == source.model.fingerprint:
        return None
    motions = [[each.acceleration for each in motions_of(model)] for model in (source.model, other)]
    if all(motions):
        n = min(len(each) for several in motions for each in several)
        if all(np.array_equal(one[:n], two[:n]) for one, two in zip(*motions, strict=True)):  # a part
            return None
    try:
        batch = source.likelihood.simulate(theta[None])
    except (ChangedModel, StaleCache) as error:  # concerns the next sampling, not this prediction
        logger.warning("the response is not compared with the response to the calibration motion: %s", error)
        return None
    if batch.reasons[0]:
        return None
    n = min(batch.response.shape[2], response.shape[1])
    known = batch.response[0][:, :n]
    return relative_difference(response[:, :n] - known, known)
