"""Responses beside the measurements of each data set and event: before and after an update, and draws of the prior.

Responses are taken from the caches of the likelihood where they are there; the likelihood counts the others.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..cache.verification import StaleCache
from ..likelihood.failure_log import TooManyFailures
from ..likelihood.likelihood import FELikelihood
from ..likelihood.posterior import Posterior
from ..noise.marginal import sampled_noise
from ..noise.residuals import ResidualChecks, residual_checks
from ..signals.channels import Channel, Measurements
from ..signals.error_measures import relative_errors
from ..signals.events import find_events
from ..simulation.faults import ChangedModel
from ..simulation.model import SimulationFailed
from .run import FinishedRun
from .slow_motion import FEWEST_DRAWS, SlowMotion, slow_motions

__all__ = ["ChannelFit", "Compared", "Fit", "Fits", "compare", "data_sets_of", "draws_to_compare", "fit_data_sets"]

logger = logging.getLogger(__name__)

MOST_DRAWS = 100  # of the prior
SECONDS = 10.0  # of simulations of these draws


class Window(NamedTuple):
    """The part of the measurements that belongs to one event."""

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    inside: np.ndarray  # (n_channels, n_samples) bool, among the samples of all events
    rows: np.ndarray  # channels that are kept
    columns: np.ndarray  # samples that are kept

    def of(self, values: np.ndarray) -> np.ndarray:
        """The part of values (..., n_channels, n_samples), NaN outside of the event."""
        return np.where(self.inside, values, np.nan)[..., self.rows[:, None], self.columns]


@dataclass(frozen=True, eq=False)
class Compared:
    """Measurements of one event, and responses to compare with them: the fit, and draws of the prior."""

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    responses: np.ndarray  # (n, n_channels, n_samples) at the times of the samples [SI]
    fitted: bool  # whether the first response is the fit, not one more draw of the prior
    supports: int = 1  # whose motions excite the model
    modal: "ModalFit | None" = None  # modes of the responses, instead of these

    @cached_property
    def slow(self) -> dict[str, SlowMotion]:
        """Channels that follow the draws of the prior where no parameter changes the response, see `slow_motions`."""
        return slow_motions(self.measurements, self.draws) if self.is_history else {}

    @property
    def draws(self) -> np.ndarray:
        """The responses that are draws of the prior."""
        return self.responses[int(self.fitted) :]

    @property
    def is_history(self) -> bool:
        """Whether there are samples along time, of which clocks, offsets and slow motions can be judged."""
        return not self.modal and self.measurements.is_history


class ModalFit(NamedTuple):
    """Measured and computed modes, `PredictedModes` of `fe_likelihoods.modal`."""

    likelihood: Any
    draws: Any  # modes at draws of the prior; None if none can be simulated
    points: np.ndarray | None = None  # samples of the posterior (n, ndim); None before a run
    samples: Any = None  # modes there


class ChannelFit(NamedTuple):
    """How well one channel of one event is reproduced, by relative root mean square errors [-]."""

    channel: Channel
    samples: int  # that are compared
    before: float  # NaN where there is no simulation
    after: float  # NaN where there is no simulation
    checks: ResidualChecks | None  # of the residuals after the update; None where they cannot be checked
    assumed: float = np.nan  # independent samples that the noise assumes


class Fit(NamedTuple):
    """Measurements and responses of one data set or event; residuals are checked as the noise whitens them."""

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    responses: dict[str, np.ndarray]  # (n_channels, n_samples) [SI], before and after the update
    residuals: np.ndarray | None  # (n_channels, n_samples) [SI], measured minus simulated
    channels: tuple[ChannelFit, ...]
    modal: ModalFit | None = None  # of modal data, instead of responses and residuals
    deviations: np.ndarray | None = None  # of the errors, of the shape of the residuals [SI]; None if not known


class Fits(NamedTuple):
    """The fits of all data sets and events; `before` and `after` say in words what the two responses are."""

    fits: tuple[Fit, ...]
    before: str
    after: str
    simulations: int  # run for the fits
    failures: tuple[str, ...]  # simulations that failed, in words
    compared: tuple[Compared, ...] = ()  # what `check_responses` judges


def data_sets_of(posterior: Any) -> list[tuple[str, FELikelihood, np.ndarray]]:
    """Name (empty if there is one only), likelihood and columns of the parameters of each data set."""
    likelihood = posterior.likelihood
    return [(key, *part) for key, part in zip(likelihood.likelihoods, likelihood.parts(), strict=True)]


def windows_of(likelihood: FELikelihood, key: str = "") -> list[Window]:
    """The measurements of a likelihood, event by event; `key` is the name of the data set."""
    measured, events = likelihood.measurements, find_events(likelihood.model)
    spans = [(key, -np.inf, np.inf)]
    if events is not None and len(events.windows) > 1:
        spans = [(f"{key}, {each.name}" if key else each.name, each.start, each.end) for each in events.windows]
    times = np.stack([measured.times(channel.name) for channel in measured.channels])
    half, found = 0.5 * np.array(measured.steps)[:, None], []
    for title, start, end in spans:
        inside = (times > start - half) & (times < end + half)
        rows = np.flatnonzero((inside & np.isfinite(measured.values)).any(axis=1))
        columns = np.flatnonzero(inside[rows].any(axis=0))
        if not len(rows):
            continue
        part = Measurements(
            tuple(measured.channels[row] for row in rows),
            tuple(measured.steps[row] for row in rows),
            np.where(inside, measured.values, np.nan)[np.ix_(rows, columns)],
            measured.description,
            tuple(measured.starts[row] + columns[0] * measured.steps[row] for row in rows),
            measured.axis,
            () if measured.is_history else np.array(measured.points, dtype=object)[columns],
        )
        found.append(Window(title, part, inside, rows, columns))
    return found


def draws_to_compare(posterior: Posterior, seconds: float | None = None) -> np.ndarray:
    """Draws of the prior (n, ndim), always the same ones: 100, or fewer if these take longer than ten seconds.

    A simulation takes `seconds`; by default the mean of those that the posterior has made, or else of the second draw.
    """
    try:
        draws = posterior.sample_prior(MOST_DRAWS, np.random.RandomState(1))
    except NotImplementedError:  # a prior without draws
        return np.empty((0, posterior.ndim))
    if seconds is None and posterior.report()["simulations"]:
        report = posterior.report()
        seconds = report["seconds"] / report["simulations"]
    for row in draws[:2] if seconds is None else ():  # the first one may compile
        start = time.perf_counter()
        posterior.likelihood.log_likelihood(row)
        seconds = time.perf_counter() - start
    return draws[: int(np.clip(SECONDS / max(seconds, 1e-6), FEWEST_DRAWS, MOST_DRAWS))]


def compare(
    likelihood: FELikelihood, points: np.ndarray, fitted: bool, key: str = "", samples: np.ndarray | None = None
) -> tuple[Compared, ...]:
    """Responses at points (n, ndim) beside the measurements of each event.

    The points are draws of the prior, after the fit if it is `fitted`. Failed simulations are left out; the result is
    empty if all fail, or the first one fails and is the fit. `key` is the name of the data set. Of modal data, modes at
    draws and `samples` are compared.
    """
    n = len(likelihood.model.parameter_names)
    if likelihood.is_modal:
        modal = _modes(likelihood, points[int(fitted) :], samples if fitted else None)
        no = np.empty((0, *likelihood.measurements.values.shape))
        return (Compared(key, likelihood.measurements, no, fitted, modal=modal),)
    try:
        batch = likelihood.simulate(points[:, :n])
    except (ChangedModel, StaleCache, TooManyFailures) as error:  # concerns the next sampling, not this result
        logger.warning("the fit is compared with no draws of the prior: %s", error)
        return ()
    good = [i for i, reason in enumerate(batch.reasons) if not reason]
    if not good or (fitted and good[0]):
        return ()
    responses = np.stack(
        [likelihood.measurements.values - likelihood.residuals_of(each) for each in batch.response[good]]
    )
    supports = len(getattr(likelihood.model, "supports", ()))
    return tuple(
        Compared(each.title, each.measurements, each.of(responses), fitted, supports)
        for each in windows_of(likelihood, key)
    )


def _modes(likelihood: Any, draws: np.ndarray, samples: np.ndarray | None) -> ModalFit:
    """Modes at draws of the prior, and at as many samples of the posterior (n, ndim)."""
    found: list[Any] = []
    if samples is not None:
        rows = np.linspace(0, len(samples) - 1, max(min(len(draws), len(samples)), 1)).round().astype(int)
        samples = samples[np.unique(rows)]
    for points in (draws, samples):
        try:
            found.append(likelihood.predict_modes(points) if points is not None and len(points) else None)
        except SimulationFailed as error:
            logger.warning("modes are not compared: %s", error)
            found.append(None)
    return ModalFit(likelihood, found[0], samples, found[1])


def fit_data_sets(run: FinishedRun) -> Fits:
    """Simulate two points of each data set, before and after the update, and compare them with the measurements.

    The result is empty for a posterior without a likelihood of this package.
    """
    if run.likelihood is None:
        return Fits((), "", "", 0, ())
    start, start_name = _before(run)
    names = f"before: {start_name}", f"after: {run.centre_name}"
    fits, failures, compared, simulations = [], [], [], run.likelihood.simulations
    for key, likelihood, columns in data_sets_of(run):
        point, n = run.centre[columns], len(likelihood.model.parameter_names)
        draws = draws_to_compare(run.posterior)[:, columns]
        compared += compare(likelihood, np.stack([point, *draws]), True, key, run.samples[:, columns])
        if likelihood.is_modal:
            fits.append(Fit(key, likelihood.measurements, {}, None, (), compared[-1].modal))
            continue
        batch = likelihood.simulate(np.stack([start[columns], point])[:, :n])
        residuals = {}
        for name, response, reason in zip(names, batch.response, batch.reasons, strict=True):
            if reason:
                failures.append(f"{key}{', ' if key else ''}{name}: the simulation failed ({reason})")
            else:
                residuals[name] = likelihood.residuals_of(response)
        fits += _split(likelihood, key, residuals, names, dict(zip(likelihood.parameter_names, point, strict=True)))
    made = run.likelihood.simulations - simulations
    return Fits(tuple(fits), *names, made, tuple(failures), tuple(compared))


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
    names: tuple[str, str],
    values: Mapping[str, float],
) -> list[Fit]:
    """One fit per event, from residuals (n_channels, n_samples) by name; `values` are the parameters of the fit."""
    sampled, checked, deviations, fits = sampled_noise(likelihood.noise), residuals.get(names[1]), None, []
    parameters = np.array([values.get(name, np.nan) for name in sampled.parameter_names])
    if not likelihood.measurements.is_history:  # samples without an order
        checked = None
        if hasattr(sampled, "standard_deviations") and np.isfinite(parameters).all():
            deviations = sampled.standard_deviations(parameters[None])[0][:, None]
    elif checked is not None and hasattr(sampled, "whitened"):
        checked = sampled.whitened(checked, likelihood.measurements.values - checked, parameters)
    fewer = getattr(sampled, "effective_samples", None)
    for window in windows_of(likelihood, key):
        part = window.measurements
        own = {name: window.of(each) for name, each in residuals.items()}
        errors = {name: relative_errors(each, part.values) for name, each in own.items()}
        missing, channels = np.full(part.n_channels, np.nan), []
        left = None if checked is None else window.of(checked)
        for row, channel in enumerate(part.channels):
            checks = None if left is None else _check(left[[row]])
            samples = int(np.isfinite(part.values[row]).sum())
            assumed = samples if fewer is None else min(np.broadcast_to(fewer, part.n_channels)[row], samples)
            before, after = (float(errors.get(name, missing)[row]) for name in names)
            channels.append(ChannelFit(channel, samples, before, after, checks, float(assumed)))
        responses = {name: part.values - each for name, each in own.items()}
        errors_of = None if deviations is None else deviations[window.rows]
        fits.append(Fit(window.title, part, responses, own.get(names[1]), tuple(channels), deviations=errors_of))
    return fits


def _check(residuals: np.ndarray) -> ResidualChecks | None:
    """The checks of one channel's residuals (1, n_samples); None for too few samples, or an exact fit."""
    try:
        return residual_checks(residuals)
    except ValueError:
        return None
