"""Which code belongs to the user, and the digest of this library's source files.

User code has no version: it is sent to workers by value, and labels contain its source. This library is represented by
a digest of its files, and installed packages by their versions.
"""

import functools
import importlib.metadata
import sys
import sysconfig
import types
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

__all__ = ["LIBRARY", "SCRIPTS", "code_within", "is_of_user", "package_version", "sources_digest"]

LIBRARY = __name__.split(".")[0]
SCRIPTS = ("__main__", "__mp_main__")  # names of a script or notebook, and of a script in a worker that imports it


def is_of_user(module: Any) -> bool:
    """Whether a module (or its name) is user code, not part of this library, of Python or of an installed package."""
    if isinstance(module, str):
        name, module = module, sys.modules.get(module)
    else:
        name = _values(module).get("__name__")
    if not isinstance(name, str):
        return False
    return _is_of_user(name, _places(module) or _places(sys.modules.get(name.partition(".")[0])))


def code_within(model: Any) -> dict[str, Any]:
    """User code of a model that another one contains, as ``code_parts()`` of that one; empty if there is none."""
    own = {"model": model} if is_of_user(type(model).__module__) else {}
    return own | (model.code_parts() if hasattr(model, "code_parts") else {})


def _values(module: Any) -> dict[str, Any]:
    # asking a lazy module for an attribute would import it
    return object.__getattribute__(module, "__dict__") if isinstance(module, types.ModuleType) else {}


def _places(module: Any) -> tuple[str, ...]:
    """The file of a module, or the folders of a package that has no file."""
    file = _values(module).get("__file__")
    return (file,) if isinstance(file, str) else tuple(map(str, _values(module).get("__path__", ())))


@functools.cache
def _is_of_user(name: str, places: tuple[str, ...]) -> bool:
    top = name.partition(".")[0]
    if top in SCRIPTS:
        return True
    if not top or top in (LIBRARY, "samplers") or top in sys.builtin_module_names:
        return False
    for path in map(Path, places):
        if {"site-packages", "dist-packages"} & set(path.resolve().parts):
            return not package_version(top)
        if any(path.resolve().is_relative_to(folder) for folder in _standard_folders()):
            return False
    return bool(places) or top not in sys.stdlib_module_names  # a module created by code has no file


@functools.cache
def _standard_folders() -> tuple[Path, ...]:
    return tuple(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib"))


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


@functools.cache  # of what this process has imported; reading it takes milliseconds, and labels ask again and again
def package_version(top: str) -> str:
    """Version of an installed package, by the name of its top-level module; empty for other modules."""
    try:
        return importlib.metadata.version(top)
    except (importlib.metadata.PackageNotFoundError, ValueError):
        pass
    try:
        return " ".join(map(importlib.metadata.version, _distributions().get(top, ())))
    except importlib.metadata.PackageNotFoundError:
        return ""


@functools.cache
def sources_digest() -> bytes:
    """Digest of this library's source files."""
    root, digest = Path(__file__).resolve().parents[1], blake2b(digest_size=16)
    for file in sorted(root.glob("**/*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.digest()
