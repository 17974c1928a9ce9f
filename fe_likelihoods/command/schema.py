"""Keys of the TOML file that describes an update: their kinds, their meanings, and the checks of their values.

Every section has a table of `Key`. A value is read by the kind of its key, and converted to SI units. Messages name the
file, the section and the key, and propose the nearest known key for an unknown one.
"""

import datetime
import difflib
import importlib
import inspect
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..models.executable import ExecutableModel
from ..models.function import FunctionModel
from ..noise.gaussian import GaussianNoise
from ..signals.clock_times import is_clock
from ..signals.read import read_record
from ..units import DIMENSIONS, to_si

__all__ = [
    "EVENT",
    "FREE_SECTIONS",
    "MODEL_KINDS",
    "SECTIONS",
    "USER",
    "Key",
    "did_you_mean",
    "documented_keys",
    "model_keys",
    "part_keys",
    "read_keys",
    "read_quantity",
    "split_number",
]

SMALLEST_STRESS = 1e4  # [Pa]; a smaller plain number is in another unit
_ZERO = "time or clock time"


class Key(NamedTuple):
    """One key of a section.

    Its kind is a name in `_KINDS`; a dimension of `fe_likelihoods.units.DIMENSIONS`, for a text with number and unit
    (``"1.22 m"``) or a number in SI units; or "time or clock time".
    """

    name: str
    kind: str
    meaning: str  # for the documentation
    required: bool = False  # whether it has no default


def documented_keys(
    owner: Any, names: str = "", *, without: str = "", required: str = "", **kinds: str
) -> tuple[Key, ...]:
    """Keys for the arguments of a class or function, from its numpydoc section "Parameters" or "Attributes".

    A float with a unit in its description, such as ``[m]``, is a quantity of this dimension. `names` are the keys
    (default: all), `without` are arguments that are no keys, `required` are keys without a default, all separated by
    blanks; `kinds` has kinds that the types do not say. The meaning is the first sentence of a description, and the
    sentence that begins with "Default".
    """
    text = inspect.getdoc(owner)
    if text is None:
        raise RuntimeError("docstrings describe the keys of the TOML file: start Python without the option -OO")
    section = re.search(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\w[^\n]*\n-+$|\Z)", text, re.M | re.S)
    found = {}
    for group, form, text in re.findall(r"^(\w[\w, ]*) : (.+)\n((?:    .*\n?)+)", section[1], re.M):
        first, *others = re.split(r"(?<=\.) (?=[A-Z])", " ".join(text.split()))
        kind = _kind(form, first)
        unit = f" [{DIMENSIONS[kind]}]".replace("2", "²") if kind in DIMENSIONS else ""
        choices = form.removesuffix(", optional").replace("{", "").replace("}", "") + ": " if "{" in form else ""
        default = next((f"; d{each[1:]}" for each in others if each.startswith("Default")), "")
        first = first[0].lower() + first[1:] if choices else first
        meaning = f"{choices}{first.removesuffix('.').replace(unit, '')}{default.removesuffix('.')}"
        for name in group.split(", "):
            found[name] = Key(name, kinds.get(name) or kind, meaning, name in required.split())
    return tuple(found[name] for name in names.split() or found if name not in without.split())


def _kind(form: str, meaning: str) -> str:
    """Kind of a key from the type and the unit that a docstring states; empty if no kind fits."""
    form = re.split(r" or |, optional", form)[0]
    if form == "float":
        unit = next((unit for unit in re.findall(r"\[([^\];]+)[\];]", meaning)), "")
        dimensions = (name for name, si in DIMENSIONS.items() if si == unit.replace("²", "2"))
        return next(dimensions, "number")
    return "text" if form.startswith("{") else _KINDS_OF_TYPES.get(form, "")


_KINDS_OF_TYPES = {
    "int": "whole number",
    "bool": "yes or no",
    "str": "text",
    "tuple of str": "texts",
    "sequence of str": "texts",
    "sequence of int": "whole numbers",
    "sequence of float": "numbers",
}
USER = (
    Key("parameters", "texts", "Names of the structural parameters, in the order of theta", True),
    Key("channels", "table of texts", 'Channels of the response: name = "quantity [unit]", in order'),
    Key(
        "sensors",
        "table of whole numbers or texts",
        "With [modes], instead of channels: sensor = row of the matrices, from 0, that a function returns; a list of "
        "names for other models",
    ),
    *documented_keys(FunctionModel, "dt n_steps time_limit", n_steps="whole number >= 1"),
    Key("depends_on", "texts", "Files that the response depends on besides the code"),
    Key("version", "text", "Text that stands for the code in the cache; change it when the results change"),
)
"""Keys of ``[model]`` that all models of the user have; a program needs a `time_limit`."""

