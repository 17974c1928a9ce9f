"""Tempered ensemble samplers behind the interface of emcee.

The names below, and every module of the package, are looked up when they are first used: emcee starts with all of
`scipy.stats`, which a program need not wait for until it samples.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors; _HOME says the same when the program runs
    from .alarms import SamplingWarning
    from .backends import read_ladder
    from .importance import EvidenceCheck
    from .ladder import Stage
    from .presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL
    from .smc import SMCSampler
    from .tempered import TemperedSampler
    from .tmcmc import TMCMCSampler

__all__ = [
    "CHING_CHEN_2007",
    "EvidenceCheck",
    "RAMANCHA_2022_CONSTANT",
    "RAMANCHA_2022_LITERAL",
    "SMCSampler",
    "SamplingWarning",
    "Stage",
    "TMCMCSampler",
    "TemperedSampler",
    "read_ladder",
]

_HOME = {
    "CHING_CHEN_2007": "presets",
    "EvidenceCheck": "importance",
    "RAMANCHA_2022_CONSTANT": "presets",
    "RAMANCHA_2022_LITERAL": "presets",
    "SMCSampler": "smc",
    "SamplingWarning": "alarms",
    "Stage": "ladder",
    "TMCMCSampler": "tmcmc",
    "TemperedSampler": "tempered",
    "read_ladder": "backends",
}


def __getattr__(name: str) -> Any:
    """A public name or a module of the package, imported when it is first named (PEP 562)."""
    if name in _HOME:
        return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    full = f"{__name__}.{name}"
    try:
        return import_module(full)
    except ModuleNotFoundError as error:
        if error.name != full:  # the module is there, and misses something itself
            raise
        raise AttributeError(f"module {__name__!r} has no attribute and no module {name!r}") from None


def __dir__() -> list[str]:
    from pkgutil import iter_modules

    return sorted({*globals(), *__all__, *(module.name for module in iter_modules(__path__))})
