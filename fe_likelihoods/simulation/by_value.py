"""Code and values that travel to other processes by value: a worker computes with what this process has in memory.

Functions, classes and modules of the user are sent as they are now, with the values of their module (`cloudpickle`).
So a worker has the same globals as this process, whatever its files say, and functions of a notebook and lambdas work.
The library, installed packages and the standard library are imported by the worker.

* A module is sent once, with all of its values, and is found in the worker under its name by functions that import it
  while they run. Of the script or notebook (``__main__``), only the values that the sent functions use are sent.
* A value of a module or class that cannot be sent, such as an open file, does not prevent the others from being sent.
  A simulation that uses it ends the run. A lock becomes a new lock.
* A worker whose version of this library has other source code refuses everything.
"""

import builtins
import contextlib
import dis
import functools
import importlib.machinery
import importlib.util
import io
import os
import pickle
import re
import sys
import threading
import types
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import cloudpickle

from .faults import ChangedModel

__all__ = ["Arrived", "NotSent", "Pickled", "dumps", "is_arriving", "is_of_user", "is_worker", "without_addresses"]

_SCRIPTS = ("__main__", "__mp_main__")  # names of a script or notebook, and of a script in a worker that imports it
_LIBRARIES = {"fe_likelihoods", "samplers"}
_INSTALLED = {"site-packages", "dist-packages"}
_LOCKS = (type(threading.Lock()), type(threading.RLock()))
_PLAIN = (int, float, complex, str, bytes, bool, type(None), type, types.ModuleType)
_CACHED = type(functools.cache(len))
_OF_THE_IMPORT = {"__builtins__", "__loader__", "__spec__", "__cached__"}
_OF_A_FUNCTION = tuple(f"__{name}__" for name in "name qualname defaults kwdefaults annotations doc module".split())
_lock = threading.RLock()
_arriving: dict[str, types.ModuleType] | None = None  # modules of the function that is being loaded
_present: dict[str, types.ModuleType] = {}  # modules of the function that ran last in this process
_is_worker = False
_of_user: dict[str, bool] = {}  # by name of a module


