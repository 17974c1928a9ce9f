"""Label of a model: the code, files and versions that its results depend on, besides its declared identity.

Stored simulations belong to a declared identity, the fingerprint of the model: class, parameters, channels, excitation,
``version=`` and ``depends_on=``. Whether the code still computes the same results is verified by repeating some stored
simulations (`fe_likelihoods.cache.verification`). The label only sets how many: a few for rows that were stored under a
known label, many for an unknown label. So a label may be incomplete, and may change without need. It contains

* user functions, classes and values by value: the parts of the model, and everything that their code names,
* the source files of the user modules among them, without comments, and the versions of installed packages,
* environment variables whose names occur in this code,
* the source files of this library that simulations depend on,
* what simulations of the model opened while they ran (`fe_likelihoods.simulation.files`).

Pickles by cloudpickle are not used, because their bytes differ between processes: they contain random class
identifiers, sets in varying order, and file names of notebook cells.
"""

import ast
import contextlib
import functools
import logging
import os
import platform
import re
import sys
import types
import weakref
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from .by_value import names_in
from .files import Opened, file_digest
from .user_code import LIBRARY, SCRIPTS, is_of_user, package_version, sources_digest

__all__ = [
    "ModelLabel",
    "cpu_name",
    "items_of",
    "value_digest",
]

SOURCES = ("kernels/*.py", "modal/*.py", "models/*.py", "signals/*.py", "simulation/model.py", "noise/*.py", "units.py")
MOST_OBJECTS = 1_000_000  # in one value; further objects are left out
_PLAIN = (type(None), bool, int, float, complex, str, bytes, bytearray, type(...), type(NotImplemented))
_WRAPPED = ("__func__", "__self__", "fget", "fset", "fdel", "func", "args", "keywords", "__wrapped__", "cell_contents")
_WRAPPERS = (
    types.MethodType,
    staticmethod,
    classmethod,
    property,
    functools.partial,
    functools.partialmethod,
    functools.cached_property,
    type(functools.lru_cache(len)),
    types.CellType,
)
_OF_CLASSES = {
    "__slotnames__",
    "_abc_impl",
    "__dict__",
    "__weakref__",
    "__module__",
    "__qualname__",
    "__firstlineno__",
    "__static_attributes__",
}
_DATA = (int, float, complex, str, bytes, list, dict, set, np.ndarray)  # class attributes that running code may change
_OF_SHELLS = {"_", "PWD", "OLDPWD", "SHLVL"}  # changes are irrelevant for simulations
_PARTS = {"function", "class", "output", "statistic", "library", "python"}
_first: dict[str, str] = {}  # first digests of values that running code changes
_opened: dict[str, Opened] = {}  # by code, in this process


class ModelLabel:
    """Label of a model in its present state, completed by its simulations.

    Its code is the mapping ``code_parts()`` if the model has this method; for other user models, the object itself; and
    the residual statistic that is stored, if the user has defined one. `items` are digests of everything that is known
    without a simulation, `opened` is what simulations opened; `observes` says whether they are observed, since they may
    run user code.
    """

    def __init__(self, model: Any, statistic: Any = None) -> None:
        self._statistic = statistic
        now = self._present(model)
        self.items = now | {name: digest for name, digest in _first.items() if name in now}
        self.observes = _has_user_code(model) or (statistic is not None and _defined_by_user(statistic))
        # only the first simulation of a process imports a module, so the files it opened belong to later labels too
        self.opened, self._was_observed = _opened.get(self.code, Opened({})).read_again(), False

    @property
    def code(self) -> str:
        """Digest of `items`."""
        return _joined(self.items)

    @property
    def identity(self) -> str:
        """Digest of code and values only, without the versions of Python and this library."""
        from ..kernels.jit import KERNEL_HASH  # late, because it imports numba

        items = {name: digest for name, digest in self.items.items() if name not in ("python", "library")}
        return _joined(items or {"kernels": KERNEL_HASH})

    @property
    def known(self) -> Opened | None:
        """What simulations of this process opened; None before the first simulation."""
        return self.opened if self._was_observed else None

    def add(self, opened: Opened | None, here: bool = True) -> bool:
        """Add what simulations opened (`here`: in this process); returns whether there was anything new."""
        self._was_observed = self._was_observed or (here and opened is not None)
        if opened is None or opened.files.keys() <= self.opened.files.keys():
            return False
        self.opened = opened | self.opened
        _opened[self.code] = self.opened
        return True

    def present(self, model: Any) -> dict[str, str]:
        """The items of a model in its present state, and of the files that simulations opened."""
        return self._present(model) | self.opened.read_again().items()

    def changed(self, model: Any) -> set[str]:
        """Names of the items that differ from the label."""
        known, now = self.items | self.opened.items(), self.present(model)
        return {name for name in known.keys() | now.keys() if known.get(name) != now.get(name)}

    def has_changed_itself(self, names: Iterable[str]) -> None:
        """Record that simulations change some items; later labels of this process keep their first digests."""
        for name in self.items.keys() & set(names) - _PARTS:
            _first.setdefault(name, self.items[name])

    @property
    def changing(self) -> set[str]:
        """Names of items that simulations of this process have changed."""
        return self.items.keys() & _first.keys()

    def _present(self, model: Any) -> dict[str, str]:
        parts: dict[str, Any] = model.code_parts() if hasattr(model, "code_parts") else {}
        if is_of_user(type(model).__module__):
            parts = parts | _parts_of(model)
        if self._statistic is not None and _defined_by_user(self._statistic):
            parts = parts | {"statistic": self._statistic}
        return (items_of(parts) if parts else {}) | {"library": sources_digest(*SOURCES).hex()}


