"""A rehearsal before a run: is the model what a sampler takes it for, and are its numerical errors small enough?

A model that returns something else the second time, or the same under every motion, ends in numbers that look like a
result. `rehearse` simulates a few times what a run would simulate thousands of times. The search for the best fit, at
which it halves step and mesh, also says which parameters the data determine.
"""

from collections.abc import Mapping
from contextlib import contextmanager, suppress
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ..emulation.modes import Mode, find_modes
from ..emulation.target import ResponseTarget
from ..information.identifiability import Identifiability, of_mode
from ..likelihood.likelihood import FELikelihood
from ..likelihood.posterior import Posterior
from ..noise.gaussian import GaussianNoise
from ..priors.distributions import HalfNormal
from ..signals.channels import Measurements
from ..signals.events import Events
from ..signals.records import Record
from ..simulation.model import SimulationBatch, simulate_batch
from ..units import from_si
from .finding import CARE, NOTE, WRONG, Finding, by_severity
from .fit import Compared, compare, draws_to_compare, fit_gate
from .steps import (
    NOTHING,
    UNREAD,
    find_discretisation_error,
    find_unread_motion,
    motions_to_replace,
    relative_difference,
    under,
)

__all__ = ["Rehearsal", "refuse_chance", "rehearse"]

EQUAL = 1e-9  # difference of two responses, relative to their norm, up to which they are the same
LATE_SHARE = 0.05  # of a motion, by which it is shifted
SECONDS = 60.0  # of the search for the best fit
MOST_SEARCHED = 150  # simulations of this search
LARGEST_PEAKS = {"motion": (3.0, "g"), "acceleration": (20.0, "g"), "displacement": (10.0, "m")}
SMALLEST_MOTION = 1e-6  # [g]


class Rehearsal(NamedTuple):
    """What a rehearsal has found, the most severe finding first."""

    findings: tuple[Finding, ...]
    simulations: int  # number of simulations made
    seconds: float  # per simulation [s]
    searched: float  # simulations of a search for the best fit from one start; NaN without one
    identifiability: Identifiability | None = None  # of this search; None without a fit, or for several data sets


class _Stage:
    """Runs, times and counts simulations of models other than the likelihood's."""

    def __init__(self, bar: tqdm) -> None:
        self.bar, self.made, self.seconds = bar, 0, np.inf

    def count(self, n: int) -> None:
        self.made += n
        self.bar.update(n)

    def simulate(self, model: Any, points: np.ndarray) -> SimulationBatch:
        """Responses at points (n, n_parameters)."""
        self.bar.total = max(self.bar.total or 0, self.bar.n + len(points))
        start = perf_counter()
        batch = simulate_batch(model, points)
        self.seconds = min(self.seconds, (perf_counter() - start) / len(points))  # the first one may compile
        self.count(len(points))
        return batch

    def run(self, model: Any, theta: np.ndarray) -> tuple[np.ndarray | None, str]:
        """A response (n_channels, n_steps), None if the simulation fails, and the reason."""
        batch = self.simulate(model, theta[None])
        return (None if batch.reasons[0] else batch.response[0]), batch.reasons[0]


def rehearse(posterior: Posterior, events: Mapping[str, Any] | None = None, *, progress: bool = False) -> Rehearsal:
    """Try the model of a posterior before a run.

    It simulates the mean of the prior twice, under twice the motion, a later motion and the motions of other events,
    and draws of the prior, which are compared with the measurements as in `fe_likelihoods.check_fit`. Where time
    permits (a minute), it searches for the best fit, and halves step and mesh there.

    Parameters
    ----------
    posterior : Posterior
    events : mapping of str to Record, optional
        Other motions that will be predicted, as for ``model.with_record``.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    Rehearsal

    Raises
    ------
    ValueError
        If the simulation at the mean of the prior fails.

    Examples
    --------
    >>> for finding in rehearse(posterior).findings:
    ...     print(finding.severity, finding)
    """
    found: list[Finding] = []
    single = isinstance(posterior.likelihood, FELikelihood)
    keys = getattr(posterior.likelihood, "likelihoods", {"": None})
    mean = posterior.prior.mean()
    with tqdm(total=0, disable=not progress, unit="simulation", desc="check") as bar, _announced(posterior, bar):
        stage, before = _Stage(bar), _made(posterior)
        seconds, searched, told = 0.0, np.nan, None
        compared: list[Compared] = []
        for key, (likelihood, columns) in zip(keys, posterior.likelihood.parts(), strict=True):
            model = likelihood.model
            theta = mean[columns][: len(model.parameter_names)]
            batch = likelihood.simulate(theta[None])
            if batch.reasons[0]:
                raise ValueError(
                    f"the simulation at the mean of the prior has failed: {batch.reasons[0]}; check model and priors"
                )
            response = batch.response[0]
            stage.seconds = np.inf
            again, reason = stage.run(model, theta)
            chance = _of_chance(response, again, reason)
            draws = draws_to_compare(posterior, stage.seconds)[:, columns]
            compared += compare(likelihood, draws, False, key)
            if not chance:  # generators of workers have moved on meanwhile
                later = simulate_batch(model, np.tile(theta, (2, 1)), likelihood.simulator.pool)
                stage.count(2)
                for again, reason in zip(later.response, later.reasons, strict=True):
                    chance = chance or _of_chance(response, None if reason else again, reason)
            # where responses differ by chance, other differences say nothing
            found += chance or _of_motions(stage, model, theta, response, events or {})
            found += _of_sizes(likelihood.measurements, model)
            seconds += stage.seconds
        if single and not any(each.severity == WRONG for each in found):
            refined, searched, told = _at_best_fit(stage, posterior, seconds)
            found += refined
        of_fit = fit_gate(compared)
        told = None if of_fit else told  # what the data tell is not known where they are wrong or out of reach
        found += of_fit
        simulations = stage.made + _made(posterior) - before
    return Rehearsal(by_severity(found), simulations, seconds, searched, told)


