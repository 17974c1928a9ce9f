"""Sections of the TOML file that describes an update: frozen dataclasses, whose fields are the keys.

`fe_likelihoods.command.keys.key` states kind, meaning and default of each; those of built-in structures are the
described fields of their classes.
"""

import importlib
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from .keys import CLOCK, Key, key, keys_of

__all__ = [
    "FREE_SECTIONS",
    "MODEL_KINDS",
    "SECTIONS",
    "USER",
    "USER_MODELS",
    "LoadTest",
    "Measured",
    "Modes",
    "Motion",
    "Section",
    "model_keys",
    "part_keys",
]


NUMBERS = "number, or list of number"


@dataclass(frozen=True, kw_only=True)
class Section:
    """Values of one section; None stands for a key that is left out."""

    def given(self, *names: str) -> dict[str, Any]:
        """The values of these keys, by default of all, without keys that are left out."""
        values = {name: getattr(self, name) for name in names or (each.name for each in fields(self))}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class Table(Section):
    """How a table of samples is read."""

    READING: ClassVar = ("time", "time_unit", "dt", "skip", "resample")

    time: Any = key("text", "Name or number of the column of times, if it is not found")
    time_unit: Any = key("text", "Unit of the times, if the column name does not end with it")
    dt: Any = key("time", "Time step, needed for a file without times")
    skip: Any = key("whole number >= 0", "Number of lines above the table, if they are not found")
    resample: Any = key("time", "Nominal step of uneven times, to which the samples are interpolated linearly")


@dataclass(frozen=True, kw_only=True)
class Motion(Table):
    """``[record]``, the base motion."""

    file: Any = key("text", "Base acceleration: CSV, Excel, a data set (.h5), or a format of `read_record`")
    column: Any = key("text or whole number", "Column (CSV, workbook), component (GeoNet), channel or file (V2)")
    units: Any = key("text", "Unit of the acceleration, if the file does not state it")
    missing: Any = key("list of number or text", "What stands for missing samples in other columns")
    scale: Any = key("number", "Factor by which the record is multiplied; -1 for a reversed sensor")
    duration: Any = key("time", "Length of the first part that is used")
    supports: Any = key(
        "list of text",
        'Instead of file, "file.csv" or "file.csv:column" of column base, first end and second end of a bridge deck',
    )


@dataclass(frozen=True, kw_only=True)
class Measured(Table):
    """``[measurements]``."""

    file: Any = key("text", "Measured response: CSV, Excel, V2 and other files as in [record], or a data set (.h5)")
    columns: Any = key("table of text or whole number", "Channel = name of its column, or number in a V2 file")
    units: Any = key("table of text", "Channel = unit, if the file does not state it")
    reversed: Any = key("list of text", "Channels whose sensor counts the other way round: they are multiplied by -1")
    channels: Any = key("list of text", "Channels to use; by default all")
    zero: Any = key(CLOCK, "Time in the file at which the base motion begins")
    missing: Any = key(
        "list of number or text or time span",
        'What stands for missing samples, such as "OL", and times to leave out, ["channel", first, last]',
    )
    baseline: Any = key(
        "table of points of time and value", "Channel = points [time, value] of an offset or a drift that is subtracted"
    )


