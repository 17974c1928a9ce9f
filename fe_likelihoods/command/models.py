"""The model and the posterior that a TOML file describes."""

import importlib
import importlib.util
import math
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ..cache.simulation_cache import SimulationCache
from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..likelihood.parameters import channels_of_deviations
from ..likelihood.posterior import Posterior
from ..models.sensed import SensedModel, Sensor
from ..priors.distributions import Distribution, HalfNormal, LogNormal, Uniform
from ..signals.channels import Channel, Measurements
from ..signals.records import Record
from ..simulation.model import Model
from .data import is_dataset, read_base_motion, read_bundled, read_measured, read_supports
from .job import Job
from .modes_and_loads import FRAMES, has_no_time, load_likelihood, modal_likelihood
from .noises import make_noise
from .priors import parse_prior
from .schema import did_you_mean, part_keys

__all__ = [
    "USER_MODELS",
    "Problem",
    "load_function",
    "make_problem",
    "noise_channels_of",
    "reduce_data",
    "runs_code_of_user",
]

USER_MODELS = ("function", "opensees", "executable")
ERRORS_OF_MODES = {"frequency_error": 0.01, "shape_error": 0.03}  # medians of log-normal priors without one (assumed)
NOISE_SCALE = 0.3  # half-normal prior of a sigma without one in the file, in root mean squares of the channel (assumed)


class Problem(NamedTuple):
    """What a TOML file describes."""

    posterior: Posterior
    record: Record | None  # excitation as it is used
    assumed: dict[str, Distribution]  # priors of noise parameters that the file does not give
    truth: dict[str, float] | None = None  # parameter values of bundled synthetic data


def make_problem(job: Job, cache: SimulationCache | None = None) -> Problem:
    """Read the data, make the model and the posterior; ValueError, which names section and key, for any fault."""
    jobs, made, known, record = job.data_sets(), {}, {}, None
    for section, each in jobs.items():
        made[section], numbers, motion = _data_set(each, cache)
        known, record = known | numbers, motion if motion is not None else record
    if twice := [name for name in known if name in job.priors]:
        raise ValueError(
            f"{job.where('priors')} {twice[0]}: this error is known from [load_test]: leave one of them out"
        )
    likelihood = made.popitem()[1] if len(made) == 1 else _located(job, "model", lambda: JointLikelihood(made))
    priors, assumed = _make_priors(job, likelihood, known)
    posterior = Posterior(likelihood, priors)
    posterior = _located(job, "noise", posterior.marginal) if job.noise.get("marginal") else posterior
    truth = _truth(job, posterior, record) if len(jobs) == 1 else None
    return Problem(posterior, record, assumed, truth)


def _data_set(job: Job, cache: SimulationCache | None) -> tuple[FELikelihood, dict[str, float], Record | None]:
    """The likelihood of one data set, its known errors by the names of parameters, and its excitation."""
    if has_no_time(job):
        return *_without_time(job, cache), None
    record = read_base_motion(job)
    sensors = _all_channels(job, record)
    measured = read_measured(job, sensors, record)
    record, measured = reduce_data(job, record, measured)
    model = _located(job, "model", lambda: _make_model(job, record, measured))
    model = _located(job, "priors", lambda: _with_sensors(job, model))
    workers = job.budget.get("workers")
    if workers is not None and job.kind not in USER_MODELS:
        raise ValueError(
            f"{job.where('budget')} workers: a built-in model uses all cores by itself; leave this key out"
        )
    law = _located(job, "noise", lambda: make_noise(job, model))
    made = _located(job, "measurements", lambda: FELikelihood(model, measured, law, pool=workers, cache=cache))
    return made, {}, record


