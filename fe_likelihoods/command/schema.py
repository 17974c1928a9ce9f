"""Keys of the TOML file that describes an update: their kinds, their meanings, and the checks of their values.

Every section has a table of `Key`. A value is read by the kind of its key, and converted to SI units. Messages name the
file, the section and the key, and propose the nearest known key for an unknown one.
"""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..signals.clock_times import is_clock
from ..units import DIMENSIONS, to_si

__all__ = [
    "EVENT",
    "FREE_SECTIONS",
    "MODELS",
    "PARTS",
    "SECTIONS",
    "USER",
    "Key",
    "did_you_mean",
    "read_keys",
    "read_quantity",
    "split_number",
]

_ZERO = "time or clock time"
SMALLEST_STRESS = 1e4  # [Pa]; a smaller plain number is in another unit


class Key(NamedTuple):
    """One key of a section.

    Attributes
    ----------
    name : str
        The key.
    kind : str
        A name in `_KINDS`, a dimension of `fe_likelihoods.units.DIMENSIONS`, which stands for a text with number and
        unit (``"1.22 m"``) or a number in SI units, or "time or clock time".
    meaning : str
        What it is, for the documentation.
    required : bool
        Whether it has no default.
    """

    name: str
    kind: str
    meaning: str
    required: bool = False


_CONCRETE = (
    Key("fc", "stress", "compressive strength"),
    Key("ec", "stress", "initial modulus"),
    Key("ft", "stress", "tensile strength"),
    Key("peak_strain", "number", "strain at fc; 2 fc/ec by default"),
    Key("ultimate_strain", "number", "strain beyond which the cover carries no stress"),
    Key("softening_strain", "number", "strain over which the stress in tension decreases"),
    Key("softening_ratio", "number", "stress at the end of softening, as a share of ft"),
)
_STEEL = (
    Key("fy", "stress", "yield strength"),
    Key("fu", "stress", "ultimate strength"),
    Key("es", "stress", "elastic modulus"),
    Key("esh", "stress", "modulus at the onset of hardening"),
    Key("hardening_strain", "number", "strain at the onset of hardening"),
    Key("ultimate_strain", "number", "strain at fu"),
)
_BARS = (
    Key("number", "whole number", "number of bars"),
    Key("diameter", "displacement", "diameter of one bar"),
    Key("area", "number", "area of one bar [m²]; by default from its diameter"),
    Key("first_angle", "rotation", "angle of the first bar"),
)
_HOOPS = (
    Key("diameter", "displacement", "diameter of the hoop bar"),
    Key("spacing", "displacement", "distance between hoops"),
    Key("fy", "stress", "yield strength"),
    Key("area", "number", "area of one set [m²]; by default from its diameter"),
    Key("ultimate_strain", "number", "strain at fracture"),
    Key("spiral", "yes or no", "whether it is a spiral"),
)
_FATIGUE = (
    Key("cf", "number", "plastic strain of a half cycle that breaks a bar (0.26)"),
    Key("alpha", "number", "exponent of Coffin and Manson (0.506)"),
    Key("cd", "number", "coefficient of the loss of strength (0.389)"),
)
_BUCKLING = (
    Key(
        "slenderness",
        "number",
        "unsupported bar length divided by the diameter; by default from the hoop spacing",
    ),
    Key("alpha", "number", "1 for steel that hardens linearly (the default), 0.75 for steel that does not"),
)
_PIER = (
    Key("modulus", "stress", "modulus of elasticity"),
    Key("inertia", "number", "second moment of area [m⁴]"),
    Key("length", "displacement", "length of the pier"),
    Key("height", "displacement", "height of the block"),
    Key("center", "displacement", "height of the centre of mass of the block"),
    Key("mass", "number", "mass of the block [kg]"),
    Key("rotary_inertia", "number", "rotational inertia of the block [kg m²]"),
    Key("damping_ratio", "number", "ratio of critical damping"),
)
_BEARING = (
    Key("load", "force", "weight on the bearing"),
    Key("f_min", "number", "coefficient of friction at rest"),
    Key("df", "number", "increase of the coefficient at high velocity"),
    Key("a", "number", "rate of this increase with velocity [s/m]"),
    Key("yield_displacement", "displacement", "displacement at which sliding begins"),
    Key("gamma", "number", "constant of the Bouc-Wen law"),
)
_DAMPER = (
    Key("stiffness", "number", "stiffness of the spring [N/m]"),
    Key("viscosity", "number", "coefficient of the dashpot [N s/m]"),
    Key("count", "whole number", "number of dampers"),
)
PARTS: dict[str, dict[str, tuple[Key, ...]]] = {
    "column": {
        "concrete": _CONCRETE,
        "steel": _STEEL,
        "bars": _BARS,
        "hoops": _HOOPS,
        "fatigue": _FATIGUE,
        "buckling": _BUCKLING,
    },
    "bridge": {
        **{f"pier_{i}": _PIER for i in (1, 2)},
        **{f"bearing_{i}": _BEARING for i in (1, 2)},
        **{f"damper_{i}": _DAMPER for i in (1, 2)},
    },
}
"""Tables below ``[model]`` by the kind of the model; a key that is left out has the value of the built-in structure."""

