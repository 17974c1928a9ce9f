"""User code and its values, sent to other processes by value: a worker computes with what this process has in memory.

Functions, classes and modules of the user are sent in their present state, with the values of their module
(`cloudpickle`). So a worker has the same globals as this process, whatever the source files contain, and lambdas and
notebook functions work. The worker imports this library, installed packages and the standard library.

* A module is sent once, with all of its values; sent functions that import it while they run find it under its name. Of
  the script or notebook (``__main__``), only the values that the sent functions use are sent.
* If a value of a module cannot be sent, such as an open file, the other values are sent; a simulation that uses the
  missing value ends the run. A lock becomes a new lock.
* A worker refuses everything if its version of this library has different source code.
"""

import dis
import functools
import importlib.machinery
import io
import os
import pickle
import re
import sys
import threading
import types
from collections import OrderedDict
from hashlib import blake2b
from typing import Any, NamedTuple

import cloudpickle
import numpy as np

from samplers.interrupts import become_worker

from .faults import ChangedModel
from .user_code import SCRIPTS, is_of_user, sources_digest

__all__ = [
    "Arrived",
    "CannotLoad",
    "NotSent",
    "Pickled",
    "Recent",
    "dumps",
    "is_arriving",
    "process_name",
    "without_addresses",
]

_LOCKS = (type(threading.Lock()), type(threading.RLock()))
_CACHED = type(functools.cache(len))
_OF_THE_IMPORT = {"__builtins__", "__loader__", "__spec__", "__cached__"}
_COMPILED = tuple(importlib.machinery.EXTENSION_SUFFIXES)
_lock = threading.RLock()
_arriving: dict[str, types.ModuleType] | None = None  # modules of the function that is being loaded
_names: dict[int, bytes] = {}
_present: dict[str, types.ModuleType] = {}  # modules of the function that ran last in this process


def _forget_lock() -> None:
    """In a forked process: another thread of the parent may have held the lock."""
    global _lock
    _lock = threading.RLock()


os.register_at_fork(after_in_child=_forget_lock)