def _without_time(job: Job, cache: SimulationCache | None) -> tuple[FELikelihood, dict[str, float]]:
    """The likelihood of modes or of a load test, and known errors."""
    workers = job.budget.get("workers")
    section = "modes" if job.modes else "load_test"
    if job.kind not in USER_MODELS and (job.kind not in FRAMES or not job.modes):
        kinds = (*(FRAMES if job.modes else ()), *USER_MODELS)
        raise ValueError(
            f"{job.where('model')} kind: with [{section}], expected one of {', '.join(kinds)}; beside other data, "
            f"[{section}.model] is its own model"
        )

    def make_model(make: Any, channels: tuple[Channel, ...], dt: float | None, n_steps: int | None) -> Model:
        return _user_model(job, None, channels, make, {"dt": dt, "n_steps": n_steps} if n_steps else {})

    if job.modes:
        made = _located(job, "modes", lambda: modal_likelihood(job, workers, cache, lambda: _frame(job), make_model))
        return made, {}
    channels = _user_channels(job)
    made, known = _located(job, "load_test", lambda: load_likelihood(job, workers, cache, channels, make_model))
    return made.with_noise(_located(job, "noise", lambda: make_noise(job, made.model))) if job.noise else made, known


def runs_code_of_user(job: Job) -> bool:
    """Whether one of the models is a user's function, script or program."""
    return any(each.kind in USER_MODELS for each in job.data_sets().values())


def _frame(job: Job) -> Any:
    """A shear frame."""
    from ..models.linear_structure_parts import ShearFrame
    from ..models.tall_buildings import GroupedFrame

    return _located(job, "model", lambda: (GroupedFrame if job.kind == "grouped frame" else ShearFrame)(**job.model))


def _truth(job: Job, posterior: Posterior, record: Record | None) -> dict[str, float] | None:
    """True values of bundled data: multiples of the nominal values of the built-in structure, where it has these."""
    if "bundled" not in job.measurements or job.kind not in ("column", "bridge"):
        return None
    model = posterior.likelihood.model
    model = model.model if isinstance(model, SensedModel) else model
    usual = type(model).lhpost(record) if job.kind == "column" else type(model)(record)
    truth = read_bundled(job, "measurements").attributes["truth"]
    changed = {name for name, value in usual.nominal.items() if not math.isclose(model.nominal[name], value)}
    return {name: truth[name] for name in posterior.parameter_names if name in truth and name not in changed} or None


def _located(job: Job, section: str, make: Callable[[], Any]) -> Any:
    """Errors with file and section before them."""
    try:
        return make()
    except ValueError as error:
        raise (
            error if str(error).startswith(f"{job.file.name}:") else ValueError(f"{job.where(section)} {error}")
        ) from error


def _all_channels(job: Job, record: Record | None) -> tuple[Channel, ...]:
    """Channels that the measurements may have."""
    if is_dataset(job, "measurements"):
        return ()  # the data set has its channels
    if job.kind in USER_MODELS:
        return _user_channels(job)
    names = tuple(job.measurements.get("columns", ())) or None
    return _located(job, "model", lambda: _built_in(job, record, names).channels)


def reduce_data(
    job: Job, record: Record | None, measured: Measurements | None
) -> tuple[Record | None, Measurements | None]:
    """The first part of the data, reduced to every n-th sample."""
    duration, every = job.record.get("duration"), job.record.get("every", 1)

    def reduce() -> tuple[Record | None, Measurements | None]:
        shorter, fewer = record, measured
        if duration is not None:
            shorter, fewer = shorter.trim(0.0, duration), fewer and fewer.trim(0.0, duration)
        if every != 1:
            shorter, fewer = shorter.resample(shorter.dt * every), fewer and fewer.decimate(every)
        return shorter, fewer

    return (record, measured) if record is None else _located(job, "record", reduce)


def _make_model(job: Job, record: Record | None, measured: Measurements) -> Model:
    if job.kind in USER_MODELS:
        return _user_model(job, record)
    return _built_in(job, record, tuple(channel.name for channel in measured.channels), measured)


def _with_sensors(job: Job, model: Model) -> Model:
    """The model with sensors whose gain or lag has a prior, such as ``gain_top`` or ``lag_support_0``."""
    names, sensors = [channel.name for channel in model.channels], defaultdict[str, dict[str, Distribution]](dict)
    for name, text in job.priors.items():
        kind, _, place = name.partition("_")
        known = place in names or re.fullmatch(r"support_\d+", place)
        if kind in ("gain", "lag") and known and name not in model.parameter_names:
            sensors[place][kind] = parse_prior(text, "time" if kind == "lag" else None)
    made = {place: Sensor(**priors) for place, priors in sensors.items()}
    outputs = {place: sensor for place, sensor in made.items() if place in names}
    inputs = {int(place.partition("_")[2]): sensor for place, sensor in made.items() if place not in names}
    return SensedModel(model, outputs, inputs) if made else model