def _made(posterior: Posterior) -> int:
    """Simulations that a posterior has made, also for verification and with first parts of its records."""
    parts = [part for part, _ in posterior.likelihood.parts()]
    return sum(each.simulations + each.verifications for part in parts for each in (part, *part.shortened))


def refuse_chance(posterior: Posterior) -> None:
    """Simulate the mean of the prior again; ValueError if the responses differ. A failed simulation is no such case."""
    mean = posterior.prior.mean()
    for likelihood, columns in posterior.likelihood.parts():
        theta = mean[columns][: len(likelihood.model.parameter_names)]
        first = likelihood.simulate(theta[None])
        later = simulate_batch(likelihood.model, np.tile(theta, (2, 1)), likelihood.simulator.pool)
        for response, reason in zip(later.response, later.reasons, strict=True):
            for finding in [] if first.reasons[0] or reason else _of_chance(first.response[0], response, ""):
                raise ValueError(str(finding))


@contextmanager
def _announced(posterior: Posterior, bar: tqdm) -> Any:
    """Count the simulations of the posterior in the bar."""

    def update(n: float) -> None:
        bar.total = max(bar.total or 0, bar.n + n)
        bar.update(n)

    posterior.when_simulated(update)
    try:
        yield
    finally:
        posterior.when_simulated(None)


def _of_chance(response: np.ndarray, again: np.ndarray | None, reason: str) -> list[Finding]:
    """Whether a second simulation of the same parameters gives the same response."""
    action = (
        "Set the seeds of the model, give each simulation a folder of its own, and read no results of earlier runs."
    )
    if again is None:
        text = f"The first simulation at the mean of the prior succeeded, the second one failed: {reason}."
        return [Finding("The model is not repeatable", WRONG, text, action)]
    share = relative_difference(again - response, response)
    if share <= EQUAL:
        return []
    text = (
        f"Two simulations of the same parameters differ by {100.0 * share:.2g} % of the response: the likelihood of a "
        "point is another one each time, no sampler converges, and stored simulations are refused."
    )
    return [Finding("The model is not repeatable", WRONG, text, action)]


def _later(record: Record, steps: int) -> Record:
    """The record after a number of zeros, with its length."""
    zeros = np.zeros(steps)
    return Record(record.name, record.dt, np.concatenate([zeros, record.acceleration[:-steps]]), record.source)


