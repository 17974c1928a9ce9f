"""Processes of a ``multiprocessing.Pool``, which replaces one that dies and never says that its task is lost."""

from multiprocessing.pool import Pool, ThreadPool
from typing import Any

__all__ = ["PoolWorkers"]


class PoolWorkers:
    """The processes of a pool while it is waited for.

    Parameters
    ----------
    pool : object
        Any pool; only the processes of a `multiprocessing.pool.Pool` need to be watched.

    Attributes
    ----------
    are_watched : bool
        Whether the pool is of this kind.
    """

    def __init__(self, pool: Any):
        self.are_watched = isinstance(pool, Pool) and not isinstance(pool, ThreadPool)
        self._pool, self._known = pool, {}
        self._note()

    def _note(self) -> None:
        if self.are_watched:
            self._known |= {process.pid: process for process in list(getattr(self._pool, "_pool", ()))}

    def check(self) -> None:
        """Raise RuntimeError if a process has died.

        With ``maxtasksperchild``, processes end after a number of tasks with the exit code 0.
        """
        if not self.are_watched:
            return
        self._note()
        replaced = getattr(self._pool, "_maxtasksperchild", None) is not None
        ends = {pid: process.exitcode for pid, process in self._known.items() if process.exitcode is not None}
        for pid, code in ends.items():
            if code != 0 or not replaced:
                raise RuntimeError(
                    f"a process of the multiprocessing.Pool has died (exit code {code}). Such a pool replaces it, but "
                    "the simulation that it ran is lost, and would be waited for for ever. Run again with a new pool; "
                    "with a number as pool, such as pool=8, a simulation whose process dies is repeated"
                )
            del self._known[pid]