def without_addresses(message: str) -> str:
    """A message without object addresses, which differ between runs."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", message)


def is_arriving() -> bool:
    """Whether an object from another process is being loaded."""
    return _arriving is not None


class Recent(OrderedDict):
    """The most recently used values, by key: at most 8, with a total of 256 MiB (or one larger value)."""

    def __init__(self) -> None:
        super().__init__()
        self._sizes: dict[Any, int] = {}

    def use(self, key: Any) -> Any:
        """The value of a key, which becomes the most recently used value; None if it is not kept."""
        if key in self:
            self.move_to_end(key)
        return self.get(key)

    def keep(self, key: Any, value: Any, size: int) -> None:
        """Keep a value; `size` is in bytes."""
        self[key], self._sizes[key] = value, size
        self.move_to_end(key)
        while len(self) > 8 or (len(self) > 1 and sum(self._sizes[key] for key in self) > 2**28):
            del self._sizes[self.popitem(last=False)[0]]


class CannotLoad(ValueError):
    """A function that cannot be unpickled in a worker process."""


class Pickled(NamedTuple):
    """A function as it is sent to workers."""

    payload: bytes  # digest of the library, name of the sending process, and the pickled function
    key: bytes  # digest of the payload; differs after a change of the function's values

    @classmethod
    def of(cls, function: Any) -> "Pickled":
        """Pickle a function with everything that it uses at present; ValueError if that is impossible."""
        try:
            payload = sources_digest() + process_name() + dumps(function)
            return cls(payload, blake2b(payload, digest_size=16).digest())
        except Exception as error:
            name = getattr(function, "__qualname__", type(function).__qualname__)
            raise ValueError(
                f"{name} cannot be sent to another process ({type(error).__name__}: {without_addresses(str(error))}). "
                "Objects that it uses must not contain open files, locks and connections"
            ) from error

    def load(self) -> "Arrived":
        """The function, in a worker.

        CannotLoad if it cannot be unpickled; ChangedModel if this process has another version of this library, or a
        file that the model depends on differs.
        """
        global _arriving
        if self.payload[:16] != sources_digest():
            raise ChangedModel(
                "the worker process has another version of fe_likelihoods than the process that sends simulations: "
                "install the same version everywhere, and start a new pool"
            )
        with _lock:
            # a pool may run the function in the sending process, whose modules must not be replaced
            if self.payload[16:32] != process_name():
                _arriving = {}
                become_worker()
            try:
                _, function = pickle.loads(memoryview(self.payload)[32:])
                return Arrived(function, _arriving or {})
            except ChangedModel:
                raise
            except Exception as error:
                text = without_addresses(f"{type(error).__name__}: {error}")
                raise CannotLoad(f"a function cannot be loaded in a worker process: {text}") from error
            finally:
                _arriving = None


def process_name() -> bytes:
    """Random name of this process; a forked process has a different name."""
    return _names.setdefault(os.getpid(), os.urandom(16))


class Arrived:
    """A function that was sent, with its user modules."""

    def __init__(self, function: Any, modules: dict[str, types.ModuleType]) -> None:
        self._function, self._modules = function, modules

    def prepare(self) -> None:
        """Put the modules into `sys.modules`, for functions that import them while they run."""
        global _present
        if _present is not self._modules:
            sys.modules.update(self._modules)
            _present = self._modules

    def __call__(self, item: Any) -> Any:
        self.prepare()
        return self._function(item)


def dumps(thing: Any) -> bytes:
    """Pickle an object, with user code and its values by value."""
    with _lock:
        finder = _Pickler(io.BytesIO())
        try:
            finder.dump(thing)
            pickler = _Pickler(file := io.BytesIO(), finder.find())
            pickler.dump((list(finder.modules.values()), thing))
        finally:
            for module in finder.registered:
                cloudpickle.unregister_pickle_by_value(module)
        return file.getvalue()


class _Pickler(cloudpickle.Pickler):
    """Pickler whose functions keep their module: all functions of a module share one namespace with its values.

    `contents` has the values of the modules that are sent, by name. Without it, modules are pickled without values, to
    find these modules and values: a module can refer to any other one.
    """

    def __init__(self, file: io.BytesIO, contents: dict[str, dict[str, Any]] | None = None) -> None:
        super().__init__(file, protocol=5)
        self.contents = contents
        self.modules: dict[str, types.ModuleType] = {}  # that are sent
        self.registered: list[types.ModuleType] = []
        self._used: dict[str, dict[str, Any]] = {}  # globals of functions, by module
        self._known: dict[Any, types.ModuleType | None] = {}

    def _module(self, name: Any) -> types.ModuleType | None:
        """The module with a name if it is sent; None if the worker imports it."""
        if name not in self._known:
            module = sys.modules.get(name) if isinstance(name, str) else None
            is_sent = is_of_user(module) and module.__name__ == name
            if not is_sent or str(vars(module).get("__file__")).endswith(_COMPILED):
                module = None
            self._known[name] = module
            if module is not None:
                self.modules[name] = module
                self._module(name.rpartition(".")[0])
                if name not in cloudpickle.list_registry_pickle_by_value():
                    cloudpickle.register_pickle_by_value(module)
                    self.registered.append(module)
        return self._known[name]

    def find(self) -> dict[str, dict[str, Any]]:
        """Values of all modules that are sent; in place of a value that cannot be sent, a `NotSent`."""
        found: dict[str, dict[str, Any]] = {}
        while True:
            new = [
                (name, key, value)
                for name, module in list(self.modules.items())
                for key, value in self._values(name, module).items()
                if key not in found.setdefault(name, {})
            ]
            if not new:
                return found
            for name, key, value in new:
                found[name][key] = self._sendable(key, value)

    def _values(self, name: str, module: types.ModuleType) -> dict[str, Any]:
        """Values of a module: all of them, but no modules of a package; those that functions use of a script."""
        values = vars(module).copy()  # other threads may change it
        if name in SCRIPTS:
            return {key: values[key] for key in ("__file__", "__package__") if key in values} | self._used.get(name, {})
        return {
            key: value
            for key, value in values.items()
            if key not in _OF_THE_IMPORT and not is_of_user(sys.modules.get(f"{name}.{key}"))
        }

    def _sendable(self, key: str, value: Any) -> Any:
        """A value, or its replacement if it cannot be sent."""
        if isinstance(value, _LOCKS):
            return _Lock(value)
        try:
            self.dump(value)
            _refuse_a_name(value)
        except Exception as error:
            self.clear_memo()  # of parts of this value
            return NotSent(key, f"{type(error).__name__}: {without_addresses(str(error))}")
        return value

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, types.FunctionType):
            return self._function(obj)
        if isinstance(obj, types.ModuleType):
            if self._module(obj.__name__) is not obj:
                return NotImplemented
            contents = None if self.contents is None else self.contents[obj.__name__]
            parent = self._module(obj.__name__.rpartition(".")[0])
            return _new_module, (obj.__name__,), (parent, contents), None, None, _fill_module
        if isinstance(obj, _CACHED) and self._module(obj.__module__) is not None:  # pickled by its name otherwise
            return _new_cached, (obj.__wrapped__, *obj.cache_parameters().values())
        if isinstance(obj, functools.cached_property):  # with a lock in Python 3.11
            return functools.cached_property, (obj.func,), {"attrname": obj.attrname}
        if isinstance(obj, type):
            return self._class(obj)
        if self.contents is None and _is_array(obj):
            return abs, (0,)
        return NotImplemented

    def _class(self, obj: type) -> Any:
        self._module(obj.__module__)
        reduced = super().reducer_override(obj)
        if reduced is NotImplemented or len(reduced) != 6:
            return reduced
        # a new class for each function, since the methods of an earlier class may refer to earlier values
        make, (*arguments, _, extra), (state, slots), *tail = reduced
        members = types.MemberDescriptorType  # of slots with private names, which cloudpickle leaves
        state = {name: value for name, value in state.items() if not isinstance(value, members)}
        state |= {name: _Lock(value) for name, value in state.items() if isinstance(value, _LOCKS)}
        return make, (*arguments, None, extra), (state, slots), *tail

    def _function(self, function: types.FunctionType) -> Any:
        """Reduce a function; a user function gets the namespace of its module."""
        self._module(function.__module__)
        module = self._module(function.__globals__.get("__name__"))
        reduced = super().reducer_override(function)
        if module is None or reduced is NotImplemented or vars(module) is not function.__globals__:
            return reduced
        make, (code, _, *arguments), (attributes, slots), *tail = reduced
        used = slots["__globals__"]
        if self.contents is None:
            self._used.setdefault(module.__name__, {}).update(used)
            package = (vars(module).get("__package__") or "").split(".")
            places = ["", *(".".join([*package[: k + 1], ""]) for k in range(len(package)))]
            for name in [each.__name__ for each in used.values() if isinstance(each, types.ModuleType)]:
                self._module(name)
            for name in [f"{place}{name}" for place in places for name in _imported(code)]:
                self._module(name)
            values = _Globals({})
        else:
            contents = self.contents[module.__name__]
            values = _Globals({name: contents[name] for name in used if name in contents})
        state = attributes, slots | {"__globals__": values}
        return make, (code, _Namespace(module), *arguments), state, *tail


@functools.lru_cache(maxsize=4096)
def _imported(code: types.CodeType) -> frozenset[str]:
    """Names of modules that code imports while it runs, without the package where the import is relative."""
    found, module = set(), ""
    for step in dis.get_instructions(code):
        if step.opname == "IMPORT_NAME":
            found.add(module := step.argval)
        elif step.opname == "IMPORT_FROM":
            found.add(f"{module}.{step.argval}".lstrip("."))
    inner = [_imported(constant) for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return frozenset(found).union(*inner)


class _Namespace:
    """The globals of a module; the receiving process uses the globals of its own copy of the module."""

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __reduce__(self) -> tuple:
        return vars, (self._module,)


class _Globals:
    """The globals that a function uses: it may run before its module is filled. Not in the process that sends them."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def __reduce__(self) -> tuple:
        return _if_arriving, (self._values,)


