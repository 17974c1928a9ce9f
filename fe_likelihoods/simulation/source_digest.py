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
import sys
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any

__all__ = ["imported_files", "object_digest", "simulation_fingerprint", "source_digest"]

LIBRARY = __name__.split(".")[0]
ROOT = Path(__file__).resolve().parents[1]
EXCLUDED = "plots"
MODELS = f"{LIBRARY}.models"


def simulation_fingerprint(model: Any, statistic: Any = None) -> str:
    """Fingerprint of a model together with the digest of the source files that its results depend on.

    Parameters
    ----------
    model : Model
        Its class may be defined outside the library.
    statistic : function, optional
        The statistic of the residuals that is stored, where it is not the sum of squares.

    Returns
    -------
    str
    """
    modules = [f"{LIBRARY}.simulation.model", *_modules_of(model)]
    if statistic is not None and statistic.__module__.split(".")[0] == LIBRARY:
        modules.append(statistic.__module__)
    return f"{model.fingerprint} {source_digest(*modules)}"


def object_digest(thing: Any) -> str:
    """Digest of the source files that an object depends on: of its class, the base classes, and its attributes."""
    return source_digest(*_modules_of(thing))


def _modules_of(thing: Any) -> list[str]:
    """Modules of the library in which the class of an object, its bases and the classes of its attributes are defined.

    A class of the user may use any model of the library, so all models stand in for its own modules.
    """
    modules = set()
    for base in type(thing).__mro__:
        top = base.__module__.split(".")[0]
        if top == LIBRARY:
            modules.add(base.__module__)
        elif top not in sys.stdlib_module_names:
            modules.add(MODELS)
    return sorted(modules | _modules_of_attributes(thing))


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
        found = {base.__module__ for base in type(value).__mro__ if base.__module__.split(".")[0] == LIBRARY}
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
    for path in sorted(imported_files(*modules)):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(ROOT).as_posix()}\0{len(content)}\0".encode() + content)
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
    found: set[Path] = set()
    waiting = [file for module in modules for file in _files(tuple(module.split(".")[1:]))]
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            waiting += _imports(file)
    return found


def _files(parts: tuple[str, ...]) -> list[Path]:
    """Files of a module of the library given by the parts of its name, all files of a folder; none for a plot."""
    if parts[:1] == (EXCLUDED,):
        return []
    file = ROOT.joinpath(*parts).with_suffix(".py") if parts else ROOT
    if file.is_file():
        return [file]
    folder = ROOT.joinpath(*parts)
    return [path for path in folder.rglob("*.py") if path.relative_to(ROOT).parts[0] != EXCLUDED]


def _imports(file: Path) -> list[Path]:
    """Files of the library's modules that a file imports."""
    package = file.relative_to(ROOT).parts[:-1]
    found = []
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
        found += [path for one in parts for path in _files(one)]
    return found


def _is_module(parts: tuple[str, ...]) -> bool:
    path = ROOT.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").is_file()


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    """All statements below a node, without those for type checkers only."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        if field == "body" and isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        for child in getattr(node, field, ()) if not isinstance(node, ast.expr) else ():
            yield child
            yield from _statements(child)
