"""Digest of what a Python function computes, the same in every process.

A stored result belongs to the code that made it. The digest covers the bytecode and constants of a function, its
defaults and attributes, the values it closes over, the global names it uses, the modules it imports when it runs, and
recursively the functions, classes and objects that it uses, in its own package and in any file that is not installed
(such as a file in the same folder). Of a module of the user, however it is reached, the members count whose names
appear in any of these functions. The standard library and installed packages are represented by name and version,
modules of this library by their source files (see `fe_likelihoods.simulation.source_digest`). For objects that cannot
be identified by their value (an open file, a handle of compiled code) a ValueError is raised, and the user is asked for
a version.

The digest cannot contain what the code finds only while it runs: files and environment variables that it reads, names
that it composes, modules that it imports by a computed name. They can be named in ``depends_on=`` of a model; besides,
stored results are compared with new ones (see `fe_likelihoods.simulation.verification`).
"""

import dis
import enum
import functools
import importlib
import importlib.metadata
import importlib.util
import logging
import re
import sys
import types
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import is_dataclass
from hashlib import blake2b
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from .source_digest import LIBRARY, inherits_fingerprint, is_standard, object_digest, source_digest

__all__ = ["CodeDescription", "code_digest", "describe_code"]

_DESCRIPTORS = (types.WrapperDescriptorType, types.MethodDescriptorType, types.ClassMethodDescriptorType)
_BUILTIN_VALUES = (int, float, complex, str, bytes, bytearray, tuple, list, frozenset, set, dict)


class CodeDescription(NamedTuple):
    """Digest of a function, and where its code is.

    Attributes
    ----------
    digest : str
        Hexadecimal, 128 bits.
    files : tuple of str
        Files of the user that contain the code, sorted.
    code : dict of str to frozenset of bytes
        Digests of the bytecode alone, per name of a function.
    values : dict of str to bytes
        Digests of the values that belong to names of modules, classes and functions.
    """

    digest: str
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


def describe_code(thing: Any, strict: bool = True) -> CodeDescription:
    """As `code_digest`, with the files of the code, and with separate digests of bytecode and of values.

    Parameters
    ----------
    thing : object
    strict : bool
        False: objects without a stable digest are represented by their class, and no ValueError is raised.
    """
    digest = _Digest(_package(thing), strict)
    text = digest.whole(thing).hex()
    code = {name: frozenset(digests) for name, digests in digest.bytecode.items()}
    return CodeDescription(text, tuple(sorted(digest.files)), code, digest.values)


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
    """

    def __init__(self, package: str, strict: bool = True) -> None:
        self.package, self.strict = package, strict
        self.open: dict[int, int] = {}  # ids of the objects in progress and their depths, to detect cycles
        self.done: dict[int, tuple[bytes, Any]] = {}  # with the object, so that its id is not reused
        self.names: set[str] = set()  # of globals and attributes in the functions of the user
        self.modules: dict[str, types.ModuleType] = {}  # of the user, reached as globals, values or imports
        self.files: set[str] = set()
        self.bytecode: dict[str, set[bytes]] = defaultdict(set)
        self.values: dict[str, bytes] = {}

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
                if value is not self.modules[module]:
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
        if (kind is np.ndarray or isinstance(thing, np.generic)) and not np.asarray(thing).dtype.hasobject:
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
        if isinstance(thing, functools.cached_property):
            return ["cached property", self.of(thing.func)]
        if isinstance(thing, functools._lru_cache_wrapper):
            return ["cached", self.of(thing.__wrapped__)]
        if isinstance(thing, types.FunctionType):
            return self._function(thing)
        if isinstance(getattr(thing, "py_func", None), types.FunctionType):  # compiled by numba
            return ["compiled", _version("numba"), self.of(thing.py_func)]
        if isinstance(thing, types.BuiltinFunctionType | np.ufunc | type(len)):
            owner = getattr(thing, "__module__", None) or type(thing).__module__
            bound = getattr(thing, "__self__", None)  # the array of array.dot; the module of a function of a module
            values = [] if bound is None or isinstance(bound, types.ModuleType) else [self.of(bound)]
            return ["builtin", owner, thing.__name__, _version(owner), *values]
        if isinstance(thing, _DESCRIPTORS):  # methods of compiled types
            owner = thing.__objclass__
            return ["descriptor", owner.__module__, owner.__qualname__, thing.__name__, _version(owner.__module__)]
        if isinstance(thing, re.Pattern):
            return ["pattern", self.of(thing.pattern), self.of(thing.flags)]
        if isinstance(thing, type):
            return self._class(thing)
        return self._object(thing)

    def _function(self, function: types.FunctionType) -> list[str | bytes]:
        parts: list[str | bytes] = ["function", function.__qualname__]
        if self._known_by_version(function.__module__):
            return [*parts, function.__module__, _version(function.__module__)]
        closed_over = [_contents(cell) for cell in function.__closure__ or ()]
        bytecode = self._joined(self._code(function.__code__))
        self.bytecode[_full_name(function)].add(bytecode)
        values = [self.of((function.__defaults__, function.__kwdefaults__)), self.of(closed_over)]
        values += [self.of(vars(function))]
        for what, value in zip(("defaults", "closure", "attributes"), values, strict=True):
            self.values[f"{what} of {_full_name(function)}"] = value
        parts += [bytecode, *values]
        self.names.update(_names(function.__code__))
        self.files.add(function.__code__.co_filename)
        for name in sorted(set(_global_names(function.__code__))):
            if name in function.__globals__:
                parts += self._named(name, function.__globals__[name], function.__qualname__)
                self.values[f"{_module_name(function)}.{name}"] = parts[-1]
        for name in sorted(set(_imports(function))):
            parts += [name, self.of(_imported(name)) if not self._known_by_version(name) else _version(name)]
        return parts

    def _named(self, name: str, value: Any, user: str) -> list[str | bytes]:
        """Digest of the value of a name in a function or module."""
        try:
            return [name, self.of(value)]
        except ValueError as error:
            raise ValueError(f"{user} uses {name}, and {error}") from None

    def _separate(self) -> "_Digest":
        """A digest that does not depend on what this one has seen."""
        other = _Digest(self.package, self.strict)
        other.names, other.modules, other.files = self.names, self.modules, self.files
        other.bytecode, other.values = self.bytecode, self.values
        return other

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
                self.values[f"{_full_name(thing)}.{name}"] = parts[-1]
        return parts + [self.of(base) for base in thing.__bases__ if base is not object]

    def _object(self, thing: Any) -> list[str | bytes]:
        fingerprint = getattr(thing, "fingerprint", None)
        if isinstance(fingerprint, str):
            # a fingerprint describes values; the source files determine what the class does with them
            code = [self.of(type(thing))] if inherits_fingerprint(type(thing)) else []
            return ["fingerprint", fingerprint, object_digest(thing), *code]
        if isinstance(thing, enum.Enum):
            return ["enum", self.of(type(thing)), thing.name, self.of(thing.value)]
        value = _builtin_value(thing)
        state = _attributes(thing, always=value is not None)
        if state is None and not self.strict:
            return ["object", self.of(type(thing))]
        if state is None:
            raise ValueError(
                f"no digest can be made of {repr(thing)[:80]} ({type(thing).__name__}) that would be the same in "
                "another process"
            )
        parts = [self.of(part) for item in state.items() for part in item]
        return ["object", self.of(type(thing)), self.of(value), *parts]

    def _known_by_version(self, module: str) -> bool:
        """Whether a module is represented by a version: neither in the function's package nor a file of the user."""
        top = module.split(".")[0]
        return top != self.package and (top == LIBRARY or not _is_own(top))


