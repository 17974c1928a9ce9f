"""Arrays of blobs that hold the values of all points exactly.

The type of an array is found from all values, unlike in emcee, which takes the type of the first. A value that an array
of a given type cannot hold is refused: text is never cut, and a number never cut or rounded. The exception is a float
that the user declares with fewer digits, such as ``blobs_dtype=numpy.float32``.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

__all__ = ["converted", "joined", "stacked"]

NUMBERS, LARGEST_EXACT = "biufc", 2.0**53  # integers above are rounded in a float


def stacked(blobs: list, dtype: Any = None, name: str = "log_prob_fn") -> np.ndarray:
    """Blobs of several points, a sequence for each, as one array (n, ...), as emcee stores them.

    Text and blobs of different lengths become objects. ValueError if a declared dtype cannot hold a value.
    """
    found = _inferred(blobs) if dtype is None else _declared(blobs, np.dtype(dtype), name)
    single = tuple(axis for axis in range(1, found.ndim) if found.shape[axis] == 1)
    return np.squeeze(found, single) if single else found


def joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of blobs (n_i, ...) of several batches as one; of objects if no other type holds all values."""
    if len({(array.dtype, array.shape[1:]) for array in arrays}) == 1:
        return np.concatenate(arrays)
    numbers = all(array.dtype.kind in NUMBERS for array in arrays)
    if numbers and len({array.shape[1:] for array in arrays}) == 1:
        whole = np.concatenate(arrays)
        parts = np.split(whole, np.cumsum([len(array) for array in arrays])[:-1])
        if not any(_lost(array, part).any() for array, part in zip(arrays, parts, strict=True)):
            return whole
    return _objects(row for array in arrays for row in _rows(array))


def converted(blobs: np.ndarray, dtype: np.dtype, shape: tuple[int, ...], declared: bool = False) -> np.ndarray:
    """Blobs (n, ...) as an array ``(n, *shape)`` of a type, `declared` or not; ValueError if it cannot hold a value."""
    if blobs.dtype == dtype and blobs.shape[1:] == shape:
        return blobs
    if dtype.kind == "O" and shape == ():
        return _objects(_rows(blobs))
    if blobs.shape[1:] != shape:
        shapes = [np.shape(blob) for blob in blobs]
        found = next((each for each in shapes if each != shape), blobs.shape[1:])
        raise ValueError(
            f"the blobs of each point must have the shape {shape} of the first evaluations; got {found}. "
            "Return arrays of one length; or, without a file, pass blobs_dtype=object and return a dictionary"
        )
    try:
        with np.errstate(all="ignore"):
            found = blobs.astype(dtype)
        lost = _lost(blobs, found, declared)
        value = blobs[lost].ravel()[:1].tolist()
    except (TypeError, ValueError, OverflowError):
        lost, value = np.ones(1, dtype=bool), [_first_that_does_not_fit(blobs, dtype)]
    if lost.any():
        numbers = {blobs.dtype.kind, dtype.kind} <= set(NUMBERS)
        wider = np.result_type(blobs.dtype, dtype) if numbers else "object, or for text in a file blobs_dtype='S50'"
        raise ValueError(
            f"blobs of type {dtype}, as in the first evaluations or as declared, cannot hold {value[0]!r} exactly: "
            f"pass blobs_dtype={wider}. A run with a file then goes on with its evaluations"
        )
    return found


def _first_that_does_not_fit(blobs: np.ndarray, dtype: np.dtype) -> Any:
    """The first of the values that cannot become the type; the first one if each can alone."""
    values = blobs.ravel().tolist()
    for value in values:
        try:
            np.array(value).astype(dtype)
        except (TypeError, ValueError, OverflowError):
            return value
    return values[0]


