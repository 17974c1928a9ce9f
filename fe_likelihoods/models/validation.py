"""Checks of the arguments and parameters of models.

Every message states what was expected, what was given and what to do. A wrong argument raises `ValueError` when a model
is built. Parameters that describe no structure raise `SimulationFailed` when they are simulated, because a sampler may
propose them.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, fields
from numbers import Integral, Real
from typing import Any

import numpy as np

from ..simulation.model import SimulationFailed

_ADVICE = "give one number in SI units"


def invalid(expected: str, got: object, advice: str) -> ValueError:
    """Error with the message ``expected ...; got ...; advice``, to be raised by the caller."""
    return ValueError(f"expected {expected}; got {got!r}; {advice}")


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def check_number(kind: str, name: str, value: object) -> None:
    """Raise ValueError if `value` is not a finite number that is "positive", "zero or positive" or any ("finite")."""
    least = {"positive": math.ulp(0.0), "zero or positive": 0.0, "finite": -math.inf}[kind]
    if not (_is_finite(value) and value >= least):
        raise invalid(f"a {kind} {name}", value, _ADVICE)


def check_integer(name: str, value: object, low: int, high: int) -> None:
    """Raise ValueError if `value` is not an integer from `low` to `high`, both included."""
    if not isinstance(value, Integral) or isinstance(value, bool) or not low <= value <= high:
        raise invalid(f"{name} between {low} and {high}, an integer", value, "see the documentation of the model")


def described(unit: str, meaning: str, sign: str = "", default: Any = ..., more: str = "", kind: str = "") -> Any:
    """A field of a `structure`: SI unit, meaning, and further sentences for the docstring alone.

    The `sign` is a kind of `check_number` that `check_described` asks for; `kind` that of the key of a TOML file, if it
    does not follow from unit and type.
    """
    metadata = {"unit": unit, "meaning": meaning, "sign": sign, "more": more, "kind": kind}
    return field(metadata=metadata, **({} if default is ... else {"default": default}))


def structure(kind: type) -> type:
    """A class with its described fields as the section "Parameters" of its docstring, before other sections."""
    lines = ["Parameters", "----------"]
    for each in fields(kind) if kind.__doc__ else ():  # there are no docstrings with the option -OO of Python
        form = re.sub(r"(\w+)\[(\w+)(, \.\.\.)?\]", r"\1 of \2", each.type)
        optional = each.default is None and form.endswith(" | None")
        about, unit = each.metadata, f" [{each.metadata['unit']}]" if each.metadata["unit"] else ""
        first, mark, rest = about["meaning"].partition("; ")
        lines.append(f"{each.name} : {form.removesuffix(' | None') + ', optional' if optional else form}")
        lines += [f"    {line}" for line in textwrap.wrap(f"{first}{unit}{mark}{rest}. {about['more']}", 112)]
    if kind.__doc__:
        head, mark, rest = re.split(r"(\n    (?=(?:Raises|Notes|Examples)\n)|$)", kind.__doc__, maxsplit=1)
        kind.__doc__ = "\n    ".join([f"{head.rstrip()}\n", *lines]) + f"\n{mark}{rest}"
    return kind


def check_described(instance: Any, of: str = "") -> None:
    """Check the described fields of an instance by `check_number`; those with the default None may be None.

    `of`, such as ``"of a pier"``, is appended to the names in messages of ValueError.
    """
    for each in fields(instance):
        value = getattr(instance, each.name)
        if each.metadata.get("sign") and (value is not None or each.default is not None):
            check_number(each.metadata["sign"], f"{each.name} {of}".rstrip(), value)


def positive_float(value: Any, name: str, unit: str) -> float:
    """Convert `value` to a float; raise ValueError if it is not a positive finite number of `unit`."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not (math.isfinite(number) and number > 0.0):
        raise ValueError(f"{name} must be a positive number of {unit}; got {value!r}")
    return number


def check_names(what: str, names: object, known: Collection[str], advice: str) -> None:
    """Raise ValueError if `names` is not a non-empty sequence of different names out of `known`."""
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or set(names) - set(known):
        raise invalid(f"{what} out of {tuple(known)}", names, advice)
    if len(set(names)) != len(names):
        raise invalid(f"each of the {what} once", names, "remove the repeated name")


def check_nominal(names: Sequence[str], nominal: Mapping[str, float]) -> None:
    """Raise ValueError if one of the parameters `names` has a nominal value of zero, which has no multiples."""
    zero = [name for name in names if nominal[name] == 0.0]
    if zero:
        raise invalid("non-zero nominal values", zero, "set these values, or remove the names from parameters")


def check_values(values: Mapping[str, float], may_be_zero: Collection[str] = ()) -> None:
    """Raise SimulationFailed if a physical value is not finite and positive; values in `may_be_zero` may be zero."""
    for name, value in values.items():
        if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name not in may_be_zero):
            raise SimulationFailed(f"{name} = {value:.4g} is outside the range of the model: it must be positive")


def check_theta(theta: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Convert the parameters of one simulation to floats (n_parameters,); raise ValueError for another shape."""
    theta = np.asarray(theta, dtype=float)
    if theta.shape != (len(names),):
        raise ValueError(f"expected one value for each of {tuple(names)}, shape ({len(names)},); got {theta.shape}")
    return theta


def check_thetas(thetas: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Convert the parameters of a batch to floats (n, n_parameters); raise ValueError for another shape."""
    thetas = np.asarray(thetas, dtype=float)
    if thetas.ndim != 2 or thetas.shape[1] != len(names):
        raise ValueError(
            f"expected rows with one value for each of {tuple(names)}, shape (n, {len(names)}); got {thetas.shape}"
        )
    return thetas