def _built_in(job: Job, record: Record, names: tuple[str, ...] | None, measured: Measurements | None = None) -> Model:
    values = dict(job.model)
    if job.kind == "column":
        from ..models.rc_column import PARAMETERS, RCColumn
        from ..models.rc_column_parts import LowCycleFatigue

        usual = RCColumn.lhpost(record)
        for part in part_keys("column"):  # a section of fatigue switches it on
            if part in values:
                values[part] = _changed(job, part, getattr(usual, part) or LowCycleFatigue(), values[part])
        if "units" in values:
            values["units"] = tuple((dict(usual.units) | values["units"]).items())
        _check_names(job, "parameters", values.get("parameters", ()), tuple(PARAMETERS))
        return RCColumn.lhpost(record, **values, outputs=names)
    if job.kind == "bridge":
        from ..models.isolated_bridge import IsolatedBridge

        usual = IsolatedBridge(record)
        for part in ("pier", "bearing", "damper"):
            pair = getattr(usual, f"{part}s")
            values[f"{part}s"] = tuple(
                _changed(job, f"{part}_{i}", pair[i - 1], values.pop(f"{part}_{i}", {})) for i in (1, 2)
            )
        if measured is not None:
            values["every"] = max(1, round(measured.dt / record.dt))
        _check_names(job, "parameters", values.get("parameters", ()), usual.parameter_names)
        return IsolatedBridge(record, **values, outputs=names)
    if job.kind == "oscillator":
        from ..models.linear_oscillator import LinearOscillator

        return LinearOscillator(record, **values)
    from ..models.linear_structure import LinearStructure
    from ..models.linear_structure_parts import BridgeDeck

    if job.kind == "bridge deck":
        supports = [reduce_data(job, each, None)[0] for each in read_supports(job)]
        return LinearStructure(BridgeDeck(**values), supports, outputs=names)
    return LinearStructure(_frame(job), record, outputs=names)


def _changed(job: Job, part: str, usual: Any, changes: Mapping[str, Any]) -> Any:
    """A part of the built-in structure with the values of the file."""
    changes = dict(changes)
    if part in ("bars", "hoops") and "diameter" in changes:
        changes.setdefault("area", None)  # from the new diameter
    try:
        return replace(usual, **changes)
    except ValueError as error:
        raise ValueError(f"{job.file.name}: [model.{part}] {error}") from error


