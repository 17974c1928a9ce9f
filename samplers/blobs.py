"""Arrays of blobs that hold the values of all points exactly.

The type of an array is found from all values, unlike in emcee, which takes the type of the first. A value that an array
of a given type cannot hold is refused: text is never cut, and a number never cut or rounded. The exception is a float
that the user declares with fewer digits, such as ``blobs_dtype=numpy.float32``.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

__all__ = ["converted", "joined", "leaves", "stacked"]

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
    if all(array.dtype.kind in NUMBERS for array in arrays) and len({array.shape[1:] for array in arrays}) == 1:
        whole = np.concatenate(arrays)
        if not _lost(arrays, whole):
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
    found = _as_type(blobs, dtype)
    value = _lost(blobs, found, declared) if found is not None else []
    if found is None:  # the first value that cannot become the type alone, or else the first of all
        value = [each for each in leaves(blobs) if _as_type(np.array(each), dtype) is None] or list(leaves(blobs))
    if value:
        numbers = {blobs.dtype.kind, dtype.kind} <= set(NUMBERS)
        wider = np.result_type(blobs.dtype, dtype) if numbers else "object, or for text in a file blobs_dtype='S50'"
        raise ValueError(
            f"blobs of type {dtype}, as in the first evaluations or as declared, cannot hold {value[0]!r} exactly: "
            f"pass blobs_dtype={wider}. A run with a file then goes on with its evaluations"
        )
    return found


def _as_type(blobs: np.ndarray, dtype: np.dtype) -> np.ndarray | None:
    """Blobs in another type, exactly or not; None if a value cannot become this type."""
    try:
        with np.errstate(all="ignore"):
            return blobs.astype(dtype)
    except (TypeError, ValueError, OverflowError):
        return None


def _inferred(blobs: list) -> np.ndarray:
    """Blobs in the type that NumPy finds for all of them, if it holds them exactly; objects otherwise."""
    try:
        found = np.array(blobs)
        exact = found.dtype.kind not in "US"  # a number beside text would become text
        if found.dtype.kind in "fc" and np.any(np.abs(found) >= LARGEST_EXACT):
            exact = not _lost(blobs, found)
        return found if exact else np.array(blobs, dtype=object)
    except (TypeError, ValueError):  # rows of different lengths, or types that have nothing in common
        return _as_objects(blobs)


def _declared(blobs: list, dtype: np.dtype, name: str) -> np.ndarray:
    """Blobs in a declared type; ValueError if it cannot hold one of them."""
    if dtype.kind == "O":
        return _as_objects(blobs)
    if dtype.names is None and (found := _inferred(blobs)).dtype == dtype:
        return found
    try:
        with np.errstate(all="ignore"):
            found = np.array(blobs, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must return blobs of the declared type, blobs_dtype={dtype}: {error}") from error
    if value := _lost(blobs, found, declared=True):
        raise ValueError(
            f"{name} must return blobs of the declared type, blobs_dtype={dtype}; got {value[0]!r}, which this type "
            "cannot hold. Declare a wider one"
        )
    return found


def leaves(values: Iterable) -> Iterator:
    """The single values of nested sequences and arrays in order, as values of Python, whose comparisons are exact."""
    for value in values.reshape(-1) if isinstance(values, np.ndarray) else values:
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        if isinstance(plain, list | tuple):
            yield from leaves(plain)
        else:
            yield plain


def _lost(given: Iterable, found: np.ndarray, declared: bool = False) -> list:
    """The first of the values that an array of them, of a type `declared` or not, has not kept, in a list."""
    for value, kept in zip(leaves(given), leaves(found), strict=False):
        both = value.encode() if isinstance(value, str) and isinstance(kept, bytes) else value
        if declared and isinstance(value, float | complex) and isinstance(kept, float | complex):
            same = np.isfinite(kept) or not np.isfinite(value)  # the user may want fewer digits
        else:
            same = both is kept or both == kept or (kept != kept and (value != value or (declared and value is None)))
        if not same:
            return [value]
    return []


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