@dataclass(frozen=True, kw_only=True)
class Modes(Section):
    """``[modes]``."""

    file: Any = key("text", "Identified modes: CSV, Excel or MATLAB (`read_modal_data`)", ...)
    unit: Any = key("text", 'Unit of the frequencies, if the file does not state it: "Hz" or "rad/s"')
    columns: Any = key("table of text", "Sensor of the model = name of its column; by default the column of this name")
    variables: Any = key("table of text", "Of a MATLAB file: frequencies and shapes = names of the variables")
    modes: Any = key("list of whole number", "Numbers of the modes to compare; by default all but those held out")
    held_out: Any = key("list of whole number", "Numbers of modes that are predicted instead of compared")
    mean: Any = key("yes or no", "Take the mean of several identifications, and their scatter as the errors", False)
    frequency_cv: Any = key(NUMBERS, "Known coefficient of variation of the frequencies, or one per mode of the file")
    covariance: Any = key("list of list of number", "Known covariance of the compared frequencies [Hz²] instead")
    temperatures: Any = key(NUMBERS, "Temperature of each identification [°C]; adds the parameter temperature_slope")
    shape_error: Any = key(NUMBERS, "Known standard deviation of a component of a shape with a norm of 1")
    unknown_errors: Any = key(
        "one of common, mode",
        "Parameters frequency_error and shape_error, of all modes or of each; by default where no error is known",
    )
    student_t: Any = key("number", "Degrees of freedom of Student-t errors, such as 4, for wrong identifications")
    n_modes: Any = key(
        "whole number >= 1", "Modes that the model computes (twice as many as were measured, or all of a function)"
    )


@dataclass(frozen=True, kw_only=True)
class LoadTest(Section):
    """``[load_test]``."""

    file: Any = key("text", "Load test: CSV or Excel with a line for each load case", ...)
    columns: Any = key("table of text", "Channel = name of its column; by default the column of this name")
    units: Any = key("table of text", "Channel = unit, if the file does not state it")
    cases: Any = key("text", "Column with the names of the load cases, or with positions; by default the first one")
    errors: Any = key("table of number with unit", 'Channel = known standard deviation of its sensor, such as "0.1 mm"')


@dataclass(frozen=True, kw_only=True)
class Noise(Section):
    """``[noise]``."""

    kind: Any = key("one of gaussian, autoregressive", "Autoregressive noise takes sensor only", "gaussian")
    groups: Any = key("one of channel, all, event", "What has a level: each channel, all, or each in each event")
    shares_of: Any = key("one of measured, response", "Levels are shares of this signal, and not in SI units")
    sensor: Any = key("table of number with unit", "Channel = known standard deviation of its sensor noise (zero)")
    window: Any = key("time", "Length of the moving window for the root mean square of the response")
    local: Any = key("number", 'For "response": weight of the response envelope in the variance, from 0 to 1 (0.25)')


@dataclass(frozen=True, kw_only=True)
class Sampler(Section):
    """``[sampler]``."""

    kind: Any = key("one of smc, tmcmc", "Sampler", "smc")
    walkers: Any = key("whole number >= 1", "Number of walkers", 500)
    steps: Any = key("whole number >= 1", "Stored steps at beta = 1: 4, or 1 with a guide, whose draws are the first")
    seed: Any = key("whole number >= 0", "Seed", 1)
    chains: Any = key("whole number >= 1", "Independent runs with successive seeds; the report is of the first", 1)
    guide: Any = key("yes or no", "Find the posterior from the responses, with hundreds of simulations", False)
    recycle: Any = key("yes or no", "Reuse every evaluated point; by default with 150 walkers or more")
    max_failure_share: Any = key("number", "Share of failed evaluations at which the run stops (0.5)")


@dataclass(frozen=True, kw_only=True)
class Budget(Section):
    """``[budget]``."""

    max_simulations: Any = key("whole number >= 1", "Most simulations; the run can be continued with more")
    workers: Any = key("whole number >= 1", "Processes, for a model of your own (1); built-in models use all cores")


@dataclass(frozen=True, kw_only=True)
class Predictions(Section):
    """``[prediction]``."""

    draws: Any = key("whole number >= 0", "Draws of the posterior whose response is predicted; 0 for none", 100)
    noise: Any = key("yes or no", "Predict measurements, with their noise", False)


SECTIONS: dict[str, type[Section]] = {
    "record": Motion,
    "measurements": Measured,
    "modes": Modes,
    "load_test": LoadTest,
    "noise": Noise,
    "sampler": Sampler,
    "budget": Budget,
    "prediction": Predictions,
}
"""Sections besides those of `FREE_SECTIONS`."""

