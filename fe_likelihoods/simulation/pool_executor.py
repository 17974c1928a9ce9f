"""Executor for other pools: concurrent.futures, multiprocessing, MPI, and any object with ``map``."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cached_property
from multiprocessing.pool import Pool, ThreadPool
from typing import Any

from samplers.evaluation.point_queue import workers_of
from samplers.interrupts import SentFunction

from .by_value import Pickled
from .local_pool import Outcome, Submitting, value_of

__all__ = ["PoolExecutor"]


class PoolExecutor(Submitting):
    """Executor for any object with ``map(function, items)``.

    A `multiprocessing.Pool` replaces a process that dies but does not run its item again, so the call never returns.
    Use a `LocalPool` if simulations may crash.
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool

    @property
    def other_processes(self) -> bool:
        """Whether the pool is known to run its work in other processes."""
        return isinstance(self.pool, Executor | Pool) and not isinstance(self.pool, ThreadPoolExecutor | ThreadPool)

    @property
    def submits(self) -> bool:
        """Whether the pool can run single items: it has ``submit``."""
        return hasattr(self.pool, "submit")

    @property
    def n_workers(self) -> int | None:
        """Number of items that run at once; None if the pool does not say."""
        return workers_of(self.pool)

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """Outcomes of a function for every item, in order; ValueError if a worker cannot load the function."""
        if self.submits:
            return super().map(function, items)
        return [value_of(outcome) for outcome in self.pool.map(self._by_value(function), list(items))]

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the pool only has ``map``."""
        if not self.submits:
            raise ValueError(
                f"{type(self.pool).__name__} has map and no submit: its items cannot be submitted one by one; use map"
            )
        sent, futures = self._by_value(function), []
        try:
            for item in items:
                futures.append(self.pool.submit(sent, item))
        except BaseException:
            self.give_up(futures)
            raise
        return futures

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items that the pool has not started."""
        for future in futures:
            future.cancel()

    def _by_value(self, function: Callable) -> SentFunction:
        """The function as it is sent to workers, pickled now if they are known to be other processes."""
        by_value = _ByValue(function)
        if self.other_processes:
            by_value.pickled  # noqa: B018
        return SentFunction(by_value)


class _ByValue:
    """A function that is sent to other processes by value, in its state when it is first pickled."""

    def __init__(self, function: Callable) -> None:
        self._function = function

    @cached_property
    def pickled(self) -> Pickled:
        return Pickled.of(self._function)

    def __call__(self, item: Any) -> Any:
        return self._function(item)

    def __reduce__(self) -> tuple:
        return Pickled, tuple(self.pickled)
