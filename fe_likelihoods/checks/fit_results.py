"""The response before and after the update, for each data set and each event, with checks of the residuals.

Responses are taken from the caches of the likelihood where they are there; `Fits.simulations` counts the others.
"""

from typing import NamedTuple

import numpy as np

from ..likelihood.likelihood import FELikelihood
from ..noise.autoregressive import AutoregressiveNoise
from ..noise.marginal import sampled_noise
from ..noise.residuals import ResidualChecks, innovations, residual_checks
from ..signals.channels import Channel, Measurements
from .fit import Compared, compare, draws_to_compare, windows_of
from .run import FinishedRun

__all__ = ["SMALL_PROBABILITY", "ChannelFit", "Fit", "Fits", "fit_data_sets"]

SMALL_PROBABILITY = 0.01  # of white or normal residuals, below which a reader is told


class ChannelFit(NamedTuple):
    """How well one channel of one event is reproduced, by relative root mean square errors [-]."""

    channel: Channel
    samples: int  # that are compared
    before: float  # NaN where there is no simulation
    after: float  # NaN where there is no simulation
    checks: ResidualChecks | None  # of the residuals after the update; None where they cannot be checked


class Fit(NamedTuple):
    """Measurements and responses of one data set or event.

    The noise says how the likelihood treats successive errors: as independent ("white"), with a correlation
    ("autoregressive") or with a spectrum ("bands"; the innovations or the whitened residuals are checked then), or as
    fewer independent ones ("effective"). Where its level depends on the response, residuals are divided by it before
    the checks.
    """

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    responses: dict[str, np.ndarray]  # (n_channels, n_samples) [SI], before and after the update
    residuals: np.ndarray | None  # (n_channels, n_samples) [SI], measured minus simulated
    channels: tuple[ChannelFit, ...]
    noise: str


class Fits(NamedTuple):
    """The fits of all data sets and events; `before` and `after` say in words what the two responses are."""

    fits: tuple[Fit, ...]
    before: str
    after: str
    simulations: int  # run for the fits
    failures: tuple[str, ...]  # simulations that failed, in words
    compared: tuple[Compared, ...] = ()  # what `fit_gate` judges


def fit_data_sets(run: FinishedRun) -> Fits:
    """Simulate two points of each data set, before and after the update, and compare them with the measurements.

    The result is empty for a posterior without a likelihood of this package.
    """
    if run.likelihood is None:
        return Fits((), "", "", 0, ())
    start, start_name = _before(run)
    before, after = f"before: {start_name}", f"after: {run.centre_name}"
    fits, failures, simulations, compared = [], [], run.likelihood.simulations, []
    keys = getattr(run.likelihood, "likelihoods", {"": None})
    for key, (likelihood, columns) in zip(keys, run.likelihood.parts(), strict=True):
        point = run.centre[columns]
        n = len(likelihood.model.parameter_names)
        # both use the time shifts after the update
        points = {before: np.concatenate([start[columns][:n], point[n:]]), after: point}
        batch = likelihood.simulate(np.stack([theta[:n] for theta in points.values()]))
        residuals = {}
        for (title, theta), response, reason in zip(points.items(), batch.response, batch.reasons, strict=True):
            if reason:
                failures.append(f"{key}{', ' if key else ''}{title}: the simulation failed ({reason})")
            else:
                residuals[title] = likelihood.residuals_of(response, theta)
        values = dict(zip(likelihood.parameter_names, point.tolist(), strict=True))
        fits += _split(likelihood, key, residuals, before, after, values)
        draws = draws_to_compare(run.posterior)[:, columns]
        compared += compare(likelihood, np.stack([point, *draws]), True, key)
    made = run.likelihood.simulations - simulations
    return Fits(tuple(fits), before, after, made, tuple(failures), tuple(compared))


def _before(run: FinishedRun) -> tuple[np.ndarray, str]:
    """The point (ndim,) that represents the knowledge before the update, and its name."""
    fast = set(run.posterior.fast_parameters)
    nominal = np.array([parameter.nominal for parameter in run.parameters])
    structural = [i for i in range(len(nominal)) if i not in fast]
    if np.isfinite(nominal[structural]).all():
        return nominal, "nominal values"
    try:
        median, name = run.posterior.prior_transform(np.full(len(nominal), 0.5)), "median of the prior"
    except ValueError:  # a joint prior without such a map
        median, name = np.median(run.posterior.sample_prior(1000, 0), axis=0), "median of draws of the prior"
    known = np.isfinite(nominal)
    return np.where(known, nominal, median), name if not known.any() else f"nominal values, where known, and {name}"


def _split(
    likelihood: FELikelihood,
    key: str,
    residuals: dict[str, np.ndarray],
    before: str,
    after: str,
    values: dict[str, float],
) -> list[Fit]:
    """One fit per event."""
    sampled = sampled_noise(likelihood.noise)
    noise = "autoregressive" if isinstance(sampled, AutoregressiveNoise) else "white"
    noise = "bands" if getattr(sampled, "n_bands", 1) > 1 else noise
    noise = "effective" if getattr(sampled, "effective_samples", None) is not None else noise
    checked = residuals.get(after)
    if checked is not None and hasattr(sampled, "whitened"):
        parameters = np.array([values[name] for name in sampled.parameter_names])
        checked = sampled.whitened(checked, likelihood.measurements.values - checked, parameters)
    fits = []
    for window in windows_of(likelihood, key):
        part = window.measurements
        own = {name: window.of(each) for name, each in residuals.items()}
        left = None if checked is None else window.of(checked)
        fits.append(
            Fit(
                window.title,
                part,
                {name: part.values - each for name, each in own.items()},
                own.get(after),
                tuple(
                    _channel_fit(part, row, own, before, after, None if left is None else left[[row]], values, noise)
                    for row in range(part.n_channels)
                ),
                noise,
            )
        )
    return fits


def _channel_fit(
    part: Measurements,
    row: int,
    residuals: dict[str, np.ndarray],
    before: str,
    after: str,
    left: np.ndarray | None,
    values: dict[str, float],
    noise: str,
) -> ChannelFit:
    channel, measured = part.channels[row], part.values[row]
    errors = {name: _relative_error(each[row], measured) for name, each in residuals.items()}
    checks = None
    if left is not None:
        try:
            if noise == "autoregressive":
                left = innovations(left, np.array([values[f"rho_{channel.name}"]]))
            checks = residual_checks(left, whitened=noise in ("autoregressive", "bands"))
        except (ValueError, KeyError):  # too few samples, no rho of this channel, or an exact fit: nothing to check
            checks = None
    samples = int(np.isfinite(measured).sum())
    return ChannelFit(channel, samples, errors.get(before, np.nan), errors.get(after, np.nan), checks)


def _relative_error(residuals: np.ndarray, measured: np.ndarray) -> float:
    """RRMSE [-]; NaN for a channel that is zero at all samples."""
    there = np.isfinite(measured) & np.isfinite(residuals)
    power = float(np.square(measured[there]).sum())
    return float(np.sqrt(np.square(residuals[there]).sum() / power)) if power > 0.0 else np.nan
