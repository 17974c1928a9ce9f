"""Requests for responses of which several run at once, each of any number of simulations.

A request only fills the caches of a likelihood: when it has ended, `CachedSimulations.simulate` returns its responses
without a simulation. So nothing depends on it but the time.
"""

from collections.abc import Hashable
from queue import SimpleQueue
from typing import Any

import numpy as np

from ..cache.memory import distinct_keys
from .new_simulations import RunningSimulation, take_all

__all__ = ["RunningRequests"]


class RunningRequests:
    """Simulations of one likelihood, in groups that are waited for.

    Without a pool to which single simulations can be submitted, nothing is simulated here, and all requests have ended.

    Parameters
    ----------
    likelihood : CachedSimulations
        It must cache the responses in memory until they are used.
    """

    def __init__(self, likelihood: Any) -> None:
        self._likelihood = likelihood
        self._arrived: SimpleQueue = SimpleQueue()
        self._left: dict[Hashable, set[RunningSimulation]] = {}  # by name of the request

    def __contains__(self, name: Hashable) -> bool:
        return name in self._left

    def begin(self, name: Hashable, thetas: np.ndarray) -> None:
        """Begin to simulate structural parameters (n, n_structural), unless their responses are cached."""
        self._left[name] = set()
        if not self._likelihood.streams:
            return
        keys, distinct = distinct_keys(thetas)
        first = [distinct.index(place) for place in range(len(keys))]
        new = np.flatnonzero(~self._likelihood.has_responses(keys))
        if len(new):
            wanted = [keys[place] for place in new], thetas[first][new]
            self._left[name].update(self._likelihood.start_simulations(*wanted, True, self._arrived))

    def wait(self) -> list[Hashable]:
        """Wait until a request has ended; returns the names of all that have, in the order in which they began.

        A simulation whose process was lost counts as ended: `CachedSimulations.simulate` runs it again.
        """
        while not (ended := [name for name, left in self._left.items() if not left]):
            arrived = take_all(self._arrived, wait=True)
            self._likelihood.receive_simulations(arrived)
            for left in self._left.values():
                left.difference_update(arrived)
        for name in ended:
            del self._left[name]
        return ended

    def close(self) -> None:
        """Cancel what was not started; what runs is cached if it ends while others are waited for."""
        left = [running for group in self._left.values() for running in group]
        self._left.clear()
        if left:
            self._likelihood.leave_simulations(left, self._arrived, running=False)
        self._likelihood.write_simulations()
