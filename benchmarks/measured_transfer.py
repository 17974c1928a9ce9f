"""What the predictions of measured tests have in common: kinds of noise, one posterior, and the scores of both.

A model is calibrated with one measured event, or the first part of a test, and predicts another one. Each prediction is
made in several ways:

* "SI": noise with a standard deviation in the unit of the channel, as `GaussianNoise` has it;
* "relative": the same standard deviations as shares of the level of the predicted response (``level="measured"``), one
  level for the whole motion; "window": the level within a window around each sample. All three have the same posterior
  of the structure, because a share is a standard deviation divided by a constant, and its prior is divided by the same
  constant;
* "modulated": shares of the level of the simulated response (``level="response"`` with its default settings, and with
  the imposed deformation of a test that has one), calibrated with this noise: another posterior of the structure;
* "relative, model" and "modulated, model", for numbers such as peaks: with errors that have the spectrum of the
  response in the place of errors that are independent from sample to sample (``noise="model"``);
* "ratios", for numbers: the response without noise, times the ratio of measured to fitted value in the
  calibration, with a stated guess of its spread between events (`EventRatios`).

Each row is the mean interval score of the 90 % band as a multiple of the root mean square of the measured channel; the
note has the relative error, the CRPS and the width of the band in the same unit, the coverage of all samples and of the
strong part. The rows of numbers have the score as a multiple of the measured value, and say in which intervals it is.
"""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import (
    EventRatios,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    SimulationCache,
    propagate,
    share_within,
)
from fe_likelihoods.prediction.quantities import ChannelQuantity, measured_quantity
from fe_likelihoods.prediction.score_tables import QuantityScores, score_values
from samplers import SMCSampler

from .rows import Row
from .targets import SHARED

__all__ = ["GUESS", "Case", "Fit", "calibrate", "ratios_of", "score_case", "skipped", "stored_responses", "within"]

GUESS = {"prior_sd": 0.1, "prior_events": 3.0}
"""Stated spread between events of the logarithm of measured / fitted, worth three events (assumed)."""


class Case(NamedTuple):
    """What is predicted.

    Attributes
    ----------
    name : str
        Name of the case.
    model : Model
        Model under the excitation of the case.
    measured : Measurements
        Its measurements, all samples.
    part : slice
        The samples that are scored.
    numbers : mapping of str to ChannelQuantity
        Numbers that are scored, such as the peak in this part.
    noise : GaussianNoise
        Noise of the calibrated channels; the calibration with this kind of noise has the same settings, except for the
        deformation of another specimen.
    """

    name: str
    model: Any
    measured: Measurements
    part: slice
    numbers: Mapping[str, ChannelQuantity]
    noise: GaussianNoise


class Fit(NamedTuple):
    """Samples of a calibration: parameters of the structure, and the standard deviation of each channel.

    Attributes
    ----------
    structure : ndarray, shape (n, n_parameters)
        Parameters of the structure.
    sigma : ndarray, shape (n, n_channels)
        Standard deviations of the errors [SI]; with ``level="response"`` their shares of the level [-].
    model : Model
        The model of the calibration.
    measured : Measurements
        The measurements of the calibration, whose root mean squares are the levels of the shares.
    simulations : int
        Number of simulations.
    """

    structure: np.ndarray
    sigma: np.ndarray
    model: Any
    measured: Measurements
    simulations: int


@functools.cache
def _folder() -> TemporaryDirectory:
    return TemporaryDirectory()  # deleted when the process ends


def stored_responses() -> SimulationCache:
    """Cache of the predicted responses of this process, so that each way to predict needs no further simulations."""
    return SimulationCache(Path(_folder().name) / "responses.sqlite", verify=False)


def skipped(name: str, *files: str) -> list[Row]:
    """A row that says so if measured data are missing: files below ``measured`` in the folder of FE_SHARED."""
    missing = [file for file in files if not (SHARED / "measured" / file).exists()]
    note = f"no {', '.join(missing)} in {SHARED / 'measured'}: set FE_SHARED"
    return [Row(name, "SKIPPED", None, "", note)] if missing else []


def calibrate(
    model: Any,
    measured: Measurements,
    prior: Mapping[str, Any],
    scale: float,
    seed: int,
    *,
    noise: GaussianNoise | None = None,
    walkers: int = 300,
    draws: int = 200,
) -> Fit:
    """Sample the posterior with SMC, white noise or `noise`.

    The prior of all standard deviations has the scale `scale` [SI], that of shares this scale divided by the root mean
    square of the measured channel. `draws` of the samples are kept for predictions.
    """
    levels = (
        np.sqrt(np.nanmean(np.square(measured.values), axis=1)) if noise is not None else np.ones(measured.n_channels)
    )
    noise = GaussianNoise(model.channels) if noise is None else noise
    scales = dict(zip(noise.parameter_names, scale / levels, strict=True))
    whole = dict(prior) | {name: HalfNormal(float(each)) for name, each in scales.items()}
    posterior = Posterior(FELikelihood(model, measured, noise), whole)
    sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 2, progress=False)
    samples, n = sampler.get_chain(flat=True), len(model.parameter_names)
    chosen = np.random.default_rng(seed).choice(len(samples), min(draws, len(samples)), replace=False)
    return Fit(samples[chosen, :n], samples[chosen, n:], model, measured, posterior.report()["simulations"])