def _check_names(job: Job, key: str, names: Any, known: tuple[str, ...]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{job.where('model')} {key}: unknown {name!r}; {did_you_mean(name, known)}")


def _user_channels(job: Job) -> tuple[Channel, ...]:
    channels = []
    if "channels" not in job.model or "sensors" in job.model:
        raise ValueError(
            f"{job.where('model')} channels: give the channels of the response, such as "
            '{top = "relative displacement [mm]"}; sensors are for [modes]'
        )
    for name, text in job.model["channels"].items():
        match = re.fullmatch(r"\s*(.+?)\s*\[(.+)\]\s*", text)
        try:
            if match is None:
                raise ValueError(f'expected quantity and unit, such as "displacement [mm]"; got {text!r}')
            channels.append(Channel(name, match[1], match[2].strip()))
        except ValueError as error:
            raise ValueError(f"{job.where('model')} channels: {name}: {error}") from None
    return tuple(channels)


def _user_model(
    job: Job, record: Record | None, channels: tuple[Channel, ...] = (), make: Any = None, steps: Any = None
) -> Model:
    """A model of the user; `channels`, a maker of the model of a function, and `steps` of data without a time."""
    given = dict(job.model) | (steps or {})
    names, channels = given.pop("parameters"), _user_channels(job) if make is None and not channels else channels
    given.pop("channels", None), given.pop("sensors", None)
    given["depends_on"] = [job.path("model", "depends_on", name) for name in given.get("depends_on", ())]
    common = ({} if has_no_time(job) else {"record": record}) | given
    if job.kind == "executable":
        from ..models.executable import ExecutableModel

        for key in ("templates", "files"):
            if key in common:
                common[key] = {name: job.path("model", key, file) for name, file in common[key].items()}
        command = [
            str(path.resolve()) if (path := job.folder / word).is_file() else word for word in common.pop("command")
        ]
        return ExecutableModel(command, common.pop("templates"), common.pop("output"), names, channels, **common)
    function = load_function(job, common.pop("function"))
    if job.kind == "opensees":
        from ..models.opensees import OpenSeesModel

        return OpenSeesModel(function, names, channels, **common)
    from ..models.function import FunctionModel

    return (make or FunctionModel)(function, names, channels, **common)


def load_function(job: Job, text: str) -> Callable:
    """The function that ``"file.py:name"`` names, from a module that worker processes can import too.

    ValueError if the file or the function does not exist, the file cannot be imported, or another module has its name.
    """
    where = f"{job.where('model')} function:"
    file, _, name = text.rpartition(":")
    if not file or not name.isidentifier():
        raise ValueError(f'{where} expected "file.py:name of the function"; got {text!r}')
    path = job.path("model", "function", file).resolve()
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    importlib.invalidate_caches()
    found = importlib.util.find_spec(path.stem) if path.stem.isidentifier() else None
    if found is None or found.origin is None or Path(found.origin).resolve() != path:
        raise ValueError(f"{where} {path.name} cannot be imported by its name; rename it, for example to my_model.py")
    try:
        module = importlib.import_module(path.stem)
    except Exception as error:
        raise ValueError(f"{where} {path.name} cannot be imported: {type(error).__name__}: {error}") from error
    function = vars(module).get(name)
    if not callable(function):
        names = tuple(key for key, value in vars(module).items() if callable(value) and not key.startswith("_"))
        raise ValueError(f"{where} {path.name} has no function {name!r}; {did_you_mean(name, names)}")
    return function


def _make_priors(
    job: Job, likelihood: FELikelihood | JointLikelihood, known: Mapping[str, float]
) -> tuple[dict[str, Any], dict[str, Distribution]]:
    """The priors of all parameters, numbers for `known` ones, and the assumed ones, which the file does not give."""
    names, parts = likelihood.parameter_names, [part for part, _ in likelihood.parts()]
    structural = dict.fromkeys(name for part in parts for name in part.model.parameter_names)
    channels = {name: channel for part in parts for name, channel in noise_channels_of(part).items()}
    measured = {channel.name: part.measurements for part in parts for channel in part.model.channels}
    for name in job.priors:
        if name not in names:
            raise ValueError(
                f"{job.where('priors')} {name}: the model has no such parameter; {did_you_mean(name, names)}"
            )
    given = {}
    for name, text in job.priors.items():
        try:
            given[name] = parse_prior(text, channels[name].dimension if name in channels else None)
        except ValueError as error:
            raise ValueError(f"{job.where('priors')} {name}: {error}") from None
    if missing := [name for name in structural if name not in given]:
        raise ValueError(
            f"{job.where('priors')} {missing[0]}: this prior is missing; write for example "
            f'{missing[0]} = "normal(1, 0.3)"'
        )
    assumed = {
        name: _default_prior(name, channels.get(name), measured)
        for name in names
        if name not in given and name not in known
    }
    return {name: (given | assumed | dict(known))[name] for name in names}, assumed


def noise_channels_of(likelihood: FELikelihood) -> dict[str, Channel]:
    """Channel of each parameter that is the noise level of a channel, by name."""
    return channels_of_deviations(likelihood.noise, likelihood.model.channels)


def _default_prior(name: str, channel: Channel | None, measured: Mapping[str, Measurements]) -> Distribution:
    if name.startswith("rho_"):
        return Uniform(-1.0, 1.0)
    for error, median in ERRORS_OF_MODES.items():
        if name.startswith(error):
            return LogNormal(median, 1.0)
    if channel is None:
        return HalfNormal(NOISE_SCALE)
    rms = measured[channel.name].select([channel.name]).root_mean_squares[0]
    return HalfNormal(float(f"{NOISE_SCALE * rms:.3g}") if math.isfinite(rms) and rms > 0.0 else 1.0)
