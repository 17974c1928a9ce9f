r"""Uncertainty propagation: distribution of a response under the posterior of the parameters.

A quantity :math:`g` of the response (a history, a peak, or any function of it) has the posterior mean and variance

.. math::

   E[g] = \int g(\theta)\, p(\theta \mid D)\, d\theta \approx \frac{1}{N} \sum_j g(\theta_j), \qquad
   \mathrm{Var}[g] \approx \frac{1}{N} \sum_j \left(g(\theta_j) - E[g]\right)^2,

estimated from samples :math:`\theta_j` of the posterior. The samples are simulated in batches, and equal samples once,
because resampling makes many copies. Failed simulations are counted by reason and left out. Peaks, bandwidths
and ends of histories are compared with the calibration: `fe_likelihoods.checks.model` judges the numbers.

See ``docs/theory/prediction.rst``.
"""

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from samplers.evaluation.values import most_common_reasons

from ..cache.simulation_cache import SimulationCache
from ..cache.verification import StaleCache
from ..checks.finding import warn
from ..checks.model import check_bandwidth, check_final_values, check_peaks, check_same_response, relative_difference
from ..likelihood.joint import JointLikelihood
from ..likelihood.simulator import Simulator
from ..noise.protocol import noise_under
from ..signals.channels import Measurements
from ..signals.records import Record, find_events, motions_of
from ..simulation.failure_reasons import ChangedModel
from ..simulation.model import Model, SimulationFailed
from .model_and_motion import (
    PredictionSource,
    chosen_state,
    distinct_rows,
    excite,
    one_data_set,
    predict_channels_of,
    read_source,
    split_samples,
    under_record,
)
from .prediction import Accumulator, Prediction
from .quantities import ChannelQuantity, MeanOfLast, Quantity, evaluator

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


logger = logging.getLogger(__name__)

_BATCH_VALUES = 2**22  # response values in one batch: 32 MiB
_LARGEST_BATCH = 256
_LARGEST_SERIAL_BATCH = 16  # small, so that the progress bar moves often when simulations run one by one


