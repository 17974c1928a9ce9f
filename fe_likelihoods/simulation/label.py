"""Label of a model: the code, files and versions that its results depend on, besides its declared identity.

It sets how many stored simulations of a declared identity are verified (`fe_likelihoods.cache.verification`), so it may
be incomplete, and may change without need. Digests of pickles would differ between processes: cloudpickle's contain
random class identifiers, sets in varying order, and file names of notebook cells.
"""

import ast
import functools
import itertools
import os
import platform
import re
import sys
import types
from collections.abc import Iterable, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from .by_value import LIBRARY, SCRIPTS, attribute, is_of_user, names_in, package_version, sources_digest
from .files import Opened, digests_by_name, file_digest, mapped, read_again

__all__ = ["ModelLabel", "items_of", "value_digest"]

_PLAIN = (type(None), bool, int, float, complex, str, bytes, bytearray, type(...), type(NotImplemented))
_WRAPPERS = (staticmethod, classmethod, property, types.CellType, type(functools.lru_cache(len)))
_WRAPPED = ("__wrapped__", "fget", "fset", "fdel", "cell_contents")
_OF_CLASSES = set(  # the last three are annotations, from Python 3.14 on
    "__slotnames__ _abc_impl __dict__ __weakref__ __module__ __qualname__ __firstlineno__ __static_attributes__ "
    "__annotate_func__ __annotations_cache__ __classdictcell__".split()
)
_DATA = (int, float, complex, str, bytes, list, dict, set, np.ndarray)  # class attributes that running code may change
_OF_SHELLS = {"_", "PWD", "OLDPWD", "SHLVL"}  # changes are irrelevant for simulations
_PARTS = {"function", "class", "output", "statistic", "library", "python"}
_first: dict[str, str] = {}  # first digests of values that simulations of this process have changed
_sources: dict[str, tuple] = {}  # by name of a module: the module and its spec, digest of the source, words in it


