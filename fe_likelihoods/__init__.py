"""Structural finite-element models as black-box log-likelihoods.

Every module is there after ``import fe_likelihoods`` alone, as in ``fe_likelihoods.problems.bridge_column()``, and is
read when it is first named.
"""

from importlib import import_module
from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    """A module of the package, imported when it is first named (PEP 562)."""
    full = f"{__name__}.{name}"
    try:
        return import_module(full)
    except ModuleNotFoundError as error:
        if error.name != full:  # the module is there, and misses something itself
            raise
        raise AttributeError(f"module {__name__!r} has no attribute and no module {name!r}") from None


def __dir__() -> list[str]:
    from pkgutil import iter_modules

    return sorted({*globals(), *(module.name for module in iter_modules(__path__))})
