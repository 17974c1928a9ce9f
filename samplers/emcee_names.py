"""Names of emcee, imported without `scipy.stats`, which takes as long to import as all else that a sampler needs.

Only the module of emcee's KDEMove imports it; here that module gets a function that imports it when it is called.
"""

import builtins
import sys
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType, SimpleNamespace
from typing import Any

__all__ = [
    "Backend",
    "DEMove",
    "DESnookerMove",
    "EnsembleSampler",
    "HDFBackend",
    "MHMove",
    "Model",
    "Move",
    "RedBlueMove",
    "State",
    "get_progress_bar",
    "ndarray_to_list_of_dicts",
    "walkers_independent",
]


def _gaussian_kde(*arguments: Any, **options: Any) -> Any:
    from scipy.stats import gaussian_kde

    return gaussian_kde(*arguments, **options)


def _import(name: str, *arguments: Any) -> Any:
    late = SimpleNamespace(gaussian_kde=_gaussian_kde)
    return late if name == "scipy.stats" else builtins.__import__(name, *arguments)


class _Loader(SourceFileLoader):
    """Loads a module whose own imports are those of `_import`."""

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["__builtins__"] = vars(builtins) | {"__import__": _import}
        super().exec_module(module)


class _Finder:
    """Finds the module of KDEMove, and leaves all others to the other finders."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path) if name == "emcee.moves.kde" else None
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(name, spec.loader.path)
        return spec


sys.meta_path.insert(0, _Finder)
try:
    from emcee import EnsembleSampler, State
    from emcee.backends import Backend, HDFBackend
    from emcee.ensemble import ndarray_to_list_of_dicts, walkers_independent
    from emcee.model import Model
    from emcee.moves import DEMove, DESnookerMove, MHMove, Move, RedBlueMove
    from emcee.pbar import get_progress_bar
finally:
    sys.meta_path.remove(_Finder)
