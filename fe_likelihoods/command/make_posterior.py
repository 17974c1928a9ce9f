"""The posterior that a TOML file describes: its data sets, their models and likelihoods, and the priors."""

import importlib
import math
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from ..adapters.identification import read_modal_data
from ..cache.simulation_cache import SimulationCache
from ..likelihood.joint import JointLikelihood
from ..likelihood.likelihood import FELikelihood
from ..likelihood.parameters import channels_of_deviations
from ..likelihood.posterior import Posterior
from ..modal.load_cases import read_load_test
from ..modal.modal_data import ModalData
from ..modal.modal_likelihood import ModalLikelihood
from ..modal.mode_models import FunctionModes, modal_channels
from ..modal.pairing import SLOPE
from ..models.one_run import one_run
from ..models.sensor_errors import SensedModel, Sensor
from ..noise.autoregressive import AutoregressiveNoise
from ..noise.gaussian import GaussianNoise
from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from ..priors.problem_priors import NOISE_SCALE
from ..signals.channels import Channel, Measurements
from ..signals.records import Record
from ..simulation.model import Model
from .job import Job, is_dataset, read_base_motion, read_measured, read_supports, within_duration
from .keys import USER_MODELS, check_known, did_you_mean, parse_prior, read_by_channel, table_keys

ERRORS_OF_MODES = {"frequency_error": 0.01, "shape_error": 0.03}  # medians of log-normal priors without one (assumed)
TEMPERATURE_SLOPE = 2e-3  # [1/K], its sd without a prior (assumed): -1e-4 to -5e-4 in concrete, more if frozen
STRUCTURES = "frame", "bridge deck"  # built-in ones that have modes


class Problem(NamedTuple):
    """What a TOML file describes."""

    posterior: Posterior
    record: Record | None  # excitation as it is used
    assumed: dict[str, Distribution]  # priors of noise parameters that the file does not give


class _DataSet(NamedTuple):
    """A data set that has been read."""

    job: Job
    make_model: Callable[[], Any]
    make_likelihood: Callable[[Any, Any], FELikelihood]  # from its model and a pool
    response: tuple[tuple[Channel, ...], float, int]  # channels, step and number of samples, of one run for several
    known: Mapping[str, float] = {}  # errors, by the names of parameters
    record: Record | None = None


def make_problem(job: Job, cache: SimulationCache | None = None) -> Problem:
    """Read the data, make the model and the posterior; ValueError, which names section and key, for any fault."""
    jobs = job.data_sets()
    if any(job.budget.workers and each.measurements and each.kind not in USER_MODELS for each in jobs.values()):
        raise ValueError(
            f"{job.where('budget')} workers: a built-in model uses all cores by itself; leave this key out"
        )
    readers = {"measurements": _histories, "modes": _modes, "load_test": _load_test}
    sets = {name: each.located(name, readers[name], each, cache) for name, each in jobs.items()}
    models = _of_one_run(job, {name: sets[name] for name in job.shared})
    made, known, record = {}, {}, None
    for name, each in sets.items():
        model = models[name] if name in models else each.job.located("model", each.make_model)
        made[name] = each.job.located(name, each.make_likelihood, model, job.budget.workers)
        known, record = known | dict(each.known), each.record or record
    likelihood = made.popitem()[1] if len(made) == 1 else job.located("model", JointLikelihood, made)
    priors, assumed = _make_priors(job, likelihood, known)
    return Problem(job.located("priors", Posterior, likelihood, priors), record, assumed)


def _histories(job: Job, cache: SimulationCache | None) -> _DataSet:
    record, own = read_base_motion(job), job.kind in USER_MODELS
    channels: tuple[Channel, ...] = ()  # a data set has its channels
    if not is_dataset(job, "measurements"):
        names = tuple((job.measurements and job.measurements.columns) or ()) or None
        channels = user_channels(job) if own else job.located("model", built_in, job, record, names).channels
    measured, record = within_duration(job, read_measured(job, channels, record)), within_duration(job, record)

    def make_model() -> Model:
        if own:
            return user_model(job, user_channels(job), record)
        return built_in(job, record, tuple(channel.name for channel in measured.channels))

    def make_likelihood(model: Model, pool: Any) -> FELikelihood:
        sensed = job.located("priors", _with_sensors, job, model)
        noise = job.located("noise", _make_noise, job, sensed.channels)
        return FELikelihood(sensed, measured, noise, pool=pool, cache=cache)

    step, size = job.model.get("dt", measured.steps[0]), job.model.get("n_steps", measured.values.shape[1])
    return _DataSet(job, make_model, make_likelihood, (channels, step, size), record=record)


