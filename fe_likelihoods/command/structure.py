"""The structure of a TOML file: built-in ones, and functions, scripts and programs of the user."""

import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..signals.channels import Channel, Measurements
from ..signals.records import Record
from ..simulation.model import Model
from .data import read_supports, reduce_data
from .job import Job
from .keys import did_you_mean
from .sections import part_keys

__all__ = ["built_in", "linear_parts", "load_function", "user_channels", "user_model"]


def built_in(job: Job, record: Record, names: tuple[str, ...] | None, measured: Measurements | None = None) -> Model:
    """A structure of the library with channels (None: its usual ones)."""
    values = dict(job.model)
    if job.kind == "column":
        from ..models.rc_column import RCColumn
        from ..models.rc_column_parts import LowCycleFatigue

        usual = RCColumn.lhpost(record)
        for part in values.keys() & part_keys("column").keys():  # a section of fatigue switches it on
            values[part] = _changed(job, part, getattr(usual, part) or LowCycleFatigue(), values[part])
        if "units" in values:
            values["units"] = tuple((dict(usual.units) | values["units"]).items())
        return RCColumn.lhpost(record, **values, outputs=names)
    if job.kind == "bridge":
        from ..models.isolated_bridge import IsolatedBridge

        usual = IsolatedBridge(record)
        for part in ("pier", "bearing", "damper"):
            both = enumerate(getattr(usual, f"{part}s"), 1)
            values[f"{part}s"] = tuple(
                _changed(job, f"{part}_{i}", one, values.pop(f"{part}_{i}", {})) for i, one in both
            )
        every = {} if measured is None else {"every": max(1, round(measured.dt / record.dt))}
        return IsolatedBridge(record, **values, **every, outputs=names)
    if job.kind == "oscillator":
        from ..models.linear_oscillator import LinearOscillator

        return LinearOscillator(record, **values)
    from ..models.linear_structure import LinearStructure

    deck = job.kind == "bridge deck"
    motion = [reduce_data(job, each, None)[0] for each in read_supports(job)] if deck else record
    return LinearStructure(linear_parts(job), motion, outputs=names)


def linear_parts(job: Job) -> Any:
    """A shear frame, with groups of storeys or without, or a bridge deck."""
    from ..models.linear_structure_parts import BridgeDeck, ShearFrame

    kind = ShearFrame if job.kind == "frame" else BridgeDeck
    return job.located("model", kind, **job.model)


def _changed(job: Job, part: str, usual: Any, changes: Mapping[str, Any]) -> Any:
    """A part of the built-in structure with the values of the file."""
    if part in ("bars", "hoops") and "diameter" in changes:
        changes = {"area": None} | dict(changes)  # from the new diameter
    try:
        return replace(usual, **changes)
    except ValueError as error:
        raise ValueError(f"{job.file.name}: [model.{part}] {error}") from error


def user_channels(job: Job) -> tuple[Channel, ...]:
    """Channels of a model of the user; ValueError, which names the channel, for a wrong quantity or unit."""
    where = f"{job.where('model')} channels:"
    if "channels" not in job.model or "sensors" in job.model:
        raise ValueError(
            f'{where} give the channels of the response, such as {{top = "relative displacement [mm]"}}; sensors are '
            "for [modes]"
        )
    channels = []
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
    """A model of the user; `options` are the steps of data without a time, and ``make``, another model of a function.

    ``output``, of one run that answers several data sets, is a function, or files by the names of data sets.
    """
    make, output = options.pop("make", None), options.pop("output", None)
    given = {key: value for key, value in job.model.items() if key not in ("channels", "sensors")}
    names = given.pop("parameters")
    given["depends_on"] = [job.path("model", "depends_on", name) for name in given.get("depends_on", ())]
    given |= ({} if job.has_no_time or record is None else {"record": record}) | options
    if job.kind == "executable":
        from ..models.executable import ExecutableModel

        for key in given.keys() & {"templates", "files"}:
            given[key] = {name: job.path("model", key, file) for name, file in given[key].items()}
        paths = [(word, job.folder / word) for word in given.pop("command")]
        words = [str(path.resolve()) if path.is_file() else word for word, path in paths]
        file = given.pop("output")
        return ExecutableModel(words, given.pop("templates", {}), output or file, names, channels, **given)
    from ..models.function import FunctionModel

    text = given.pop("function")
    if job.kind == "opensees":
        from ..models.opensees import OpenSeesModel

        make = OpenSeesModel
    return (make or FunctionModel)(output or load_function(job, text), names, channels, **given)


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
