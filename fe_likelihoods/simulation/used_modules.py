"""Modules that a function uses: which of them belong to the user, and the versions of the others."""

import dis
import functools
import importlib
import importlib.metadata
import importlib.util
import sys
import types
from collections.abc import Iterator
from hashlib import blake2b
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path, PurePath
from typing import Any

from .source_digest import LIBRARY, is_standard, source_digest

__all__ = ["imported_module", "imports_of", "is_own", "module_version", "package_version"]


@functools.cache
def is_own(top: str) -> bool:
    """Whether a module is neither installed nor in the standard library, so that it changes without a version."""
    if top in ("__main__", "__mp_main__"):  # a notebook has no file; the script has the second name in a worker
        return True
    if is_standard(top):
        return False
    module = sys.modules.get(top)
    try:
        spec = module.__spec__ if module else importlib.util.find_spec(top)
    except (ValueError, ImportError):
        spec = None
    found = getattr(module, "__file__", None) or getattr(spec, "origin", None)
    places = [found] if found else list(getattr(spec, "submodule_search_locations", None) or [])
    return any(not {"site-packages", "dist-packages"} & set(PurePath(place).parts) for place in places)


def imported_module(name: str) -> Any:
    """A module that a function imports, or the reason why it cannot be imported."""
    try:
        return importlib.import_module(name)
    except ImportError as error:  # it may be optional
        return f"{type(error).__name__} of {name}"


def module_version(module: str) -> str:
    """Digest of the source files for a module of this library, otherwise the version of the package."""
    return source_digest(module) if module.split(".")[0] == LIBRARY else package_version(module)


@functools.cache
def package_version(module: str) -> str:
    """Version of a package; for a compiled module without a version a digest of its file; otherwise empty."""
    top = module.split(".")[0]
    try:
        return importlib.metadata.version(top)
    except importlib.metadata.PackageNotFoundError:
        file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
        if file.name.endswith(tuple(EXTENSION_SUFFIXES)):
            return blake2b(file.read_bytes(), digest_size=16).hexdigest()
        version = getattr(sys.modules.get(top), "__version__", "")
        return version if isinstance(version, str) else ""


def imports_of(function: types.FunctionType) -> Iterator[str]:
    """Full names of the modules that a function imports when it runs."""
    for module, items in _import_statements(function.__code__):
        try:
            name = importlib.util.resolve_name(module, function.__globals__.get("__package__") or "")
        except ImportError:
            raise ValueError(f"{function.__qualname__} imports {module}, but is not in a package") from None
        yield name
        yield from (f"{name}.{item}" for item in items if _is_submodule(name, item))


@functools.lru_cache(maxsize=4096)
def _import_statements(code: types.CodeType) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Modules, with a dot for each level of a relative import, and the names that are imported from them."""
    found: list[tuple[str, tuple[str, ...]]] = []
    codes = [code]
    while codes:
        code = codes.pop()
        codes += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
        before: list[Any] = []
        for step in dis.get_instructions(code):
            if step.opname == "IMPORT_NAME":
                level = next((value for value in before[-2:] if isinstance(value, int)), 0)
                found.append(("." * level + step.argval, tuple(before[-1] or ())))
            before.append(step.argval)
    return tuple(found)


def _is_submodule(package: str, name: str) -> bool:
    """Whether ``from package import name`` imports a module of the user."""
    if not is_own(package.split(".")[0]) or package.split(".")[0] == LIBRARY:
        return False
    try:
        return importlib.util.find_spec(f"{package}.{name}") is not None
    except (ImportError, ValueError):
        return False
