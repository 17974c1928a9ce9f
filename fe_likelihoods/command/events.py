"""Predictions of other events: base motions that a TOML file lists as ``[events.NAME]``."""

import math
import warnings
from typing import Any, NamedTuple

import numpy as np

from ..checks.finding import FindingWarning
from ..likelihood.likelihood import FELikelihood
from ..noise.protocol import follows_response
from ..prediction.prediction import Prediction
from ..signals.channels import Measurements
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .data import read_base_motion, read_measured, reduce_data
from .job import Job
from .models import Problem

__all__ = ["Event", "predict_events", "predict_quietly", "read_events"]


class Event(NamedTuple):
    """An event to predict."""

    name: str
    record: Record  # base motion as it is used
    measured: Measurements | None  # response, if it is to be compared
    options: dict[str, Any]  # state at the beginning and pause before it, for `propagate`


def _histories_of(problem: Problem) -> tuple[FELikelihood, dict[str, str]]:
    """The likelihood of the measured histories, and its name for `propagate` if there are other data sets."""
    likelihood = problem.posterior.likelihood
    parts = likelihood.likelihoods
    return (likelihood, {}) if "" in parts else (parts["measurements"], {"part": "measurements"})


def read_events(job: Job, problem: Problem) -> tuple[Event, ...]:
    """Read the records and measurements of all events.

    ValueError, which names section and key, if a file, a key or a value is wrong, or the model cannot have another
    motion.
    """
    return tuple(_read_event(job.data_sets()["measurements"], problem, name) for name in job.events)


def _read_event(job: Job, problem: Problem, name: str) -> Event:
    given, own = job.events[name], job.of_event(name)
    where, model = own.where("record"), _histories_of(problem)[0].model
    if not hasattr(model, "with_record"):
        raise ValueError(f"{where} a model of kind {job.kind} without [record] has one excitation: leave this out")
    record = read_base_motion(own)
    try:
        measured = None if own.measurements is None else read_measured(own, model.channels, record)
    except ValueError as error:
        raise ValueError(str(error).replace("] file: ", "] measured: ", 1)) from error
    record, measured = reduce_data(own, record, measured)
    if not math.isclose(record.dt, problem.record.dt, rel_tol=1e-9):  # the step that the model was calibrated with
        record = record.resample(problem.record.dt)
        if measured is not None and measured.end > record.time[-1]:  # by less than a step of the model
            measured = measured.trim(0.0, record.time[-1])
    return Event(name, record, measured, given.given("from_state", "rest"))


def predict_quietly(job: Job, problem: Problem, samples: np.ndarray, **options: Any) -> Any:
    """The result of `propagate` with the settings of a file; its findings are not warned of as well."""
    from ..prediction.propagation import propagate

    likelihood, part = _histories_of(problem)
    usual = {"noise": bool(job.prediction.noise), "seed": job.sampler.seed, "cache": likelihood.simulator.cache}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FindingWarning)
        return propagate(problem.posterior, samples, **usual | part | options)


def predict_events(
    job: Job, events: tuple[Event, ...], problem: Problem, samples: np.ndarray, progress: bool
) -> dict[str, dict[str, Prediction] | SimulationFailed]:
    """Predict histories and peaks at samples (n, ndim) under other base motions; a cache serves both kinds.

    Peaks with a noise in shares of the response have the model error (``noise="model"`` of `propagate`), because noise
    that is independent from sample to sample makes them too large. Responses are stored in the likelihood's cache, so
    that an interrupted prediction continues there. Returns "histories" and "peaks" of each event by its name, or the
    error that says that all its simulations have failed.
    """
    found = {}
    for event in events if len(samples) else ():
        try:
            found[event.name] = job.located(
                f"events.{event.name}", _predict_event, job, event, problem, samples, progress
            )
        except SimulationFailed as error:
            found[event.name] = error
    return found


def _predict_event(
    job: Job, event: Event, problem: Problem, samples: np.ndarray, progress: bool
) -> dict[str, Prediction]:
    from ..prediction.quantities import peak

    likelihood, wanted = _histories_of(problem)[0], job.prediction.noise
    noise: Any = event.measured is not None if wanted is None else wanted  # measurements contain noise
    options = event.options | {"record": event.record, "progress": progress}
    quantities = {"histories": None, "peaks": [peak(channel.name) for channel in likelihood.model.channels]}
    if not (noise and follows_response(likelihood.noise)):
        return predict_quietly(job, problem, samples, quantity=quantities, noise=noise, **options)
    found: dict[str, Prediction] = {}
    # the second kind finds all responses in the cache; with `[budget] cache = false` it simulates them again
    for kind, (name, quantity) in zip((noise, "model"), quantities.items(), strict=True):
        found |= predict_quietly(job, problem, samples, quantity={name: quantity}, noise=kind, **options)
    return found