def _module_name(thing: Any) -> str:
    """Module of a function or class; that of the script has another name in a worker process."""
    return "__main__" if thing.__module__ == "__mp_main__" else str(thing.__module__)


def _full_name(thing: Any) -> str:
    return f"{_module_name(thing)}.{thing.__qualname__}"


def _builtin_value(thing: Any) -> Any:
    """Value of an instance of a subclass of a built-in type or of an array, None for other objects."""
    if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
        return np.array(thing, subok=False)
    return next((kind(thing) for kind in _BUILTIN_VALUES if isinstance(thing, kind)), None)


def _attributes(thing: Any, always: bool) -> dict[str, Any] | None:
    """All attributes of an object, without those that a cached property has computed from others.

    None if they need not be the whole state of the object: if it has no attributes, unless `always`, or if its class
    defines how it is pickled and is not a dataclass.
    """
    cls = type(thing)
    if cls.__module__ == "builtins":
        return None
    slots = [slot for base in cls.__mro__ for slot in _slots(base)]
    if not (always or slots or is_dataclass(thing) or isinstance(getattr(thing, "__dict__", None), dict)):
        return None
    if not (always or is_dataclass(thing) or _is_plain(thing)):
        return None
    state = {slot: getattr(thing, slot) for slot in slots if hasattr(thing, slot)} | getattr(thing, "__dict__", {})
    if isinstance(thing, defaultdict):
        state["default_factory"] = thing.default_factory
    return {name: value for name, value in state.items() if not _is_computed(cls, name)}


def _is_plain(thing: Any) -> bool:
    """Whether an object has no state besides its attributes, such as that of compiled code or of an open file."""
    cls = type(thing)
    if cls.__reduce_ex__ is not object.__reduce_ex__ or cls.__reduce__ is not object.__reduce__:
        return False
    try:
        thing.__reduce_ex__(2)
    except TypeError:
        return False
    return True


def _slots(cls: type) -> list[str]:
    """Names of the slots that a class defines, as they are looked up on its instances."""
    slots = vars(cls).get("__slots__", ())
    names = [slots] if isinstance(slots, str) else list(slots)
    private = "_" + cls.__name__.lstrip("_")
    names = [private + name if name.startswith("__") and not name.endswith("__") else name for name in names]
    return [name for name in names if name not in ("__dict__", "__weakref__")]


def _is_computed(cls: type, name: str) -> bool:
    """Whether an attribute is the stored value of a cached property."""
    found = next((vars(base)[name] for base in cls.__mro__ if name in vars(base)), None)
    return isinstance(found, functools.cached_property)


@functools.cache
def _is_own(top: str) -> bool:
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


def _imported(name: str) -> Any:
    """A module that a function imports, or the reason why it cannot be imported."""
    try:
        return importlib.import_module(name)
    except ImportError as error:  # it may be optional
        return f"{type(error).__name__} of {name}"


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
                    name = importlib.util.resolve_name(name, package)
                except ImportError:
                    raise ValueError(f"{function.__qualname__} imports {name}, but is not in a package") from None
                yield name
                yield from (f"{name}.{item}" for item in before[-1] or () if _is_submodule(name, item))
            before.append(step.argval)


def _is_submodule(package: str, name: str) -> bool:
    """Whether ``from package import name`` imports a module of the user."""
    if not _is_own(package.split(".")[0]) or package.split(".")[0] == LIBRARY:
        return False
    try:
        return importlib.util.find_spec(f"{package}.{name}") is not None
    except (ImportError, ValueError):
        return False


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
