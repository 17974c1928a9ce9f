"""Executor of other pools: concurrent.futures, multiprocessing, MPI, and any object with ``map``."""

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from multiprocessing.pool import Pool, ThreadPool
from typing import Any

from .local_pool import Outcome
from .pool_workers import PoolWorkers
from .processes import TemporaryFolder
from .sent_functions import FunctionReference, Missing, Unusable

__all__ = ["PoolExecutor", "resolve"]

SECONDS_BETWEEN_CHECKS = 1.0  # of the processes of a multiprocessing.Pool


class _Task(Future):
    """Future of an item, which stands for that of the pool."""

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
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)


class PoolExecutor:
    """Executor for any object with ``map(function, items)``.

    Parameters
    ----------
    pool : object

    Attributes
    ----------
    folder : TemporaryFolder, optional
        Where mapped functions are stored for the workers; None before the first one.
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool
        self.folder: TemporaryFolder | None = None
        self._last: tuple[Any, FunctionReference, FunctionReference] | None = None
        self._waiting_lock, self._waiting = threading.Lock(), set()  # tasks of a multiprocessing.Pool

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
        """Outcomes of a function for every item, in their order; RuntimeError if a worker cannot load the function."""
        items = list(items)
        reference, carrying = self._references(function)
        outcomes = self._map(reference, items)
        missing = [index for index, outcome in enumerate(outcomes) if isinstance(outcome, Missing)]
        if missing:
            carried = self._map(carrying, [items[index] for index in missing])
            for index, outcome in zip(missing, carried, strict=True):
                outcomes[index] = outcome
        for outcome in outcomes:
            if isinstance(outcome, Unusable):
                raise outcome.error
        return outcomes

    def _map(self, function: Callable, items: list) -> list:
        workers = PoolWorkers(self.pool)
        if not workers.are_watched:
            return list(self.pool.map(function, items))
        result = self.pool.map_async(function, items)
        while not result.ready():
            result.wait(SECONDS_BETWEEN_CHECKS)
            if not result.ready():
                workers.check()
        return result.get()

    def submit(self, function: Callable[[Any], Outcome], item: Any) -> Future:
        """Future of the outcome of a function for one item, with the errors of `map`.

        ``cancel()`` of the future has an effect until the pool starts the item, where the pool can cancel.
        """
        return self.submit_all(function, [item])[0]

    def submit_all(self, function: Callable[[Any], Outcome], items: Sequence[Any]) -> list[Future]:
        """Futures as of `submit` for several items.

        The function is pickled again if it is another object than in the last call.

        Raises
        ------
        ValueError
            If the pool has ``map`` only.
        """
        if not self.submits:
            raise ValueError(
                f"{type(self.pool).__name__} has map, and neither submit nor apply_async: its items cannot be "
                "submitted one by one; use map"
            )
        if self._last is None or self._last[0] is not function:
            self._last = function, *self._references(function)
        _, reference, carrying = self._last
        tasks: list[Future] = []
        try:
            for item in items:
                tasks.append(self._send(_Task(), item, reference, carrying))
        except BaseException:
            self.give_up(tasks)
            raise
        return tasks

    def give_up(self, futures: Sequence[Future], running: bool = True) -> None:
        """Cancel items; with `running`, the results of those that the pool has started are ignored."""
        for future in futures:
            if not future.cancel() and running:
                Future.cancel(future)

    def _references(self, function: Callable) -> tuple[FunctionReference, FunctionReference]:
        """The function as it is sent to the workers, and as it is sent to those that cannot read the file."""
        if self.folder is None:
            self.folder = TemporaryFolder()
        return FunctionReference(function, self.folder.path), FunctionReference(function, self.folder.path, True)

    def _send(self, task: _Task, item: Any, reference: FunctionReference, carrying: FunctionReference | None) -> _Task:
        """Send an item to the pool; `carrying` is sent to a worker that does not find the function."""

        def received(result: Any) -> None:
            if isinstance(result, Missing) and carrying is not None:
                try:
                    self._send(task, item, carrying, None)
                except Exception as error:
                    resolve(task, error=error)
            elif isinstance(result, Unusable):
                resolve(task, error=result.error)
            else:
                resolve(task, result)

        failed = partial(_fail, task)
        if hasattr(self.pool, "submit"):
            task.inner = self.pool.submit(reference, item)
            task.inner.add_done_callback(partial(_forward, task, received))
        else:
            self._expect(task)
            task.inner = self.pool.apply_async(reference, (item,), callback=received, error_callback=failed)
        return task

    def _expect(self, task: _Task) -> None:
        """Let a task fail when a process of its `multiprocessing.Pool` dies, which never reports it."""
        workers = PoolWorkers(self.pool)
        if not workers.are_watched:
            return
        with self._waiting_lock:
            if not self._waiting:
                threading.Thread(target=self._check, args=(workers,), name="watch of a pool", daemon=True).start()
            self._waiting.add(task)

    def _check(self, workers: PoolWorkers) -> None:
        """Watch the processes while tasks are waited for; in a thread."""
        while True:
            time.sleep(SECONDS_BETWEEN_CHECKS)
            with self._waiting_lock:
                self._waiting = {task for task in self._waiting if not task.done()}
                if not self._waiting:
                    return
                try:
                    workers.check()
                except RuntimeError as error:
                    for task in self._waiting:
                        resolve(task, error=error)
                    self._waiting = set()
                    return


def _fail(task: _Task, error: BaseException) -> None:
    resolve(task, error=error)


def _forward(task: _Task, received: Callable[[Any], None], inner: Any) -> None:
    """Pass the end of a pool's future on."""
    if inner.cancelled():
        Future.cancel(task)
    elif (error := inner.exception()) is not None:
        resolve(task, error=error)
    else:
        received(inner.result())
