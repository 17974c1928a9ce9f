"""How many rows of a cache have been used since they were verified, for all likelihoods of one model object."""

import os
import threading
import uuid
import weakref
from collections import Counter, OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from .disk_cache import SimulationCache
from .fingerprint import state_of
from .model import Model

__all__ = ["Schedule", "shared_schedule"]

MAX_SCHEDULES = 32

# while there is a likelihood that has it
_of_models: "weakref.WeakValueDictionary[tuple, Schedule]" = weakref.WeakValueDictionary()
_schedules: "OrderedDict[str, Schedule]" = OrderedDict()  # of pickled objects: copies in a process share one


class Schedule:
    """How many rows have been used since the last full verification, per table and fingerprint.

    It is shared by the likelihoods of one model object, by those that were derived from one, and by their copies.

    Parameters
    ----------
    token : str
        Identifies the schedule in other processes, where it starts anew.
    """

    def __init__(self, token: str) -> None:
        self.token = token
        self.served: Counter[tuple[str, str]] = Counter()
        self.restarts = 0
        self.failed_attempts = 0
        self.pause_ends, self.rows_in_pause = -np.inf, 0
        self.stale: tuple[str, Any] | None = None  # fingerprint of the row that differed, and the error
        self.stamps: dict[str, tuple] = {}  # of the source files, per fingerprint
        self._lock, self._owner = threading.RLock(), os.getpid()
        self.made_for: tuple = ()  # the model and pool, so that their ids are not reused

    def __reduce__(self) -> tuple:
        return _schedule, (_schedule(self.token, self).token,)

    @property
    def lock(self) -> threading.RLock:
        """A lock that no thread of a parent process held at the time of the fork."""
        if self._owner != os.getpid():
            self._lock, self._owner = threading.RLock(), os.getpid()
        return self._lock


def _schedule(token: str, new: Schedule | None = None) -> Schedule:
    """The schedule of this process with a token."""
    if token not in _schedules:
        _schedules[token] = new or Schedule(token)
        while len(_schedules) > MAX_SCHEDULES:
            _schedules.popitem(last=False)
    return _schedules[token]


def shared_schedule(cache: SimulationCache, model: Model, pool: Any) -> Schedule:
    """The schedule for a file, a model object in its present state and a pool."""
    key = (str(Path(cache.path).absolute()), cache.tolerance, id(model), id(pool), model.fingerprint, state_of(model))
    schedule = _of_models.get(key)
    if schedule is None:
        schedule = _of_models[key] = Schedule(uuid.uuid4().hex)
        schedule.made_for = model, pool
    return schedule