def _modes(job: Job, cache: SimulationCache | None) -> _DataSet:
    _check_kind(job, "modes", STRUCTURES)
    if job.noise is not None:
        raise ValueError(f"{job.where('noise')} modes have no such errors: give frequency_cv and others in [modes]")
    data, held_out = _read_modes(job)
    unknown, options = job.modes.unknown_errors, job.modes.given("student_t")
    channels, n_modes, sensors, make = (), 0, job.model.get("sensors"), None
    if job.kind in USER_MODELS:
        if sensors is None:
            raise ValueError(
                f"{job.where('model')} sensors: with [modes], give sensors = {{top = 0}} with the rows of the matrices "
                "that the function returns, or a list of names"
            )
        numbers = (data.n_modes, *data.mode_numbers, *(held_out.mode_numbers if held_out else ()))
        channels, n_modes = modal_channels(tuple(sensors)), job.modes.n_modes or 2 * max(numbers)
        if job.kind == "function":
            make = lambda function, names, _, **more: FunctionModes(function, names, sensors, n_modes, **more)  # noqa: E731

    def make_model() -> Any:
        if job.kind in STRUCTURES:
            return linear_matrices(job)
        return user_model(job, channels, make=make, **({} if make else {"dt": 1.0, "n_steps": n_modes}))

    def make_likelihood(model: Model, pool: Any) -> ModalLikelihood:
        return ModalLikelihood(model, data, unknown, unknown, pool, cache=cache, held_out=held_out, **options)

    return _DataSet(job, make_model, make_likelihood, (channels, 1.0, n_modes))


def _read_modes(job: Job) -> tuple[ModalData, ModalData | None]:
    """The data of ``[modes]``, and the modes that are held out."""
    given = job.modes
    columns, more = given.columns or {}, given.given("unit", "variables")
    if "shapes" in more.get("variables", ()) and not columns:
        raise ValueError('columns: name the sensors of all rows of the shapes, in order, as columns = {roof = "1"}')
    sensors = tuple(columns if given.variables else columns.values())
    data = read_modal_data(job.path("modes", "file", given.file), sensors, **more)
    data = replace(data, sensors=tuple(columns) or data.sensors, **given.given("temperatures"))
    data = replace(data.mean() if given.mean else data, **given.given("frequency_cv", "shape_error"))
    if both := set(given.held_out or ()) & set(given.modes or ()):
        raise ValueError(f"held_out: the modes {sorted(both)} are in modes too: leave them out of one of them")
    held_out = None if given.held_out is None else data.select(given.held_out)
    data = data.select(given.modes or [each for each in data.mode_numbers if each not in (given.held_out or ())])
    if given.covariance is not None:  # instead of a column of the file
        data = replace(
            data, covariance=given.covariance, frequency_cv=None if given.frequency_cv is None else data.frequency_cv
        )
    return data, held_out


def _load_test(job: Job, cache: SimulationCache | None) -> _DataSet:
    _check_kind(job, "load_test", ())
    channels, given = user_channels(job), job.load_test
    errors = read_by_channel(given.errors or {}, channels, "errors")
    path = job.path("load_test", "file", given.file)
    test = read_load_test(path, channels, errors=errors, **given.given("columns", "units", "cases"))
    steps = {"dt": 1.0, "n_steps": len(test.cases)}

    def make_likelihood(model: Model, pool: Any) -> FELikelihood:
        noise = None if job.noise is None else job.located("noise", _make_noise, job, channels)
        return FELikelihood(model, test.measurements, noise, pool, cache=cache)

    return _DataSet(
        job, lambda: user_model(job, channels, **steps), make_likelihood, (channels, *steps.values()), test.known
    )


def _make_noise(job: Job, channels: tuple[Channel, ...]) -> Any:
    given = {} if job.noise is None else job.noise.given("groups", "shares_of", "sensor", "window", "local")
    if "sensor" in given:
        given["sensor"] = read_by_channel(given["sensor"], channels, "sensor")
    if job.noise is None or job.noise.kind == "gaussian":
        return GaussianNoise(channels, **given)
    if more := [name for name in given if name != "sensor"]:
        raise ValueError(f'{more[0]}: the kind "autoregressive" has no such key: leave it out, or leave kind out')
    return AutoregressiveNoise(channels, **given)


def _check_kind(job: Job, section: str, kinds: tuple[str, ...]) -> None:
    if job.kind not in (*kinds, *USER_MODELS):
        raise ValueError(
            f"{job.where('model')} kind: with [{section}], expected one of {', '.join((*kinds, *USER_MODELS))}; beside "
            f"other data, [{section}.model] is its own model"
        )


