"""Cache in memory of the statistics of recent simulations.

The statistics of the residuals do not depend on the noise parameters. They are reused when only these change, when a
sampler returns to a point, and when a chain is evaluated again.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

__all__ = ["MemoryCache", "distinct_keys"]

_NAN = np.array([np.nan]).tobytes()


def distinct_keys(rows: np.ndarray) -> tuple[list[bytes], list[int]]:
    """Bytes of the distinct rows of a float array, in order of first appearance, and the index of every row in them."""
    first: dict[bytes, int] = {}
    which = [first.setdefault(row.tobytes(), len(first)) for row in rows + 0.0]  # adding zero makes 0.0 of -0.0
    return list(first), which


class MemoryCache:
    """Least-recently-used cache of statistics, with the bytes of the structural parameters as keys.

    Failures are cached as NaN. The cache may be shared by threads. It is empty after unpickling, because its contents
    would be larger than anything else in the pickle.

    Parameters
    ----------
    rows : int
        Largest number of simulations; 0 for none.

    Raises
    ------
    ValueError
        If `rows` is not a whole number or is negative.
    """

    def __init__(self, rows: int) -> None:
        if isinstance(rows, bool) or not isinstance(rows, int | np.integer) or rows < 0:
            raise ValueError(
                f"memory_rows must be the number of simulations to cache in memory, a whole number of 0 or more; got "
                f"{rows!r}"
            )
        self.rows = int(rows)
        self._misfits: OrderedDict[bytes, bytes] = OrderedDict()  # from the least to the most recently used
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple:
        return type(self), (self.rows,)

    def __len__(self) -> int:
        return len(self._misfits)

    def look_up(self, keys: Sequence[bytes], width: int) -> tuple[np.ndarray, list[bool]]:
        """Cached statistics of distinct keys.

        Parameters
        ----------
        keys : sequence of n bytes
        width : int
            Numbers per simulation, such as n_channels.

        Returns
        -------
        misfit : (n, width) float
            NaN where the simulation failed or is not cached.
        known : list of n bool
            Whether it is cached.
        """
        found = []
        with self._lock:
            for key in keys:
                misfit = self._misfits.get(key)
                if misfit is not None:
                    self._misfits.move_to_end(key)
                found.append(misfit)
        unknown = _NAN * width
        filled = bytearray().join([unknown if misfit is None else misfit for misfit in found])  # makes a writable array
        misfits = np.frombuffer(filled, dtype=float).reshape(len(keys), width)
        return misfits, [misfit is not None for misfit in found]

    def store(self, keys: Sequence[bytes], misfits: np.ndarray) -> None:
        """Cache the statistics (n, width) of n distinct keys."""
        with self._lock:
            self._misfits.update(zip(keys, map(np.ndarray.tobytes, misfits), strict=True))
            while len(self._misfits) > self.rows:
                self._misfits.popitem(last=False)