USER = (
    Key("parameters", "texts", "names of the structural parameters, in the order of theta", True),
    Key("channels", "table of texts", 'channels of the response: name = "quantity [unit]", in order', True),
    Key("dt", "time", "time step of the response; by default that of the record"),
    Key("n_steps", "whole number >= 1", "number of samples of the response, for a model without a record"),
    Key(
        "time_limit",
        "time",
        "longest duration of a run; a longer one is stopped and counts as failed (a program needs it)",
    ),
    Key("depends_on", "texts", "files that the response depends on besides the code"),
    Key("version", "text", "text that stands for the code in the cache; change it when the results change"),
)
"""Keys of ``[model]`` that all models of the user have."""

MODELS: dict[str, tuple[Key, ...]] = {
    "column": (
        Key("diameter", "displacement", "diameter of the section"),
        Key("height", "displacement", "from the foundation to the centre of the mass"),
        Key("cover", "displacement", "clear cover, to the outside of the hoops"),
        Key("mass", "number", "mass at the top [kg]"),
        Key("axial_load", "force", "gravity load at the top; by default the weight of the mass"),
        Key("rotational_inertia", "number", "rotational inertia of the mass [kg m²]"),
        Key("vertical_mass", "yes or no", "whether the mass also acts vertically"),
        Key("a0", "number", "mass-proportional damping [1/s]"),
        Key("a1", "number", "stiffness-proportional damping [s]"),
        Key("penetration", "displacement", "length of strain penetration into the foundation"),
        Key("parameters", "texts", "names of the parameters that are updated"),
        Key("n_elements", "whole number", "number of elements"),
        Key("n_points", "whole number", "integration points per element"),
        Key("mesh", "whole number", "number of strips of the section"),
        Key("geometry", "text", '"corotational" or "linear"'),
        Key("substeps", "whole number", "integration steps per step of the record"),
        Key("units", "table of texts", "units in which channels are shown"),
        Key("tolerance", "number", "norm of the last Newton correction [m and rad]"),
        Key("element_tolerance", "number", "work of the last correction of an element [J]"),
        Key("max_iterations", "whole number", "most Newton iterations per step"),
        Key("halvings", "whole number", "how often a step that does not converge is halved"),
    ),
    "bridge": (
        Key("deck_mass", "number", "mass of the deck [kg]"),
        Key("parameters", "texts", "names of the parameters that are updated"),
        Key("friction", "text", '"bouc-wen", "elastic-plastic" or "coulomb"'),
        Key("step", "time", "integration step"),
        Key("p_delta", "yes or no", "whether the piers have the geometric stiffness of the weight"),
        Key("gravity", "number", "acceleration of gravity [m/s²]"),
        Key("tolerance", "number", "last correction of the isolator forces, relative to the bearing load"),
        Key("max_iterations", "whole number", "most Newton iterations per step"),
    ),
    "oscillator": (
        Key("period", "time", "nominal undamped period", True),
        Key("damping_ratio", "number", "nominal ratio of critical damping"),
    ),
    "frame": (
        Key("floors", "table of whole numbers", "channel = floor that it is on, counted from 1", True),
        Key("masses", "numbers", "nominal mass of each floor [kg]", True),
        Key("stiffnesses", "numbers", "nominal stiffness of each storey [N/m]", True),
        Key("free_masses", "whole numbers", "floors whose masses are parameters"),
    ),
    "function": (
        Key("function", "text", 'the function, as "file.py:name"', True),
        *USER,
        Key("isolated", "yes or no", "whether it runs in a process of its own"),
    ),
    "opensees": (Key("function", "text", 'the function that builds and runs, as "file.py:name"', True), *USER),
    "executable": (
        Key("command", "texts", "program and its arguments", True),
        Key("templates", "table of texts", "input files: name in the folder of the run = template", True),
        Key("output", "text", "name of the file with the response", True),
        Key("columns", "whole numbers", "columns of this file that are the channels, counted from 0"),
        Key("files", "table of texts", "further files: name in the folder of the run = file"),
        *(key._replace(required=True) if key.name == "time_limit" else key for key in USER),
    ),
}
"""Keys of ``[model]`` by its ``kind``."""