def _inferred(blobs: list) -> np.ndarray:
    """Blobs in the type that NumPy finds for all of them, if it holds them exactly; objects otherwise."""
    try:
        found = np.array(blobs)
        exact = found.dtype.kind not in "US"  # a number beside text would become text
        if found.dtype.kind in "fc" and np.any(np.abs(found) >= LARGEST_EXACT):
            exact = not _lost(np.array(blobs, dtype=object), found).any()
        return found if exact else np.array(blobs, dtype=object)
    except (TypeError, ValueError):  # rows of different lengths, or types that have nothing in common
        return _as_objects(blobs)


def _declared(blobs: list, dtype: np.dtype, name: str) -> np.ndarray:
    """Blobs in a declared type; ValueError if it cannot hold one of them."""
    if dtype.kind == "O":
        return _as_objects(blobs)
    try:
        with np.errstate(all="ignore"):
            found = np.array(blobs, dtype=dtype)
        value = _first_lost(blobs, found)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must return blobs of the declared type, blobs_dtype={dtype}: {error}") from error
    if value:
        raise ValueError(
            f"{name} must return blobs of the declared type, blobs_dtype={dtype}; got {value[0]!r}, which this type "
            "cannot hold. Declare a wider one"
        )
    return found


def _first_lost(blobs: list, found: np.ndarray) -> list:
    """The first of the blobs that an array of them has not kept, in a list; empty if there is none."""
    if found.dtype.names is not None:
        if any(not hasattr(row, "__len__") or len(row) != len(found.dtype.names) for row in blobs):
            return []
        columns = ([row[place] for row in blobs] for place in range(len(found.dtype.names)))
        values = (_first_lost(column, found[name]) for name, column in zip(found.dtype.names, columns, strict=True))
        return next(filter(None, values), [])
    given = _inferred(blobs)
    return given[_lost(given, found, declared=True)].ravel()[:1].tolist() if given.shape == found.shape else []


def _lost(given: np.ndarray, found: np.ndarray, declared: bool = False) -> np.ndarray:
    """Which values of an array another array of the same shape, of another type, `declared` or not, has not kept."""
    old, new = given.dtype.kind, found.dtype.kind
    if new == "O" or given.dtype == found.dtype:
        return np.zeros(given.shape, dtype=bool)
    if new in "SU":
        text = np.array([isinstance(value, str | bytes) for value in given.ravel().tolist()], dtype=bool)
        cut = given.astype(new) != found
        return cut | ~text.reshape(given.shape)
    if old == "O":
        pairs = zip(given.ravel().tolist(), found.ravel().tolist(), strict=True)
        same = [
            bool(_plain(value) == kept or (kept != kept and (value != value or (declared and value is None))))
            for value, kept in pairs
        ]
        return ~np.array(same, dtype=bool).reshape(given.shape)
    if declared and old + new in ("ff", "cc", "fc"):  # the user may want fewer digits
        return np.isfinite(given) & ~np.isfinite(found)
    with np.errstate(all="ignore"):
        back = found.astype(given.dtype)
    lost = (back != given) & ~((back != back) & (given != given))
    return lost | ((found < 0) != (given < 0)) if {old, new} <= set("iu") else lost


def _plain(value: Any) -> Any:
    """A scalar of NumPy as a number of Python, whose comparisons are exact."""
    return value.item() if isinstance(value, np.generic) else value


def _as_objects(blobs: list) -> np.ndarray:
    """Blobs (n, k) as objects; blobs of different lengths as n sequences."""
    try:
        return np.array(blobs, dtype=object)
    except ValueError:
        return _objects(blobs)


def _rows(array: np.ndarray) -> list:
    """The blobs of an array (n, ...): numbers of Python, or arrays where a blob has several values."""
    return list(array) if array.ndim > 1 and array.dtype.kind != "O" else array.tolist()


def _objects(rows: Iterable) -> np.ndarray:
    """Any values as an array (n,) of objects."""
    rows = list(rows)
    found = np.empty(len(rows), dtype=object)
    for place, row in enumerate(rows):
        found[place] = row
    return found