_FUNCTION = Key("function", "text", 'The function, as "file.py:name"', True)
_OWN = {
    "function": (_FUNCTION, *USER, *documented_keys(FunctionModel, "isolated")),
    "opensees": (_FUNCTION, *USER),
    "executable": (
        *documented_keys(ExecutableModel, "command", required="command"),
        Key("templates", "table of texts", "Input files: name in the folder of the run = template", True),
        Key("output", "text", "Name of the file with the response", True),
        *documented_keys(ExecutableModel, "columns output_units record_file", output_units="table of texts"),
        Key("files", "table of texts", "Further files: name in the folder of the run = file"),
        *(key._replace(required=True) if key.name == "time_limit" else key for key in USER),
    ),
}
_COLUMN_PARTS = dict(concrete="Concrete", steel="Steel", bars="Bars", hoops="Hoops", fatigue="LowCycleFatigue")
_BRIDGE_PARTS = {f"{name.lower()}_{i}": name for name in ("Pier", "Bearing", "Damper") for i in (1, 2)}
_BUILT_IN: dict[str, tuple[str, dict[str, str]]] = {
    "column": (
        "rc_column.RCColumn",
        dict(without=f"loading outputs max_increment {' '.join(_COLUMN_PARTS)}", units="table of texts"),
    ),
    "bridge": (
        "isolated_bridge.IsolatedBridge",
        dict(without="record piers bearings dampers rubber outputs every vertical"),
    ),
    "oscillator": ("linear_oscillator.LinearOscillator", dict(without="record", required="period")),
    "frame": (
        "linear_structure_parts.ShearFrame",
        dict(required="floors masses stiffnesses", floors="table of whole numbers"),
    ),
    "grouped frame": (
        "tall_buildings.GroupedFrame",
        dict(names="groups", required="groups"),
    ),
    "bridge deck": ("linear_structure_parts.BridgeDeck", {}),
}
_PARTS = {"column": ("rc_column_parts", _COLUMN_PARTS), "bridge": ("isolated_bridge_parts", _BRIDGE_PARTS)}
MODEL_KINDS = (*_BUILT_IN, *_OWN)
"""Kinds of ``[model]``."""


def _in_models(name: str) -> Any:
    """A class of `fe_likelihoods.models`, imported where a file needs it: some import numba."""
    module, _, name = name.partition(".")
    return getattr(importlib.import_module(f"fe_likelihoods.models.{module}"), name)


def model_keys(kind: str) -> tuple[Key, ...]:
    """Keys of ``[model]`` for one of `MODEL_KINDS`."""
    if kind in _OWN:
        return _OWN[kind]
    name, options = _BUILT_IN[kind]
    storeys = ()
    if kind == "grouped frame":
        storeys = tuple(key for key in model_keys("frame") if key.name in ("floors", "masses", "stiffnesses"))
    return (*storeys, *documented_keys(_in_models(name), **options))


def part_keys(kind: str) -> dict[str, tuple[Key, ...]]:
    """Keys of the tables below ``[model]`` by name; a key that is left out has the value of the built-in structure."""
    module, names = _PARTS.get(kind, ("", {}))
    return {part: documented_keys(_in_models(f"{module}.{name}")) for part, name in names.items()}


