"""Digest of what a Python function computes, the same in every process.

A stored result belongs to the code that made it. The digest covers everything a function uses: its bytecode and
constants, its defaults, the values it closes over, the global names it uses, the modules it imports when it runs, and
recursively the functions and classes that it calls, in its own package and in any file that is not installed (such as a
file in the same folder). The standard library and installed packages are represented by name and version, modules of
this library by their source files (see `fe_likelihoods.simulation.source_digest`). For objects that cannot be
identified by their value (an open file, a handle of compiled code) a ValueError is raised, and the user is asked for a
version.
"""

import dis
import enum
import functools
import importlib
import importlib.metadata
import importlib.util
import logging
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from hashlib import blake2b
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from .source_digest import LIBRARY, inherits_fingerprint, object_digest, source_digest

__all__ = ["code_digest"]


def code_digest(function: Callable) -> str:
    """Digest of a function, or a class, and of everything it uses.

    Parameters
    ----------
    function : callable

    Returns
    -------
    str
        Hexadecimal, 128 bits.

    Raises
    ------
    ValueError
        If it uses an object that has no stable digest; the message names it.
    """
    return _Digest(_package(function)).of(function).hex()


def _package(thing: Any) -> str:
    """Top-level package in which a function or the class of a callable object is defined."""
    while isinstance(thing, functools.partial):
        thing = thing.func
    module = getattr(thing, "__module__", None) or type(thing).__module__
    return module.split(".")[0]


class _Digest:
    """Digests of objects, relative to the package of one function.

    Parameters
    ----------
    package : str
        Package whose functions and classes are covered by their code instead of a version.
    """

    def __init__(self, package: str) -> None:
        self.package = package
        self.open: dict[int, int] = {}  # ids of the objects in progress and their depths, to detect cycles
        self.done: dict[int, tuple[bytes, Any]] = {}  # with the object, so that its id is not reused

    def of(self, thing: Any) -> bytes:
        """Digest of an object."""
        key = id(thing)
        if key in self.done:
            return self.done[key][0]
        if key in self.open:
            return self._joined(["circle", str(self.open[key])])
        self.open[key] = len(self.open)
        try:
            digest = self._joined(self._parts(thing))
        finally:
            del self.open[key]
        self.done[key] = digest, thing
        return digest

    @staticmethod
    def _joined(parts: list[str | bytes]) -> bytes:
        digest = blake2b(digest_size=16)
        for part in parts:
            data = part.encode() if isinstance(part, str) else part
            digest.update(len(data).to_bytes(8, "little") + data)
        return digest.digest()

    def _parts(self, thing: Any) -> list[str | bytes]:
        """Parts of which the digest of an object is made, by its type."""
        kind = type(thing)
        if thing is None or kind in (bool, int, float, complex, str, bytes, type(Ellipsis)):
            return [kind.__name__, repr(thing)]
        if isinstance(thing, np.ndarray | np.generic) and not np.asarray(thing).dtype.hasobject:
            values = np.ascontiguousarray(thing)
            return ["array", values.dtype.str, repr(np.shape(thing)), values.tobytes()]
        if kind in (tuple, list):
            return [kind.__name__, *map(self.of, thing)]
        if kind in (set, frozenset):
            # a separate digest for each item, so that the order does not matter
            return [kind.__name__, *sorted(_Digest(self.package).of(item) for item in thing)]
        if isinstance(thing, dict | types.MappingProxyType):
            return ["dict", *(self.of(part) for item in thing.items() for part in item)]
        if isinstance(thing, PurePath):
            return ["path", str(thing)]
        if isinstance(thing, types.ModuleType):
            return ["module", thing.__name__, _version(thing.__name__)]
        if isinstance(thing, logging.Logger):
            return ["logger", thing.name]
        if isinstance(thing, types.CodeType):
            return self._code(thing)
        if isinstance(thing, functools.partial):
            return ["partial", *map(self.of, (thing.func, thing.args, thing.keywords))]
        if isinstance(thing, types.MethodType):
            return ["method", self.of(thing.__func__), self.of(thing.__self__)]
        if isinstance(thing, staticmethod | classmethod):
            return [kind.__name__, self.of(thing.__func__)]
        if isinstance(thing, property):
            return ["property", *map(self.of, (thing.fget, thing.fset))]
        if isinstance(thing, types.FunctionType):
            return self._function(thing)
        if isinstance(getattr(thing, "py_func", None), types.FunctionType):  # compiled by numba
            return ["compiled", _version("numba"), self.of(thing.py_func)]
        if isinstance(thing, types.BuiltinFunctionType | np.ufunc | type(len)):
            owner = getattr(thing, "__module__", None) or type(thing).__module__
            bound = getattr(thing, "__self__", None)  # the array of array.dot; the module of a function of a module
            values = [] if bound is None or isinstance(bound, types.ModuleType) else [self.of(bound)]
            return ["builtin", owner, thing.__name__, _version(owner), *values]
        if isinstance(thing, type):
            return self._class(thing)
        return self._object(thing)

    def _function(self, function: types.FunctionType) -> list[str | bytes]:
        parts: list[str | bytes] = ["function", function.__qualname__]
        if self._known_by_version(function.__module__):
            return [*parts, function.__module__, _version(function.__module__)]
        closed_over = [_contents(cell) for cell in function.__closure__ or ()]
        parts += [self._joined(self._code(function.__code__))]
        parts += map(self.of, (function.__defaults__, function.__kwdefaults__, closed_over))
        names = sorted(set(_names(function.__code__)))
        for name in sorted(set(_global_names(function.__code__))):
            if name in function.__globals__:
                parts += self._named(name, function.__globals__[name], names, function)
        for name in sorted(set(_imports(function))):
            if self._known_by_version(name):
                parts += [name, _version(name)]
            else:
                parts += self._named(name, importlib.import_module(name), names, function)
        return parts

    def _named(self, name: str, value: Any, names: list[str], function: types.FunctionType) -> list[str | bytes]:
        """Digest of the value of a name in a function, and of the attributes that it uses if the value is a module."""
        try:
            parts = [name, self.of(value)]
        except ValueError as error:
            raise ValueError(f"{function.__qualname__} uses {name}, and {error}") from None
        if isinstance(value, types.ModuleType) and not self._known_by_version(value.__name__):
            members = [member for member in names if member in vars(value) and vars(value)[member] is not value]
            for member in members:
                inner = [other for other in names if other != member]
                parts += self._named(member, vars(value)[member], inner, function)
        return parts

    def _code(self, code: types.CodeType) -> list[str | bytes]:
        parts = map(self.of, (code.co_consts, code.co_names, code.co_varnames))
        return ["code", str(sys.implementation.cache_tag), code.co_code, *parts]

    def _class(self, thing: type) -> list[str | bytes]:
        parts: list[str | bytes] = ["class", thing.__qualname__]
        if self._known_by_version(thing.__module__):
            return [*parts, thing.__module__, _version(thing.__module__)]
        skipped = {"__doc__", "__module__", "__dict__", "__weakref__", "__annotations__", "__static_attributes__"}
        skipped |= {"__firstlineno__", "__annotations_cache__", "__annotate_func__", "__dataclass_fields__"}
        skipped |= {"__dataclass_params__", "__match_args__", "__orig_bases__", "_abc_impl"}
        if issubclass(thing, tuple) and "_fields" in vars(thing):  # the generated members of a named tuple
            skipped |= {"__new__", *thing._fields}
        for name, member in vars(thing).items():
            if name not in skipped and not isinstance(member, types.MemberDescriptorType | types.GetSetDescriptorType):
                parts += [name, self.of(member)]
        return parts + [self.of(base) for base in thing.__bases__ if base is not object]

    def _object(self, thing: Any) -> list[str | bytes]:
        fingerprint = getattr(thing, "fingerprint", None)
        if isinstance(fingerprint, str):
            # a fingerprint describes values; the source files determine what the class does with them
            code = [self.of(type(thing))] if inherits_fingerprint(type(thing)) else []
            return ["fingerprint", fingerprint, object_digest(thing), *code]
        if isinstance(thing, enum.Enum):
            state = {thing.name: thing.value}
        elif is_dataclass(thing):
            state = {field.name: getattr(thing, field.name) for field in fields(thing)}
        elif isinstance(thing, tuple):  # named
            state = dict(enumerate(thing))
        elif type(thing).__module__ != "builtins" and isinstance(getattr(thing, "__dict__", None), dict):
            state = vars(thing)
            plain = type(thing).__reduce_ex__ is object.__reduce_ex__ and type(thing).__reduce__ is object.__reduce__
            if not plain or hasattr(type(thing), "__slots__"):
                state = None
        else:
            state = None
        if state is None:
            raise ValueError(
                f"no digest can be made of {repr(thing)[:80]} ({type(thing).__name__}) that would be the same in "
                "another process"
            )
        return ["object", self.of(type(thing)), *(self.of(part) for item in state.items() for part in item)]

    def _known_by_version(self, module: str) -> bool:
        """Whether a module is represented by a version: neither in the function's package nor a file of the user."""
        top = module.split(".")[0]
        return top != self.package and (top == LIBRARY or not _is_own(top))


