"""Keys and sections of the TOML file: kinds of values, their checks, quantities with units, priors.

Sections are frozen dataclasses, whose fields are the keys; `key` states kind, meaning and default of each. Keys of
built-in structures are the described fields of their classes. Messages name the file, the section and the key, and
propose the nearest known key for an unknown one.
"""

import datetime
import difflib
import functools
import importlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar, NamedTuple

from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from ..signals.tables import is_clock
from ..units import DIMENSIONS, to_si

SMALLEST_STRESS = 1e4  # [Pa]; a smaller plain number is in another unit
CLOCK = "time or clock time"


class Key(NamedTuple):
    """One key of a section.

    Its kind is one of `_check_of`; a dimension of `fe_likelihoods.units.DIMENSIONS`, for a text with number and unit
    (``"1.22 m"``) or a number in SI units; "one of " and choices; or "time or clock time".
    """

    name: str
    kind: str
    meaning: str  # for the documentation
    required: bool = False  # whether it has no default


def key(kind: str, meaning: str, default: Any = None) -> Any:
    """A field of a section; without a default (None) it may be left out, and ``...`` means that it may not."""
    shown = "" if default in (None, ...) else f" ({json.dumps(default)})"  # as TOML writes it
    given = {} if default is ... else {"default": default}
    return field(metadata={"kind": kind, "unit": "", "meaning": meaning + shown}, **given)


_KINDS_OF_TYPES = {
    "float": "number",
    "int": "whole number",
    "bool": "yes or no",
    "str": "text",
    "tuple[str, ...]": "list of text",
    "Sequence[int]": "list of whole number",
    "Sequence[float]": "list of number",
}


@functools.cache
def keys_of(owner: type, without: str = "", optional: bool = False) -> tuple[Key, ...]:
    """Keys of a section, or of the described fields of a structure or one of its parts, but for names in `without`.

    Kinds follow from unit and type where they are not stated. All keys may be left out where they have the values of a
    built-in structure (`optional`).
    """
    found = []
    for each in sorted(fields(owner), key=lambda each: each.name in getattr(owner, "READING", ())):
        about, unit = each.metadata, each.metadata["unit"]
        kind = about["kind"] or next((name for name, si in DIMENSIONS.items() if si == unit), "")
        meaning, mark, rest = about["meaning"].partition("; ")
        meaning += f" [{unit}]" if unit and not kind else ""
        kind = kind or _KINDS_OF_TYPES.get(each.type.removesuffix(" | None"), "")
        required = each.default is MISSING and not optional
        if kind and each.name not in without.split():
            found.append(Key(each.name, kind, meaning + mark + rest, required))
    return tuple(found)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _is_span(value: Any) -> bool:
    """Whether a value is a pair of times in order, or a name and such a pair."""
    times = value[1:] if isinstance(value, list) and value and _is_text(value[0]) else value
    return isinstance(times, list) and len(times) == 2 and all(map(_is_number, times)) and times[0] <= times[1]


def _are_points(value: Any) -> bool:
    """Whether a value is a list of points [time, value] at different times."""
    if not isinstance(value, list) or not all(isinstance(point, list) and len(point) == 2 for point in value):
        return False
    right = all(_is_number(time) and (_is_number(level) or _is_text(level)) for time, level in value)
    return right and 0 < len({time for time, _ in value}) == len(value)


def _whole(least: float) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= least


_Check = tuple[Callable[[Any], bool], str]
_ONE: dict[str, _Check] = {
    "text": (_is_text, '"abc"'),
    "number": (_is_number, "1.0"),
    "whole number": (_whole(-math.inf), "1"),
    "whole number >= 0": (_whole(0), "1"),
    "whole number >= 1": (_whole(1), "1"),
    "yes or no": (lambda value: isinstance(value, bool), "true"),
    "number with unit": (lambda value: _is_number(value) or _is_text(value), '"0.01 g"'),
    "points of time and value": (_are_points, '[[0.0, "0.01 g"], [40.0, "0.03 g"]]'),
    "time span": (_is_span, '["top", 12.3, 12.8]'),
}
"""Check of a value, and an example, of the kinds that others are made of."""


def _check_of(kind: str) -> _Check:
    """The same for kinds such as "list of number", "table of text or number" (by name), and "text, or list of text"."""
    if kind in _ONE:
        return _ONE[kind]
    container, _, inner = kind.partition(" of ")
    if ", or " in kind or container not in ("list", "table"):
        (fits, _), (other, example) = map(_check_of, re.split(", or | or ", kind, maxsplit=1))
        return lambda value: fits(value) or other(value), example
    are, example = _check_of(inner)
    if container == "list":
        return lambda value: isinstance(value, list) and all(map(are, value)), f"[{example}]"
    return (
        lambda value: isinstance(value, dict) and 0 < len(value) == sum(map(are, value.values())),
        f"{{top = {example}}}",
    )


def did_you_mean(given: Any, known: Sequence[str]) -> str:
    """The nearest known name as a question, or all known names."""
    lower = {name.lower(): name for name in reversed(known)}
    near = difflib.get_close_matches(str(given).lower(), [*lower], n=1, cutoff=0.55)
    return f"did you mean {lower[near[0]]}?" if near else f"known are {', '.join(known)}"


def check_known(given: Iterable[str], known: Iterable[str], where: str, what: str) -> None:
    """ValueError for the first name that is not known, with the nearest known one."""
    known = tuple(known)
    if unknown := [name for name in given if name not in known]:
        raise ValueError(f"{where} {unknown[0]}: {what}; {did_you_mean(unknown[0], known)}")


_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|[-+]?inf)\s*(.*?)\s*", re.IGNORECASE)


