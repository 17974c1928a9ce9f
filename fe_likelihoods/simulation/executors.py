"""One map over any pool: how simulations are spread over processes and machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: that many processes of a `LocalPool`.
* an object with ``gather``, a client of dask.distributed: ``gather(map(function, groups of items, pure=False))``.
* anything else with ``map``: ``list(pool.map(function, items))``, which covers the executors of concurrent.futures,
  loky and mpi4py.futures and the pools of multiprocessing and schwimmbad.

The function that is mapped holds the model and the measurements and may be large, an item is a few parameters. The
function crosses into each worker process once: over the worker's own pipe in a `LocalPool`, through a temporary file
in other pools of the same machine, and beside the item where a worker says that it knows neither the function nor the
file. After that a task is a digest and the parameters.

What comes back does not depend on the pool, to the last bit.
"""

import logging
import pickle
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import cache, partial
from multiprocessing.pool import Pool, ThreadPool
from pathlib import Path
from typing import Any, NamedTuple

from .local_pool import LocalPool, Outcome
from .processes import PickledFunction, TemporaryFolder

__all__ = ["DaskEngine", "LocalPool", "PoolEngine", "as_executor"]

logger = logging.getLogger(__name__)

_KNOWN_FUNCTIONS = 8
_DIED = "the worker process died each time that dask tried"


def as_executor(pool: Any, model: Any = None) -> "LocalPool | DaskEngine | PoolEngine | None":
    """What maps functions over a pool, by the rule above.

    Parameters
    ----------
    pool : None, int, or a pool
    model : optional
        Looked at before anything runs: it must be picklable if the workers are other processes.

    Returns
    -------
    None for None, else an object whose ``map(function, items)`` returns a list. The functions must return an
    `Outcome`: an item that brings down every process that tries it gets one as well, where the pool survives that.

    Raises
    ------
    ValueError
        If `pool` is none of these, or the model cannot be sent to its processes.
    """
    if pool is None or isinstance(pool, LocalPool | PoolEngine):
        engine = pool
    elif hasattr(pool, "gather") and hasattr(pool, "map"):
        engine = DaskEngine(pool)
    elif hasattr(pool, "map"):
        engine = PoolEngine(pool)
    else:
        engine = LocalPool(pool)
    if engine is not None and engine.other_processes:
        _check_picklable(model, engine)
    return engine


def _check_picklable(model: Any, engine: Any) -> None:
    try:
        shipment = PickledFunction.of(model)
        if isinstance(engine, LocalPool):
            shipment.script()
    except ValueError as error:
        name, value = _culprit(model)
        raise ValueError(
            f"with this pool the model {type(model).__name__} must go to other processes, which its attribute {name} = "
            f"{value!r} prevents. {error}"
            if name
            else f"with this pool the model must go to other processes. {error}"
        ) from error


def _culprit(thing: Any, depth: int = 3) -> tuple[str, Any]:
    """Name and value of the innermost attribute that cannot be pickled."""
    try:
        state = thing.__getstate__()
    except Exception:
        return "", thing
    state = state if isinstance(state, dict) else getattr(thing, "__dict__", {})
    for name, value in state.items():
        try:
            pickle.dumps(value)
        except Exception:
            inner, culprit = _culprit(value, depth - 1) if depth else ("", value)
            return (f"{name}.{inner}", culprit) if inner else (name, value)
    return "", thing


class _Missing(NamedTuple):
    """Answer of a worker that does not have the function."""


class _Unusable(NamedTuple):
    """Answer of a worker that has the function and cannot load it, and why."""

    reason: str


class _Shipped:
    """A function that is left behind when it is pickled: its digest goes instead.

    Called in this process it is the function itself. In another one it takes the function from those known there,
    from the file, or from its own payload, which it carries only if told to.
    """

    def __init__(self, function: Callable, folder: Path, carried: bool = False) -> None:
        self._function, self._folder, self._carried = function, folder, carried
        self._lock = threading.Lock()
        self._parts: tuple | None = None

    def __call__(self, item: Any) -> Any:
        return self._function(item)

    def __reduce__(self) -> tuple:
        with self._lock:  # pools pickle in threads of their own, often once for every item
            if self._parts is None:
                shipment = PickledFunction.of(self._function)
                path = self._folder / shipment.key.hex()
                if not self._carried and not path.exists():
                    part = path.with_suffix(f".{threading.get_ident()}")
                    part.write_bytes(shipment.payload)
                    part.replace(path)
                self._parts = shipment.key, str(path), shipment.payload if self._carried else b""
        return _Arrived, self._parts


_functions: OrderedDict[bytes, Callable] = OrderedDict()
_loading = threading.Lock()


class _Arrived:
    """What a `_Shipped` function is in a worker process."""

    def __init__(self, key: bytes, path: str, payload: bytes) -> None:
        self._parts = key, path, payload

    def __reduce__(self) -> tuple:
        return type(self), self._parts

    def __call__(self, item: Any) -> Any:
        key, path, payload = self._parts
        with _loading:
            function = _functions.get(key)
            if function is None:
                try:
                    payload = payload or Path(path).read_bytes()
                except OSError:
                    return _Missing()
                try:
                    function = pickle.loads(payload)
                except Exception as error:
                    return _Unusable(f"{type(error).__name__}: {error}")
                _functions[key] = function
            _functions.move_to_end(key)
            while len(_functions) > _KNOWN_FUNCTIONS:
                _functions.popitem(last=False)
        return function(item)


