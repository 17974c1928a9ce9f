"""Reading of HDF5 data sets from files that may be damaged."""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["DAMAGE", "read_values"]

# Errors that reading a damaged file raises, besides ValueError
DAMAGE = (OSError, KeyError, IndexError, TypeError, AttributeError, RuntimeError, OverflowError, MemoryError)
# deflate compresses zeros to 1/1032 of their size (RFC 1951); data are never smaller
_LARGEST_RATIO = 1100
_SMALL = 2**20


def read_values(data: Any, path: str | os.PathLike, kind: str = "<f8") -> NDArray:
    """Return the numbers of an h5py data set; ValueError if it declares more numbers than the file can contain."""
    declared, stored = int(data.size) * np.dtype(kind).itemsize, int(data.id.get_storage_size())
    if declared > _SMALL and (declared > _LARGEST_RATIO * stored or stored > os.path.getsize(path)):
        raise ValueError(
            f"{path}: {data.name} declares {data.size} numbers, more than the file can contain; it is damaged, make it "
            "or download it again"
        )
    return np.asarray(data[()], dtype=kind)