def _parse(text: Any, dimension: str | None) -> tuple[float, str]:
    """The number in SI units in a text with a number and perhaps a unit, and this unit."""
    match = _QUANTITY.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError("it is no number with a unit")
    number, unit = float(match[1]), match[2]
    return to_si(number, unit, dimension).item() if unit else number, unit


def read_quantity(value: Any, dimension: str) -> float:
    """A number in SI units, from such a number or a text with number and unit; `dimension` is a key of `DIMENSIONS`."""
    if _is_number(value):
        if dimension == "stress" and 0.0 < abs(value) < SMALLEST_STRESS:
            raise ValueError(
                f"a plain number is in Pa, and {value!r} Pa is far below any strength or modulus; give the unit, such "
                f'as "{value!r} MPa" or "{value!r} ksi"'
            )
        return float(value)
    try:
        found, unit = _parse(value, dimension)
        if unit and math.isfinite(found):
            return found
        why = "it has no unit" if not unit else "it is not finite"
    except ValueError as error:
        why = str(error)
    si = DIMENSIONS[dimension]
    raise ValueError(f"expected a number in {si}, or a text with a unit such as '1 {si}'; got {value!r}: {why}")


def read_by_channel(given: Mapping[str, Any], channels: Sequence[Any], key: str) -> dict[str, float]:
    """Standard deviations [SI] by the names of `channels`."""
    known, values = {channel.name: channel for channel in channels}, {}
    check_known(given, known, f"{key}:", "unknown channel")
    for name, value in given.items():
        try:
            values[name] = read_quantity(value, known[name].dimension)
        except ValueError as error:
            raise ValueError(f"{key}: {name}: {error}") from None
        if not values[name] >= 0.0:
            raise ValueError(f"{key}: {name}: expected a standard deviation; got {value!r}")
    return values


def read_keys(given: Mapping[str, Any], keys: Sequence[Key], where: str) -> dict[str, Any]:
    """Check the keys of a section as TOML gives it, and convert quantities to SI units; errors name the section."""
    known = {each.name: each for each in keys}
    check_known(given, known, where, "unknown key")
    if missing := [each for each in keys if each.required and each.name not in given]:
        raise ValueError(f"{where} {missing[0].name}: this key is missing: {missing[0].meaning}")
    return {name: _read_value(value, known[name].kind, f"{where} {name}:") for name, value in given.items()}


def _read_value(value: Any, kind: str, where: str) -> Any:
    if kind == CLOCK:
        if isinstance(value, datetime.time | datetime.datetime):  # a clock time without quotes
            value = value.isoformat()
        if isinstance(value, str) and is_clock(value):
            return value
        kind = "time"
    if kind in DIMENSIONS:
        try:
            return read_quantity(value, kind)
        except ValueError as error:
            raise ValueError(f"{where} {error}") from None
    if kind.startswith("one of "):
        choices = kind.removeprefix("one of ").split(", ")
        if value not in choices:
            raise ValueError(f"{where} expected {kind}; got {value!r}; {did_you_mean(value, choices)}")
        return value
    fits, example = _check_of(kind)
    if not fits(value):
        raise ValueError(f"{where} expected a {kind}, such as {example}; got {value!r}")
    return value


FORMS: dict[str, tuple[type[Distribution], str]] = {
    "normal": (TruncatedNormal, "normal(mean, sd) or normal(mean, sd, lower, upper); without bounds positive"),
    "half-normal": (HalfNormal, "half-normal(sd), sd before taking the absolute value"),
    "uniform": (Uniform, "uniform(low, high)"),
    "log-normal": (LogNormal, "log-normal(median, sd of the natural logarithm)"),
}
"""Distributions of ``[priors]`` by name: class, and how it is written."""


def parse_prior(text: Any, dimension: str | None = None) -> Distribution | float:
    """A distribution from a text such as ``half-normal(0.1 g)``, or a known number; without a unit in SI units."""
    if _QUANTITY.fullmatch(str(text)):
        return _parse(str(text), dimension)[0]
    match = re.fullmatch(r"\s*([A-Za-z-]+)\s*\(([^();]*)\)\s*", str(text))
    if match is None or match[1].lower() not in FORMS:
        wanted = 'a distribution in quotes, such as "normal(1, 0.3)", with decimal points and commas between numbers'
        known = "; ".join(form for _, form in FORMS.values())
        raise ValueError(f"expected {wanted}, or a known number; got {text!r}; known are {known}")
    make, form = FORMS[name := match[1].lower()]
    try:
        found = [_parse(argument, dimension) for argument in match[2].split(",") if argument.strip()]
        numbers = [number for number, _ in found]
        if name == "log-normal" and any(unit for _, unit in found[1:]):
            raise ValueError("a logarithm has no unit")
        if name == "normal" and (len(numbers) == 3 or (len(numbers) == 2 and numbers[0] <= 0.0)):
            raise ValueError("give both bounds")
        return make(*numbers)
    except (ValueError, TypeError) as error:
        why = f": {error}" if isinstance(error, ValueError) else ""  # else another number of arguments
        raise ValueError(f"expected {form}; got {text!r}{why}") from None


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
    recycle: Any = key("yes or no", "Reuse every evaluated point; by default yes")
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
_COLUMN_TABLES = dict(concrete="Concrete", steel="Steel", bars="Bars", hoops="Hoops", fatigue="LowCycleFatigue")
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


def table_keys(kind: str) -> dict[str, tuple[Key, ...]]:
    """Keys of the tables below ``[model]`` by name; a key that is left out has the value of the built-in column."""
    return {
        name: _keys_of("rc_column_materials", kind_of, True)
        for name, kind_of in _COLUMN_TABLES.items()
        if kind == "column"
    }
