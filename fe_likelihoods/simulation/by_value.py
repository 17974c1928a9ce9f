"""User code and its values, sent to other processes by value: a worker computes with what this process has in memory.

Functions, classes and modules of the user are sent in their present state, with the values of their module
(`cloudpickle`). So a worker has the same globals as this process, whatever the source files contain, and lambdas and
notebook functions work. The worker imports this library, installed packages and the standard library.

* A module is sent once, with all of its values; sent functions that import it while they run find it under its name. Of
  the script or notebook (``__main__``), only the values that the sent functions use are sent. A lock becomes a new one;
  other values that cannot be sent, such as an open file, are refused with their type.
* A worker refuses everything if its version of this library has different source code.
"""

import dis
import functools
import importlib.machinery
import importlib.metadata
import io
import pickle
import sys
import sysconfig
import threading
import types
from collections.abc import Callable, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
from cloudpickle.cloudpickle import _dynamic_class_reduce

from samplers.interrupts import become_worker, is_worker, process_name

from .failure_reasons import ChangedModel, UnusableModel, text_of

__all__ = [
    "LIBRARY",
    "SCRIPTS",
    "Pickled",
    "attribute",
    "is_arriving",
    "is_of_user",
    "load",
    "names_in",
    "package_version",
    "sources_digest",
]

