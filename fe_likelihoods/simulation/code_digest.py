"""Digest of what a Python function computes, the same in every process.

A stored result belongs to the code that made it. The digest covers the bytecode and constants of a function, its
defaults and attributes, the values it closes over, the global names it uses, the modules it imports when it runs, and
recursively the functions, classes and objects that it uses, in its own package and in any file that is not installed
(such as a file in the same folder). Of a module of the user, however it is reached, the members count whose names
appear in any of these functions. The standard library and installed packages are represented by name and version,
modules of this library by their source files (see `fe_likelihoods.simulation.source_digest`). Objects are represented
by their values (see `fe_likelihoods.simulation.object_state`). For those without a value that is the same in another
process (an open file, a handle of compiled code) a ValueError is raised, and the user is asked for a version.

A second digest leaves out what the code may itself change when it runs, such as a counter (see
`fe_likelihoods.simulation.own_writes`).

The digest cannot contain what the code finds only while it runs: files and environment variables that it reads, names
that it composes, modules that it imports by a computed name. They can be named in ``depends_on=`` of a model; besides,
stored results are compared with new ones (see `fe_likelihoods.simulation.verification`).
"""

import builtins
import dis
import enum
import functools
import logging
import re
import sys
import types
from collections import defaultdict
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from . import object_state
from .own_writes import writes_of
from .source_digest import LIBRARY, inherits_fingerprint, object_digest
from .used_modules import imported_module, imports_of, is_own, module_version

__all__ = ["CodeDescription", "code_digest", "describe_code"]

_DESCRIPTORS = (types.WrapperDescriptorType, types.MethodDescriptorType, types.ClassMethodDescriptorType)
_WRAPPED = {"__wrapped__", "__module__", "__name__", "__qualname__", "__doc__", "__dict__", "cache_parameters"}


class CodeDescription(NamedTuple):
    """Digest of a function, and where its code is.

    Attributes
    ----------
    digest : str
        Hexadecimal, 128 bits.
    steady : str
        The same without the values that the code may itself change when it runs.
    files : tuple of str
        Files of the user that contain the code, sorted.
    code : dict of str to frozenset of bytes
        Digests of the bytecode alone, per name of a function.
    values : dict of str to bytes
        Digests of the values that belong to names of modules, classes and functions.
    """

    digest: str
    steady: str
    files: tuple[str, ...]
    code: dict[str, frozenset[bytes]]
    values: dict[str, bytes]


def code_digest(thing: Any) -> str:
    """Digest of a function, a class or a value, and of everything it uses.

    Parameters
    ----------
    thing : object

    Returns
    -------
    str
        Hexadecimal, 128 bits.

    Raises
    ------
    ValueError
        If it uses an object that has no stable digest; the message names it.
    """
    return describe_code(thing).digest


def describe_code(thing: Any, strict: bool = True, user: Any = None) -> CodeDescription:
    """As `code_digest`, with the files of the code, and with separate digests of bytecode and of values.

    Parameters
    ----------
    thing : object
    strict : bool
        False: objects without a stable digest are represented by their class, and no ValueError is raised.
    user : object, optional
        Function or class whose package is covered by its code instead of a version; by default `thing`.
    """
    package = _package(thing if user is None else user)
    digest = _Digest(package, strict)
    text = digest.whole(thing).hex()
    code = {name: frozenset(digests) for name, digests in digest.bytecode.items()}
    own, steady = digest.own_changes(), text
    if digest.changes_by_use or any(own):
        steady = _Digest(package, False, own).whole(thing).hex()
    return CodeDescription(text, steady, tuple(sorted(digest.files)), code, digest.values)