def _parts_of(model: Any) -> dict[str, Any]:
    """User class and attributes of an object, without the time limit, which changes no response."""
    name = type(model).__qualname__
    attributes = {attribute: value for attribute, value in _state(model).items() if attribute != "time_limit"}
    return {"class": type(model)} | {f"{name}().{attribute}": value for attribute, value in attributes.items()}


def _defined_by_user(function: Any) -> bool:
    return is_of_user(getattr(function, "__module__", None) or type(function).__module__)


def _has_user_code(model: Any) -> bool:
    """Whether a model may run user code."""
    return hasattr(model, "code_parts") or is_of_user(type(model).__module__)


@functools.cache
def cpu_name() -> str:
    """Name and features of the processor; on another processor, the last digits of results may differ."""
    import llvmlite.binding as llvm  # late, because it is slow

    asked = [os.environ.get(name, "") for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "OPENBLAS_CORETYPE")]
    with contextlib.suppress(RuntimeError):  # features are not known everywhere
        asked.append(llvm.get_host_cpu_features().flatten())
    return " ".join([llvm.get_host_cpu_name(), *filter(None, asked)])


def value_digest(value: Any) -> str:
    """Digest of a value, function or class with all that its code names; ValueError for an open file in it."""
    walk = _Walk()
    items = walk.items({"value": value})
    if walk.opaque:
        raise ValueError(f"an object of the type {', '.join(sorted(walk.opaque))} has no value that can be compared")
    return _joined(items)


def items_of(parts: Mapping[str, Any]) -> dict[str, str]:
    """Digests of values, and of all functions, values, files, packages and variables that their code names."""
    return _Walk().items(parts)


def _joined(items: Mapping[str, str]) -> str:
    return blake2b(repr(sorted(items.items())).encode(), digest_size=16).hexdigest()