def _if_arriving(values: dict[str, Any]) -> dict[str, Any]:
    return {} if _arriving is None else values


def _new_module(name: str) -> types.ModuleType:
    if _arriving is None and name in sys.modules:  # at home
        return sys.modules[name]
    module = sys.modules[name] = types.ModuleType(name)
    if _arriving is not None:
        _arriving[name] = module
    return module


def _fill_module(module: types.ModuleType, state: tuple[Any, dict[str, Any]]) -> None:
    if _arriving is not None:
        parent, values = state
        vars(module).update(values)
        if parent is not None:
            vars(parent)[module.__name__.rpartition(".")[2]] = module


def _new_cached(function: Any, maxsize: int | None, typed: bool) -> Any:
    return functools.lru_cache(maxsize, typed)(function)


def _refuse_a_name(value: Any) -> None:
    """Raise TypeError if an object is pickled as its name in a user module, as compiled functions are."""
    if isinstance(value, types.FunctionType | types.ModuleType | type | _CACHED) or _is_array(value):
        return
    reduce = cloudpickle.Pickler.dispatch_table.get(type(value), lambda value: value.__reduce_ex__(4))
    name = reduce(value)
    if isinstance(name, str) and is_of_user(sys.modules[pickle.whichmodule(value, name)]):
        raise TypeError("it is known by its name only")


def _is_array(value: Any) -> bool:
    """Whether a value is an array of numbers, which refers to no code."""
    return type(value) is np.ndarray and not value.dtype.hasobject


class _Lock:
    """A lock, which becomes a new lock in the receiving process."""

    def __init__(self, lock: Any) -> None:
        self._make = threading.RLock if isinstance(lock, _LOCKS[1]) else threading.Lock

    def __reduce__(self) -> tuple:
        return self._make, ()


class NotSent:
    """Placeholder in a worker for a module value that cannot be sent; raises `ChangedModel` when it is used."""

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
