"""Prior distributions as text, such as ``normal(1, 0.3)``, ``half-normal(0.1 g)`` and ``uniform(-1, 1)``."""

import math
import re

from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from ..units import to_si
from .keys import split_number

__all__ = ["FORMS", "parse_prior"]

FORMS = {
    "normal": ("normal(mean, sd) or normal(mean, sd, lower, upper); without bounds it is positive", (2, 4)),
    "half-normal": ("half-normal(sd), sd before taking the absolute value", (1,)),
    "uniform": ("uniform(low, high)", (2,)),
    "log-normal": ("log-normal(median, sd of the natural logarithm)", (2,)),
}
_MAKE = {"normal": TruncatedNormal, "half-normal": HalfNormal, "uniform": Uniform, "log-normal": LogNormal}


def parse_prior(text: str, dimension: str | None = None) -> Distribution:
    """Make a distribution from its text, such as ``half-normal(0.1 g)``; numbers without a unit are in SI units.

    Units must have the dimension, a key of `fe_likelihoods.units.DIMENSIONS`. ValueError for an unknown name, another
    number of arguments, or values that the distribution refuses.
    """
    forms = "; ".join(form for form, _ in FORMS.values())
    match = re.fullmatch(r"\s*([A-Za-z-]+)\s*\(([^()]*)\)\s*", text) if isinstance(text, str) else None
    if match is None or match[1].lower() not in FORMS:
        raise ValueError(
            f'expected a distribution in quotes, such as "normal(1, 0.3)"; got {text!r}; known are {forms}'
        )
    name = match[1].lower()
    arguments = [argument for argument in match[2].split(",") if argument.strip()]
    form, counts = FORMS[name]
    if len(arguments) not in counts:
        raise ValueError(f"expected {form}; got {text!r}")
    if name == "log-normal" and split_number(arguments[1])[1]:
        raise ValueError(f"expected {form}, which has no unit; got {text!r}")
    return _MAKE[name](*(_number(argument, text, dimension) for argument in arguments))


def _number(argument: str, text: str, dimension: str | None) -> float:
    number, unit = split_number(argument)
    try:
        value = float(number)
    except ValueError:
        raise ValueError(
            f"expected a number, or a number with a unit such as '0.1 g'; got {argument!r} in {text!r}"
        ) from None
    if math.isnan(value):
        raise ValueError(f"expected a number; got {argument!r} in {text!r}")
    return to_si(value, unit, dimension).item() if unit else value