_TABLE = documented_keys(read_record, "time time_unit dt skip resample", time="text", skip="whole number >= 0")
_ERRORS = "number or numbers"
SECTIONS: dict[str, tuple[Key, ...]] = {
    "record": (
        Key(
            "file",
            "text",
            "Acceleration of the base: AT2, V1, V2, SMC, GeoNet, K-NET, ESM, miniSEED, SAC, CSV, Excel, or a data set "
            "(.h5)",
        ),
        Key(
            "supports",
            "texts",
            'Motions of several supports instead of file, as "file.csv" or "file.csv:column"; of a bridge deck the '
            "base of the column, the first end and the second end",
        ),
        Key("bundled", "text", "A bundled synthetic motion, instead of a file"),
        Key("column", "text", "Column of a CSV file or workbook, component (GeoNet), or file in an archive (V2)"),
        Key("channel", "whole number", "Channel of a V2 file"),
        Key("units", "text", "Unit of the acceleration, if the file does not state it"),
        *_TABLE,
        Key("scale", "number", "Factor by which the record is multiplied; -1 for a reversed sensor"),
        Key("duration", "time", "Length of the first part that is used"),
        Key("every", "whole number >= 1", "Keep every n-th sample: a faster simulation with a longer step"),
    ),
    "measurements": (
        Key("file", "text", "Measured response: CSV, Excel, V2 and other files as in [record], or a data set (.h5)"),
        Key("bundled", "text", "Bundled synthetic measurements, instead of a file"),
        Key("columns", "table of texts or numbers", "Channel = name of its column in the file, or number in a V2 file"),
        Key("units", "table of texts", "Channel = unit, if the file does not state it"),
        Key("reversed", "texts", "Channels whose sensor counts the other way round: they are multiplied by -1"),
        Key("channels", "texts", "Channels to use; by default all"),
        *_TABLE,
        Key("zero", _ZERO, "Time in the file at which the base motion begins"),
        Key(
            "missing",
            "numbers and times",
            "Numbers that stand for missing samples, and times [first, last] that are left out, with the name of a "
            "channel before them for this one alone [s after zero]",
        ),
        Key("baseline", "points by name", "Channel = points [time, value] of an offset or a drift that is subtracted"),
    ),
    "modes": (
        Key(
            "file",
            "text",
            "Identified modes, alone or beside other data: CSV, Excel or MATLAB (`read_modal_data`)",
            True,
        ),
        Key("unit", "text", 'Unit of the frequencies, if the file does not state it: "Hz" or "rad/s"'),
        Key(
            "columns", "table of texts", "Sensor of the model = name of its column; by default the column of this name"
        ),
        Key(
            "variables", "table of texts", "Of a MATLAB file: frequencies, shapes and damping = names of the variables"
        ),
        Key("modes", "whole numbers", "Numbers of the modes to compare; by default all"),
        Key("mean", "yes or no", "Take the mean of several identifications, and their scatter as the errors (no)"),
        Key(
            "frequency_cv", _ERRORS, "Known coefficient of variation of the frequencies, such as 0.005, or one per mode"
        ),
        Key(
            "shape_error", _ERRORS, "Known standard deviation of a component of a shape with a norm of 1, such as 0.02"
        ),
        Key(
            "unknown_errors",
            "text",
            '"common" or "mode": parameters frequency_error and shape_error, of all modes or of each, are added to the '
            "known errors; by default where no error is known",
        ),
        Key("student_t", "number", "Degrees of freedom of Student-t errors, such as 4, for wrong identifications"),
        Key("n_modes", "whole number >= 1", "Modes that the model computes (twice as many as were measured)"),
        Key(
            "close",
            "number",
            "Frequencies that differ by less than this share are compared as a plane of shapes (0.02)",
        ),
    ),
    "load_test": (
        Key("file", "text", "Load test, alone or beside other data: CSV or Excel with a line for each load case", True),
        Key("columns", "table of texts", "Channel = name of its column; by default the column of this name"),
        Key("units", "table of texts", "Channel = unit, if the file does not state it"),
        Key("cases", "text", "Column with the names of the load cases, or with positions; by default the first one"),
        Key("errors", "table of quantities", 'Channel = known standard deviation of its sensor, such as "0.1 mm"'),
    ),
    "noise": (
        Key(
            "kind",
            "text",
            '"gaussian" (the default), or "autoregressive": each error depends on the one before, with a correlation '
            "per channel; takes sensor only",
        ),
        *documented_keys(
            GaussianNoise, "groups level sensor window local", groups="text or numbers", sensor="table of quantities"
        ),
        Key("marginal", "yes or no", "Integrate the levels out (no); for levels in SI units without bands and sensor"),
    ),
    "sampler": (
        Key("kind", "text", '"smc" (the default), "tmcmc" or "emcee"'),
        Key("walkers", "whole number >= 1", "Number of walkers (500; emcee: 4 per parameter, 32 or more)"),
        Key(
            "steps", "whole number >= 1", "Sweeps at beta = 1, each of which stores all walkers (4); emcee: iterations"
        ),
        Key("discard", "whole number >= 0", "Emcee: iterations that are left out as burn-in (half of steps)"),
        Key("seed", "whole number >= 0", "Seed (1)"),
        Key("guide", "yes or no", "Find the posterior from the responses, with hundreds of simulations (no)"),
        Key("preset", "text", '"ramancha2022", "ramancha2022-constant" or "ching-chen-2007": settings of papers'),
        Key("recycle", "yes or no", "Reuse every evaluated point; by default with 150 walkers or more"),
        Key("ess_ratio", "number", "Share of effective walkers wanted at each stage, without recycling"),
        Key("min_moves", "whole number", "Fewest sweeps per stage"),
        Key("max_moves", "whole number >= 1", "Most sweeps per stage"),
        Key("max_failure_share", "number", "Share of failed evaluations at which the run stops (0.5)"),
    ),
    "budget": (
        Key("max_simulations", "whole number >= 1", "Most simulations; the run can be continued with more"),
        Key("workers", "whole number >= 1", "Processes, for a model of your own (1); built-in models use all cores"),
        Key("cache", "yes or no", "Keep every simulation in a file of the folder (yes)"),
    ),
    "prediction": (
        Key("draws", "whole number >= 0", "Draws of the posterior whose response is predicted (100); 0 for none"),
        Key("noise", "yes or no", "Predict measurements, with their noise (no)"),
        Key("quantiles", "probabilities", "Probabilities of the quantiles ([0.05, 0.5, 0.95])"),
    ),
}
"""Keys of the sections besides ``[model]`` and ``[priors]``."""