SECTIONS: dict[str, tuple[Key, ...]] = {
    "record": (
        Key(
            "file",
            "text",
            "acceleration of the base: AT2, V2, SMC, GeoNet, K-NET, ESM, CSV, Excel, or a data set (.h5)",
        ),
        Key("bundled", "text", "a bundled synthetic motion, instead of a file"),
        Key("format", "text", "at2, v2, smc, geonet, knet, esm, csv or dataset; by default it is recognised"),
        Key("column", "text", "column of a CSV file or workbook, or component (GeoNet)"),
        Key("channel", "whole number", "channel of a V2 file"),
        Key("units", "text", "unit of the acceleration, if the file does not state it"),
        Key("time_unit", "text", "unit of the times of a CSV file, if the file does not state it"),
        Key("dt", "time", "time step, for a CSV file without times"),
        Key("skip", "whole number >= 0", "lines above the table of a CSV file, if they are not found"),
        Key("scale", "number", "factor by which the record is multiplied"),
        Key("duration", "time", "length of the first part that is used"),
        Key("every", "whole number >= 1", "keep every n-th sample: a faster simulation with a longer step"),
    ),
    "measurements": (
        Key("file", "text", "measured response: CSV, Excel, or a data set (.h5)"),
        Key("bundled", "text", "bundled synthetic measurements, instead of a file"),
        Key("columns", "table of texts", "channel = name of its column in the file"),
        Key("units", "table of texts", "channel = unit, if the file does not state it"),
        Key("channels", "texts", "channels to use; by default all"),
        Key("time_unit", "text", "unit of the times, if the file does not state it"),
        Key("dt", "time", "time step, for a file without times"),
        Key("skip", "whole number >= 0", "lines above the table, if they are not found"),
        Key("zero", _ZERO, "time in the file at which the base motion begins"),
        Key("missing", "numbers", "numbers that stand for missing samples"),
    ),
    "noise": (
        Key(
            "kind",
            "text",
            '"gaussian" (the default), or "autoregressive": each error depends on the one before, with a correlation '
            "per channel; takes sensor only",
        ),
        Key(
            "groups",
            "text or numbers",
            'what has a level: "channel" (the default), "all" for one level in root mean squares of the measured '
            'channels, "event" for each channel and event, or frequencies between bands [Hz], ascending, for each '
            "channel and band, so that errors are correlated in time",
        ),
        Key(
            "level",
            "text",
            'what a level is: "si" (the default), a standard deviation in the unit of the channel; "measured", a share '
            "of the root mean square of the measured channel, in predictions of the simulated response; "
            '"response", a share of the level of the simulated response, which follows it in time or per band',
        ),
        Key("sensor", "table of quantities", "channel = known standard deviation of the noise of its sensor"),
        Key("window", "time", 'level "response" or "measured": length of the window in which the level is taken'),
        Key(
            "local",
            "number",
            'level "response": 0 to 1 (0.25); 1: the noise follows the response in each window, 0: one level for the '
            "record",
        ),
        Key("marginal", "yes or no", "integrate the levels out (no); for levels in SI units without bands and sensor"),
    ),
    "sampler": (
        Key("kind", "text", '"smc" (the default), "tmcmc" or "emcee"'),
        Key("walkers", "whole number >= 1", "number of walkers (500; emcee: 4 per parameter, 32 or more)"),
        Key(
            "steps", "whole number >= 1", "sweeps at beta = 1, each of which stores all walkers (4); emcee: iterations"
        ),
        Key("discard", "whole number >= 0", "emcee: iterations that are left out as burn-in (half of steps)"),
        Key("seed", "whole number >= 0", "seed (1)"),
        Key("guide", "yes or no", "find the posterior from the responses, with hundreds of simulations (no)"),
        Key("preset", "text", '"ramancha2022", "ramancha2022-constant" or "ching-chen-2007": settings of papers'),
        Key("runs", "whole number >= 1", "runs of recycling that must agree (1)"),
        Key("recycle", "yes or no", "reuse every evaluated point; by default with 150 walkers or more"),
        Key("ess_ratio", "number", "share of effective walkers wanted at each stage, without recycling"),
        Key("min_moves", "whole number", "fewest sweeps per stage"),
        Key("max_moves", "whole number >= 1", "most sweeps per stage"),
        Key("max_failure_share", "number", "share of failed evaluations at which the run stops (0.5)"),
    ),
    "budget": (
        Key("max_simulations", "whole number >= 1", "most simulations; the run can be continued with more"),
        Key("workers", "whole number >= 1", "processes, for a model of your own (1); built-in models use all cores"),
        Key("cache", "yes or no", "keep every simulation in a file of the folder (yes)"),
    ),
    "prediction": (
        Key("draws", "whole number >= 0", "draws of the posterior whose response is predicted (100); 0 for none"),
        Key("noise", "yes or no", "predict measurements, with their noise (no)"),
        Key("quantiles", "probabilities", "of the quantiles ([0.05, 0.5, 0.95])"),
    ),
}
"""Keys of the sections besides ``[model]`` and ``[priors]``."""