def without_addresses(message: str) -> str:
    """A message without the addresses of objects, which differ between runs."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", message)


def is_of_user(module: Any) -> bool:
    """Whether a module is Python code that belongs neither to this library, nor to a package, nor to Python."""
    if not isinstance(module, types.ModuleType):
        return False
    values = object.__getattribute__(module, "__dict__")  # asking a lazy module for an attribute would import it
    return isinstance(values.get("__name__"), str) and _is_of_user(values["__name__"], values.get("__file__"))


@functools.cache
def _is_of_user(name: str, file: str | None) -> bool:
    top = name.partition(".")[0]
    if top in _SCRIPTS:
        return True
    if top in _LIBRARIES or top in sys.stdlib_module_names or top in sys.builtin_module_names:
        return False
    if file is not None and file.endswith(tuple(importlib.machinery.EXTENSION_SUFFIXES)):
        return False
    root = sys.modules.get(top)
    places = [file or getattr(root, "__file__", None) or ""] + [str(place) for place in getattr(root, "__path__", ())]
    return not any(_INSTALLED & set(PurePath(place).parts) for place in places)


def is_worker() -> bool:
    """Whether this process has loaded a function of another process."""
    return _is_worker


def is_arriving() -> bool:
    """Whether an object is being loaded that another process has sent."""
    return _arriving is not None


@functools.cache
def library_digest() -> bytes:
    """Digest of the source code of this library."""
    root, digest = Path(__file__).parents[1], blake2b(digest_size=16)
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.digest()


class Pickled(NamedTuple):
    """A function as it is sent to workers.

    Attributes
    ----------
    payload : bytes
        Digest of the library, name of the process that sends it, and the pickled function.
    key : bytes
        Digest of the payload: another function, or other values.
    """

    payload: bytes
    key: bytes

    @classmethod
    def of(cls, function: Any) -> "Pickled":
        """Pickle a function with everything that it uses, as it is now; ValueError if that is impossible."""
        try:
            payload = library_digest() + _this_process(os.getpid()) + dumps(function)
        except Exception as error:
            name = getattr(function, "__qualname__", type(function).__qualname__)
            raise ValueError(
                f"{name} cannot be sent to another process ({type(error).__name__}: {without_addresses(str(error))}). "
                "Objects that it uses must not contain open files, locks and connections"
            ) from error
        return cls(payload, _digest(payload))

    def is_whole(self) -> bool:
        """Whether the payload matches the digest."""
        return _digest(self.payload) == self.key

    def load(self) -> "Arrived":
        """The function, in a worker.

        Raises
        ------
        ValueError
            If the payload does not match its digest, in which case nothing is unpickled, or cannot be unpickled.
        ChangedModel
            If this process has imported another version of this library, or a file that the model depends on differs.
        """
        global _arriving, _is_worker
        if not self.is_whole():
            raise ValueError("the pickled function has been changed after it was sent: its digest differs")
        if self.payload[:16] != library_digest():
            raise ChangedModel(
                "the worker process has another version of fe_likelihoods than the process that sends simulations: "
                "install the same version everywhere, and start a new pool"
            )
        with _lock:
            # a pool may run it in the process that has sent it, whose modules stay as they are
            _arriving = None if self.payload[16:32] == _this_process(os.getpid()) else {}
            _is_worker |= _arriving is not None
            try:
                return Arrived(pickle.loads(memoryview(self.payload)[32:]), _arriving or {})
            except ChangedModel:
                raise
            except Exception as error:
                text = without_addresses(f"{type(error).__name__}: {error}")
                raise ValueError(f"a function cannot be loaded in a worker process: {text}") from error
            finally:
                _arriving = None


def _digest(payload: bytes) -> bytes:
    return blake2b(payload, digest_size=16).digest()


@functools.cache
def _this_process(pid: int) -> bytes:
    """Random name of this process; a forked process has another one."""
    return os.urandom(16)


class Arrived:
    """A function that was sent, with the modules of the user that belong to it."""

    def __init__(self, function: Any, modules: dict[str, types.ModuleType]) -> None:
        self._function, self._modules = function, modules

    def prepare(self) -> None:
        """Let the modules be found under their names, by functions that import them while they run."""
        global _present
        if _present is not self._modules:
            sys.modules.update(self._modules)
            _present = self._modules

    def __call__(self, item: Any) -> Any:
        self.prepare()
        return self._function(item)


def dumps(thing: Any) -> bytes:
    """Pickle an object, with code and values of the user by value."""
    with _lock:
        loaded = list(sys.modules.copy().items())  # other threads may import while the items are read
        for name, module in loaded:
            if name not in _of_user:
                _of_user[name] = is_of_user(module) and module.__name__ == name
        modules = {name: module for name, module in loaded if _of_user[name]}
        known = cloudpickle.list_registry_pickle_by_value()
        added = [module for name, module in modules.items() if name not in known]
        for module in added:
            cloudpickle.register_pickle_by_value(module)
        try:
            file = io.BytesIO()
            _Pickler(file, modules).dump(thing)
            return file.getvalue()
        finally:
            for module in added:
                cloudpickle.unregister_pickle_by_value(module)


class _Pickler(cloudpickle.Pickler):
    """Pickler whose functions keep their module: its values and its functions are those of one namespace."""

    def __init__(self, file: io.BytesIO, modules: dict[str, types.ModuleType]) -> None:
        super().__init__(file, protocol=5)
        self._modules = modules
        self._namespaces: dict[str, _Namespace] = {}

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, types.ModuleType):
            if self._modules.get(obj.__name__) is not obj:
                return NotImplemented
            values = {name: value for name, value in vars(obj).items() if name not in _OF_THE_IMPORT}
            for name in [name for name in values if f"{obj.__name__}.{name}" in self._modules]:
                del values[name]  # modules of a package are sent where a function names them
            if obj.__name__ in _SCRIPTS:
                values = {name: values[name] for name in ("__file__", "__package__") if name in values}
            parent = self._modules.get(obj.__name__.rpartition(".")[0])
            state = parent, {name: _sendable(name, value) for name, value in values.items()}
            return _new_module, (obj.__name__,), state, None, None, _fill_module
        if isinstance(obj, _CACHED) and self._modules.get(obj.__module__) is not None:  # pickled by its name otherwise
            return _new_cached, (obj.__wrapped__, *obj.cache_parameters().values())
        reduced = super().reducer_override(obj) if not isinstance(obj, types.FunctionType) else self._function(obj)
        if reduced is NotImplemented or len(reduced) != 6 or isinstance(obj, types.FunctionType):
            return reduced
        # a class: a new one for each function, since the methods of another one may belong to other values
        make, (*arguments, _, extra), (state, slots), *tail = reduced
        state = {name: _sendable(name, value) for name, value in state.items()}
        return make, (*arguments, None, extra), (state, slots), *tail

    def _function(self, function: types.FunctionType) -> Any:
        """Reduce a function; one of a module of the user gets the namespace of that module."""
        module = self._modules.get(function.__globals__.get("__name__"))
        if module is None or vars(module) is not function.__globals__:
            return super().reducer_override(function)
        namespace = self._namespaces.setdefault(module.__name__, _Namespace(module))
        names, code = _names_in(function.__code__), function.__code__
        used = {}
        if module.__name__ in _SCRIPTS:
            used = {name: _new_lock(value) for name, value in vars(module).items() if name in names.all}
        package = module.__dict__.get("__package__") or ""
        imported = [self._modules[name] for name in _resolved(names.imported, package) if name in self._modules]
        state = (
            used,
            [*imported, *_named_modules(vars(module), names.all)],
            {name: getattr(function, name) for name in _OF_A_FUNCTION},
            [cell for cell in function.__closure__ or ()],
            vars(function),
        )
        return _new_function, (code, namespace, len(code.co_freevars)), state, None, None, _fill_function


class _Names(NamedTuple):
    """Names in the code of a function and of the functions inside it."""

    all: frozenset[str]
    imported: frozenset[str]  # modules, with a dot for each level of a relative import, and what is imported from them


@functools.lru_cache(maxsize=4096)
def _names_in(code: types.CodeType) -> _Names:
    imported: set[str] = set()
    before: list[Any] = [0, None]
    for step in dis.get_instructions(code):
        if step.opname == "IMPORT_NAME":
            level, items = before[-2:]
            module = "." * level + step.argval
            imported |= {module, *(f"{module}{'.' if step.argval else ''}{item}" for item in items or ())}
        before.append(step.argval)
    inner = [_names_in(constant) for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return _Names(
        frozenset(code.co_names).union(*(names.all for names in inner)),
        frozenset(imported).union(*(names.imported for names in inner)),
    )


def _resolved(imported: frozenset[str], package: str) -> set[str]:
    """Full names of modules."""
    found = set()
    for name in imported:
        with contextlib.suppress(ImportError):
            found.add(importlib.util.resolve_name(name, package))
    return found


def _named_modules(values: Mapping[str, Any], names: frozenset[str]) -> list[types.ModuleType]:
    """Modules that a code names, also as ``package.module``, which a worker has to import as well."""
    found = []
    for module in [values[name] for name in sorted(names & values.keys())]:
        if isinstance(module, types.ModuleType):
            inner = {name: sys.modules.get(f"{module.__name__}.{name}") for name in names & vars(module).keys()}
            found += [module, *(_named_modules(inner, names) if hasattr(module, "__path__") else ())]
    return found


def _new_function(code: types.CodeType, namespace: dict[str, Any], n_cells: int) -> types.FunctionType:
    namespace.setdefault("__builtins__", builtins)
    return types.FunctionType(code, namespace, None, None, tuple(types.CellType() for _ in range(n_cells)))


def _fill_function(function: types.FunctionType, state: tuple) -> None:
    used, _, attributes, cells, others = state
    if _arriving is not None:
        function.__globals__.update(used)
    for name, value in attributes.items():
        setattr(function, name, value)
    for cell, sent in zip(function.__closure__ or (), cells, strict=True):
        with contextlib.suppress(ValueError):  # an empty cell
            cell.cell_contents = sent.cell_contents
    vars(function).update(others)


class _Namespace:
    """The globals of a module, which are the module's own in the process that receives them."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __reduce__(self) -> tuple:
        return vars, (self._module,)