class ModelLabel:
    """Label of a model in its present state: `items`, digests of its code and values, with their digest `code`.

    The code is what ``code_parts()`` returns, and the model and the residual statistic if the user has defined them.
    Simulations that may run user code are observed (`observes`): `opened` are the files that they have opened.
    """

    def __init__(self, model: Any, statistic: Any = None) -> None:
        by_user = is_of_user(getattr(statistic, "__module__", None) or type(statistic).__module__)
        self._statistic = statistic if by_user else None
        self.items = self._present(model)
        self.items |= {name: _first[name] for name in self.changing}
        self.code = _joined(self.items)
        is_users = hasattr(model, "code_parts") or is_of_user(type(model).__module__)
        self.observes = is_users or self._statistic is not None
        self.opened = mapped() if self.observes else {}

    @property
    def identity(self) -> str:
        """Digest of code and values only, without the versions of Python and this library."""
        from ..kernels.jit import KERNEL_HASH  # late, because it imports numba

        items = {name: digest for name, digest in self.items.items() if name not in ("python", "library")}
        return _joined(items or {"kernels": KERNEL_HASH})

    def add(self, opened: Opened) -> None:
        """Add what simulations opened."""
        if not opened.keys() <= self.opened.keys():
            self.opened = opened | self.opened

    def present(self, model: Any) -> dict[str, str]:
        """The items of a model in its present state, and of the files that simulations opened."""
        return self._present(model) | digests_by_name(read_again(self.opened))

    def has_changed_itself(self, names: Iterable[str]) -> None:
        """Record that simulations change some items; later labels of this process keep their first digests."""
        _first.update({name: self.items[name] for name in self.items.keys() & set(names) - _PARTS - self.changing})

    @property
    def changing(self) -> set[str]:
        """Names of items that simulations of this process have changed, such as a count of calls."""
        return self.items.keys() & _first.keys()

    def _present(self, model: Any) -> dict[str, str]:
        parts: dict[str, Any] = dict(model.code_parts()) if hasattr(model, "code_parts") else {}
        kind = type(model)
        if is_of_user(kind.__module__):  # a time limit changes no response
            name = f"{_name_of(kind.__module__)}.{kind.__qualname__}()"
            parts |= {f"{name}.{each}": value for each, value in _state(model) if each != "time_limit"}
            parts |= {"class": kind}
        if self._statistic is not None:
            parts |= {"statistic": self._statistic}
        return (items_of(parts) if parts else {}) | {"library": sources_digest().hex()}


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
        self._words: set[str] = set()

    def items(self, parts: Mapping[str, Any]) -> dict[str, str]:
        """Digests by name."""
        items = {"python": f"{platform.python_implementation()} {platform.python_version()} {platform.machine()}"}
        self._waiting.update(parts)
        while self._waiting:
            name, value = self._waiting.popitem()
            if name not in items:
                self._done: dict[int, tuple[bytes, Any]] = {}
                self._open: dict[int, int] = {}  # depth of the objects that contain the present one
                try:
                    items[name] = self._digest(value).hex()
                except RecursionError:
                    items[name] = f"deeper than {sys.getrecursionlimit()}"
                if isinstance(value, str):  # a command or an input file of a program
                    self._words |= set(re.findall(r"\w+", value))
        for name in (names := list(self._modules)):  # with the user modules that these modules name
            if name in SCRIPTS:  # of a script, only the parts that the model uses count
                continue
            items[f"source of {name}"], words = _source(self._modules[name])
            self._words |= words
            for value in list(vars(self._modules[name]).values()):
                other = value.__name__ if isinstance(value, types.ModuleType) else attribute(value, "__module__")
                if isinstance(other, str) and other not in self._modules and self._is_of_user(other):
                    names += [other] if other in self._modules else []
        items |= {f"package {package}": package_version(package) for package in self._packages}
        return items | {f"environment {n}": os.environ[n] for n in self._words & os.environ.keys() - _OF_SHELLS}

    def _digest(self, value: Any) -> bytes:
        """Digest of one value; equal values have equal digests, whether they are one object or several."""
        if id(value) in self._open:  # it contains itself
            return f"the object {len(self._open) - self._open[id(value)]} levels above".encode()
        if id(value) not in self._done:
            digest = blake2b(digest_size=8)
            self._open[id(value)] = len(self._open)
            try:
                try:
                    text, parts = self._contents(value)
                except RecursionError:
                    raise
                except Exception:  # foreign code
                    self.opaque.add(f"{type(value).__module__}.{type(value).__qualname__}")
                    text, parts = type(value).__qualname__, [type(value), *_state(value)]
                digest.update(text.encode("utf-8", "surrogatepass"))
                for part in parts:
                    digest.update(_bytes_of(part) if type(part) in _PLAIN else self._digest(part))
            finally:
                del self._open[id(value)]
            self._done[id(value)] = digest.digest(), value  # the object too, so that its id is not reused
        return self._done[id(value)][0]

    def _contents(self, value: Any) -> tuple[str, Iterable[Any]]:
        """A text and other values, which together stand for a value."""
        kind = type(value)
        name = f"{_name_of(kind.__module__)}.{kind.__qualname__}"
        if kind in _PLAIN:
            return name, [value]
        if isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
            return f"{name} {value.dtype.str} {value.shape}", [np.ascontiguousarray(value).tobytes()]
        if isinstance(value, types.CodeType):  # without local variable names, line numbers and file name
            arguments = value.co_varnames[: value.co_argcount + value.co_kwonlyargcount]
            self._words.update(text for text in value.co_consts if isinstance(text, str))
            names = value.co_name, value.co_names, arguments, value.co_freevars, value.co_flags
            return repr(names), [value.co_code, *value.co_consts]
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, types.ModuleType):  # data by value; functions and classes are in its source
            for each, member in list(vars(value).items()) if self._is_of_user(value.__name__) else ():
                if not each.startswith("__") and not isinstance(member, types.ModuleType | type | types.FunctionType):
                    self._waiting.setdefault(f"{value.__name__}.{each}", member)
            return f"{name} {value.__name__}", []
        if isinstance(value, _WRAPPERS):
            return name, [attribute(value, each) for each in _WRAPPED]
        if kind in (list, tuple):
            return name, value
        if kind in (set, frozenset):
            return name + repr(sorted(map(self._digest, value))), []
        if isinstance(value, dict | types.MappingProxyType):
            state = () if kind in (dict, types.MappingProxyType) else _state(value)
            return name, [*itertools.chain.from_iterable(value.items()), *state]
        if kind.__module__.partition(".")[0] == "numba":  # the compiled variants change with use
            return name, [attribute(value, "py_func") or attribute(attribute(value, "_dispatcher"), "py_func")]
        if is_of_user(kind.__module__) or isinstance(value, types.SimpleNamespace):
            return name, [kind, *_state(value)]
        parts = value.__reduce_ex__(2)  # what pickle would rebuild it from, with iterators as lists
        parts = [parts] if isinstance(parts, str) else [*parts[:3], *(part and list(part) for part in parts[3:5])]
        return name, [kind, *parts]

    def _function(self, function: types.FunctionType) -> tuple[str, list[Any]]:
        module, code = function.__module__ or "", function.__code__
        name = f"{_name_of(module)}.{function.__qualname__}"
        if not self._is_of_user(module):
            return name, []
        for each in sorted(names_in(code) & function.__globals__.keys()):
            self._waiting.setdefault(f"{_name_of(module)}.{each}", function.__globals__[each])
        attributes = [pair for pair in vars(function).items() if pair[0] != "__wrapped__"]
        values = function.__defaults__, function.__kwdefaults__, function.__closure__
        return name, [code, *values, attributes, attribute(function, "__wrapped__")]

    def _class(self, cls: type) -> tuple[str, list[Any]]:
        name = f"{_name_of(cls.__module__)}.{cls.__qualname__}"
        if not isinstance(cls.__module__, str) or not self._is_of_user(cls.__module__):  # a descriptor in Cython
            return name, []
        parts = [*cls.__bases__, type(cls)]
        for each, member in sorted(vars(cls).items()):
            if each in _OF_CLASSES or isinstance(member, types.MemberDescriptorType):
                continue
            if isinstance(member, _DATA) and "<locals>" not in name:
                self._waiting.setdefault(f"{name}.{each}", member)
            else:
                parts += each, member
        return name, parts

    def _is_of_user(self, module: str) -> bool:
        """Whether a module is the user's; installed packages are noted, and represented by their versions."""
        top = module.partition(".")[0]
        if is_of_user(module):
            self._modules.update({module: sys.modules[module]} if module in sys.modules else {})
            return True
        if top and top not in (LIBRARY, *sys.stdlib_module_names):
            self._packages.add(top)
        return False