EVENT: tuple[Key, ...] = (
    *(key for key in SECTIONS["record"] if key.name != "every"),
    Key("measured", "text", "measured response in this event, to be compared: a file as in [measurements]"),
    Key("zero", _ZERO, "time in this file at which the base motion begins; by default as in [measurements]"),
    Key("from_state", "text", '"virgin" (the default), or "end" to begin with the state after the record'),
    Key("rest", "time", 'pause before the motion, for "end" (10 s)'),
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
    "text or numbers": (
        lambda value: _is_text(value) or _all(_is_number, list)(value),
        "a text in quotes, or a list of numbers, such as [1.0, 5.0]",
    ),
    "whole numbers": (_all(_is_whole, list), "a list of whole numbers, such as [1, 2]"),
    "table of texts": (_all(_is_text, dict), 'texts by name, such as {top = "abc"}'),
    "table of quantities": (
        _all(lambda value: _is_number(value) or _is_text(value), dict),
        'numbers with units by name, such as {top = "0.01 g"}',
    ),
    "table of whole numbers": (_all(_is_whole, dict), "whole numbers by name, such as {top = 2}"),
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
    """A number in SI units, from such a number or a text with number and unit.

    Parameters
    ----------
    value : int, float or str
    dimension : str
        A key of `fe_likelihoods.units.DIMENSIONS`.

    Raises
    ------
    ValueError
        If it is neither, the unit is unknown or of another dimension, or a stress without a unit is below
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
    "strain": "100 microstrain",
    "rotation": "5 deg",
    "time": "20 s",
}


def read_keys(given: Mapping[str, Any], keys: Sequence[Key], where: str) -> dict[str, Any]:
    """Check the keys of a section and convert its values.

    Parameters
    ----------
    given : mapping of str to object
        The section as TOML gives it.
    keys : sequence of Key
    where : str
        File and section, for messages.

    Returns
    -------
    dict of str to object
        The values, quantities in SI units.

    Raises
    ------
    ValueError
        For an unknown key, one that is missing, or a value of another kind.
    """
    known = {key.name: key for key in keys}
    for name in given:
        if name not in known:
            raise ValueError(f"{where} {name}: unknown key; {did_you_mean(name, tuple(known))}")
    for key in keys:
        if key.required and key.name not in given:
            raise ValueError(f"{where} {key.name}: this key is missing; it is {key.meaning}")
    values = {}
    for name, value in given.items():
        kind = known[name].kind
        if kind == _ZERO:
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