def ratios_of(fit: Fit, model: Any, quantities: Mapping[str, ChannelQuantity]) -> dict[str, float]:
    """Ratio of measured to fitted value of numbers in the calibration."""
    listed = list(quantities.values())
    fitted = propagate(model, fit.structure[::3], quantity=listed, quantiles=(0.5,), progress=False).quantile(0.5)
    return dict(zip(quantities, measured_quantity(listed, fit.measured) / fitted, strict=True))


def score_case(
    case: Case, fit: Fit, modulated: Fit, ratios: Mapping[str, float], seed: int
) -> tuple[list[Row], dict[str, QuantityScores]]:
    """Rows of a case, and the scores of its numbers by way to predict.

    Parameters
    ----------
    case : Case
        What is predicted. Channels that were not calibrated have the mean noise of those that were.
    fit, modulated : Fit
        The calibrations with white noise and with ``level="response"``.
    ratios : mapping of str to float
        Ratios of measured to fitted numbers in the calibration.
    seed : int
        Seed of the noise and of the ratios.
    """
    levels = np.sqrt(np.nanmean(np.square(fit.measured.values), axis=1))
    shares, sensor, channels = np.minimum(fit.sigma / levels, 0.99), case.noise.sensor, case.model.channels
    relative, window = (
        GaussianNoise(fit.measured.channels, level="measured", window=w, sensor=sensor)
        for w in (None, case.noise.window)
    )
    kinds = {
        "SI": (GaussianNoise(fit.model.channels), fit.structure, fit.sigma),
        "relative": (relative, fit.structure, shares),
        "window": (window, fit.structure, shares),
        "modulated": (case.noise, modulated.structure, modulated.sigma),
    }
    rows, scored = [], {}
    quantities = list(case.numbers.values())
    settings = {"cache": stored_responses(), "progress": False}
    for way, (noise, structure, parameters) in kinds.items():
        likelihood = FELikelihood(fit.model, fit.measured, noise)
        samples = np.hstack([structure, parameters])
        wanted = {"histories": None, "numbers": quantities}
        options = {"model": case.model, "quantity": wanted, "noise": True, "seed": seed, "check": False}
        predicted = propagate(likelihood, samples, **options, **settings)
        scores = predicted["histories"].score(case.measured, part=case.part)
        for k, channel in enumerate(channels):
            scaled = scores.crps[k] / scores.rms[k], scores.width[k] / scores.rms[k]
            note = (
                f"RRMSE {scores.rrmse[k]:.3f}, CRPS {scaled[0]:.3f}, width {scaled[1]:.2f}, coverage "
                f"{scores.coverage[k]:.2f}, strong {scores.coverage_strong[k]:.2f}"
            )
            label = f"{case.name}, {channel.name}" if len(channels) > 1 else case.name
            rows.append(Row(f"interval score / RMS, {way}", label, scores.interval_score[k] / scores.rms[k], "", note))
        scored[way] = predicted["numbers"].score(case.measured)
        if way in ("relative", "modulated"):
            options |= {"quantity": quantities, "noise": "model"}
            scored[f"{way}, model"] = propagate(likelihood, samples, **options, **settings).score(case.measured)
    alone = propagate(case.model, fit.structure, quantity=quantities, **settings)
    rng = np.random.default_rng(seed)
    ones = np.ones(len(alone.values))
    draws = [EventRatios([ratios[name]], **GUESS).draw(ones, rng) for name in case.numbers]
    names, units = zip(*((channel.name, channel.unit) for channel in alone.channels), strict=True)
    measured = measured_quantity(quantities, case.measured)
    scored["ratios"] = score_values(names, units, alone.values * np.stack(draws, axis=1), measured, 0.9)
    for way, scores in scored.items():
        for k, name in enumerate(case.numbers):
            size = abs(scores.measured[k])
            inside = ["50 %"] * bool(abs(scores.pit[k] - 0.5) <= 0.25) + ["90 %"] * bool(scores.within[k])
            note = (
                f"CRPS {scores.crps[k] / size:.3f}, width {(scores.upper[k] - scores.lower[k]) / size:.2f}, median "
                f"{scores.median[k] / size:.2f}, PIT {scores.pit[k]:.3f}, in {' and '.join(inside) or 'none'}"
            )
            rows.append(Row(f"{name}: interval score, {way}", case.name, scores.interval_score[k] / size, "", note))
    return rows, scored


def within(scored: Sequence[Mapping[str, QuantityScores]]) -> list[Row]:
    """Shares of all numbers within their intervals, by way to predict, with the mean relative width and score."""
    rows = []
    for way in scored[0]:
        each = [cases[way] for cases in scored]
        pit = np.concatenate([one.pit for one in each])
        size = np.concatenate([np.abs(one.measured) for one in each])
        width, score = (
            np.concatenate(values) / size
            for values in ([one.upper - one.lower for one in each], [one.interval_score for one in each])
        )
        text = f"mean width {width.mean():.2f}, interval score {score.mean():.2f}"
        for p in (0.5, 0.9):
            share = share_within(pit, p)
            rows.append(Row(f"numbers within {p:.0%}, {way}", "all", share.value, "", f"{share}; {text}"))
    return rows
