"""Simulations that were requested and have not ended, one by one and in groups.

A request only fills the caches of a simulator: when it has ended, `Simulator.simulate` returns its responses without a
simulation. It affects the time, never the result.
"""

from collections.abc import Hashable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from ..cache.memory import distinct_keys

__all__ = ["RunningRequests", "RunningSimulation", "Simulated", "take_all"]


class Simulated(NamedTuple):
    """Result of one simulation: its statistics, the reason of a failure, and its response if it was requested."""

    misfit: np.ndarray
    reason: str
    response: np.ndarray | None


class RunningSimulation:
    """A simulation that was requested of a `Simulator`, with its parameters and their key as in `distinct_keys`.

    `future` is None if it waits to be run in this process or in a batch; `users` are the queues of the requests that
    wait for it. It is `received` when it has ended and was counted and cached, or was cancelled; it then has a
    `result`, or an `error` for which the model is not to blame.
    """

    __slots__ = ("error", "future", "key", "received", "responses", "result", "theta", "users")

    def __init__(self, key: bytes, theta: np.ndarray, responses: bool) -> None:
        self.key, self.theta, self.responses = key, theta, responses
        self.future: Future | None = None
        self.users: set[SimpleQueue] = set()
        self.received = False
        self.result: Simulated | None = None
        self.error: BaseException | None = None


def take_all(arrived: SimpleQueue, wait: bool) -> list:
    """All items of a queue; with `wait`, at least one."""
    items = [arrived.get()] if wait else []
    try:
        while True:
            items.append(arrived.get_nowait())
    except Empty:
        return items


class RunningRequests:
    """Groups of simulations for responses; each group is waited for as a whole.

    Without a pool that accepts single simulations, nothing is simulated here, and all requests count as ended. The
    simulator must cache the responses in memory until they are used.
    """

    def __init__(self, simulator: Any) -> None:
        self._simulator = simulator
        self._arrived: SimpleQueue = SimpleQueue()
        self._left: dict[Hashable, set[RunningSimulation]] = {}  # by name of the request

    def __contains__(self, name: Hashable) -> bool:
        return name in self._left

    def begin(self, name: Hashable, thetas: np.ndarray) -> None:
        """Begin to simulate structural parameters (n, n_structural), unless their responses are cached."""
        self._left[name] = set()
        if not self._simulator.streams:
            return
        keys, _ = distinct_keys(thetas)
        new = [key for key, is_there in zip(keys, self._simulator.has_responses(keys), strict=True) if not is_there]
        if new:
            self._left[name].update(self._simulator.start(new, True, self._arrived))

    def wait(self) -> list[Hashable]:
        """Wait until a request has ended; names of all that have, in the order in which they began.

        A simulation whose process was lost counts as ended: `Simulator.simulate` runs it again.
        """
        while not (ended := [name for name, left in self._left.items() if not left]):
            arrived = take_all(self._arrived, wait=True)
            self._simulator.receive(arrived)
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
            self._simulator.leave(left, self._arrived, running=False)