FREE_SECTIONS = "model", "priors"
"""Sections whose keys depend on the kind of the structure and its parameters."""


_LIMIT = Key("time_limit", "time", "Longest duration of a run; a longer run is stopped and counts as failed")
USER = (
    Key("parameters", "list of text", "Names of the structural parameters, in the order of theta", True),
    Key("channels", "table of text", 'Channels of the response: name = "quantity [unit]", in order'),
    Key("sensors", "table of whole number, or list of text", "With [modes]: sensor = row of the matrices, or names"),
    Key("dt", "time", "Time step of the response; with a record a whole multiple of its step, by default that step"),
    Key("n_steps", "whole number >= 1", "Number of response samples; with a record it follows from dt"),
    _LIMIT,
    Key("depends_on", "list of text", "Files that the response depends on besides the code"),
    Key("version", "text", "Text that stands for the code in the cache; change it when the results change"),
)
"""Keys of ``[model]`` that all models of the user have; a program needs a `time_limit`."""

_FUNCTION = Key("function", "text", 'The function, as "file.py:name"', True)
_OWN = {
    "function": (_FUNCTION, *USER, Key("isolated", "yes or no", "Run the function in a separate process")),
    "opensees": (_FUNCTION, *USER),
    "executable": (
        Key("command", "list of text", "Program and its arguments", True),
        Key("templates", "table of text", "Input files: name in the folder of the run = template"),
        Key("output", "text", "Name of the file with the response", True),
        Key("columns", "list of whole number", "Columns of the output file that are the channels, counted from 0"),
        Key("output_units", "table of text", "Channel = its unit in the output file; default: SI units"),
        Key("record_file", "text", "Name of the file with the base motion [m/s²]; default: record.txt"),
        Key("files", "table of text", "Further files: name in the folder of the run = file"),
        *(each._replace(required=each.required or each == _LIMIT) for each in USER),
    ),
}
_OSCILLATOR = (
    Key("period", "time", "Nominal undamped period, above 0", True),
    Key("damping_ratio", "number", "Nominal fraction of critical damping, between 0 and 1"),
)
_COLUMN_PARTS = dict(concrete="Concrete", steel="Steel", bars="Bars", hoops="Hoops", fatigue="LowCycleFatigue")
_BUILT_IN = {  # modules and classes
    "column": (("rc_column", "RCColumn"), ("rc_column_materials", "ColumnAnalysis")),
    "frame": (("frames_and_decks", "ShearFrame"),),
    "bridge deck": (("frames_and_decks", "BridgeDeck"),),
}
MODEL_KINDS = (*_BUILT_IN, "oscillator", *_OWN)
"""Kinds of ``[model]``."""
USER_MODELS = tuple(_OWN)
"""Those that run a function or a program of the user."""


def _keys_of(module: str, name: str, optional: bool) -> tuple[Key, ...]:
    """Keys of a class of `fe_likelihoods.models`, imported where a file needs it: some import numba."""
    owner = getattr(importlib.import_module(f"fe_likelihoods.models.{module}"), name)
    return keys_of(owner, "outputs max_increment", optional)


def model_keys(kind: str) -> tuple[Key, ...]:
    """Keys of ``[model]`` for one of `MODEL_KINDS`."""
    own = _OWN | {"oscillator": _OSCILLATOR}
    return own[kind] if kind in own else sum((_keys_of(*each, kind == "column") for each in _BUILT_IN[kind]), ())


def part_keys(kind: str) -> dict[str, tuple[Key, ...]]:
    """Keys of the tables below ``[model]`` by name; a key that is left out has the value of the built-in column."""
    return {
        name: _keys_of("rc_column_materials", kind_of, True)
        for name, kind_of in _COLUMN_PARTS.items()
        if kind == "column"
    }
