"""What a Python function computes, as a digest that is the same in every process.

A result that is kept belongs to the code that made it. The digest goes through all that a function uses: its bytecode
and constants, its defaults, the values it closes over, the global names it mentions, what it imports as it runs, and in
the same way the functions and classes that it calls, in its own package and in any file that is not installed (beside
it, say). Of the standard library and of installed packages the name and the version enter, of this library its sources.
What cannot be told apart by its value (an open file, a handle of compiled code) is refused, and the user asked for a
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

from .source_digest import class_digest, source_digest

__all__ = ["code_digest"]

_LIBRARY = __name__.split(".")[0]


def code_digest(function: Callable) -> str:
    """Hex digest of a function and of all that it uses.

    Parameters
    ----------
    function : callable

    Raises
    ------
    ValueError
        If it uses something of which no stable digest can be made; the message says what.
    """
    return _Digest(_package(function)).of(function).hex()


def _package(thing: Any) -> str:
    while isinstance(thing, functools.partial):
        thing = thing.func
    module = getattr(thing, "__module__", None) or type(thing).__module__
    return module.split(".")[0]


class _Digest:
    def __init__(self, package: str) -> None:
        self.package = package
        self.open: dict[int, int] = {}  # what is being digested, and how deep: where it is met again, a circle closes
        self.done: dict[int, tuple[bytes, Any]] = {}  # with the thing, so that its id is not used again

    def of(self, thing: Any) -> bytes:
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
        kind = type(thing)
        if thing is None or kind in (bool, int, float, complex, str, bytes, type(Ellipsis)):
            return [kind.__name__, repr(thing)]
        if isinstance(thing, np.ndarray | np.generic) and not np.asarray(thing).dtype.hasobject:
            values = np.ascontiguousarray(thing)
            return ["array", values.dtype.str, repr(np.shape(thing)), values.tobytes()]
        if kind in (tuple, list):
            return [kind.__name__, *map(self.of, thing)]
        if kind in (set, frozenset):
            # each by itself, so that the order does not matter
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
            return ["builtin", owner, thing.__name__, _version(owner)]
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
        for name in names:
            if name in function.__globals__:
                parts += self._told(name, function.__globals__[name], names, function)
        for name in sorted(set(_imports(function))):
            if self._known_by_version(name):
                parts += [name, _version(name)]
            else:
                parts += self._told(name, importlib.import_module(name), names, function)
        return parts

    def _told(self, name: str, value: Any, names: list[str], function: types.FunctionType) -> list[str | bytes]:
        """Digest of a name that a function uses, and of what it may use of it behind a dot, if it is a module."""
        try:
            parts = [name, self.of(value)]
        except ValueError as error:
            raise ValueError(f"{function.__qualname__} uses {name}, and {error}") from None
        if isinstance(value, types.ModuleType) and not self._known_by_version(value.__name__):
            members = [member for member in names if member in vars(value) and vars(value)[member] is not value]
            for member in members:
                inner = [other for other in names if other != member]
                parts += self._told(member, vars(value)[member], inner, function)
        return parts

    def _code(self, code: types.CodeType) -> list[str | bytes]:
        parts = map(self.of, (code.co_consts, code.co_names, code.co_varnames))
        return ["code", str(sys.implementation.cache_tag), code.co_code, *parts]

    def _class(self, thing: type) -> list[str | bytes]:
        parts: list[str | bytes] = ["class", thing.__qualname__]
        if self._known_by_version(thing.__module__):
            return [*parts, thing.__module__, _version(thing.__module__)]
        if issubclass(thing, tuple) and hasattr(thing, "_fields"):
            return [*parts, *thing._fields]
        skipped = {"__doc__", "__module__", "__dict__", "__weakref__", "__annotations__", "__static_attributes__"}
        skipped |= {"__firstlineno__", "__annotations_cache__", "__annotate_func__", "__dataclass_fields__"}
        skipped |= {"__dataclass_params__", "__match_args__"}
        for name, member in vars(thing).items():
            if name not in skipped and not isinstance(member, types.MemberDescriptorType | types.GetSetDescriptorType):
                parts += [name, self.of(member)]
        return parts + [self.of(base) for base in thing.__bases__ if base is not object]

    def _object(self, thing: Any) -> list[str | bytes]:
        fingerprint = getattr(thing, "fingerprint", None)
        if isinstance(fingerprint, str):
            # a fingerprint describes values; what the methods of the library's classes do with them is in the sources
            return ["fingerprint", fingerprint, class_digest(type(thing))]
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
        """Whether a module is told by name and version: neither the function's package nor a file of the user's own."""
        top = module.split(".")[0]
        return top != self.package and (top == _LIBRARY or not _is_own(top))


@functools.cache
def _is_own(top: str) -> bool:
    """Whether a module is a file neither installed nor of the standard library: it changes without a version."""
    if top in sys.stdlib_module_names:
        return False
    module = sys.modules.get(top)
    try:
        spec = module.__spec__ if module else importlib.util.find_spec(top)
    except (ValueError, ImportError):
        spec = None
    found = getattr(module, "__file__", None) or getattr(spec, "origin", None)
    places = [found] if found else list(getattr(spec, "submodule_search_locations", None) or [])
    return any(not {"site-packages", "dist-packages"} & set(PurePath(place).parts) for place in places)


def _version(module: str) -> str:
    """What stands for the code of a module: of this library a digest of sources, otherwise the package's version."""
    return source_digest(module) if module.split(".")[0] == _LIBRARY else _package_version(module)


@functools.cache
def _package_version(module: str) -> str:
    """Version of a package, or of a compiled module without a version a digest of its file; otherwise empty."""
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
    """Full names of the modules that a function imports as it runs."""
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
                    raise ValueError(f"{function.__qualname__} imports {name}, but stands in no package") from None
            before.append(step.argval)


def _contents(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not yet filled
        return None


def _names(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)
