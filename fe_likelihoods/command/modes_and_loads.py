"""Modes and load tests that a TOML file describes."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..modal.load_cases import LoadTest, read_load_test
from ..modal.modal_data import ModalData
from ..modal.modal_likelihood import ModalLikelihood
from ..modal.modal_readers import read_modal_data
from ..modal.mode_models import FunctionModes, modal_channels
from ..signals.channels import Channel
from .job import Job
from .keys import read_by_channel

__all__ = ["STRUCTURES", "modal_likelihood", "modes_of_user", "read_load_cases", "read_modes"]

STRUCTURES = "frame", "bridge deck"  # built-in ones that have modes


def read_modes(job: Job) -> tuple[ModalData, ModalData | None]:
    """The data of ``[modes]``, and the modes that are held out."""
    given = job.modes
    if given.n_modes is not None and job.kind in STRUCTURES:
        raise ValueError(f"n_modes: a {job.kind} has a mode for each storey or shape; leave it out")
    columns = given.columns or {}
    sensors = tuple(columns if given.variables else columns.values())
    data = read_modal_data(job.path("modes", "file", given.file), sensors, **given.given("unit", "variables"))
    data = replace(data, sensors=tuple(columns)) if columns and not given.variables else data
    data = replace(data, **given.given("temperatures"))
    data = data.mean() if given.mean else data
    errors = given.given("frequency_cv", "covariance", "shape_error")
    every = {  # errors of all modes of the file, which those held out have as well
        name: errors.pop(name)
        for name in ("frequency_cv", "shape_error")
        if name in errors and "covariance" not in errors and np.size(errors[name]) in (1, data.n_modes)
    }
    data = replace(data, **every)
    held_out = None if given.held_out is None else data.select(given.held_out)
    if both := set(given.held_out or ()) & set(given.modes or ()):
        raise ValueError(f"held_out: the modes {sorted(both)} are in modes too: leave them out of one of them")
    compared = given.modes or [each for each in data.mode_numbers if each not in (given.held_out or ())]
    if "covariance" in errors:  # instead of a column of the file
        errors = {"frequency_cv": None} | errors
    return replace(data.select(compared), **errors), held_out


def modes_of_user(job: Job, numbers: tuple[int, ...]) -> tuple[Callable | None, tuple[Channel, ...], int]:
    """What makes the model of a function (None for others), channels of the response, and its number of modes.

    `numbers` are those of the measured modes.
    """
    sensors = job.model.get("sensors")
    if sensors is None or "channels" in job.model:
        raise ValueError(
            f"{job.where('model')} sensors: with [modes], give sensors = {{top = 0}} with the rows of the matrices "
            "that the function returns, or a list of names, and no channels"
        )
    n_modes = job.modes.n_modes or 2 * max(numbers)

    def modes_of(function: Callable, names: Any, _: Any, **options: Any) -> FunctionModes:
        return FunctionModes(function, names, sensors, n_modes, **options)

    return modes_of if job.kind == "function" else None, modal_channels(tuple(sensors)), n_modes


def modal_likelihood(
    job: Job, model: Any, data: ModalData, held_out: ModalData | None, pool: Any, cache: SimulationCache | None
) -> ModalLikelihood:
    """The likelihood of ``[modes]``."""
    unknown, options = job.modes.unknown_errors, job.modes.given("close", "student_t")
    return ModalLikelihood(model, data, unknown, unknown, pool, cache=cache, held_out=held_out, **options)


def read_load_cases(job: Job, channels: tuple[Channel, ...]) -> LoadTest:
    """The data of ``[load_test]``."""
    errors = read_by_channel(job.load_test.errors or {}, channels, "errors")
    path = job.path("load_test", "file", job.load_test.file)
    test = read_load_test(path, channels, errors=errors, **job.load_test.given("columns", "units", "cases"))
    if not np.isfinite(test.values).any():
        raise ValueError(f"file: {path} has no value")
    for key, value in (("dt", 1.0), ("n_steps", n := len(test.cases))):
        if job.model.get(key, value) != value:
            raise ValueError(f"{job.where('model')} {key}: a load test has {n} load cases and no time: leave it out")
    return test