@functools.cache
def _is_own(top: str) -> bool:
    """Whether a module is neither installed nor in the standard library, so that it changes without a version."""
    if top in sys.stdlib_module_names:
        return False
    if top == "__main__":  # a notebook has no file
        return True
    module = sys.modules.get(top)
    try:
        spec = module.__spec__ if module else importlib.util.find_spec(top)
    except (ValueError, ImportError):
        spec = None
    found = getattr(module, "__file__", None) or getattr(spec, "origin", None)
    places = [found] if found else list(getattr(spec, "submodule_search_locations", None) or [])
    return any(not {"site-packages", "dist-packages"} & set(PurePath(place).parts) for place in places)


def _version(module: str) -> str:
    """Digest of the source files for a module of this library, otherwise the version of the package."""
    return source_digest(module) if module.split(".")[0] == LIBRARY else _package_version(module)


@functools.cache
def _package_version(module: str) -> str:
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


def _imports(function: types.FunctionType) -> Iterator[str]:
    """Full names of the modules that a function imports when it runs."""
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        codes += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
        before: list[Any] = []
        for step in dis.get_instructions(code):
            if step.opname == "IMPORT_NAME":
                level = next((value for value in before[-2:] if isinstance(value, int)), 0)
                name, package = "." * level + step.argval, function.__globals__.get("__package__") or ""
                try:
                    yield importlib.util.resolve_name(name, package)
                except ImportError:
                    raise ValueError(f"{function.__qualname__} imports {name}, but is not in a package") from None
            before.append(step.argval)


def _contents(cell: types.CellType) -> Any:
    """Value of a closure variable, None if it is not set yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _global_names(code: types.CodeType) -> Iterator[str]:
    """Names of globals, without attributes, that a code object and the functions defined in it read."""
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
            yield step.argval
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _global_names(constant)


def _names(code: types.CodeType) -> Iterator[str]:
    """Names of globals and attributes in a code object and the functions defined in it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)
