"""Digest of the library's source files that a simulation depends on.

A fingerprint describes the inputs of a model, not what its code does with them. Cached results therefore also depend
on the source files of the library that the code of the model is in: the files of the model's class and of the classes
of its attributes (such as the parts of a structure), the files that these import, and so on. Imports inside functions
count. Imports for type checkers only (``if TYPE_CHECKING:``) and everything in the folder `plots` do not count, because
they cannot change a response.

The digest is one of bytes: a changed comment in one of these files changes it as well, a change in any other file does
not.
"""

import ast
import functools
import importlib.util
import sys
import sysconfig
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path, PurePath
from typing import Any

__all__ = ["LIBRARY", "imported_files", "inherits_fingerprint", "is_standard", "object_digest", "source_digest"]

LIBRARY = __name__.split(".")[0]
ROOT = Path(__file__).resolve().parents[1]
EXCLUDED = "plots"
MODELS = f"{LIBRARY}.models"


def object_digest(thing: Any, *modules: str) -> str:
    """Digest of the source files that an object depends on, and of further modules.

    Parameters
    ----------
    thing : object
        The files are those of its class, of the base classes, and of the classes of its attributes.
    *modules : str
        Full names of further modules of the library.

    Returns
    -------
    str
        As from `source_digest`.
    """
    return source_digest(*sorted({*modules, *_modules_of(thing)}))


def inherits_fingerprint(cls: type) -> bool:
    """Whether a class of the user has the fingerprint of a class of the library, which does not know its methods."""
    for base in cls.__mro__:
        if _top(base) == LIBRARY:
            return base is not cls
        if "fingerprint" in vars(base):
            return False
    return False


@functools.cache
def is_standard(top: str) -> bool:
    """Whether a module belongs to the standard library; not a file of the user with the name of such a module."""
    if top not in sys.stdlib_module_names:
        return False
    module = sys.modules.get(top)
    try:
        spec = getattr(module, "__spec__", None) or importlib.util.find_spec(top)
    except (ValueError, ImportError):
        return True
    file = getattr(module, "__file__", None) or getattr(spec, "origin", None)
    if file in (None, "built-in", "frozen"):
        return True
    folders = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib")}
    parents = set(Path(file).resolve().parents)
    return bool(folders & parents) and not {"site-packages", "dist-packages"} & set(Path(file).parts)


def _modules_of(thing: Any) -> set[str]:
    """Modules of the library in which the class of an object, its bases and the classes of its attributes are defined.

    A class of the user may use any model of the library, so all models stand in for its own modules.
    """
    modules = _library_modules(thing) | _modules_of_attributes(thing)
    if any(_top(base) != LIBRARY and not is_standard(_top(base)) for base in type(thing).__mro__):
        modules.add(MODELS)
    return modules


def _library_modules(thing: Any) -> set[str]:
    """Modules of the library in which the class of an object and its bases are defined."""
    return {base.__module__ for base in type(thing).__mro__ if _top(base) == LIBRARY}


def _top(cls: type) -> str:
    """Name of the package in which a class is defined."""
    return cls.__module__.split(".")[0]


def _modules_of_attributes(thing: Any) -> set[str]:
    """Modules of the library's classes among the attributes of an object and, recursively, among their attributes."""
    modules: set[str] = set()
    seen = {id(thing)}
    waiting = list(getattr(thing, "__dict__", {}).values())
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        found = _library_modules(value)
        modules |= found
        if found:
            waiting += getattr(value, "__dict__", {}).values()
        if isinstance(value, tuple | list):
            waiting += value
        elif isinstance(value, dict):
            waiting += value.values()
    return modules


@functools.cache
def source_digest(*modules: str) -> str:
    """Hex digest (BLAKE2b, 128 bits) of modules of the library and of all files that they import.

    Parameters
    ----------
    *modules : str
        Full names of modules. The name of a folder stands for all modules in it, and that of the library for all of
        its modules except the plots.
    """
    digest = blake2b(digest_size=16)
    for name, file in sorted(_closure(*modules).items()):
        content = file.read_bytes()
        digest.update(f"{name.as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()


def imported_files(*modules: str) -> set[Path]:
    """Files of modules of the library, and of the library's modules that they import directly or indirectly.

    Parameters
    ----------
    *modules : str
        As for `source_digest`.

    Returns
    -------
    set of Path
        Without the plots.
    """
    return set(_closure(*modules).values())


def _closure(*modules: str) -> dict[PurePath, Path]:
    """Files of modules and of all that they import; the keys are the places of the files in the library."""
    found: dict[PurePath, Path] = {}
    waiting = [item for module in modules for item in _files(tuple(module.split(".")[1:]))]
    while waiting:
        name, file = waiting.pop()
        if name not in found:
            found[name] = file
            waiting += _imports(name, file)
    return found


def _files(parts: tuple[str, ...]) -> list[tuple[PurePath, Path]]:
    """Places in the library and files of a module given by the parts of its name; all of a folder; none for a plot."""
    if parts[:1] == (EXCLUDED,):
        return []
    folder = ROOT.joinpath(*parts)
    file = folder.with_suffix(".py") if parts else folder
    if not file.is_file() and not folder.is_dir():  # a folder that an editable installation reads from elsewhere
        file = _origin(parts)
        if file is None:
            name = ".".join((LIBRARY, *parts))
            raise ValueError(
                f"the digest of the code needs the source file of the module {name}, which was not found; reinstall "
                f"{LIBRARY}"
            )
        folder = file.parent
        file = folder if file.name == "__init__.py" else file
    if file.is_file():
        return [(PurePath(*parts).with_suffix(".py"), file)]
    names = [(path.relative_to(folder), path) for path in folder.rglob("*.py")]
    return [(PurePath(*parts) / name, path) for name, path in names if parts or name.parts[0] != EXCLUDED]


@functools.cache
def _origin(parts: tuple[str, ...]) -> Path | None:
    """Source file of a module of the library, as Python would import it; None if there is none."""
    try:
        spec = importlib.util.find_spec(".".join((LIBRARY, *parts)))
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec and spec.origin and Path(spec.origin).suffix == ".py" else None


def _imports(place: PurePath, file: Path) -> list[tuple[PurePath, Path]]:
    """Places and files of the library's modules that a file imports."""
    package = place.parts[:-1]
    found: list[tuple[PurePath, Path]] = []
    for node in _statements(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            names = [tuple(alias.name.split(".")) for alias in node.names]
            parts = [name[1:] for name in names if name[0] == LIBRARY]
        elif isinstance(node, ast.ImportFrom):
            module = tuple((node.module or "").split(".")) if node.module else ()
            if node.level:
                base = package[: len(package) - node.level + 1] + module
            elif module[0] == LIBRARY:
                base = module[1:]
            else:
                continue
            parts = [base + (alias.name,) if _is_module(base + (alias.name,)) else base for alias in node.names]
        else:
            continue
        found += [item for one in parts for item in _files(one)]
    return found


def _is_module(parts: tuple[str, ...]) -> bool:
    path = ROOT.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").is_file() or (len(parts) == 1 and _origin(parts) is not None)


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """All statements below a node, without those for type checkers only."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        if field == "body" and isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        for child in getattr(node, field, ()) if not isinstance(node, ast.expr) else ():
            yield child
            yield from _statements(child)