def _new_module(name: str) -> types.ModuleType:
    if _arriving is None and name in sys.modules:  # at home
        return sys.modules[name]
    module = sys.modules[name] = types.ModuleType(name)
    if _arriving is not None:
        _arriving[name] = module
    return module


def _fill_module(module: types.ModuleType, state: tuple[Any, Mapping[str, Any]]) -> None:
    if _arriving is not None:
        parent, values = state
        vars(module).update(values)
        if parent is not None:
            vars(parent)[module.__name__.rpartition(".")[2]] = module


def _new_cached(function: Any, maxsize: int | None, typed: bool) -> Any:
    return functools.lru_cache(maxsize, typed)(function)


def _new_lock(value: Any) -> Any:
    return _Lock(isinstance(value, _LOCKS[1])) if isinstance(value, _LOCKS) else value


def _sendable(name: str, value: Any) -> Any:
    """A value of a module or class, or what is sent instead if it cannot be pickled."""
    if isinstance(value, types.FunctionType):
        plain = not (value.__defaults__ or value.__kwdefaults__ or value.__closure__ or vars(value))
    else:
        plain = isinstance(value, _PLAIN) or not getattr(getattr(value, "dtype", None), "hasobject", True)
    if plain:
        return value
    if isinstance(value, _LOCKS):
        return _new_lock(value)
    try:
        _Probe(io.BytesIO(), protocol=5).dump(value)
        _refuse_a_name(value)
    except Exception as error:
        return NotSent(name, f"{type(error).__name__}: {without_addresses(str(error))}")
    return value


