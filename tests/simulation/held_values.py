"""What an object of a user may hold, for the digest of a model: functions of a number that make the values anew.

``python -m tests.simulation.held_values`` prints the digests, which have to be the same in every process.
"""

import collections
import contextvars
import datetime
import decimal
import enum
import fractions
import functools
import io
import itertools
import json
import logging
import operator
import os
import pathlib
import random
import re
import sys
import threading
import types
import uuid
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import scipy.interpolate
import scipy.linalg
import scipy.signal
import scipy.sparse
import scipy.sparse.linalg
import scipy.spatial
import scipy.stats

from fe_likelihoods import Channel, Record
from fe_likelihoods.simulation.code_digest import code_digest

X = np.linspace(0.0, 1.0, 9)
Pair = collections.namedtuple("Pair", "a b")
SENTINEL = object()


class Grade(enum.Enum):
    A = 1
    B = 2


class Flag(enum.IntFlag):
    A = 1
    B = 2


class Reduced:
    """Defines how it is pickled."""

    def __init__(self, k):
        self.k = k

    def __reduce__(self):
        return Reduced, (self.k,)


class Stated:
    """Leaves out something when it is pickled."""

    def __init__(self, k):
        self.k, self.buffer = k, [k]

    def __getstate__(self):
        return {"k": self.k}


class Holder:
    """A function of the parameters with an attribute."""

    def __init__(self, value):
        self.value = value

    def __call__(self, theta):
        return theta


def frame(k):
    import pandas

    return pandas.DataFrame({"a": X, "b": ["x", str(k)] + 7 * [None]}, index=pandas.date_range("2020", periods=9))


def logged(k):
    handler = logging.StreamHandler()
    handler.setLevel(k)
    return handler


