"""Arrays of blobs that hold the values of all points exactly.

Numbers are stored as floats, and everything else as Python objects, unless the user declares another type. So the type
does not depend on the values of the first points, unlike in emcee. A value that the type cannot hold is refused: text
is never cut, and a number never cut or rounded. The exception is a float that the user declares with fewer digits, such
as ``blobs_dtype=numpy.float32``.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

__all__ = ["stacked"]

LARGEST_EXACT = 2**53  # integers above are rounded in a float, and stay Python's


def stacked(blobs: list, dtype: Any = None, name: str = "log_prob_fn") -> np.ndarray:
    """Blobs of several points, a sequence for each, as one array (n, ...), as emcee stores them.

    ValueError if a declared dtype cannot hold a value.
    """
    try:
        with np.errstate(all="ignore"):
            if dtype is None:
                found = np.array(blobs)
                found = found.astype(np.result_type(found.dtype, float)) if found.dtype.kind in "biufc" else None
                if found is None or (np.any(np.abs(found) >= LARGEST_EXACT) and _lost(blobs, found)):
                    found = np.array(blobs, object)
            else:
                found = np.array(blobs, dtype)
    except (TypeError, ValueError, OverflowError) as error:  # no type holds all values, or rows of several lengths
        if dtype is not None and np.dtype(dtype).kind != "O":
            raise ValueError(f"{name} must return blobs of the declared type, blobs_dtype={dtype}: {error}") from error
        found = np.empty(len(blobs), dtype=object)
        for place, row in enumerate(blobs):
            found[place] = row
    if dtype is not None and (value := _lost(blobs, found)):
        raise ValueError(
            f"{name} must return blobs of the declared type, blobs_dtype={dtype}; got {value[0]!r}, which this type "
            "cannot hold. Declare a wider one"
        )
    single = tuple(axis for axis in range(1, found.ndim) if found.shape[axis] == 1)
    return np.squeeze(found, single) if single else found


def _leaves(values: Iterable) -> Iterator:
    """The single values of nested sequences and arrays in order, as values of Python, whose comparisons are exact."""
    for value in values.reshape(-1) if isinstance(values, np.ndarray) else values:
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        if isinstance(plain, list | tuple):
            yield from _leaves(plain)
        else:
            yield plain


def _lost(given: Iterable, found: np.ndarray) -> list:
    """The first of the values that an array of them has not kept, in a list; a float may have fewer digits."""
    for value, kept in zip(_leaves(given), _leaves(found), strict=False):
        both = value.encode() if isinstance(value, str) and isinstance(kept, bytes) else value
        same = both is kept or both == kept or (kept != kept and (value != value or value is None))
        if isinstance(value, float | complex) and isinstance(kept, float | complex):
            same = np.isfinite(kept) or not np.isfinite(value)
        if not same:
            return [value]
    return []
