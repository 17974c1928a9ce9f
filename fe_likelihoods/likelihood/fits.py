"""Measurements of each data set and event beside responses: before and after an update, and at draws of the prior."""

import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from ..cache.verification import StaleCache
from ..noise.marginal import sampled_noise
from ..noise.residuals import ResidualChecks, residual_checks
from ..signals.channels import Channel, Measurements, relative_errors
from ..signals.records import find_events
from ..simulation.failure_reasons import ChangedModel
from ..simulation.model import SimulationFailed
from ..text_tables import listed
from .likelihood import FELikelihood
from .posterior import Posterior

logger = logging.getLogger(__name__)

FEWEST_DRAWS, MOST_DRAWS, SECONDS = 5, 100, 10.0  # of the prior, and of their simulations


class ModalFit(NamedTuple):
    """Measured and computed modes, `PredictedModes` of `fe_likelihoods.modal`."""

    likelihood: Any
    draws: Any  # modes at draws of the prior; None if none can be simulated
    centre: np.ndarray | None = None  # of the samples of the posterior (ndim,); None before a run
    samples: Any = None  # modes at samples, as `predict_modes` takes them
    held_out: Any = None  # modes that were measured, but not compared, at these samples


class ChannelFit(NamedTuple):
    """How well one channel of one event is reproduced, by relative root mean square errors [-]."""

    channel: Channel
    samples: int  # that are compared
    before: float  # NaN where there is no simulation
    after: float  # NaN where there is no simulation
    checks: ResidualChecks | None  # of the whitened residuals; None where they cannot be checked
    assumed: float  # independent samples that the noise assumes


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Measurements of one data set or event, and the responses to them [SI], NaN outside of the event."""

    title: str  # name of the data set and of the event; empty if there is one only
    measurements: Measurements
    draws: np.ndarray  # (n, n_channels, n_samples) at draws of the prior; of modes these draws
    after: np.ndarray | None = None  # (n_channels, n_samples) of the fit
    before: np.ndarray | None = None  # the same at the mean of the prior
    white: np.ndarray | None = None  # residuals of the fit as the noise whitens them; None without time
    assumed: np.ndarray | None = None  # (n_channels,) independent samples that the noise assumes at most
    deviations: np.ndarray | None = None  # (n_channels, 1) of errors without time, where they are stated
    modal: ModalFit | None = None  # modes, instead of responses

    @property
    def residuals(self) -> np.ndarray | None:
        """Measured minus simulated (n_channels, n_samples) of the fit."""
        return None if self.after is None else self.measurements.values - self.after

    @cached_property
    def channels(self) -> tuple[ChannelFit, ...]:
        """The table of the fit; none of modes."""
        found = []
        for row, channel in enumerate(() if self.modal else self.measurements.channels):
            measured = self.measurements.values[row]
            n = int(np.isfinite(measured).sum())
            errors = (
                np.nan if each is None else float(relative_errors(measured - each[row], measured))
                for each in (self.before, self.after)
            )
            checks = None if self.white is None else checks_of(self.white[row])
            worth = n if self.assumed is None else min(n, float(self.assumed[row]))
            found.append(ChannelFit(channel, n, *errors, checks, worth))
        return tuple(found)

    def where(self, *names: str) -> str:
        """Names of channels, and the event that they are of."""
        return f"{listed(names)}{f' ({self.title})' if self.title else ''}"


def checks_of(residuals: np.ndarray) -> ResidualChecks | None:
    """The checks of one channel's residuals (n_samples,); None for too few samples, or an exact fit."""
    with suppress(ValueError):
        return residual_checks(residuals[None])


def data_sets_of(posterior: Any) -> list[tuple[str, FELikelihood, np.ndarray]]:
    """Name (empty if there is one only), likelihood and columns of the parameters of each data set."""
    likelihood = posterior.likelihood
    return [(key, *part) for key, part in zip(likelihood.likelihoods, likelihood.data_sets(), strict=True)]


def draws_to_compare(posterior: Posterior) -> np.ndarray:
    """Draws of the prior (n, ndim), always the same; none of a prior without draws."""
    try:
        return posterior.sample_prior(MOST_DRAWS, np.random.RandomState(1))
    except NotImplementedError:
        return np.empty((0, posterior.ndim))


def compare(posterior: Posterior, samples: np.ndarray | None = None, centre: np.ndarray | None = None) -> list[Fit]:
    """Data sets and events at draws of the prior, after a run at its samples (n, ndim), their centre, and before."""
    draws, start, fits = draws_to_compare(posterior), posterior.prior.mean(), list[Fit]()
    for key, likelihood, columns in data_sets_of(posterior):
        few, residuals = _simulate(likelihood, draws[:, columns])
        of, at = (None if each is None else each[..., columns] for each in (samples, centre))
        if likelihood.is_modal:
            modal = _modes(likelihood, few, of, at)
            fits.append(Fit(key, likelihood.measurements, few, modal=modal))
        else:
            points = {} if at is None else {"before": start[columns], "after": at}
            fits += _responses(likelihood, key, residuals, points)
    return fits


