"""State of an object: what determines its value, made of parts that can be digested one by one.

Attributes and slots are the state of an ordinary object. Objects of compiled types state their value as for pickle
(``__reduce_ex__``): dates, fractions, ranges, queues, sparse matrices, generators of random numbers. Locks, handlers of
a log, and storage that belongs to one thread carry no value that a response depends on. An open file, a thread or a
process has no value that is the same in another process.
"""

import copyreg
import functools
import io
import logging
import mmap
import random
import socket
import subprocess
import threading
import types
import warnings
import weakref
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import is_dataclass
from typing import Any

import numpy as np

__all__ = [
    "attributes",
    "builtin_value",
    "changes_by_use",
    "computed_by_use",
    "is_handle",
    "reduced_value",
    "stated_value",
]

_BUILTIN_VALUES = (int, float, complex, str, bytes, bytearray, tuple, list, frozenset, set, dict)
_WITHOUT_VALUE = (
    *(type(threading.Lock()), type(threading.RLock()), threading.Condition, threading.Event, threading.Semaphore),
    *(threading.Barrier, threading.local, logging.Handler, weakref.WeakKeyDictionary, weakref.WeakValueDictionary),
    weakref.WeakSet,
)
_HANDLES = (io.IOBase, mmap.mmap, socket.socket, subprocess.Popen, threading.Thread, Executor)
_HANDLES += (types.GeneratorType, types.CoroutineType, types.FrameType)
_RANDOM = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random)
_GLOBAL_RANDOM = (np.random.mtrand._rand, random._inst)  # started by the operating system, the same in no two processes
_VIEWS = (type({}.keys()), type({}.values()), type({}.items()))


def builtin_value(thing: Any) -> Any:
    """Value of an instance of a subclass of a built-in type or of an array, None for other objects."""
    if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
        return np.array(thing, subok=False)
    return next((kind(thing) for kind in _BUILTIN_VALUES if isinstance(thing, kind)), None)


def is_handle(thing: Any) -> bool:
    """Whether an object stands for something outside the program, such as an open file or a thread."""
    return isinstance(thing, _HANDLES) and not isinstance(thing, io.StringIO | io.BytesIO)


def changes_by_use(thing: Any) -> bool:
    """Whether every use of an object changes its state: a generator of random numbers, an iterator."""
    return isinstance(thing, _RANDOM) or (isinstance(thing, Iterator) and not isinstance(thing, io.IOBase))


def computed_by_use(name: str) -> bool:
    """Whether an attribute of an installed class is computed when it is first used: the flags of sparse matrices."""
    return name in ("_has_sorted_indices", "_has_canonical_format")


def stated_value(thing: Any) -> list[Any] | None:
    """Parts of an object whose attributes are not its value; empty if it has none, None if it does not state them."""
    if isinstance(thing, _WITHOUT_VALUE):
        return []
    if any(thing is one for one in _GLOBAL_RANDOM):
        return ["random numbers of the process"]
    if isinstance(thing, np.ndarray) and thing.dtype.hasobject:
        return [thing.dtype.str, thing.shape, thing.ravel().tolist()]
    if isinstance(thing, memoryview):
        return [thing.format, thing.shape, thing.tobytes()]
    if isinstance(thing, _VIEWS):
        return [list(thing)]
    if isinstance(thing, weakref.ReferenceType):
        return [thing()]
    if type(thing).__module__.split(".")[0] == "pandas" and hasattr(thing, "to_numpy"):
        return _pandas_parts(thing)
    return None


def reduced_value(thing: Any) -> list[Any] | None:
    """Parts of the value that an object states for pickle; None if it states none."""
    # libraries that send tracebacks between processes register other forms of the exceptions, in some processes only
    reduce = None if isinstance(thing, BaseException) else copyreg.dispatch_table.get(type(thing))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of iterators, in later versions of Python
            value = reduce(thing) if reduce else thing.__reduce_ex__(4)
            if isinstance(value, str):
                return [value]
            function, arguments, state, items, pairs = (*value, None, None, None)[:5]
            return [function, arguments, state, list(items or ()), list(pairs or ())]
    except Exception:  # the code of other packages; most often "cannot pickle"
        return None


def _pandas_parts(thing: Any) -> list[Any]:
    """Labels and values of a data frame, a series or an index; their attributes change when they are used."""
    columns = getattr(thing, "columns", None)
    parts: list[Any] = [getattr(thing, "name", None), getattr(thing, "attrs", None)]
    if columns is not None:
        parts += [columns, *(thing.iloc[:, place] for place in range(thing.shape[1]))]
    elif hasattr(thing, "dtype"):
        parts += [str(thing.dtype), thing.to_numpy()]
    else:
        parts.append(thing.to_numpy())
    if hasattr(thing, "index"):
        parts.append(thing.index)
    return parts


def attributes(thing: Any, always: bool) -> dict[str, Any] | None:
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
    if isinstance(getattr(cls, "__getstate__", None), types.MethodDescriptorType) and (
        cls.__getstate__ is not getattr(object, "__getstate__", None)
    ):  # of a compiled type
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