class _OwnChanges(NamedTuple):
    """Names of values that the code of a user may change: of variables per module, of closures, of attributes."""

    variables: set[tuple[str, str]]
    closures: set[str]
    attributes: set[str]


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
    strict : bool
        As for `describe_code`.
    skipped : _OwnChanges, optional
        Values that are left out, together with objects that every use changes.
    """

    def __init__(self, package: str, strict: bool = True, skipped: _OwnChanges | None = None) -> None:
        self.package, self.strict, self.skipped = package, strict, skipped
        self.open: dict[int, int] = {}  # ids of the objects in progress and their depths, to detect cycles
        self.done: dict[int, tuple[bytes, Any]] = {}  # with the object, so that its id is not reused
        self.names: set[str] = set()  # of globals and attributes in the functions of the user
        self.modules: dict[str, types.ModuleType] = {}  # of the user, reached as globals, values or imports
        self.files: set[str] = set()
        self.bytecode: dict[str, set[bytes]] = defaultdict(set)
        self.values: dict[str, bytes] = {}
        self.functions: dict[types.CodeType, types.FunctionType] = {}  # of the user
        self.changes_by_use = False  # whether there are objects that every use changes

    def own_changes(self) -> _OwnChanges:
        """What the functions that were digested may change."""
        found = _OwnChanges(set(), set(), set())
        writes = {function: writes_of(code) for code, function in self.functions.items()}
        changing = {function.__name__ for function, one in writes.items() if one.changes_arguments}
        for function, one in writes.items():
            passed = {(variable, attribute) for name, variable, attribute in one.arguments if name in changing}
            variables = one.variables | one.containers | {variable for variable, attribute in passed if not attribute}
            found.variables.update((_module_name(function), name) for name in variables)
            found.closures.update(variables & set(function.__code__.co_freevars))
            for variable, attribute in one.attributes | {place for place in passed if place[1]}:
                owner = function.__globals__.get(variable)
                if isinstance(owner, types.ModuleType):
                    found.variables.add((owner.__name__, attribute))
                elif attribute.startswith("__") and not attribute.endswith("__"):
                    cls = function.__qualname__.rpartition(".")[0].rpartition(".")[2]
                    found.attributes.add(f"_{cls.lstrip('_')}{attribute}")
                else:
                    found.attributes.add(attribute)
        return found

    def _is_skipped(self, name: str, module: str | None = None) -> bool:
        """Whether a variable of a module, or an attribute, is left out."""
        if self.skipped is None:
            return False
        return name in self.skipped.attributes if module is None else (module, name) in self.skipped.variables

    def whole(self, thing: Any) -> bytes:
        """Digest of an object and of the members that its functions use of the user's modules."""
        parts, seen = [self.of(thing)], set()
        while True:
            members = [(m, n) for m in self.modules for n in self.names & vars(self.modules[m]).keys()]
            new = sorted(set(members) - seen)
            if not new:
                return self._joined(parts)
            seen.update(new)
            for module, name in new:
                value = vars(self.modules[module])[name]
                if value is not self.modules[module] and not self._is_skipped(name, module):
                    parts += [module, *self._named(name, value, module)]
                    self.values[f"{module}.{name}"] = parts[-1]

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
        if kind is bytearray:
            return ["bytearray", bytes(thing)]
        if (kind in (np.ndarray, np.memmap) or isinstance(thing, np.generic)) and not np.asarray(thing).dtype.hasobject:
            values = np.ascontiguousarray(thing)
            return ["array", values.dtype.str, repr(np.shape(thing)), values.tobytes()]
        if kind in (tuple, list):
            return [kind.__name__, *map(self.of, thing)]
        if kind in (set, frozenset):
            # a separate digest for each item, so that the order does not matter
            return [kind.__name__, *sorted(self._separate().of(item) for item in thing)]
        if kind in (dict, types.MappingProxyType):
            return ["dict", *(self.of(part) for item in thing.items() for part in item)]
        if isinstance(thing, PurePath):
            return ["path", str(thing)]
        if isinstance(thing, types.ModuleType):
            if not self._known_by_version(thing.__name__):
                self.modules[thing.__name__] = thing
                self.files.update(filter(None, [getattr(thing, "__file__", None)]))
            return ["module", thing.__name__, module_version(thing.__name__)]
        if isinstance(thing, logging.Logger):
            return ["logger", thing.name]
        if isinstance(thing, types.CodeType):
            return self._code(thing)
        if isinstance(thing, functools.partial):
            return ["partial", *map(self.of, (thing.func, thing.args, thing.keywords, self._kept(vars(thing))))]
        if isinstance(thing, types.MethodType):
            return ["method", self.of(thing.__func__), self.of(thing.__self__)]
        if isinstance(thing, staticmethod | classmethod):
            return [kind.__name__, self.of(thing.__func__)]
        if isinstance(thing, property):
            return ["property", *map(self.of, (thing.fget, thing.fset))]
        if isinstance(thing, functools.cached_property):
            return ["cached property", self.of(thing.func)]
        if isinstance(thing, functools._lru_cache_wrapper):
            own = {name: value for name, value in vars(thing).items() if name not in _WRAPPED}
            return ["cached", self.of(thing.__wrapped__), self.of(self._kept(own))]
        if isinstance(thing, types.FunctionType):
            return self._function(thing)
        if isinstance(getattr(thing, "py_func", None), types.FunctionType):  # compiled by numba
            return ["compiled", module_version("numba"), self.of(thing.py_func)]
        if isinstance(thing, types.BuiltinFunctionType | np.ufunc | type(len)):
            owner = getattr(thing, "__module__", None) or type(thing).__module__
            bound = getattr(thing, "__self__", None)  # the array of array.dot; the module of a function of a module
            values = [] if bound is None or isinstance(bound, types.ModuleType) else [self.of(bound)]
            return ["builtin", owner, thing.__name__, module_version(owner), *values]
        if isinstance(thing, _DESCRIPTORS):  # methods of compiled types
            owner = thing.__objclass__
            return [
                "descriptor",
                owner.__module__,
                owner.__qualname__,
                thing.__name__,
                module_version(owner.__module__),
            ]
        if isinstance(thing, re.Pattern):
            return ["pattern", self.of(thing.pattern), self.of(thing.flags)]
        if isinstance(thing, type):
            return self._class(thing)
        return self._object(thing)

    def _function(self, function: types.FunctionType) -> list[str | bytes]:
        parts: list[str | bytes] = ["function", function.__qualname__]
        if self._known_by_version(function.__module__):
            return [*parts, function.__module__, module_version(function.__module__)]
        self.functions.setdefault(function.__code__, function)
        skipped = self.skipped.closures if self.skipped else set()
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=False)
        closed_over = [_contents(cell) for name, cell in cells if name not in skipped]
        bytecode = self._joined(self._code(function.__code__))
        self.bytecode[_full_name(function)].add(bytecode)
        values = [self.of((function.__defaults__, function.__kwdefaults__)), self.of(closed_over)]
        values += [self.of(self._kept(vars(function)))]
        for what, value in zip(("defaults", "closure", "attributes"), values, strict=True):
            self.values[f"{what} of {_full_name(function)}"] = value
        parts += [bytecode, *values]
        self.names.update(_names(function.__code__))
        self.files.add(function.__code__.co_filename)
        for name in _global_names(function.__code__):
            if self._is_skipped(name, _module_name(function)):
                continue
            if name in function.__globals__:
                parts += self._named(name, function.__globals__[name], function.__qualname__)
                self.values[f"{_module_name(function)}.{name}"] = parts[-1]
            elif name in vars(builtins) and not name.startswith("_"):
                parts += self._of_builtin(name, vars(builtins)[name], function.__qualname__)
        for name in sorted(set(imports_of(function))):
            parts += [
                name,
                self.of(imported_module(name)) if not self._known_by_version(name) else module_version(name),
            ]
        return parts

    def _named(self, name: str, value: Any, user: str) -> list[str | bytes]:
        """Digest of the value of a name in a function or module."""
        try:
            return [name, self.of(value)]
        except ValueError as error:
            raise ValueError(f"{user} uses {name}, and {error}") from None

    def _of_builtin(self, name: str, value: Any, user: str) -> list[str | bytes]:
        """Digest of a name in `builtins`; nothing for those of Python itself."""
        module = getattr(value, "__module__", None)
        if module in ("builtins", "io", "_io", "_sitebuiltins") or value in (None, True, False, Ellipsis):
            return []
        if module is not None and self._known_by_version(module):
            return [name, module, getattr(value, "__qualname__", ""), module_version(module)]
        return self._named(name, value, user)

    def _separate(self) -> "_Digest":
        """A digest that does not depend on what this one has seen."""
        other = _Digest(self.package, self.strict, self.skipped)
        other.names, other.modules, other.files = self.names, self.modules, self.files
        other.bytecode, other.values, other.functions = self.bytecode, self.values, self.functions
        return other

    def _code(self, code: types.CodeType) -> list[str | bytes]:
        parts = map(self.of, (code.co_consts, code.co_names, code.co_varnames))
        return ["code", str(sys.implementation.cache_tag), code.co_code, *parts]

    def _class(self, thing: type) -> list[str | bytes]:
        parts: list[str | bytes] = ["class", thing.__qualname__]
        if self._known_by_version(thing.__module__):
            return [*parts, thing.__module__, module_version(thing.__module__)]
        skipped = {"__doc__", "__module__", "__dict__", "__weakref__", "__annotations__", "__static_attributes__"}
        skipped |= {"__firstlineno__", "__annotations_cache__", "__annotate_func__", "__dataclass_fields__"}
        skipped |= {"__dataclass_params__", "__match_args__", "__orig_bases__", "_abc_impl"}
        skipped |= {"__slotnames__"}  # copyreg writes it when the first instance is pickled or copied
        if issubclass(thing, tuple) and "_fields" in vars(thing):  # the generated members of a named tuple
            skipped |= {"__new__", *thing._fields}
        for name, member in vars(thing).items():
            if isinstance(member, types.MemberDescriptorType | types.GetSetDescriptorType) or self._is_skipped(name):
                continue
            if name not in skipped:
                parts += [name, self.of(member)]
                self.values[f"{_full_name(thing)}.{name}"] = parts[-1]
        bases = thing.__bases__ if type(thing) is type else (type(thing), *thing.__bases__)
        return parts + [self.of(base) for base in bases if base is not object]

    def _object(self, thing: Any) -> list[str | bytes]:
        fingerprint = getattr(thing, "fingerprint", None)
        if isinstance(fingerprint, str):
            # a fingerprint describes values; the source files determine what the class does with them
            code = [self.of(type(thing))] if inherits_fingerprint(type(thing)) else []
            return ["fingerprint", fingerprint, object_digest(thing), *code]
        if isinstance(thing, enum.Enum):
            return ["enum", self.of(type(thing)), thing.name, self.of(thing.value)]
        if object_state.changes_by_use(thing):
            self.changes_by_use = True
            if self.skipped is not None:
                return ["object", self.of(type(thing))]
        value, stated = object_state.builtin_value(thing), object_state.stated_value(thing)
        state = None
        if stated is None and not object_state.is_handle(thing):
            state = object_state.attributes(thing, always=value is not None)
            stated = [] if state is not None else self._reduced(thing)
        if stated is None and not self.strict:
            return ["object", self.of(type(thing))]
        if stated is None:
            raise ValueError(
                f"no digest can be made of {repr(thing)[:80]} ({type(thing).__name__}) that would be the same in "
                "another process"
            )
        parts = [self.of(part) for item in self._kept(state or {}).items() for part in item]
        return ["object", self.of(type(thing)), self.of(value), *map(self.of, stated), *parts]

    def _reduced(self, thing: Any) -> list[Any] | None:
        """Value that an object states for pickle, with the attributes that a class of the user may leave out of it."""
        stated = object_state.reduced_value(thing)
        if stated is not None and not self._known_by_version(type(thing).__module__):
            stated.append(self._kept(getattr(thing, "__dict__", {})))
            if len(stated) > 2 and isinstance(stated[2], dict):
                stated[2] = self._kept(stated[2])
        return stated

    def _kept(self, state: dict[str, Any]) -> dict[str, Any]:
        """Those attributes that are not left out."""
        return {
            name: value
            for name, value in state.items()
            if not (self._is_skipped(name) or object_state.computed_by_use(name))
        }

    def _known_by_version(self, module: str | None) -> bool:
        """Whether a module is represented by a version: neither in the function's package nor a file of the user."""
        if module is None:  # code that was compiled from a text
            return False
        top = module.split(".")[0]
        return top != self.package and (top == LIBRARY or not is_own(top))


def _module_name(thing: Any) -> str:
    """Module of a function or class; that of the script has another name in a worker process."""
    return "__main__" if thing.__module__ == "__mp_main__" else str(thing.__module__)


def _full_name(thing: Any) -> str:
    return f"{_module_name(thing)}.{thing.__qualname__}"


def _contents(cell: types.CellType) -> Any:
    """Value of a closure variable, None if it is not set yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


@functools.lru_cache(maxsize=4096)
def _global_names(code: types.CodeType) -> tuple[str, ...]:
    """Names of globals, without attributes, that a code object and the functions defined in it read."""
    reads = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
    names = {step.argval for step in dis.get_instructions(code) if step.opname in reads}
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names.update(_global_names(constant))
    return tuple(sorted(names))


def _names(code: types.CodeType) -> Iterator[str]:
    """Names of globals and attributes in a code object and the functions defined in it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)
