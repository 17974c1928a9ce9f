"""Predictions of other events: base motions that a TOML file lists as ``[events.NAME]``."""

import logging
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..checks.finding import labelled
from ..likelihood.posterior import Posterior
from ..noise.protocol import follows_response
from ..prediction.prediction import Prediction
from ..reporting.other_events import OtherEvent, describe_event
from ..signals.channels import Channel, Measurements
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .data import read_base_motion, read_measured
from .job import Job
from .models import Problem, reduce_data
from .results import write_csv

__all__ = [
    "Event",
    "describe_events",
    "predict_events",
    "prediction_options",
    "propagate_quietly",
    "read_events",
    "write_events",
]

logger = logging.getLogger(__name__)

_STATES = ("virgin", "end")
_ENDS = (0.05, 0.5, 0.95)  # quantiles that tables and scores need


class Event(NamedTuple):
    """An event to predict."""

    name: str
    record: Record  # base motion as it is used
    measured: Measurements | None  # response, if it is to be compared
    options: dict[str, Any]  # state at the beginning and pause before it, for `propagate`


def prediction_options(job: Job) -> dict[str, Any]:
    """Noise, quantiles and seed of predictions, for `fe_likelihoods.propagate`."""
    return {
        "noise": job.prediction.get("noise", False),
        "quantiles": tuple(job.prediction.get("quantiles", (0.05, 0.5, 0.95))),
        "seed": job.sampler.get("seed", 1),
    }


def read_events(job: Job, problem: Problem) -> tuple[Event, ...]:
    """Read the records and measurements of all events.

    ValueError, which names section and key, if a file, a key or a value is wrong, or the model cannot have another
    motion.
    """
    return tuple(_read_event(job, problem, name) for name in job.events)


def _read_event(job: Job, problem: Problem, name: str) -> Event:
    given, own = job.events[name], job.of_event(name)
    where = own.where("record")
    model = problem.posterior.likelihood.model
    if not hasattr(model, "with_record"):
        raise ValueError(f"{where} a model of kind {job.kind} without [record] has one excitation: leave this out")
    if "file" not in given and "bundled" not in given:
        raise ValueError(f"{where} file: this key is missing; it is the base motion of the event")
    state = given.get("from_state", "virgin")
    if state not in _STATES:
        raise ValueError(f"{where} from_state: expected one of {', '.join(_STATES)}; got {state!r}")
    record = read_base_motion(own)
    measured = _measured(own, model.channels, record) if own.measurements else None
    record, measured = reduce_data(own, record, measured)
    if not math.isclose(record.dt, problem.record.dt, rel_tol=1e-9):  # the step that the model was calibrated with
        record = record.resample(problem.record.dt)
        if measured is not None and measured.end > record.time[-1]:  # by less than a step of the model
            measured = measured.trim(0.0, record.time[-1])
    options = {"from_state": state} | ({"rest": given["rest"]} if "rest" in given else {})
    return Event(name, record, measured, options)


def _measured(own: Job, channels: tuple[Channel, ...], record: Record) -> Measurements:
    """The measured response; messages name the key of the event."""
    try:
        return read_measured(own, channels, record)
    except ValueError as error:
        raise ValueError(str(error).replace("] file: ", "] measured: ", 1)) from error


def propagate_quietly(*arguments: Any, **options: Any) -> Prediction | dict[str, Prediction]:
    """The result of `propagate`; its warnings are findings of the result, and other warnings are given afterwards."""
    from ..prediction.propagation import propagate

    kept: set[str] = set()
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = propagate(*arguments, **options)
            results = found.values() if isinstance(found, Mapping) else [found]
            kept.update(finding.message for each in results for finding in each.findings)
    finally:  # also where all simulations have failed
        shown: dict[Any, Any] = {}  # equal ones of the same line once, as without this function
        for each in caught:
            if str(each.message) not in kept:
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno, registry=shown)
    return found


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
            found[event.name] = _predict_event(job, event, problem.posterior, samples, progress)
        except SimulationFailed as error:
            logger.warning("event %s is left out: %s", event.name, error)
            found[event.name] = error
    return found


