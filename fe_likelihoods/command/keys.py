"""Keys of the TOML file and their values: kinds, checks, quantities with units, priors, and the reading of one section.

Messages name the file, the section and the key, and propose the nearest known key for an unknown one.
"""

import dataclasses
import datetime
import difflib
import functools
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from ..signals.tables import is_clock
from ..units import DIMENSIONS, to_si

__all__ = [
    "FORMS",
    "Key",
    "check_known",
    "did_you_mean",
    "key",
    "keys_of",
    "parse_prior",
    "read_by_channel",
    "read_keys",
    "read_quantity",
]

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
    return dataclasses.field(metadata={"kind": kind, "unit": "", "meaning": meaning + shown}, **given)


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
    for each in sorted(dataclasses.fields(owner), key=lambda each: each.name in getattr(owner, "READING", ())):
        about, unit = each.metadata, each.metadata["unit"]
        kind = about["kind"] or next((name for name, si in DIMENSIONS.items() if si == unit), "")
        meaning, mark, rest = about["meaning"].partition("; ")
        meaning += f" [{unit}]" if unit and not kind else ""
        kind = kind or _KINDS_OF_TYPES.get(each.type.removesuffix(" | None"), "")
        required = each.default is dataclasses.MISSING and not optional
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