def _of_motions(
    stage: _Stage, model: Any, theta: np.ndarray, response: np.ndarray, events: Mapping[str, Any]
) -> list[Finding]:
    """Whether the response follows the motion: twice the motion, a later motion, and other events."""
    motions = motions_to_replace(model)
    if not motions:
        return []
    found = find_unread_motion(model, theta, response, stage.simulate)
    if any(each.severity == WRONG for each in found):
        return found
    dt = motions[0].dt
    every = max(1, round(model.dt / dt))
    steps = every * max(1, round(LATE_SHARE * motions[0].n_steps / every))
    if not isinstance(motions[0], Events) and steps < motions[0].n_steps // 2:
        late, _ = stage.run(under(model, lambda each: _later(each, steps)), theta)
        k = steps // every
        if late is not None and late.shape == response.shape and k < response.shape[1]:
            moved = relative_difference(late[:, k:] - response[:, :-k], response[:, :-k])
            stayed = relative_difference(late - response, response)
            if moved > stayed:
                text = (
                    f"Under a motion that begins {steps * dt:.3g} s later, the response does not move with it "
                    f"(difference {100.0 * moved:.2g} %, and {100.0 * stayed:.2g} % to the response that stays)."
                )
                found.append(Finding("The response does not follow the motion", WRONG, text, UNREAD))
    for name, record in events.items():
        other = model.with_record(record)
        result, reason = stage.run(other, theta)
        if result is None:
            text = f"Event {name}: the simulation at the mean of the prior fails: {reason}."
            found.append(Finding("An event fails", CARE, text, "Check its motion and the steps of the model."))
            continue
        n = min(result.shape[1], response.shape[1])
        same = relative_difference(result[:, :n] - response[:, :n], response[:, :n]) <= NOTHING
        if same and other.fingerprint != model.fingerprint:
            text = f"Event {name} gives the same response as the motion of the calibration."
            found.append(Finding("An event changes nothing", WRONG, text, UNREAD))
        break  # one event suffices: they are all read in the same way
    return found


def _of_sizes(measured: Measurements, model: Any) -> list[Finding]:
    """Motions and measurements whose size is not plausible in SI units."""
    sizes = [
        (f"motion {each.name}", "motion", float(np.abs(each.acceleration).max())) for each in motions_to_replace(model)
    ]
    for channel, values in zip(measured.channels, measured.values, strict=True):
        if np.isfinite(values).any():
            sizes.append((f"channel {channel.name}", channel.dimension, float(np.nanmax(np.abs(values)))))
    found = []
    for name, kind, peak in sizes:
        largest, unit = LARGEST_PEAKS.get(kind, (np.inf, ""))
        shown = from_si(peak, unit).item() if unit else 0.0
        if shown > largest or (kind == "motion" and shown < SMALLEST_MOTION):
            text = f"The peak of {name} is {shown:.3g} {unit}."
            action = "Check the unit of its file. A number without a unit is in SI units (m, m/s²)."
            found.append(Finding("A size is not plausible", CARE, text, action))
    return found


def _at_best_fit(
    stage: _Stage, posterior: Posterior, seconds: float
) -> tuple[list[Finding], float, Identifiability | None]:
    """The error of step and mesh at the best fit, the simulations of the search for it, and what the data tell."""
    n = len(posterior.likelihood.model.parameter_names)
    limit = min(MOST_SEARCHED, SECONDS / max(seconds, 1e-6))
    if limit < 10 * (n + 1):
        text = f"The test takes about {15 * (n + 1)} simulations of {seconds:.2g} s."
        action = "The run makes it at its end. It costs less to know now: halve the step and the mesh at one point."
        return [Finding("Step and mesh were not tested", NOTE, text, action)], np.nan, None
    try:
        target, mode, searched = _search(stage, posterior, limit)
    except (ValueError, np.linalg.LinAlgError) as error:
        return [Finding("Step and mesh were not tested", NOTE, f"No fit was found: {error}.")], np.nan, None
    if mode is None:
        return [Finding("Step and mesh were not tested", NOTE, "No fit was found.")], searched, None
    factor = np.linalg.cholesky(mode.covariance)
    around = target.parameters(mode.coords + np.random.default_rng(1).standard_normal((400, len(factor))) @ factor.T)
    found = find_discretisation_error(target.posterior, mode.parameters, around.std(axis=0), stage.simulate)
    if not mode.converged:  # neither shares nor the cost of a search are known
        return found, np.nan, None
    told = None
    with suppress(ValueError):  # a parameter that its prior does not let vary there
        told = of_mode(target.posterior, mode)
    return found, searched, told


def _search(stage: _Stage, posterior: Posterior, limit: float) -> tuple[ResponseTarget, Mode | None, float]:
    """The best fit from the median of the prior, under white noise where the level follows the response."""
    likelihood, given = posterior.likelihood, posterior
    try:
        target = ResponseTarget(posterior)
    except ValueError:
        measured = likelihood.measurements
        likelihood = likelihood.with_noise(GaussianNoise(measured.channels))
        levels = dict(zip(likelihood.noise.parameter_names, measured.root_mean_squares, strict=True))
        known = posterior.prior.subset(likelihood.model.parameter_names).distributions
        posterior = Posterior(likelihood, known | {name: HalfNormal(float(rms)) for name, rms in levels.items()})
        target = ResponseTarget(posterior)
    search = find_modes(posterior, starts=1, max_simulations=limit)
    if posterior is not given:
        stage.count(_made(posterior))
    return target, search.modes[0] if search.modes else None, search.simulations