def propagate(
    posterior_or_model: Any,
    samples: Any,
    *,
    data_set: str | None = None,
    channels_of: Model | None = None,
    quantity: Quantity | Mapping[str, Quantity] = None,
    record: Record | None = None,
    from_state: str | None = None,
    rest: float = 10.0,
    noise: bool | str = False,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    effective_sample_size: float | None = None,
    pool: Any = None,
    cache: SimulationCache | Simulator | str | os.PathLike | None = None,
    calibrated: Sequence[Measurements] | None = None,
    check: bool = True,
    seed: int | None = None,
    progress: bool = True,
) -> Prediction | dict[str, Prediction]:
    """Predict a quantity from samples of the parameters.

    Parameters
    ----------
    posterior_or_model : Posterior, FELikelihood, JointLikelihood or Model
        The object to predict with.
    samples : (n, ndim) array_like, or named values of shape (n,)
        Samples of equal weight: all parameters of the posterior (``sampler.get_chain(flat=True)``), or, without noise,
        the structural parameters alone. For a posterior whose noise was integrated out, the result of
        `Posterior.draw_noise`.
    data_set : str, optional
        For a `JointLikelihood` or its posterior: the name of the likelihood whose model and noise predict.
    channels_of : Model, optional
        A model with the same parameters and other channels, such as unmeasured floors, and possibly another excitation.
        Default: the posterior's model. With noise, an unmeasured channel gets the mean noise parameters of the measured
        channels with the same quantity: the mean share if the noise is in shares of the response, the mean standard
        deviation [SI] otherwise. `Prediction.findings` states it.
    quantity : optional
        None for the histories of all channels, the name of a channel or several names for their histories,
        ``peak(name)`` or another `fe_likelihoods.prediction.quantities.ChannelQuantity` or several of them, or a
        function of the response (n_channels, n_steps) [SI] that returns a number or an array of fixed shape.
        Exceptions of this function are not caught. Several of these by name, ``{"histories": None, "peaks":
        [peak(name)]}``, are predicted from the same simulations and the same draws of the noise.
    record : Record, optional
        Another excitation, for models with a method ``with_record(record)``. Default: the excitation of the model.
    from_state : {"virgin", "end"}, optional
        State of the structure at the beginning of `record`. "virgin" is the state of the model before any excitation.
        "end" is the state after the excitation of the model (such as the calibration record, or `Events`): the model
        runs its own excitation, a pause, and `record`, and the prediction covers `record` only. Default: "virgin", with
        a warning if the model is path dependent.
    rest : float
        Length of the pause without motion before `record`, for "end" [s].
    noise : bool or str
        Predict measurements: the response plus the noise of each sample, with its correlation in time. For histories,
        mean and variance are exact in the noise (the law of total variance adds the mean variance of the noise), and
        quantiles use one draw of the noise per sample. For other quantities, one draw per sample is added to the
        response. "model" predicts the response of the structure with the model error and without the sensor noise, for
        a noise that follows the response (`GaussianNoise` with shares); the errors have the spectrum of the
        response, because white errors make peaks too large. A noise with levels per event has in each event the levels
        of that event; under another `record`, give the name of the event whose levels hold for it.
    quantiles : sequence of float
        Probabilities of the quantiles, between 0 and 1. An empty sequence for none.
    effective_sample_size : float, optional
        Effective number of independent samples, for the Monte Carlo errors. Default: the number of samples, as if they
        were independent. This underestimates the errors for the copies and chains of a sampler.
    pool : optional
        Where simulations run, as in `FELikelihood`. Default: the pool of the likelihood.
    cache : SimulationCache or path, optional
        Where responses are looked up, and stored as soon as they are simulated. A prediction that was interrupted, or
        is made again, repeats only one or two of them, to compare. For "end", responses to the whole excitation are
        stored. Default: responses are not stored.
    calibrated : sequence of Measurements, optional
        Measurements of the calibration events, with whose amplitudes a prediction under another record is compared.
        Default: the likelihood's measurements. An empty sequence for no comparison.
    check : bool
        Whether the response to another `record` is compared with the response to the calibration record, at the
        parameters of one sample: a model that reads one file whatever motion it is given repeats the calibration. This
        is one simulation, which the likelihood counts, unless it has cached the response.
    seed : int, optional
        Seed of the noise. The result does not depend on `pool`.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    Prediction, or dict of str to Prediction
        Mean, variance and quantiles of the quantity; of each one where several are given by name.

    Raises
    ------
    ValueError
        Before any simulation, for samples of another shape or not finite, unknown channels, noise of a bare model,
        impossible noise parameters, a model with one excitation or without a state at the end, other settings out of
        range, and channels whose noise is not known. Later, for a function that returns arrays of different shapes.
    SimulationFailed
        If every simulation fails, unless structures collapsed and the quantity is a number (`exceedance` is then 1).

    Warns
    -----
    UserWarning
        For each finding in `Prediction.findings` that is more than a note (``docs/predictions.rst``).

    Examples
    --------
    >>> prediction = propagate(posterior, samples, noise=True)
    >>> prediction.mean.shape, prediction.quantile(0.95).shape
    ((2, 200), (2, 200))
    >>> stronger = propagate(posterior, samples, quantity=peak("displacement"), record=record.scale(2.0))
    >>> print(stronger)  # doctest: +SAMPLED
    Prediction: 300 samples, with the spread of the parameters only; effective sample size 300
    value         unit  mean  MC error     sd   5 %  50 %  95 %
    displacement    cm  16.5      0.01  0.173  16.2  16.5  16.8
    """
    known = calibration_of(posterior_or_model if calibrated is None else list(calibrated))
    posterior_or_model, samples = one_data_set(posterior_or_model, samples, data_set, noise)
    calibration = source = read_source(posterior_or_model, pool)
    other = record is not None or channels_of is not None
    moved = record is not None and channels_of is None  # the calibrated model under another motion
    if channels_of is not None:
        source, samples = predict_channels_of(channels_of, source, samples, noise)
    thetas, sample_noise = split_samples(source, samples, noise, record is not None)
    n = len(thetas)
    probabilities = _probabilities(quantiles)
    effective = _effective_sample_size(effective_sample_size, n)
    if record is not None:
        under_record(source.model, record)  # errors come before the warning about the state
    state = chosen_state(source.model, record, from_state)
    excitation = excite(source.model, record, state, rest)
    model, n_steps = excitation.model, excitation.n_steps
    if record is not None and noise and hasattr(source.noise, "under"):
        source = source._replace(noise=noise_under(source.noise, model, excitation.first))
        _, sample_noise = split_samples(source, samples, noise, True)
    wanted = quantity if isinstance(quantity, Mapping) else {"": quantity}
    if not wanted:
        raise ValueError("quantity: expected at least one quantity by name; got none")
    evaluators = {name: evaluator(each, model.channels, model.dt, n_steps) for name, each in wanted.items()}

    distinct, members = distinct_rows(thetas)
    try:
        entropy = np.random.SeedSequence(seed).entropy
    except (TypeError, ValueError) as error:
        raise ValueError(f"seed must be a whole number, zero or more, or None; got {seed!r}") from error
    accumulators = {
        name: Accumulator(evaluate, members, sample_noise, bool(probabilities), entropy, n_steps)
        for name, evaluate in evaluators.items()
    }
    together = source.executor is not None or hasattr(model, "simulate_batch")
    batch = _BATCH_VALUES // (len(model.channels) * model.n_steps)
    batch = max(1, min(batch, _LARGEST_BATCH if together else _LARGEST_SERIAL_BATCH))
    stored = cache if isinstance(cache, Simulator) else None  # of the model that predicts, with its memory
    if cache is not stored:
        nothing = Measurements(model.channels, model.dt, np.zeros((len(model.channels), model.n_steps)))
        stored = Simulator(model, nothing, pool=source.executor, cache=cache, memory_rows=0, memory_bytes=0)
    peaks, ends = Peaks(), Ends(wanted.values(), model)
    compared = moved and state == "virgin" and calibration.likelihood is not None
    first: tuple[np.ndarray, np.ndarray] | None = None  # parameters of a sample, and its response to another motion
    with tqdm(total=n, disable=not progress, unit="sample", desc="propagate") as bar:
        for start in range(0, len(distinct), batch):
            responses, reasons = excitation.simulate(distinct[start : start + batch], source.executor, stored)
            for accumulator in accumulators.values():
                accumulator.add(start, responses, reasons)
            if first is None and compared and check:
                good = next((row for row, reason in enumerate(reasons) if not reason), None)
                first = None if good is None else (distinct[start + good], responses[good].copy())
            ends.add(responses, reasons)
            if other:
                peaks.add(responses, reasons, members[start : start + batch])
            bar.update(sum(map(len, members[start : start + batch])))
    found = {name: _prediction(each, probabilities, effective, model.dt) for name, each in accumulators.items()}
    findings = check_final_values(ends.medians())
    if other:
        findings += check_peaks(peaks.medians(c.name for c in model.channels), known, alone=calibrated is None)
    if compared:
        findings += check_bandwidth(bandwidth(model), bandwidth(calibration.model))
    if first is not None:
        findings += check_same_response(difference_of_responses(calibration, model, *first))
    warn(findings)
    measured = None if source.likelihood is None or other else source.likelihood.measurements
    data = None if measured is None or measured.is_history else measured
    common = {"from_state": state, "findings": tuple(findings)}
    predictions = {
        name: replace(each, quantity=wanted[name], data=None if each.dt is None else data, **common)
        for name, each in found.items()
    }
    return predictions if isinstance(quantity, Mapping) else predictions[""]