def _of_one_run(job: Job, sets: Mapping[str, _DataSet]) -> Mapping[str, Any]:
    """Models of the data sets that one run of a user's function or program answers, by section."""
    if not sets:
        return {}
    if job.record is not None and "measurements" in sets:
        raise ValueError(f"{job.where('record')} one run for several data sets reads its motion itself: leave this out")
    first = next(iter(sets.values())).job
    output: Any = {name: each.job.model.get("output") for name, each in sets.items()}
    if first.kind != "executable":
        output = load_function(first, first.model["function"])

    def make(joined: Any, channels: Any, **steps: Any) -> Model:
        return user_model(first, tuple(channels), output=joined, **steps)

    return first.located("model", one_run, {name: each.response for name, each in sets.items()}, output, make)


def runs_code_of_user(job: Job) -> bool:
    """Whether one of the models is a user's function, script or program."""
    return any(each.kind in USER_MODELS for each in job.data_sets().values())


def _with_sensors(job: Job, model: Model) -> Model:
    """The model with sensors whose gain or lag has a prior, such as ``gain_top`` or ``lag_support_0``."""
    names, sensors = [channel.name for channel in model.channels], defaultdict[str, dict[str, Distribution]](dict)
    for name, text in job.priors.items():
        kind, _, place = name.partition("_")
        known = place in names or re.fullmatch(r"support_\d+", place)
        if kind in ("gain", "lag") and known and name not in model.parameter_names:
            sensors[place][kind] = parse_prior(text, "time" if kind == "lag" else None)
    outputs = {place: Sensor(**priors) for place, priors in sensors.items() if place in names}
    inputs = {int(place[8:]): Sensor(**priors) for place, priors in sensors.items() if place not in names}
    return SensedModel(model, outputs, inputs) if sensors else model


def _make_priors(
    job: Job, likelihood: FELikelihood | JointLikelihood, known: Mapping[str, float]
) -> tuple[dict[str, Any], dict[str, Distribution]]:
    """The priors of all parameters, numbers for `known` ones, and the assumed ones, which the file does not give."""
    names, sets, where = likelihood.parameter_names, [each for each, _ in likelihood.data_sets()], job.where("priors")
    channels, given, assumed = {}, dict[str, Any](known), {}  # of each parameter that is a noise level, its channel
    for each in sets:
        channels |= channels_of_deviations(each.noise, each.model.channels)
    measured = {channel.name: each.measurements for each in sets for channel in each.model.channels}
    structural = {name for each in sets for name in each.model.parameter_names if name != SLOPE}
    check_known(job.priors, names, where, "the model has no such parameter")
    for name, text in job.priors.items():
        if name in known:
            raise ValueError(f"{where} {name}: this error is known from [load_test]: leave one of them out")
        try:
            given[name] = parse_prior(text, channels[name].dimension if name in channels else None)
        except ValueError as error:
            raise ValueError(f"{where} {name}: {error}") from None
    for name in (name for name in names if name not in given):
        if name in structural:
            raise ValueError(f'{where} {name}: this prior is missing; write for example {name} = "normal(1, 0.3)"')
        given[name] = assumed[name] = _default_prior(name, channels.get(name), measured)
    return {name: given[name] for name in names}, assumed


def _default_prior(name: str, channel: Channel | None, measured: Mapping[str, Measurements]) -> Distribution:
    if name.startswith("rho_"):
        return Uniform(-1.0, 1.0)
    if name == SLOPE:
        return TruncatedNormal(0.0, TEMPERATURE_SLOPE, -math.inf, math.inf)
    for error, median in ERRORS_OF_MODES.items():
        if name.startswith(error):
            return LogNormal(median, 0.5)
    if channel is None:
        return HalfNormal(NOISE_SCALE)
    rms = measured[channel.name].select([channel.name]).root_mean_squares[0]
    return HalfNormal(float(f"{NOISE_SCALE * rms:.3g}") if math.isfinite(rms) and rms > 0.0 else 1.0)


# structures -----------------------------------------------------------------------------------------------------------