EVENT: tuple[Key, ...] = (
    *(key for key in SECTIONS["record"] if key.name not in ("every", "supports")),
    Key("measured", "text", "Measured response in this event, to be compared: a file as in [measurements]"),
    Key("zero", _ZERO, "Time in this file at which the base motion begins; by default as in [measurements]"),
    Key("from_state", "text", '"virgin" (the default), or "end" to begin with the state after the record'),
    Key("rest", "time", 'Pause before the motion, for "end" (10 s)'),
)
"""Keys of ``[events.NAME]``, which are predicted after the run."""

FREE_SECTIONS = {
    "model": "the structure; its keys depend on `kind`",
    "priors": "parameter = distribution",
    "events": "other base motions, one table [events.NAME] for each",
}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _all(check: Any, kind: type) -> Any:
    if kind is dict:
        return lambda value: isinstance(value, dict) and bool(value) and all(map(check, value.values()))
    return lambda value: isinstance(value, list) and all(map(check, value))


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _are_probabilities(value: Any) -> bool:
    numbers = isinstance(value, list) and all(map(_is_number, value))
    return numbers and all(0.0 < number < 1.0 for number in value) and len(set(value)) == len(value)


def _is_time(value: Any) -> bool:
    """Whether a value is a pair of times in order, or a name and such a pair."""
    times = value[1:] if isinstance(value, list) and value and _is_text(value[0]) else value
    return isinstance(times, list) and len(times) == 2 and all(map(_is_number, times)) and times[0] <= times[1]


def _is_point(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and _is_number(value[0])
        and (_is_number(value[1]) or _is_text(value[1]))
    )


_KINDS = {
    "text": (_is_text, 'a text in quotes, such as "abc"'),
    "number": (_is_number, "a number"),
    "whole number": (_is_whole, "a whole number"),
    "whole number >= 0": (lambda value: _is_whole(value) and value >= 0, "a whole number of 0 or more"),
    "whole number >= 1": (lambda value: _is_whole(value) and value >= 1, "a whole number of 1 or more"),
    "probabilities": (_are_probabilities, "a list of different numbers between 0 and 1, such as [0.05, 0.5, 0.95]"),
    "yes or no": (lambda value: isinstance(value, bool), "true or false"),
    "texts": (_all(_is_text, list), 'a list of texts, such as ["a", "b"]'),
    "numbers": (_all(_is_number, list), "a list of numbers, such as [1.0, 2.0]"),
    "numbers and times": (
        _all(lambda value: _is_number(value) or _is_time(value), list),
        'a list of numbers, and of times [first, last] in seconds, such as [-9999, [12.3, 12.8], ["top", 3.0, 3.2]]',
    ),
    "points by name": (
        _all(lambda value: _all(_is_point, list)(value) and 1 <= len({each[0] for each in value}) == len(value), dict),
        'points of time and value by name, such as {top = [[0.0, "0.01 g"], [40.0, "0.03 g"]]}',
    ),
    "text or numbers": (
        lambda value: _is_text(value) or _all(_is_number, list)(value),
        "a text in quotes, or a list of numbers, such as [1.0, 5.0]",
    ),
    "whole numbers": (_all(_is_whole, list), "a list of whole numbers, such as [1, 2]"),
    "table of texts": (_all(_is_text, dict), 'texts by name, such as {top = "abc"}'),
    "table of texts or numbers": (
        _all(lambda value: _is_text(value) or _is_whole(value), dict),
        'texts or whole numbers by name, such as {top = "abc"} or {top = 7}',
    ),
    "table of quantities": (
        _all(lambda value: _is_number(value) or _is_text(value), dict),
        'numbers with units by name, such as {top = "0.01 g"}',
    ),
    "table of whole numbers": (_all(_is_whole, dict), "whole numbers by name, such as {top = 2}"),
    "table of whole numbers or texts": (
        lambda value: _all(_is_whole, dict)(value) or _all(_is_text, list)(value),
        'whole numbers by name, such as {top = 2}, or a list of names, such as ["top"]',
    ),
    "number or numbers": (
        lambda value: _is_number(value) or _all(_is_number, list)(value),
        "a number, or a list of numbers, such as [0.005, 0.01]",
    ),
}


