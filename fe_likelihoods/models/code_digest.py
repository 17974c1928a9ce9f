"""What a Python function computes, as a digest that is the same in every process.

A result that is kept belongs to the code that made it. The digest goes through all that a function uses: its bytecode
and constants, its defaults, the values it closes over, the global names it mentions, and in the same way the functions
and classes of its own package that it calls. Of other packages only the name and the version enter. What cannot be
told apart by its value (an open file, a handle of compiled code) is refused, and the user asked for a version.
"""

import enum
import functools
import sys
import types
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from hashlib import blake2b
from pathlib import PurePath
from typing import Any

import numpy as np

__all__ = ["code_digest"]


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
        self.seen: dict[int, tuple[int, Any]] = {}  # the order of appearance, and the thing so that it keeps its id

    def of(self, thing: Any) -> bytes:
        if id(thing) in self.seen and not isinstance(thing, int | float | str | bytes | bool | None):
            return self._joined(["again", str(self.seen[id(thing)][0])])
        self.seen[id(thing)] = len(self.seen), thing
        return self._joined(self._parts(thing))

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
            return ["module", thing.__name__, self._version(thing.__name__)]
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
            return ["compiled", self._version("numba"), self.of(thing.py_func)]
        if isinstance(thing, types.BuiltinFunctionType | np.ufunc | type(len)):
            owner = getattr(thing, "__module__", None) or type(thing).__module__
            return ["builtin", owner, thing.__name__, self._version(owner)]
        if isinstance(thing, type):
            return self._class(thing)
        return self._object(thing)

    def _function(self, function: types.FunctionType) -> list[str | bytes]:
        parts: list[str | bytes] = ["function", function.__qualname__]
        if function.__module__.split(".")[0] != self.package:
            return [*parts, function.__module__, self._version(function.__module__)]
        closed_over = [_contents(cell) for cell in function.__closure__ or ()]
        parts += [self._joined(self._code(function.__code__))]
        parts += map(self.of, (function.__defaults__, function.__kwdefaults__, closed_over))
        for name in sorted(set(_names(function.__code__))):
            if name in function.__globals__:
                parts += [name, self._told(name, function.__globals__[name], function)]
        return parts

    def _told(self, name: str, value: Any, function: types.FunctionType) -> bytes:
        try:
            return self.of(value)
        except ValueError as error:
            raise ValueError(f"{function.__qualname__} uses {name}, and {error}") from None

    def _code(self, code: types.CodeType) -> list[str | bytes]:
        parts = map(self.of, (code.co_consts, code.co_names, code.co_varnames))
        return ["code", str(sys.implementation.cache_tag), code.co_code, *parts]

    def _class(self, thing: type) -> list[str | bytes]:
        parts: list[str | bytes] = ["class", thing.__qualname__]
        if thing.__module__.split(".")[0] != self.package:
            return [*parts, thing.__module__, self._version(thing.__module__)]
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
            return ["fingerprint", fingerprint]
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

    @staticmethod
    def _version(module: str) -> str:
        top = sys.modules.get(module.split(".")[0])
        version = getattr(top, "__version__", "")
        return version if isinstance(version, str) else ""


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