class _Walk:
    """Digests of values. Named functions, classes and variables in user modules become separate items."""

    def __init__(self) -> None:
        self.opaque: set[str] = set()
        self._waiting: dict[str, Any] = {}
        self._modules: dict[str, types.ModuleType] = {}
        self._packages: set[str] = set()
        self._library: set[str] = set()
        self._words: set[str] = set()
        self._done: dict[int, tuple[bytes, Any]] = {}
        self._open: dict[int, int] = {}  # depth of the objects that contain the object being added

    def items(self, parts: Mapping[str, Any]) -> dict[str, str]:
        """Digests by name."""
        items = {"python": f"{platform.python_implementation()} {platform.python_version()} {platform.machine()}"}
        self._waiting.update(parts)
        while self._waiting:
            name, value = self._waiting.popitem()
            if name not in items:
                items[name] = self._digest(value)
                if isinstance(value, str):  # a command or an input file of a program
                    self._words |= set(re.findall(r"\w+", value))
        for module in self._all_modules():
            if module.__name__ not in SCRIPTS:  # of a script, only the parts that the model uses count
                items[f"source of {module.__name__}"], words = _source(module)
                self._words |= words
        for module in self._library:
            items[f"source of {module}"] = _source(sys.modules[module])[0]
        for package in self._packages:
            items[f"package {package}"] = package_version(package)
        for name in self._words & os.environ.keys() - _OF_SHELLS:
            items[f"environment {name}"] = os.environ[name]
        return items

    def _all_modules(self) -> Iterable[types.ModuleType]:
        """The user modules found so far, and the user modules that they name."""
        waiting = list(self._modules)
        while waiting:
            module = self._modules[waiting.pop()]
            for value in [] if module.__name__ in SCRIPTS else list(vars(module).values()):
                name = value.__name__ if isinstance(value, types.ModuleType) else _attribute(value, "__module__")
                if isinstance(name, str) and name not in self._modules and name in sys.modules:
                    if name.partition(".")[0] != LIBRARY and self._is_of_user(name):
                        waiting.append(name)
        return self._modules.values()

    def _digest(self, value: Any) -> str:
        self._done, self._open, self._hash = {}, {}, blake2b(digest_size=8)
        try:
            self._add(value)
        except RecursionError:
            self._text(f"deeper than {sys.getrecursionlimit()}")
        return self._hash.hexdigest()

    def _text(self, text: str) -> None:
        self._hash.update(text.encode("utf-8", "surrogatepass") + b"\0")

    def _add(self, value: Any) -> None:
        kind = type(value)
        if kind in _PLAIN:
            self._text(f"{kind.__name__} {value!r}")
        elif id(value) in self._open:  # it contains itself
            self._text(f"the object {len(self._open) - self._open[id(value)]} levels above")
        elif len(self._done) < MOST_OBJECTS:
            self._hash.update(self._apart(value))

    def _apart(self, value: Any) -> bytes:
        """Digest of one value; equal values have equal digests, whether they are one object or several."""
        if id(value) not in self._done:
            outer, self._hash = self._hash, blake2b(digest_size=8)
            self._open[id(value)] = len(self._open)
            try:
                self._add_contents(value)
                self._done[id(value)] = self._hash.digest(), value  # the object too, so that its id is not reused
            finally:
                self._hash = outer
                del self._open[id(value)]
        return self._done[id(value)][0]

    def _add_contents(self, value: Any) -> None:
        kind = type(value)
        if kind in _PLAIN:
            self._text(f"{kind.__name__} {value!r}")
            return
        self._text(f"{_name_of(kind.__module__)}.{kind.__qualname__}")
        if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            self._text(f"{value.dtype.str} {value.shape}")
            self._hash.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, types.CodeType):
            self._add_code(value)
        elif isinstance(value, types.FunctionType):
            self._add_function(value)
        elif isinstance(value, type):
            self._add_class(value)
        elif isinstance(value, types.ModuleType):
            self._add_module(value)
        elif isinstance(value, _WRAPPERS):
            for name in _WRAPPED:
                self._add(_attribute(value, name))
        elif isinstance(value, types.BuiltinFunctionType | types.BuiltinMethodType | types.WrapperDescriptorType):
            self._text(value.__qualname__)
            if not isinstance(getattr(value, "__self__", None), types.ModuleType | None):
                self._add(value.__self__)
        elif kind in (list, tuple):
            self._add_all(value)
        elif kind in (set, frozenset):
            self._text(repr(sorted(map(self._apart, value))))
        elif isinstance(value, dict | types.MappingProxyType):
            self._add_all([item for pair in value.items() for item in pair])
            if kind not in (dict, types.MappingProxyType):
                self._add_state(value)
        elif isinstance(value, weakref.ref):
            self._add(value())
        elif isinstance(value, logging.Logger):
            self._text(value.name)
        elif kind.__module__.partition(".")[0] == "numba":  # the compiled variants change with use
            self._add(_attribute(value, "py_func") or _attribute(_attribute(value, "_dispatcher"), "py_func"))
        else:
            self._add_object(value)

    def _add_all(self, values: Iterable[Any]) -> None:
        for value in values:
            self._add(value)
        self._text("end")

    def _add_code(self, code: types.CodeType) -> None:
        """Add code without local variable names, line numbers and file name."""
        arguments = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        self._text(repr((code.co_name, code.co_names, arguments, code.co_freevars, code.co_flags)))
        self._hash.update(code.co_code)
        self._words.update(text for text in code.co_consts if isinstance(text, str))
        self._add_all(code.co_consts)

    def _add_function(self, function: types.FunctionType) -> None:
        module = function.__module__ or ""
        self._text(f"{_name_of(module)}.{function.__qualname__}")
        if self._is_of_user(module):
            self._add_all((function.__code__, function.__defaults__, function.__kwdefaults__, function.__closure__))
            self._add_all({name: value for name, value in vars(function).items() if name != "__wrapped__"}.items())
            self._add(_attribute(function, "__wrapped__"))
            for name in sorted(names_in(function.__code__).all & function.__globals__.keys()):
                self._waiting.setdefault(f"{_name_of(module)}.{name}", function.__globals__[name])

    def _add_class(self, cls: type) -> None:
        name = f"{_name_of(cls.__module__)}.{cls.__qualname__}"
        self._text(name)
        if not self._is_of_user(cls.__module__):
            return
        self._add_all(cls.__bases__)
        if type(cls) is not type:
            self._add(type(cls))
        for attribute, member in sorted(vars(cls).items()):
            if attribute in _OF_CLASSES or isinstance(member, types.MemberDescriptorType):
                continue
            self._text(attribute)
            if isinstance(member, _DATA) and "<locals>" not in name:
                self._waiting.setdefault(f"{name}.{attribute}", member)
            else:
                self._add(member)

    def _add_module(self, module: types.ModuleType) -> None:
        """Add the data of a user module by value; its functions and classes are in its source."""
        self._text(module.__name__)
        for name, value in list(vars(module).items()) if self._is_of_user(module.__name__) else ():
            if not name.startswith("__") and not isinstance(value, types.ModuleType | type | types.FunctionType):
                self._waiting.setdefault(f"{module.__name__}.{name}", value)

    def _add_object(self, value: Any) -> None:
        self._add(type(value))
        if is_of_user(type(value).__module__) or isinstance(value, types.SimpleNamespace):
            self._add_state(value)
            return
        try:  # the parts that pickle would rebuild it from
            for part in _parts(value.__reduce_ex__(2)):
                self._add(part)
        except RecursionError:
            raise
        except Exception:  # foreign code
            self.opaque.add(f"{type(value).__module__}.{type(value).__qualname__}")
            self._add_state(value)

    def _add_state(self, value: Any) -> None:
        for name, part in sorted(_state(value).items()):
            self._text(name)
            self._add(part)

    def _is_of_user(self, module: str) -> bool:
        """Whether a module is the user's; other modules are noted, and represented by versions or source digests."""
        top = module.partition(".")[0]
        if is_of_user(module):
            self._modules.update({module: sys.modules[module]} if module in sys.modules else {})
            return True
        if top == LIBRARY and module in sys.modules:
            self._library.add(module)
        elif top and top not in (LIBRARY, *sys.stdlib_module_names):
            self._packages.add(top)
        return False