def built_in(job: Job, record: Record, names: tuple[str, ...] | None) -> Model:
    """A structure of the library with channels (None: its usual ones)."""
    values = dict(job.model)
    if job.kind == "column":
        from ..models.rc_column import RCColumn
        from ..models.rc_column_materials import LowCycleFatigue

        usual = RCColumn.lhpost(record)
        analysis = {each.name: values.pop(each.name) for each in fields(usual.analysis) if each.name in values}
        values["analysis"] = replace(usual.analysis, **analysis)
        for table in values.keys() & table_keys("column").keys():  # a section of fatigue switches it on
            values[table] = _changed(job, table, getattr(usual, table) or LowCycleFatigue(), values[table])
        values["units"] = tuple((dict(usual.units) | values.get("units", {})).items())
        return RCColumn.lhpost(record, **values, outputs=names)
    if job.kind == "oscillator":
        from ..models.linear_oscillator import LinearOscillator

        return LinearOscillator(record, **values)
    from ..models.linear_structure import LinearStructure

    deck = job.kind == "bridge deck"
    motion = [within_duration(job, each) for each in read_supports(job)] if deck else record
    return LinearStructure(linear_matrices(job), motion, outputs=names)


def linear_matrices(job: Job) -> Any:
    """A shear frame, with groups of storeys or without, or a bridge deck."""
    from ..models.frames_and_decks import BridgeDeck, ShearFrame

    return job.located("model", ShearFrame if job.kind == "frame" else BridgeDeck, **job.model)


def _changed(job: Job, table: str, usual: Any, changes: Mapping[str, Any]) -> Any:
    """A table of the built-in structure with the values of the file; the area of bars is from a new diameter."""
    area = {"area": None} if table in ("bars", "hoops") and "diameter" in changes else {}
    try:
        return replace(usual, **area | dict(changes))
    except ValueError as error:
        raise ValueError(f"{job.file.name}: [model.{table}] {error}") from error


def user_channels(job: Job) -> tuple[Channel, ...]:
    """Channels of a model of the user; ValueError, which names the channel, for a wrong quantity or unit."""
    where, channels = f"{job.where('model')} channels:", []
    if "channels" not in job.model or "sensors" in job.model:
        raise ValueError(
            f'{where} give the channels of the response, such as {{top = "relative displacement [mm]"}}; sensors are '
            "for [modes]"
        )
    for name, text in job.model["channels"].items():
        match = re.fullmatch(r"\s*(.+?)\s*\[(.+)\]\s*", text)
        if match is None:
            raise ValueError(f'{where} {name}: expected quantity and unit, such as "displacement [mm]"; got {text!r}')
        try:
            channels.append(Channel(name, match[1], match[2].strip()))
        except ValueError as error:
            raise ValueError(f"{where} {name}: {error}") from None
    return tuple(channels)


def user_model(job: Job, channels: tuple[Channel, ...], record: Record | None = None, **options: Any) -> Model:
    """A model of the user; `options`: steps, ``make`` (a class), ``output`` (of one run for several data sets)."""
    make, output = options.pop("make", None), options.pop("output", None)
    given = {key: value for key, value in job.model.items() if key not in ("channels", "sensors", "parameters")}
    names = job.model["parameters"]
    given["depends_on"] = [job.path("model", "depends_on", name) for name in given.get("depends_on", ())]
    given |= ({} if record is None else {"record": record}) | options
    if job.kind == "executable":
        from ..models.executable import ExecutableModel

        for key in given.keys() & {"templates", "files"}:
            given[key] = {name: job.path("model", key, file) for name, file in given[key].items()}
        paths = [(word, job.folder / word) for word in given.pop("command")]
        words = [str(path.absolute()) if path.is_file() else word for word, path in paths]  # a link to Python stays
        file = given.pop("output")
        return ExecutableModel(words, given.pop("templates", {}), output or file, names, channels, **given)
    from ..models.function import FunctionModel

    text = given.pop("function")
    if job.kind == "opensees":
        from ..models.opensees import OpenSeesModel

        make = OpenSeesModel
    return (make or FunctionModel)(output or load_function(job, text), names, channels, **given)


def load_function(job: Job, text: str) -> Callable:
    """The function that ``"file.py:name"`` names, from a module that worker processes can import too."""
    where, (file, _, name) = f"{job.where('model')} function:", text.rpartition(":")
    if not file or not name.isidentifier():
        raise ValueError(f'{where} expected "file.py:name of the function"; got {text!r}')
    path = job.path("model", "function", file).resolve()
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))
    importlib.invalidate_caches()
    try:
        module = importlib.import_module(path.stem)
    except Exception as error:
        raise ValueError(f"{where} {path.name} cannot be imported: {type(error).__name__}: {error}") from error
    if Path(getattr(module, "__file__", None) or "").resolve() != path:
        raise ValueError(f"{where} {path.name} cannot be imported by its name; rename it, for example to my_model.py")
    function = vars(module).get(name)
    if not callable(function):
        names = tuple(key for key, value in vars(module).items() if callable(value) and not key.startswith("_"))
        raise ValueError(f"{where} {path.name} has no function {name!r}; {did_you_mean(name, names)}")
    return function