# each a function of a number, 1 or 2
VALUES = {
    "range": lambda k: range(k),
    "slice": lambda k: slice(k),
    "Fraction": lambda k: fractions.Fraction(k, 3),
    "Decimal": lambda k: decimal.Decimal(k) / 10,
    "complex": lambda k: 1j * k,
    "SimpleNamespace": lambda k: types.SimpleNamespace(k=k),
    "datetime": lambda k: datetime.datetime(2020, 1, k, tzinfo=datetime.UTC),
    "date": lambda k: datetime.date(2020, 1, k),
    "time": lambda k: datetime.time(k),
    "timedelta": lambda k: datetime.timedelta(k),
    "Path": lambda k: pathlib.Path(f"file{k}"),
    "UUID": lambda k: uuid.UUID(int=k),
    "Enum": lambda k: Grade(k),
    "IntFlag": lambda k: Flag(k),
    "namedtuple": lambda k: Pair(1, k),
    "defaultdict": lambda k: collections.defaultdict(list, a=[k]),
    "OrderedDict": lambda k: collections.OrderedDict(a=k),
    "Counter": lambda k: collections.Counter(k * "a"),
    "ChainMap": lambda k: collections.ChainMap({"a": k}),
    "UserDict": lambda k: collections.UserDict(a=k),
    "deque": lambda k: collections.deque([k], maxlen=3),
    "bytes": lambda k: bytes([k]),
    "bytearray": lambda k: bytearray([k]),
    "memoryview": lambda k: memoryview(bytes([k])),
    "keys of a dict": lambda k: {k: 1}.keys(),
    "StringIO": lambda k: io.StringIO(str(k)),
    "pattern": lambda k: re.compile(str(k)),
    "itemgetter": lambda k: operator.itemgetter(k),
    "methodcaller": lambda k: operator.methodcaller("a", k),
    "partial": lambda k: functools.partial(max, k),
    "count": lambda k: itertools.count(k),
    "iterator": lambda k: iter([k]),
    "weak reference": lambda k: weakref.ref(Grade(k)),
    "exception": lambda k: ValueError(k),
    "type": lambda k: list[int] if k == 1 else list[float],
    "set": lambda k: {"a", "b", k},
    "method": lambda k: Holder(k).__call__,
    "an object of the user": lambda k: Holder(k),
    "with __reduce__": lambda k: Reduced(k),
    "with __getstate__": lambda k: Stated(k),
    "module": lambda k: np if k == 1 else re,
    "array": lambda k: k * X,
    "array of objects": lambda k: np.array([k, "a", None], dtype=object),
    "structured array": lambda k: np.array([(k, 2.0)], dtype=[("a", int), ("b", float)]),
    "masked array": lambda k: np.ma.masked_less(X, k / 3),
    "datetime64": lambda k: np.datetime64(f"2020-01-0{k}"),
    "dtype": lambda k: np.dtype(f"f{4 * k}"),
    "Polynomial": lambda k: np.polynomial.Polynomial([1, k]),
    "vectorize": lambda k: np.vectorize(abs if k == 1 else int),
    "Generator": lambda k: np.random.default_rng(k),
    "RandomState": lambda k: np.random.RandomState(k),
    "Random": lambda k: random.Random(k),
    "interp1d": lambda k: scipy.interpolate.interp1d(X, k * X),
    "CubicSpline": lambda k: scipy.interpolate.CubicSpline(X, k * X),
    "PchipInterpolator": lambda k: scipy.interpolate.PchipInterpolator(X, k * X),
    "UnivariateSpline": lambda k: scipy.interpolate.UnivariateSpline(X, k * X),
    "BSpline": lambda k: scipy.interpolate.make_interp_spline(X, k * X),
    "RegularGridInterpolator": lambda k: scipy.interpolate.RegularGridInterpolator((X,), k * X),
    "RBFInterpolator": lambda k: scipy.interpolate.RBFInterpolator(X[:, None], k * X),
    "RectBivariateSpline": lambda k: scipy.interpolate.RectBivariateSpline(X, X, k * np.outer(X, X)),
    "csr_matrix": lambda k: scipy.sparse.csr_matrix(k * np.eye(3)),
    "csc_array": lambda k: scipy.sparse.csc_array(k * np.eye(3)),
    "lil_matrix": lambda k: scipy.sparse.lil_matrix(k * np.eye(3)),
    "dok_array": lambda k: scipy.sparse.dok_array(k * np.eye(3)),
    "LinearOperator": lambda k: scipy.sparse.linalg.aslinearoperator(k * np.eye(3)),
    "lu_factor": lambda k: scipy.linalg.lu_factor(k * np.eye(3)),
    "lti": lambda k: scipy.signal.lti([1], [1, k]),
    "frozen distribution": lambda k: scipy.stats.norm(0, k),
    "cKDTree": lambda k: scipy.spatial.cKDTree(k * np.eye(3)),
    "DataFrame": frame,
    "Series": lambda k: frame(k)["b"],
    "Index": lambda k: frame(k).index[k:],
    "Record": lambda k: Record("pulse", 0.01 * k, np.sin(np.arange(20) / 3)),
    "Channel": lambda k: Channel(f"a{k}", "displacement", "m"),
}

WITHOUT_VALUE = {
    "lock": lambda k: threading.Lock(),
    "RLock": lambda k: threading.RLock(),
    "Event": lambda k: threading.Event(),
    "Condition": lambda k: threading.Condition(),
    "Semaphore": lambda k: threading.Semaphore(k),
    "threading.local": lambda k: threading.local(),
    "handler": logged,
    "WeakValueDictionary": lambda k: weakref.WeakValueDictionary(),
    "sentinel": lambda k: SENTINEL,
    "global random numbers": lambda k: np.random.mtrand._rand,
}

REFUSED = {
    "open file": lambda k: open(os.devnull),
    "standard output": lambda k: sys.__stdout__,
    "generator": lambda k: (item for item in [k]),
    "thread": lambda k: threading.Thread(),
    "executor": lambda k: ThreadPoolExecutor(1),
    "ContextVar": lambda k: contextvars.ContextVar("a"),
    "SuperLU": lambda k: scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(np.eye(3))),
}


def digests() -> dict[str, str]:
    """Digests of objects that hold the values."""
    return {name: code_digest(Holder(make(1))) for name, make in (VALUES | WITHOUT_VALUE).items()}


if __name__ == "__main__":
    print(json.dumps(digests()))