def _bytes_of(plain: Any) -> bytes:
    """Bytes of a value of one of the types `_PLAIN`, with the type."""
    text = plain if type(plain) is bytes else repr(plain).encode("utf-8", "surrogatepass")
    return b"%s %d " % (type(plain).__name__.encode(), len(text)) + text


def _name_of(module: str) -> str:
    """Name of a module; ``__main__`` for a script, which has a different name in worker processes."""
    return "__main__" if module in SCRIPTS else module


def _state(value: Any) -> list[tuple[str, Any]]:
    """Attributes of an object in alphabetical order, including slots, whatever its class says that pickles contain."""
    state = object.__getstate__(value)
    own, slots = state if isinstance(state, tuple) else (state, None)
    return sorted(((own or {}) | (slots or {})).items())


def _source(module: types.ModuleType) -> tuple[str, frozenset[str]]:
    """Digest of the source file that a module was imported from, without comments and blank lines, and words in it.

    The file is read once for each import, which makes a new ``__spec__``: a later edit is not what runs.
    """
    spec = getattr(module, "__spec__", None)
    file = getattr(getattr(spec, "loader", None), "archive", None) or getattr(module, "__file__", None)  # a zip file
    known = _sources.get(module.__name__)
    if known is None or known[0] is not module or known[1] is not spec:
        text = source = ""
        try:
            text = Path(file or "").read_text("utf-8", "replace") if str(file).endswith(".py") else ""
            source = ast.dump(ast.parse(text)) if text else file_digest(file or "")
        except (SyntaxError, ValueError, RecursionError):
            source = text
        except OSError:
            pass
        digest = blake2b(source.encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()
        known = _sources[module.__name__] = module, spec, digest, frozenset(re.findall(r"\w+", text))
    return known[2:]
