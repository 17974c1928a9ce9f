"""Executor for other pools: concurrent.futures, multiprocessing, MPI, and any object with ``map``."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from multiprocessing.pool import Pool, ThreadPool
from typing import Any

from samplers.interrupts import Ended

from .local_pool import Outcome
from .sent_functions import FunctionReference, Missing, PrivateFiles

__all__ = ["PoolExecutor", "resolve"]


class _Task(Future):
    """Future of an item, in place of the pool's future."""

    inner: Any = None

    def cancel(self) -> bool:
        """Cancel the item unless the pool has started it, or cannot cancel anything."""
        if self.inner is not None and not (hasattr(self.inner, "cancel") and self.inner.cancel()):
            return False
        return super().cancel()


def resolve(future: Future, result: Any = None, error: BaseException | None = None) -> None:
    """Set the result or the exception of a future, unless it is cancelled."""
    if future.cancelled() or not future.set_running_or_notify_cancel():
        return
    if isinstance(result, Ended):
        error = result.error
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)


class PoolExecutor:
    """Executor for any object with ``map(function, items)``.

    A `multiprocessing.Pool` replaces a process that dies but does not run its item again, so the call never returns.
    Use a `LocalPool` if simulations may crash.
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool
        self._files = PrivateFiles()

    @property
    def other_processes(self) -> bool:
        """Whether the pool is known to run its work in other processes."""
        return isinstance(self.pool, Executor | Pool) and not isinstance(self.pool, ThreadPoolExecutor | ThreadPool)

    @property
    def submits(self) -> bool:
        """Whether the pool can run single items: it has ``submit`` or ``apply_async``."""
        return hasattr(self.pool, "submit") or isinstance(self.pool, Pool)

    @property
    def n_workers(self) -> int | None:
        """Number of items that run at once; None if the pool does not say."""
        sizes = (getattr(self.pool, name, None) for name in ("n_workers", "_max_workers", "_processes", "size"))
        return next((size for size in sizes if isinstance(size, int) and size > 0), None)

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """Outcomes of a function for every item, in order; ValueError if a worker cannot load the function."""
        items = list(items)
        reference = self._reference(function)
        outcomes = list(self.pool.map(reference, items))
        missing = [index for index, outcome in enumerate(outcomes) if isinstance(outcome, Missing)]
        if missing:
            carried = self.pool.map(reference.carried(), [items[index] for index in missing])
            for index, outcome in zip(missing, carried, strict=True):
                outcomes[index] = outcome
        for outcome in outcomes:
            if isinstance(outcome, Ended):
                raise outcome.error
        return outcomes

    def submit(self, function: Callable[[Any], Outcome], item: Any) -> Future:
        """Future with the outcome of a function for one item; raises the errors of `map`.

        ``cancel()`` has an effect until the pool starts the item, if the pool can cancel.
        """
        return self.submit_all(function, [item])[0]

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """Futures as from `submit`, for several items; ValueError if the pool only has ``map``."""
        if not self.submits:
            raise ValueError(
                f"{type(self.pool).__name__} has map, and neither submit nor apply_async: its items cannot be "
                "submitted one by one; use map"
            )
        reference = self._reference(function)
        tasks: list[Future] = []
        try:
            for item in items:
                tasks.append(self._send(_Task(), item, reference))
        except BaseException:
            self.give_up(tasks)
            raise
        return tasks

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, also ignore the results of items that the pool has started."""
        for future in futures:
            if not future.cancel() and running:
                Future.cancel(future)

    def _reference(self, function: Callable) -> FunctionReference:
        """The function as it is sent to workers, pickled now if they are known to be other processes."""
        reference = FunctionReference(function, self._files)
        if self.other_processes:
            reference.pickle()
        return reference

    def _send(self, task: _Task, item: Any, reference: FunctionReference, carried: bool = False) -> _Task:
        """Send an item to the pool, and again together with the function if the worker does not have it."""

        def received(result: Any) -> None:
            if isinstance(result, Missing) and not carried:
                try:
                    self._send(task, item, reference, True)
                except Exception as error:
                    resolve(task, error=error)
            else:
                resolve(task, result)

        def ended(inner: Future) -> None:
            if inner.cancelled():
                Future.cancel(task)
            elif (error := inner.exception()) is not None:
                resolve(task, error=error)
            else:
                received(inner.result())

        function = reference.carried() if carried else reference
        if hasattr(self.pool, "submit"):
            task.inner = self.pool.submit(function, item)
            task.inner.add_done_callback(ended)
        else:
            failed = partial(resolve, task, None)
            task.inner = self.pool.apply_async(function, (item,), callback=received, error_callback=failed)
        return task