class PoolEngine:
    """Map over any object with ``map(function, items)``.

    Parameters
    ----------
    pool : the object
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool
        self._folder: TemporaryFolder | None = None

    @property
    def other_processes(self) -> bool:
        """Whether the pool is known to send its work to other processes."""
        return isinstance(self.pool, Executor | Pool) and not isinstance(self.pool, ThreadPoolExecutor | ThreadPool)

    @property
    def n_workers(self) -> int | None:
        """How many items run at once, where the pool tells; None where it does not."""
        sizes = (getattr(self.pool, name, None) for name in ("n_workers", "_max_workers", "_processes", "size"))
        return next((size for size in sizes if isinstance(size, int) and size > 0), None)

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """Outcomes for every item, in their order; RuntimeError where the workers cannot load the function."""
        items = list(items)
        if self._folder is None:
            self._folder = TemporaryFolder()
        outcomes = self._map(_Shipped(function, self._folder.path), items)
        missing = [index for index, outcome in enumerate(outcomes) if isinstance(outcome, _Missing)]
        if missing:
            carried = self._map(
                _Shipped(function, self._folder.path, carried=True), [items[index] for index in missing]
            )
            for index, outcome in zip(missing, carried, strict=True):
                outcomes[index] = outcome
        for outcome in outcomes:
            if isinstance(outcome, _Unusable):
                raise RuntimeError(
                    f"a worker cannot load the model: {outcome.reason}. Its classes and functions must be in modules "
                    "that can be imported there"
                )
        return outcomes

    def _map(self, function: Callable, items: list) -> list:
        return list(self.pool.map(function, items))


class DaskEngine(PoolEngine):
    """Map over the cluster of a ``dask.distributed.Client``, the engine beyond one machine.

    A task costs dask about 2 ms of all processors, so short runs travel in groups: large ones first and single runs
    last, so that the workers end together, and none longer than a second by what the runs before took, so that little
    is done again where a worker dies. dask tries a group again whose worker died, and gives up after some times
    (``distributed.scheduler.allowed-failures``); its items are then tried each by itself, and one that kills its worker
    again gets ``(None, reason)``.

    Parameters
    ----------
    pool : dask.distributed.Client
    """

    other_processes = True

    def __init__(self, pool: Any) -> None:
        super().__init__(pool)
        self._seconds: float | None = None  # of one item, by the last map

    @property
    def n_workers(self) -> int | None:
        """Threads of all workers of the cluster at this moment."""
        return sum(self.pool.nthreads().values()) or None

    def _map(self, function: Callable, items: list) -> list:
        if not (n_workers := self.n_workers):
            logger.warning("the dask cluster has no worker: %d runs wait for one", len(items))
        largest = 1 if self._seconds is None else int(1.0 / max(self._seconds, 1e-3))
        groups = _groups(items, n_workers or 1, largest)
        answers = self._answers(function, groups)
        seconds = sum(answer.seconds for answer in answers if answer is not None)
        done = sum(len(answer.outcomes) for answer in answers if answer is not None)
        self._seconds = seconds / done if done else None
        lost = [group for group, answer in zip(groups, answers, strict=True) if answer is None and len(group) > 1]
        singles = iter(self._answers(function, [[item] for group in lost for item in group]))
        outcomes = []
        for group, answer in zip(groups, answers, strict=True):
            tried = [answer] if answer is not None or len(group) == 1 else [next(singles) for _ in group]
            for one in tried:
                outcomes += [(None, _DIED)] if one is None else one.outcomes
        return outcomes

    def _answers(self, function: Callable, groups: list[list]) -> "list[_Answer | None]":
        """The answer for each group; None where every worker that tried it died."""
        if not groups:
            return []
        futures = self.pool.map(partial(_one_after_the_other, function), groups, pure=False)
        try:
            return self.pool.gather(futures)
        except Exception as error:
            if type(error).__name__ != "KilledWorker":
                raise
        try:
            return [self._answer(future) for future in futures]
        finally:
            for future in futures:  # or dask would run again what a dead worker had kept of them
                future.release()

    @staticmethod
    def _answer(future: Any) -> "_Answer | None":
        error = future.exception()  # waits for it
        if error is None:
            return future.result()
        if type(error).__name__ != "KilledWorker":
            raise error
        return None


class _Answer(NamedTuple):
    outcomes: list
    seconds: float


def _one_after_the_other(function: Callable, items: list) -> _Answer:
    """Runs in the worker."""
    _settle()
    start = time.perf_counter()
    return _Answer([function(item) for item in items], time.perf_counter() - start)


@cache
def _settle() -> None:
    """Wait, once in a process: dask's nanny starts no other worker if it hears of the death of one before its start.

    Where a deadly item is tried on every new worker at once, none would be left in the end, and all would wait.
    """
    time.sleep(0.5)


def _groups(items: list, n_workers: int, largest: int) -> list[list]:
    """`items` in groups, each half of a worker's share of what is left, at least one and at most `largest`."""
    groups, start = [], 0
    while start < len(items):
        size = min(max(1, (len(items) - start) // (2 * n_workers)), max(1, largest))
        groups.append(items[start : start + size])
        start += size
    return groups
