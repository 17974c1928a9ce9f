"""Arrays of blobs that hold the values of all points exactly.

The type of an array is found from all values, unlike in emcee, which takes the type of the first. A value that an array
of a given type cannot hold is refused: text is never cut, and a number never cut or rounded. The exception is a float
that the user declares with fewer digits, such as ``blobs_dtype=numpy.float32``.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

__all__ = ["converted", "joined", "stacked"]

LARGEST_EXACT = 2.0**53  # integers above are rounded in a float


def stacked(blobs: list, dtype: Any = None, name: str = "log_prob_fn") -> np.ndarray:
    """Blobs of several points, a sequence for each, as one array (n, ...), as emcee stores them.

    Text and blobs of different lengths become objects. ValueError if a declared dtype cannot hold a value.
    """
    try:
        with np.errstate(all="ignore"):
            found = np.array(blobs, dtype)
            large = found.dtype.kind in "fc" and np.any(np.abs(found) >= LARGEST_EXACT)
        if dtype is None and (found.dtype.kind in "US" or (large and _lost(blobs, found))):
            found = np.array(blobs, dtype=object)
    except (TypeError, ValueError, OverflowError) as error:  # no type holds all values, or rows of several lengths
        if dtype is not None and np.dtype(dtype).kind != "O":
            raise ValueError(f"{name} must return blobs of the declared type, blobs_dtype={dtype}: {error}") from error
        found, large = _objects(blobs), False
    is_plain = found.dtype == float and not large and np.array(blobs).dtype.kind in "biuf"
    if dtype is not None and not is_plain and (value := _lost(blobs, found, declared=True)):
        raise ValueError(
            f"{name} must return blobs of the declared type, blobs_dtype={dtype}; got {value[0]!r}, which this type "
            "cannot hold. Declare a wider one"
        )
    single = tuple(axis for axis in range(1, found.ndim) if found.shape[axis] == 1)
    return np.squeeze(found, single) if single else found


def joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of blobs (n_i, ...) of several batches as one; of objects if no other type holds all values."""
    if len({(array.dtype, array.shape[1:]) for array in arrays}) == 1:
        return np.concatenate(arrays)
    if all(array.dtype.kind in "biufc" for array in arrays) and len({array.shape[1:] for array in arrays}) == 1:
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
        raise ValueError(
            f"the blobs of each point must have the shape {shape} of the first evaluations; got {blobs.shape[1:]}. "
            "Return arrays of one length; or, without a file, pass blobs_dtype=object and return a dictionary"
        )
    try:
        with np.errstate(all="ignore"):
            found = blobs.astype(dtype)
        value = _lost(blobs, found, declared)
    except (TypeError, ValueError, OverflowError) as error:
        value = [str(error)]
    if value:
        numbers = blobs.dtype.kind in "biufc" and dtype.kind in "biufc"
        wider = np.result_type(blobs.dtype, dtype) if numbers else "object, or for text in a file blobs_dtype='S50'"
        raise ValueError(
            f"blobs of type {dtype}, as in the first evaluations or as declared, cannot hold all values exactly "
            f"({value[0]!r}): pass blobs_dtype={wider}. A run with a file then goes on with its evaluations"
        )
    return found


def _leaves(values: Iterable) -> Iterator:
    """The single values of nested sequences and arrays in order, as values of Python, whose comparisons are exact."""
    for value in values.reshape(-1) if isinstance(values, np.ndarray) else values:
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        if isinstance(plain, list | tuple):
            yield from _leaves(plain)
        else:
            yield plain


def _lost(given: Iterable, found: np.ndarray, declared: bool = False) -> list:
    """The first of the values that an array of them, of a type `declared` or not, has not kept, in a list."""
    for value, kept in zip(_leaves(given), _leaves(found), strict=False):
        both = value.encode() if isinstance(value, str) and isinstance(kept, bytes) else value
        same = both is kept or both == kept or (kept != kept and (value != value or (declared and value is None)))
        if declared and isinstance(value, float | complex) and isinstance(kept, float | complex):
            same = np.isfinite(kept) or not np.isfinite(value)  # the user may want fewer digits
        if not same:
            return [value]
    return []


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