def did_you_mean(given: str, known: Sequence[str]) -> str:
    """The nearest known name as a question, or all known names."""
    near = difflib.get_close_matches(given.lower(), [name.lower() for name in known], n=1, cutoff=0.55)
    names = [name for name in known if near and name.lower() == near[0]]
    return f"did you mean {names[0]}?" if names else f"known are {', '.join(known)}"


def split_number(text: str) -> tuple[str, str]:
    """Number and unit of a text, with or without a space between them."""
    match = re.match(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", text.strip())
    number, unit = text.strip().partition(" ")[::2] if match is None else (match[0], text.strip()[match.end() :])
    return number, unit.strip()


def read_quantity(value: Any, dimension: str) -> float:
    """A number in SI units, from such a number or a text with number and unit; `dimension` is a key of `DIMENSIONS`.

    ValueError if it is neither, the unit is unknown or of another dimension, or a stress without a unit is below
    `SMALLEST_STRESS`.
    """
    if _is_number(value):
        if dimension == "stress" and 0.0 < abs(value) < SMALLEST_STRESS:
            raise ValueError(
                f"a plain number is in Pa, and {value!r} Pa is far below any strength or modulus; give the unit, such "
                f'as "{value!r} MPa" or "{value!r} ksi"'
            )
        return float(value)
    example = f"a number in {DIMENSIONS[dimension]}, or a text with a unit such as {_EXAMPLES[dimension]!r}"
    if not isinstance(value, str):
        raise ValueError(f"expected {example}; got {value!r}")
    number, unit = split_number(value)
    try:
        found = float(number)
        if not math.isfinite(found):
            raise ValueError("the number must be finite")
    except ValueError:
        raise ValueError(f"expected {example}; got {value!r}") from None
    if not unit:
        raise ValueError(f"expected {example}; {value!r} has no unit")
    try:
        return to_si(found, unit, dimension).item()
    except ValueError as error:
        raise ValueError(f"expected {example}; got {value!r}: {error}") from None


_EXAMPLES = {
    "acceleration": "0.1 g",
    "velocity": "0.5 m/s",
    "displacement": "1.22 m",
    "force": "522 kip",
    "stress": "42 MPa",
    "moment": "100 kN m",
    "curvature": "0.01 1/m",
    "energy": "1 kJ",
    "strain": "100 microstrain",
    "rotation": "5 deg",
    "time": "20 s",
}


def read_keys(given: Mapping[str, Any], keys: Sequence[Key], where: str) -> dict[str, Any]:
    """Check the keys of a section as TOML gives it and convert its values, quantities to SI units.

    ValueError, which names file and section (`where`), for an unknown or missing key, or a value of another kind.
    """
    known = {key.name: key for key in keys}
    for name in given:
        if name not in known:
            raise ValueError(f"{where} {name}: unknown key; {did_you_mean(name, tuple(known))}")
    for key in keys:
        if key.required and key.name not in given:
            raise ValueError(f"{where} {key.name}: this key is missing: {key.meaning}")
    values = {}
    for name, value in given.items():
        kind = known[name].kind
        if kind == _ZERO:
            if isinstance(value, datetime.time | datetime.datetime):  # a clock time without quotes
                value = value.isoformat()
            if isinstance(value, str) and is_clock(value):
                values[name] = value
                continue
            kind = "time"
        if kind in DIMENSIONS:
            try:
                values[name] = read_quantity(value, kind)
            except ValueError as error:
                raise ValueError(f"{where} {name}: {error}") from None
            continue
        check, expected = _KINDS[kind]
        if not check(value):
            raise ValueError(f"{where} {name}: expected {expected}; got {value!r}")
        values[name] = value
    return values