LIBRARY = __name__.split(".")[0]
SCRIPTS = ("__main__", "__mp_main__")  # names of a script or notebook, and of a script in a worker that imports it
_LOCKS = (type(threading.Lock()), type(threading.RLock()))
_CACHED = type(functools.cache(len))
_OF_THE_IMPORT = {"__builtins__", "__loader__", "__spec__", "__cached__"}
_COMPILED = tuple(importlib.machinery.EXTENSION_SUFFIXES)
_STANDARD = [Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib")]
_packages = functools.cache(importlib.metadata.packages_distributions)
_lock = threading.RLock()
_arriving: dict[str, types.ModuleType] | None = None  # modules of the function that is being loaded


def is_arriving() -> bool:
    """Whether an object from another process is being loaded."""
    return _arriving is not None


class Pickled:
    """A function for other processes, by value in its state when it is first pickled; in this one it is itself."""

    def __init__(self, function: Any, payload: bytes = b"") -> None:
        self._function = function
        if payload:
            self.payload = payload

    @classmethod
    def of(cls, function: Any) -> "Pickled":
        """Pickle a function with everything that it uses at present; ValueError, with a type, if that is impossible."""
        return cls(function, cls(function).payload)

    @functools.cached_property
    def payload(self) -> bytes:
        """Digest of the library, name of the sending process, and the pickled function."""
        try:
            _Pickler(file := io.BytesIO()).dump(self._function)
        except Exception as error:
            name = getattr(self._function, "__qualname__", type(self._function).__qualname__)
            raise ValueError(
                f"{name} cannot be sent to another process ({text_of(error)}). "
                "Objects that it uses must not contain open files and connections: make them inside the function"
            ) from error
        return sources_digest() + process_name() + file.getvalue()

    def __reduce__(self) -> tuple:
        return Pickled, (None, self.payload)

    def __call__(self, item: Any) -> Any:
        """The result for an item; another process loads the function once."""
        return (self._function or load(self.payload))(item)


@functools.lru_cache(8)
def load(payload: bytes) -> Callable[[Any], Any]:
    """The function of a `Pickled`, in a worker, with user modules of its own.

    UnusableModel if that fails; ChangedModel for another version of this library, or another content of a file.
    """
    global _arriving
    if payload[:16] != sources_digest():
        raise ChangedModel(
            "the worker process has another version of fe_likelihoods than the process that sends simulations: "
            "install the same version everywhere, and start a new pool"
        )
    with _lock:
        if payload[16:32] != process_name():
            become_worker()
        _arriving = modules = {}
        try:
            function = pickle.loads(memoryview(payload)[32:])
        except ChangedModel:
            raise
        except Exception as error:
            raise UnusableModel(f"a function cannot be loaded in a worker process: {text_of(error)}") from error
        finally:
            _arriving = None

    def call(item: Any) -> Any:
        if is_worker():
            sys.modules.update(modules)  # for functions that import them while they run
        return function(item)

    return call


def _sent_module(name: Any) -> types.ModuleType | None:
    """The module with a name if it is sent; None if the worker imports it."""
    module = sys.modules.get(name) if isinstance(name, str) else None
    if module is None or attribute(module, "__name__") != name or not is_of_user(name):
        return None
    return None if str(vars(module).get("__file__")).endswith(_COMPILED) else module


class _Pickler(cloudpickle.Pickler):
    """Pickler whose functions keep their module: all functions of a module share one namespace with its values."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, types.FunctionType):
            return self._function(obj)
        if isinstance(obj, types.ModuleType):
            return self._reduce_module(obj) if _sent_module(obj.__name__) is obj else NotImplemented
        if isinstance(obj, _CACHED) and _sent_module(obj.__module__) is not None:  # pickled by its name otherwise
            return _new_cached, (obj.__wrapped__, *obj.cache_parameters().values())
        if isinstance(obj, _LOCKS):
            return (threading.RLock if isinstance(obj, _LOCKS[1]) else threading.Lock), ()
        if not isinstance(obj, type) or _sent_module(obj.__module__) is None:
            return super().reducer_override(obj)
        # a new class for each function: methods of an earlier one may refer to earlier values; without members of slots
        make, (*arguments, _, extra), (state, slots), *tail = _dynamic_class_reduce(obj)
        state = {name: each for name, each in state.items() if not isinstance(each, types.MemberDescriptorType)}
        return make, (*arguments, None, extra), (state, slots), *tail

    def _reduce_module(self, module: types.ModuleType) -> tuple:
        name, values = module.__name__, vars(module)
        sent = {key: values[key] for key in ("__file__", "__package__") if key in values}
        if name not in SCRIPTS:  # modules of a package are sent where a function names them
            present = values.copy().items()  # other threads may change it
            sent |= {k: v for k, v in present if k not in _OF_THE_IMPORT and _sent_module(f"{name}.{k}") is None}
        return _new_module, (name,), (_sent_module(name.rpartition(".")[0]), sent), None, None, _fill_module

    def _function(self, function: types.FunctionType) -> Any:
        """Reduce a function; a user function gets the namespace of its module, and the modules that it imports."""
        module = _sent_module(function.__globals__.get("__name__"))
        if module is None or vars(module) is not function.__globals__:
            is_sent = _sent_module(function.__module__) is not None
            return self._dynamic_function_reduce(function) if is_sent else super().reducer_override(function)
        # where cloudpickle keeps the future globals of the functions of a module
        self.globals_ref.setdefault(id(function.__globals__), _Namespace(module))
        reduced = self._dynamic_function_reduce(function)
        used = _possible_modules(function.__code__, module.__dict__.get("__package__") or "")
        reduced[2][1]["_cloudpickle_submodules"].extend(filter(None, map(_sent_module, used)))
        return reduced


@functools.lru_cache(maxsize=4096)
def names_in(code: types.CodeType) -> frozenset[str]:
    """Names in a code object and in the code objects inside it."""
    return frozenset(name for each in _codes(code) for name in each.co_names)


def _codes(code: types.CodeType) -> list[types.CodeType]:
    inner = [each for each in code.co_consts if isinstance(each, types.CodeType)]
    return [code, *(each for part in inner for each in _codes(part))]


@functools.lru_cache(maxsize=4096)
def _possible_modules(code: types.CodeType, package: str) -> list[str]:
    """Full names of modules that import statements in the code of a package may name."""
    steps = [step for each in _codes(code) for step in dis.get_instructions(each) if step.opname == "IMPORT_NAME"]
    parts, imported = package.split("."), {step.argval for step in steps}  # without the dots of relative ones
    packages = [".".join(parts[:n]) for n in range(1, len(parts) + 1)]
    found = imported | {f"{each}.{name}".rstrip(".") for each in packages for name in imported}
    return sorted(found | {f"{each}.{name}" for each in found for name in names_in(code)})


class _Namespace(NamedTuple):
    """The globals of a module; the receiving process uses the globals of its own copy of the module."""

    module: types.ModuleType

    def __reduce__(self) -> tuple:
        return vars, (self.module,)


def _new_module(name: str) -> types.ModuleType:
    module = _arriving[name] = types.ModuleType(name)
    if is_worker():  # else a pool runs the function in the sending process, which keeps its modules
        sys.modules[name] = module
    return module


def _fill_module(module: types.ModuleType, state: tuple[Any, Mapping[str, Any]]) -> None:
    parent, values = state
    vars(module).update(values)
    if parent is not None:
        vars(parent)[module.__name__.rpartition(".")[2]] = module


def _new_cached(function: Any, maxsize: int | None, typed: bool) -> Any:
    return functools.lru_cache(maxsize, typed)(function)


# which code belongs to the user ------------------------------------------------------------------------------------


def is_of_user(module: Any) -> bool:
    """Whether a module with a name is user code, not part of this library, of Python or of an installed package."""
    if not isinstance(module, str):  # the module of a descriptor in Cython
        return False
    return _is_of_user(module, _places(sys.modules.get(module)) or _places(sys.modules.get(module.partition(".")[0])))


def attribute(value: Any, name: str) -> Any:
    """An attribute, found without running user code, or importing a lazy module; None if there is none."""
    try:
        return object.__getattribute__(value, name)
    except (AttributeError, ValueError):  # an empty cell raises ValueError
        return None


def _places(module: Any) -> tuple[str, ...]:
    """The file of a module, or the folders of a package that has no file."""
    file = attribute(module, "__file__")
    return (file,) if isinstance(file, str) else tuple(map(str, attribute(module, "__path__") or ()))


@functools.cache
def _is_of_user(name: str, places: tuple[str, ...]) -> bool:
    top = name.partition(".")[0]
    if top in SCRIPTS:
        return True
    if not top or top in (LIBRARY, "samplers"):
        return False
    for path in map(Path, places):
        if {"site-packages", "dist-packages"} & set(path.resolve().parts):
            return not package_version(top)
        if any(path.resolve().is_relative_to(folder) for folder in _STANDARD):
            return False
    return bool(places) or top not in sys.stdlib_module_names  # a module created by code has no file


@functools.cache  # of what this process has imported; reading it takes milliseconds, and labels ask again and again
def package_version(top: str) -> str:
    """Version of an installed package, by the name of its top-level module; empty for other modules."""
    try:
        return importlib.metadata.version(top)
    except (importlib.metadata.PackageNotFoundError, ValueError):
        return " ".join(map(importlib.metadata.version, _packages().get(top, ())))


@functools.cache
def sources_digest() -> bytes:
    """Digest of this library's source files."""
    root, digest = Path(__file__).resolve().parents[1], blake2b(digest_size=16)
    for file in sorted(root.glob("**/*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.digest()
