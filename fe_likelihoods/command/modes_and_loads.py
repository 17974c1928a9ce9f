"""Likelihoods of modes and load tests that a TOML file describes."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..cache.simulation_cache import SimulationCache
from ..likelihood.likelihood import FELikelihood
from ..modal.load_cases import LoadTest, read_load_test
from ..modal.modal_data import ModalData
from ..modal.modal_likelihood import ModalLikelihood
from ..modal.modal_readers import read_modal_data
from ..modal.mode_models import FunctionModes, modal_channels
from ..noise.student import StudentNoise
from ..signals.channels import Channel
from .job import Job
from .schema import read_quantity

__all__ = ["FRAMES", "has_no_time", "load_likelihood", "modal_likelihood"]

FRAMES = "frame", "grouped frame"  # built-in structures that have modes


def has_no_time(job: Job) -> bool:
    """Whether the data of a file are modes or a load test."""
    return bool(job.modes or job.load_test)


def modal_likelihood(
    job: Job, pool: Any, cache: SimulationCache | None, make_frame: Callable[[], Any], make_model: Callable[..., Any]
) -> ModalLikelihood:
    """The likelihood of ``[modes]``; ``make_model(kind of function, channels, dt, n_steps)`` for a user's model."""
    if job.noise:
        raise ValueError(f"{job.where('noise')} modes have no such errors: give frequency_cv and others in [modes]")
    given = dict(job.modes)
    data = _modal_data(job, given)
    n_modes = given.get("n_modes", 2 * max(data.n_modes, *data.mode_numbers))
    if job.kind in FRAMES:
        if "n_modes" in given:
            raise ValueError(f"{job.where('modes')} n_modes: a {job.kind} has a mode for each storey; leave it out")
        model = make_frame()
    else:
        sensors = job.model.get("sensors")
        if sensors is None or "channels" in job.model:
            raise ValueError(
                f"{job.where('model')} sensors: with [modes], give sensors = {{top = 0}} with the rows of the matrices "
                "that the function returns, or a list of names, and no channels"
            )
        if job.kind == "function":

            def modes_of(function: Callable, names: Any, _: Any, **options: Any) -> FunctionModes:
                return FunctionModes(function, names, sensors, n_modes, **options)

            model = make_model(modes_of, (), None, None)
        else:
            model = make_model(None, modal_channels(tuple(sensors)), 1.0, n_modes)
    unknown = given.get("unknown_errors")
    options = {key: given[key] for key in ("close", "student_t") if key in given}
    return ModalLikelihood(model, data, unknown, unknown, pool, cache=cache, **options)


def _modal_data(job: Job, given: dict[str, Any]) -> ModalData:
    columns, options = (
        given.get("columns", {}),
        {key: given[key] for key in ("frequency_cv", "shape_error") if key in given},
    )
    path = job.path("modes", "file", given["file"])
    more = {key: given[key] for key in ("unit", "variables") if key in given}
    sensors = tuple(columns.values()) if "variables" not in given else tuple(columns)
    data = read_modal_data(path, sensors, **more)
    if columns and "variables" not in given:
        data = replace(data, sensors=tuple(columns))
    data = data.select(given["modes"]) if "modes" in given else data
    if given.get("mean"):
        data = data.mean()
    return replace(data, **options)


def load_likelihood(
    job: Job, pool: Any, cache: SimulationCache | None, channels: tuple[Channel, ...], make_model: Callable[..., Any]
) -> tuple[FELikelihood, dict[str, float]]:
    """The likelihood of ``[load_test]``, and the known errors by the names of parameters."""
    given = dict(job.load_test)
    test = _load_test(job, given, channels)
    n = len(test.cases)
    for key, value in (("dt", 1.0), ("n_steps", n)):
        if job.model.get(key, value) != value:
            raise ValueError(f"{job.where('model')} {key}: a load test has {n} load cases and no time: leave it out")
    noise = StudentNoise(channels, given["student_t"]) if "student_t" in given else None
    if noise is not None and job.noise:
        raise ValueError(f"{job.where('noise')} leave this section out, or student_t in [load_test]")
    return FELikelihood(make_model(None, channels, 1.0, n), test.measurements, noise, pool, cache=cache), test.known


def _load_test(job: Job, given: dict[str, Any], channels: tuple[Channel, ...]) -> LoadTest:
    dimensions, errors = {channel.name: channel.dimension for channel in channels}, {}
    for name, value in given.get("errors", {}).items():
        if name not in dimensions:
            raise ValueError(f"errors: unknown channel {name!r}; the channels are {', '.join(dimensions)}")
        errors[name] = read_quantity(value, dimensions[name])
    more = {key: given[key] for key in ("columns", "units", "cases") if key in given}
    path = job.path("load_test", "file", given["file"])
    test = read_load_test(path, channels, errors=errors, **more)
    if not np.isfinite(test.values).any():
        raise ValueError(f"file: {path} has no value")
    return test
