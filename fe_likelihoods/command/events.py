"""Predictions of other events: base motions that a TOML file lists as ``[events.NAME]``."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..prediction.prediction import Prediction
from ..prediction.score_tables import QuantityScores
from ..probability.posterior import Posterior
from ..signals.channels import Channel, Measurements
from ..signals.records import Record
from ..units import from_si
from .data import read_base_motion, read_measured
from .job import Job
from .models import Problem, reduce_data
from .results import write_csv

__all__ = ["Event", "predict_events", "prediction_options", "read_events"]

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


def predict_events(
    job: Job, events: tuple[Event, ...], posterior: Posterior, samples: np.ndarray, folder: Path, progress: bool
) -> tuple[str, ...]:
    """Predict the response to other base motions, one simulation per sample and event; write tables and pictures.

    Parameters
    ----------
    job : Job
    events : tuple of Event
    posterior : Posterior
    samples : (n, ndim) ndarray
        Samples of the posterior.
    folder : Path
    progress : bool
        Whether to show progress bars.

    Returns
    -------
    tuple of str
        Names of the files: ``event-NAME.txt``, ``event-NAME.csv`` and ``event-NAME.png`` of each event.
    """
    if not len(samples):
        return ()
    return tuple(file for event in events for file in _predict_event(job, event, posterior, samples, folder, progress))


def _predict_event(
    job: Job, event: Event, posterior: Posterior, samples: np.ndarray, folder: Path, progress: bool
) -> tuple[str, ...]:
    from ..plots.predictions import plot_bands
    from ..prediction.propagation import propagate
    from ..prediction.quantities import peak

    channels = posterior.likelihood.model.channels
    options = prediction_options(job) | event.options
    options["quantiles"] = tuple(sorted({*options["quantiles"], *_ENDS}))
    if event.measured is not None:  # measurements contain noise
        options["noise"] = job.prediction.get("noise", True)
    try:
        found = propagate(
            posterior,
            samples,
            record=event.record,
            quantity={"histories": None, "peaks": [peak(channel.name) for channel in channels]},
            **options,
            progress=progress,
        )
    except ValueError as error:
        raise ValueError(f"{job.file.name}: [events.{event.name}] {error}") from error
    histories, peaks = found["histories"], found["peaks"]
    steps = f"{event.record.n_steps} samples at {event.record.dt:g} s"
    lines = [f"Event {event.name}: {event.record.name}, {steps}", f"Prediction from {histories.n_samples} samples"]
    lines[-1] += ", with the noise" if histories.noise else ", without the noise of measurements"
    if histories.n_failed:
        lines += [f"{count} samples left out: {reason}" for reason, count in histories.failure_reasons.items()]
    scores = None if event.measured is None else peaks.score(event.measured)
    rows = _peak_rows(peaks, scores)
    lines += ["", "Peaks"]
    for row in rows:
        ends = f"{row['q05']:.3g} to {row['q95']:.3g}"
        lines.append(f"  {row['channel']} [{row['unit']}]: median {row['median']:.3g}, 90 % between {ends}")
    if scores is not None:
        lines += ["", "Peaks against the measurements", str(scores)]
        lines += ["", "Histories against the measurements", str(histories.score(event.measured))]
    names = tuple(f"event-{event.name}.{ending}" for ending in ("txt", "csv", "png"))
    (folder / names[0]).write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_csv(folder / names[1], rows)
    plot_bands(histories, event.measured).savefig(folder / names[2], dpi=150)
    return names


def _peak_rows(peaks: Prediction, scores: QuantityScores | None) -> list[dict[str, Any]]:
    """Predicted and measured peaks in display units, one row per channel."""
    rows = []
    for k, channel in enumerate(peaks.channels):
        low, median, high = (from_si(peaks.quantile(p)[k], channel.unit).item() for p in _ENDS)
        row = {"channel": channel.name, "unit": channel.unit, "q05": low, "median": median, "q95": high}
        if scores is not None:
            row |= {"measured": from_si(scores.measured[k], channel.unit).item(), "pit": float(scores.pit[k])}
        rows.append(row)
    return rows