def _simulate(likelihood: FELikelihood, draws: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """The draws that ten seconds allow, and residuals (n_channels, n_samples) of those that succeed."""
    good, made, begin = list[np.ndarray](), 0, perf_counter()
    try:
        while made < len(draws) and (not made or perf_counter() - begin < SECONDS):
            more = max(made, FEWEST_DRAWS, getattr(likelihood.simulator.pool, "n_workers", None) or 1)
            batch = likelihood.simulate(draws[made : made + more, : len(likelihood.model.parameter_names)])
            made = min(made + more, len(draws))
            if not likelihood.is_modal:
                good += [likelihood.residuals_of(batch.response[k]) for k, why in enumerate(batch.reasons) if not why]
    except (ChangedModel, StaleCache) as error:  # concerns the next sampling, not this result
        logger.warning("the fit is compared with no draws of the prior: %s", error)
    return draws[:made], good


def _responses(likelihood: FELikelihood, key: str, good: list, points: dict[str, np.ndarray]) -> Iterator[Fit]:
    """The fit of each event, from residuals at draws of the prior, and at points (ndim,) by their name in `Fit`."""
    measured, noise = likelihood.measurements, sampled_noise(likelihood.noise)
    found = {"draws": measured.values - np.reshape(good, (-1, *measured.values.shape))}
    for name, point in points.items():
        batch = likelihood.simulate(point[None, : len(likelihood.model.parameter_names)])
        if not batch.reasons[0]:
            found[name] = measured.values - likelihood.residuals_of(batch.response[0])
    by_channel, assumed = dict[str, np.ndarray](), getattr(noise, "effective_samples", None)
    if assumed is not None:
        by_channel["assumed"] = np.broadcast_to(assumed, measured.n_channels)
    if measured.is_history and "after" in found:
        found["white"] = measured.values - found["after"]
        if hasattr(noise, "whitened"):
            values = dict(zip(likelihood.parameter_names, points["after"], strict=True))
            theta = np.array([values.get(name, np.nan) for name in noise.parameter_names])
            found["white"] = noise.whitened(found["white"], found["after"], theta)
    elif not measured.is_history and not noise.parameter_names and hasattr(noise, "standard_deviations"):
        by_channel["deviations"] = noise.standard_deviations(np.zeros((1, 0)))[0][:, None]
    for title, part, rows, inside in _events(likelihood, key):
        cut = {name: each[rows] for name, each in by_channel.items()}
        for name, each in found.items():
            cut[name] = np.where(inside, each, np.nan)[..., rows, :][..., inside[rows].any(axis=0)]
        yield Fit(title, part, **cut)


def _events(likelihood: FELikelihood, key: str) -> Iterator[tuple[str, Measurements, np.ndarray, np.ndarray]]:
    """Name, measurements and rows of channels of each event, and which samples (n_channels, n_samples) are in it."""
    measured, events = likelihood.measurements, find_events(likelihood.model)
    times = np.stack([measured.times(channel.name) for channel in measured.channels])
    half = 0.5 * np.array(measured.steps)[:, None]
    windows = events.windows if events is not None and len(events.windows) > 1 else [None]
    for each in windows:
        inside = np.ones(times.shape, bool) if each is None else (times > each.start - half) & (times < each.end + half)
        rows = np.flatnonzero((inside & np.isfinite(measured.values)).any(axis=1))
        if len(rows):
            columns = np.flatnonzero(inside[rows].any(axis=0))
            part = replace(
                measured,
                channels=tuple(measured.channels[row] for row in rows),
                dt=tuple(measured.steps[row] for row in rows),
                values=np.where(inside, measured.values, np.nan)[np.ix_(rows, columns)],
                start=tuple(measured.starts[row] + columns[0] * measured.steps[row] for row in rows),
                points=() if measured.is_history else np.array(measured.points, dtype=object)[columns],
            )
            yield ", ".join(filter(None, (key, "" if each is None else each.name))), part, rows, inside


def _modes(likelihood: Any, draws: np.ndarray, samples: np.ndarray | None, centre: np.ndarray | None) -> ModalFit:
    """Modes at draws of the prior, and at four times as many samples of the posterior (n, ndim)."""

    def predicted(points: np.ndarray) -> Any:
        try:
            return likelihood.predict_modes(points, most=4 * max(len(draws), FEWEST_DRAWS))
        except (SimulationFailed, ChangedModel, StaleCache) as error:
            logger.warning("modes are not compared: %s", error)

    prior, after = (None if each is None or not len(each) else predicted(each) for each in (draws, samples))
    held_out = None if None in (after, likelihood.held_out) else after.against(likelihood.held_out)
    return ModalFit(likelihood, prior, centre, after, held_out)