def _name_of(module: str) -> str:
    """Name of a module; ``__main__`` for a script, which has a different name in worker processes."""
    return "__main__" if module in SCRIPTS else module


def _parts(reduced: Any) -> list[Any]:
    """Parts of a ``__reduce_ex__`` result, with iterators as lists."""
    if isinstance(reduced, str):
        return [reduced]
    return [list(part) if place in (3, 4) and part is not None else part for place, part in enumerate(reduced)]


def _state(value: Any) -> dict[str, Any]:
    """Attributes of an object, including slots."""
    found = dict(_attribute(value, "__dict__") or {})
    for cls in type(value).__mro__:
        slots = vars(cls).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            private = name.startswith("__") and not name.endswith("__")
            found[name] = _attribute(value, f"_{cls.__name__.lstrip('_')}{name}" if private else name)
    return found


def _attribute(value: Any, name: str) -> Any:
    """An attribute, found without running user code; None if there is none."""
    try:
        return object.__getattribute__(value, name)
    except (AttributeError, ValueError):  # an empty cell raises ValueError
        return None


def _source(module: types.ModuleType) -> tuple[str, frozenset[str]]:
    """Digest of a module's source file when it was first read, and the words in it."""
    file = getattr(module, "__file__", None)
    return ("", frozenset()) if file is None else _read_source(file, id(module))


@functools.cache
def _read_source(file: str, module: int) -> tuple[str, frozenset[str]]:
    try:
        content = Path(file).read_bytes()
        if not file.endswith(".py"):
            return file_digest(file), frozenset()
        text = ast.dump(ast.parse(content))  # without comments and blank lines
    except OSError:
        return "", frozenset()
    except (SyntaxError, ValueError, RecursionError):
        text = content.decode("utf-8", "replace")
    words = frozenset(re.findall(r"\w+", content.decode("utf-8", "replace")))
    return blake2b(text.encode("utf-8", "surrogatepass"), digest_size=16).hexdigest(), words