def _effective_sample_size(effective_sample_size: float | None, n: int) -> float:
    """Return the effective sample size, by default `n`; raise ValueError if it is not a positive number."""
    if effective_sample_size is None:
        return n
    if not (np.isfinite(effective_sample_size) and effective_sample_size > 0.0):
        raise ValueError(f"effective_sample_size must be a positive number; got {effective_sample_size!r}")
    return effective_sample_size


def _prediction(accumulator: Accumulator, probabilities: tuple[float, ...], effective: float, dt: float) -> Prediction:
    n = len(accumulator.result_of_sample)
    failed, collapsed = (
        np.sort(np.concatenate([np.zeros(0, dtype=int), *samples]))
        for samples in (accumulator.failed, accumulator.collapsed)
    )
    frequent = most_common_reasons(accumulator.reasons)
    histories, noise = accumulator.quantity.rows is not None, accumulator.noise
    alone = len(failed) == n
    if alone and (histories or accumulator.shape is None or not len(collapsed)):
        raise SimulationFailed(f"nothing to predict from, all {n} samples failed ({frequent})")
    if len(failed):
        logger.warning("%d of %d samples failed and are left out of the prediction (%s)", len(failed), n, frequent)
    used = np.setdiff1d(np.arange(n), failed, assume_unique=True)
    effective = effective if alone else effective * len(used) / n
    unknown = np.full(accumulator.shape, np.nan)  # of structures that have all collapsed
    variance = unknown if alone else accumulator.moments.variance
    error = np.sqrt(variance / effective)
    if histories and noise is not None:
        added = accumulator.noise_variance.mean
        per_step = noise.of_response is not None
        variance = variance + (added if per_step else noise.over_time(added, variance.shape[1]))
    quantiles = np.zeros((0, *accumulator.shape))
    if probabilities:
        quantiles = np.array([unknown] * len(probabilities)) if alone else accumulator.quantiles(used, probabilities)
    return Prediction(
        mean=unknown if alone else accumulator.moments.mean,
        variance=variance,
        standard_error=error,
        probabilities=probabilities,
        quantiles=quantiles,
        values=None if histories else accumulator.values_of(used),
        n_samples=len(used),
        effective_sample_size=float(effective),
        failed=failed,
        collapsed=collapsed,
        failure_reasons=dict(accumulator.reasons),
        channels=accumulator.quantity.channels,
        dt=dt if histories else None,
        noise=noise is not None,
    )


def _probabilities(quantiles: Sequence[float]) -> tuple[float, ...]:
    try:
        probabilities = tuple(float(p) for p in quantiles)
    except TypeError as error:
        raise ValueError(f"quantiles must be a sequence of probabilities; got {quantiles!r}") from error
    if not all(0.0 < p < 1.0 for p in probabilities) or len(set(probabilities)) != len(probabilities):
        raise ValueError(f"quantiles must be different probabilities between 0 and 1; got {quantiles!r}")
    return probabilities