def _predict_event(
    job: Job, event: Event, posterior: Posterior, samples: np.ndarray, progress: bool
) -> dict[str, Prediction]:
    from ..prediction.quantities import peak

    channels = posterior.likelihood.model.channels
    options = prediction_options(job) | event.options
    options["quantiles"] = tuple(sorted({*options["quantiles"], *_ENDS}))
    if event.measured is not None:  # measurements contain noise
        options["noise"] = job.prediction.get("noise", True)
    quantities = {"histories": None, "peaks": [peak(channel.name) for channel in channels]}
    noises = dict.fromkeys(quantities, options.pop("noise"))
    if noises["peaks"] and follows_response(posterior.likelihood.noise):
        noises["peaks"] = "model"  # errors that are independent from sample to sample raise the largest value
    found: dict[str, Prediction] = {}
    try:
        # The second kind finds all responses in the cache; with `[budget] cache = false` it simulates them again.
        for noise in dict.fromkeys(noises.values()):
            found |= propagate_quietly(
                posterior,
                samples,
                record=event.record,
                quantity={name: quantities[name] for name in quantities if noises[name] == noise},
                cache=posterior.likelihood.simulator.cache,
                noise=noise,
                **options,
                progress=progress,
            )
        return found
    except ValueError as error:
        raise ValueError(f"{job.file.name}: [events.{event.name}] {error}") from error


def describe_events(
    events: tuple[Event, ...], predictions: Mapping[str, dict[str, Prediction] | SimulationFailed]
) -> tuple[OtherEvent, ...]:
    """Numbers, scores and sentences of the events, including events whose simulations have all failed."""
    return tuple(
        describe_event(event.name, predictions[event.name], event.measured)
        for event in events
        if event.name in predictions
    )


def write_events(folder: Path, events: tuple[Event, ...], described: tuple[OtherEvent, ...]) -> tuple[str, ...]:
    """Write ``event-NAME.txt``, ``.csv`` and ``.png`` of each event that has a prediction; returns their names.

    The events were described by `describe_events`.
    """
    files: list[str] = []
    by_name = {event.name: event for event in events}
    for found in described:
        if not found.predictions:
            continue
        names = tuple(f"event-{found.name}.{ending}" for ending in ("txt", "csv", "png"))
        _write_event([folder / name for name in names], by_name[found.name], found)
        files += names
    return tuple(files)


def _write_event(paths: list[Path], event: Event, found: OtherEvent) -> None:
    from ..plots.predictions import plot_bands
    from ..reporting.pictures import save_picture
    from ..text_tables import text_table

    steps = f"{event.record.n_steps} samples at {event.record.dt:g} s"
    lines = [f"Event {event.name}: {event.record.name}, {steps}", found.sentence]
    lines += labelled(found.findings)
    if found.values:
        lines += ["", "Peaks against the measurements", *map(str, found.values)]
    else:
        rows = [(row.name, row.unit, *(f"{value:.3g}" for value in (row.median, *row.ends))) for row in found.numbers]
        lines += ["", "Peaks", text_table([("quantity", "unit", "median", "5 %", "95 %"), *rows])]
    if found.histories:
        lines += ["", "Histories against the measurements", *map(str, found.histories)]
    paths[0].write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = []
    for channel, row in zip(found.predictions["peaks"].channels, found.numbers, strict=True):
        values = {"q05": row.ends[0], "q25": row.quartiles[0], "median": row.median}
        values |= {"q75": row.quartiles[1], "q95": row.ends[1]}
        if event.measured is not None:
            values |= {"measured": row.measured, "pit": row.pit}
        rows.append({"channel": channel.name, "unit": row.unit} | values)
    write_csv(paths[1], rows)
    save_picture(plot_bands(found.predictions["histories"], event.measured), paths[2])
