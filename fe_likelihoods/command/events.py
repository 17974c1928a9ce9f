"""Predictions of other events: base motions that a TOML file lists as ``[events.NAME]``."""

import contextlib
import logging
import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..prediction.prediction import Prediction
from ..probability.posterior import Posterior
from ..reporting.other_events import OtherEvent, describe_event
from ..signals.channels import Channel, Measurements
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .data import read_base_motion, read_measured
from .hints import in_toml_terms
from .job import Job
from .models import Problem, reduce_data
from .results import write_csv

__all__ = [
    "Event",
    "describe_events",
    "predict_events",
    "prediction_options",
    "read_events",
    "without_warnings",
    "write_events",
]

logger = logging.getLogger(__name__)

_STATES = ("virgin", "end")
_ENDS = (0.05, 0.5, 0.95)  # quantiles that tables and scores need


class Event(NamedTuple):
    """An event to predict.

    Attributes
    ----------
    name : str
    record : Record
        The base motion as it is used.
    measured : Measurements or None
        The measured response, if it is to be compared.
    options : dict
        State at the beginning and pause before it, for `fe_likelihoods.propagate`.
    """

    name: str
    record: Record
    measured: Measurements | None
    options: dict[str, Any]


def prediction_options(job: Job) -> dict[str, Any]:
    """Noise, quantiles and seed of predictions, for `fe_likelihoods.propagate`."""
    return {
        "noise": job.prediction.get("noise", False),
        "quantiles": tuple(job.prediction.get("quantiles", (0.05, 0.5, 0.95))),
        "seed": job.sampler.get("seed", 1),
    }


def read_events(job: Job, problem: Problem) -> tuple[Event, ...]:
    """Read the records and measurements of all events.

    Raises
    ------
    ValueError
        If a file, a key or a value is wrong, or the model cannot have another base motion; the message names section
        and key.
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
    options = {"from_state": state} | ({"rest": given["rest"]} if "rest" in given else {})
    return Event(name, record, measured, options)


def _measured(own: Job, channels: tuple[Channel, ...], record: Record) -> Measurements:
    """The measured response; messages name the key of the event."""
    try:
        return read_measured(own, channels, record)
    except ValueError as error:
        raise ValueError(str(error).replace("] file: ", "] measured: ", 1)) from error


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Without the warnings of `propagate`, which its result keeps as remarks: the command says and writes these."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def predict_events(
    job: Job, events: tuple[Event, ...], problem: Problem, samples: np.ndarray, progress: bool
) -> dict[str, dict[str, Prediction]]:
    """Predict histories and peaks under other base motions, one simulation per sample and event.

    Responses are stored in the cache of the likelihood, so that events whose prediction was interrupted go on there.

    Parameters
    ----------
    job : Job
    events : tuple of Event
    problem : Problem
    samples : (n, ndim) ndarray
        Samples of the posterior.
    progress : bool
        Whether to show progress bars.

    Returns
    -------
    dict of str to dict of str to Prediction
        "histories" and "peaks" of each event by its name, but of those of which all simulations fail.
    """
    found = {}
    for event in events if len(samples) else ():
        try:
            found[event.name] = _predict_event(job, event, problem.posterior, samples, progress)
        except SimulationFailed as error:
            logger.warning("event %s is left out: %s", event.name, error)
    return found


def _predict_event(
    job: Job, event: Event, posterior: Posterior, samples: np.ndarray, progress: bool
) -> dict[str, Prediction]:
    from ..prediction.propagation import propagate
    from ..prediction.quantities import peak

    channels = posterior.likelihood.model.channels
    options = prediction_options(job) | event.options
    options["quantiles"] = tuple(sorted({*options["quantiles"], *_ENDS}))
    if event.measured is not None:  # measurements contain noise
        options["noise"] = job.prediction.get("noise", True)
    try:
        with without_warnings():
            return propagate(
                posterior,
                samples,
                record=event.record,
                quantity={"histories": None, "peaks": [peak(channel.name) for channel in channels]},
                cache=posterior.likelihood.cache,
                **options,
                progress=progress,
            )
    except ValueError as error:
        raise ValueError(f"{job.file.name}: [events.{event.name}] {error}") from error


def describe_events(
    events: tuple[Event, ...], predictions: Mapping[str, dict[str, Prediction]]
) -> tuple[OtherEvent, ...]:
    """Numbers, scores and sentences of the events that were predicted."""
    return tuple(
        describe_event(event.name, predictions[event.name], event.measured)
        for event in events
        if event.name in predictions
    )


def write_events(
    folder: Path,
    events: tuple[Event, ...],
    predictions: Mapping[str, dict[str, Prediction]],
    described: tuple[OtherEvent, ...],
) -> tuple[str, ...]:
    """Write tables and pictures of predicted events, which `describe_events` has described.

    Returns
    -------
    tuple of str
        Names of the files: ``event-NAME.txt``, ``event-NAME.csv`` and ``event-NAME.png`` of each event.
    """
    files: list[str] = []
    by_name = {event.name: event for event in events}
    for found in described:
        names = tuple(f"event-{found.name}.{ending}" for ending in ("txt", "csv", "png"))
        _write_event([folder / name for name in names], by_name[found.name], predictions[found.name], found)
        files += names
    return tuple(files)


def _write_event(paths: list[Path], event: Event, predictions: dict[str, Prediction], found: OtherEvent) -> None:
    from ..plots.predictions import plot_bands
    from ..reporting.other_events import describe_event
    from ..text_tables import text_table

    found = describe_event(event.name, predictions, event.measured)
    steps = f"{event.record.n_steps} samples at {event.record.dt:g} s"
    lines = [f"Event {event.name}: {event.record.name}, {steps}", found.sentence]
    lines += [f"CAUTION: {remark}" for remark in found.remarks]
    if found.values:
        lines += ["", "Peaks against the measurements", *map(str, found.values)]
    else:
        rows = [(row.name, row.unit, *(f"{value:.3g}" for value in (row.median, *row.ends))) for row in found.numbers]
        lines += ["", "Peaks", text_table([("quantity", "unit", "median", "5 %", "95 %"), *rows])]
    if found.histories:
        lines += ["", "Histories against the measurements", *map(str, found.histories)]
    paths[0].write_text(in_toml_terms("\n".join(lines)) + "\n", encoding="utf-8")
    rows = []
    for channel, row in zip(predictions["peaks"].channels, found.numbers, strict=True):
        values = {"q05": row.ends[0], "q25": row.quartiles[0], "median": row.median}
        values |= {"q75": row.quartiles[1], "q95": row.ends[1]}
        if event.measured is not None:
            values |= {"measured": row.measured, "pit": row.pit}
        rows.append({"channel": channel.name, "unit": row.unit} | values)
    write_csv(paths[1], rows)
    plot_bands(predictions["histories"], event.measured).savefig(paths[2], dpi=150)