def _refuse_a_name(value: Any) -> None:
    """Raise TypeError if an object is pickled as its name in a module of the user, as compiled functions are."""
    if isinstance(value, types.FunctionType | _CACHED):
        return
    reduce = cloudpickle.Pickler.dispatch_table.get(type(value), lambda value: value.__reduce_ex__(4))
    name = reduce(value)
    if isinstance(name, str) and is_of_user(sys.modules[pickle.whichmodule(value, name)]):
        raise TypeError("it is known by its name only")


class _Probe(cloudpickle.Pickler):
    """Pickler that finds out whether an object can be pickled, without classes, modules and the code of functions."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, _CACHED):
            return self.reducer_override(obj.__wrapped__)
        if isinstance(obj, types.FunctionType):
            values = [cell.cell_contents for cell in obj.__closure__ or () if cell != types.CellType()]
            return abs, (), (obj.__defaults__, obj.__kwdefaults__, values, vars(obj))
        return (abs, ()) if isinstance(obj, type | types.ModuleType) else NotImplemented


class _Lock:
    """A lock, which is a new one in the process that receives it."""

    def __init__(self, reentrant: bool) -> None:
        self._reentrant = reentrant

    def __reduce__(self) -> tuple:
        return (threading.RLock if self._reentrant else threading.Lock), ()


class NotSent:
    """Stands in a worker for a value of a module that cannot be sent; `ChangedModel` where it is used."""

    def __init__(self, name: str, why: str) -> None:
        vars(self).update(name=name, why=why)

    def __reduce__(self) -> tuple:
        return NotSent, (self.name, self.why)

    def _refuse(self, *arguments: Any, **options: Any) -> Any:
        raise ChangedModel(
            f"the simulation uses the value {self.name!r} of its module, which cannot be sent to a worker process "
            f"({self.why}): make it inside the function, or run the model without a pool and not isolated"
        )

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._refuse()

    __call__ = __next__ = __getitem__ = __setitem__ = __contains__ = __iter__ = __len__ = __bool__ = __enter__ = _refuse
    __exit__ = __setattr__ = __eq__ = __lt__ = __add__ = __radd__ = __mul__ = __rmul__ = __array__ = _refuse
    __hash__ = object.__hash__
