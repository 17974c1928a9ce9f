"""Misfits of the structural parameters simulated lately.

The misfit, and what else a noise needs of the residuals, does not depend on the noise's parameters. So whoever changes
these alone, comes back to a point, or evaluates a chain again is served from memory, as long as it is not too long ago.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

__all__ = ["MisfitMemory", "distinct_keys"]

_NAN = np.array([np.nan]).tobytes()


def distinct_keys(rows: np.ndarray) -> tuple[list[bytes], list[int]]:
    """Bytes of the distinct rows of a float array, in the order of their first appearance, and which each row is."""
    first: dict[bytes, int] = {}
    which = [first.setdefault(row.tobytes(), len(first)) for row in rows + 0.0]  # -0.0 and 0.0 are one
    return list(first), which


class MisfitMemory:
    """Misfits by the bytes of their structural parameters; the ones not asked for longest are forgotten first.

    Failures are remembered as well, as NaN. Threads may share a memory. A pickled one comes back empty: it would be
    larger than anything it travels with.

    Parameters
    ----------
    rows : int
        The most that are remembered; 0 for none.

    Raises
    ------
    ValueError
        If `rows` is not a whole number, or negative.
    """

    def __init__(self, rows: int) -> None:
        if isinstance(rows, bool) or not isinstance(rows, int | np.integer) or rows < 0:
            raise ValueError(
                f"memory is the number of simulations whose misfits are remembered, 0 or more; got {rows!r}"
            )
        self.rows = int(rows)
        self._misfits: OrderedDict[bytes, bytes] = OrderedDict()  # from the one not asked for longest to the last one
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple:
        return type(self), (self.rows,)

    def __len__(self) -> int:
        return len(self._misfits)

    def look_up(self, keys: Sequence[bytes], width: int) -> tuple[np.ndarray, list[bool]]:
        """What is known of distinct keys.

        Parameters
        ----------
        keys : sequence of n bytes
        width : int — numbers of one simulation, such as n_channels

        Returns
        -------
        misfit : (n, width) float — NaN where the simulation had failed, and where nothing is known.
        known : list of n bool
        """
        found = []
        with self._lock:
            for key in keys:
                misfit = self._misfits.get(key)
                if misfit is not None:
                    self._misfits.move_to_end(key)
                found.append(misfit)
        unknown = _NAN * width
        filled = bytearray().join([unknown if misfit is None else misfit for misfit in found])  # can be written to
        misfits = np.frombuffer(filled, dtype=float).reshape(len(keys), width)
        return misfits, [misfit is not None for misfit in found]

    def store(self, keys: Sequence[bytes], misfits: np.ndarray) -> None:
        """Remember the misfits (n, width) of distinct keys."""
        with self._lock:
            self._misfits.update(zip(keys, map(np.ndarray.tobytes, misfits), strict=True))
            while len(self._misfits) > self.rows:
                self._misfits.popitem(last=False)
