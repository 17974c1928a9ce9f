"""Executors: a common ``map`` over any pool, which runs simulations in other processes or on other machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: a `LocalPool` of that many processes.
* an object with ``gather`` (a client of dask.distributed): ``gather(map(function, groups of items, pure=False))``.
* any other object with ``map``: ``list(pool.map(function, items))``. This covers the executors of concurrent.futures,
  loky and mpi4py.futures and the pools of multiprocessing and schwimmbad.

The mapped function contains the model and the measurements and may be large; an item is a few parameters. The function
is sent to each worker process once: through the worker's own pipe in a `LocalPool`, through a private temporary file,
whose digest is checked, in other pools on the same machine, and together with the items where a worker reports that it
has neither the function nor the file. Later tasks consist of a digest of the function and the parameters.

Results do not depend on the pool, to the last bit.
"""

import logging
import os
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

from .dask_workers import WorkerWatch
from .faults import TransientReason, raise_if_refused
from .local_pool import LocalPool, Outcome
from .processes import PickledFunction, TemporaryFolder, local_definition

__all__ = ["DaskExecutor", "LocalPool", "PoolExecutor", "as_executor"]

logger = logging.getLogger(__name__)

MAX_LOADED_FUNCTIONS = 8
_DIED = TransientReason("the worker process died in every attempt of dask")


def as_executor(pool: Any, model: Any = None) -> "LocalPool | DaskExecutor | PoolExecutor | None":
    """Executor for a pool, by the rule above.

    Parameters
    ----------
    pool : None, int, or a pool
    model : Model, optional
        Checked before anything runs: it must be picklable if the workers are other processes.

    Returns
    -------
    LocalPool, DaskExecutor, PoolExecutor or None
        None for None, otherwise an object whose ``map(function, items)`` returns a list. The functions must return an
        `Outcome`; an item that kills every process that runs it gets one as well, if the pool survives.

    Raises
    ------
    ValueError
        If `pool` is none of these, or the model cannot be sent to its processes.
    """
    if pool is None or isinstance(pool, LocalPool | PoolExecutor):
        executor = pool
    elif hasattr(pool, "gather") and hasattr(pool, "map"):
        executor = DaskExecutor(pool)
    elif hasattr(pool, "map"):
        executor = PoolExecutor(pool)
    else:
        executor = LocalPool(pool)
    if executor is not None and executor.other_processes:
        _check_picklable(model, executor)
    return executor


def _check_picklable(model: Any, executor: Any) -> None:
    """Raise ValueError, with the name of the attribute to blame, if a model cannot be sent to other processes."""
    try:
        pickled = PickledFunction.of(model)
        if isinstance(executor, LocalPool):
            pickled.script()
    except ValueError as error:
        name, value = _culprit(model)
        kind = type(model).__name__
        if not name:
            raise ValueError(f"with this pool the model must be sent to other processes. {error}") from error
        if local := local_definition(value):
            raise ValueError(
                f"the {name} of {kind} cannot be sent to other processes (it is {local}): define it at the top level "
                "of a module"
            ) from error
        raise ValueError(
            f"the {name} of {kind}, of type {type(value).__name__}, cannot be sent to other processes. {error}"
        ) from error


def _culprit(thing: Any, depth: int = 3) -> tuple[str, Any]:
    """Name and value of the innermost attribute of an object that cannot be pickled."""
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
    """Reply of a worker that does not have the function."""


class _Unusable(NamedTuple):
    """Reply of a worker that has the function but cannot load it, with the reason."""

    reason: str


class _FunctionReference:
    """A function that is pickled as a reference: its digest and the path of a file with the pickled function.

    Called in this process, it calls the function. In another process it becomes a `_LoadedFunction`.

    Parameters
    ----------
    function : callable
    folder : Path
        Temporary folder for the file.
    carried : bool
        Whether the pickled function itself is part of the reference, for workers that cannot read the file.
    """

    def __init__(self, function: Callable, folder: Path, carried: bool = False) -> None:
        self._function, self._folder, self._carried = function, folder, carried
        self._lock = threading.Lock()
        self._parts: tuple | None = None

    def __call__(self, item: Any) -> Any:
        return self._function(item)

    def __reduce__(self) -> tuple:
        with self._lock:  # pools pickle in threads of their own, often once per item
            if self._parts is None:
                pickled = PickledFunction.of(self._function)
                path = self._folder / pickled.key.hex()
                if not self._carried and not path.exists():
                    part = path.with_suffix(f".{threading.get_ident()}")
                    with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                        file.write(pickled.payload)
                    part.replace(path)
                self._parts = pickled.key, str(path), pickled.payload if self._carried else b""
        return _LoadedFunction, self._parts


loaded_functions: OrderedDict[bytes, Callable] = OrderedDict()
_loading = threading.Lock()


class _LoadedFunction:
    """A `_FunctionReference` in a worker process, which loads the function once and keeps the most recent ones."""

    def __init__(self, key: bytes, path: str, payload: bytes) -> None:
        self._parts = key, path, payload

    def __reduce__(self) -> tuple:
        return type(self), self._parts

    def __call__(self, item: Any) -> Any:
        key, path, payload = self._parts
        with _loading:
            function = loaded_functions.get(key)
            if function is None:
                try:
                    pickled = PickledFunction(payload or Path(path).read_bytes(), key)
                except OSError:
                    return _Missing()
                try:
                    function = pickled.load()
                except Exception as error:
                    return _Unusable(f"{type(error).__name__}: {error}")
                loaded_functions[key] = function
            loaded_functions.move_to_end(key)
            while len(loaded_functions) > MAX_LOADED_FUNCTIONS:
                loaded_functions.popitem(last=False)
        return function(item)


class PoolExecutor:
    """Executor for any object with ``map(function, items)``.

    Parameters
    ----------
    pool : object

    Attributes
    ----------
    folder : TemporaryFolder, optional
        Where mapped functions are stored for the workers; None before the first map.
    """

    def __init__(self, pool: Any) -> None:
        self.pool = pool
        self.folder: TemporaryFolder | None = None

    @property
    def other_processes(self) -> bool:
        """Whether the pool is known to run its work in other processes."""
        return isinstance(self.pool, Executor | Pool) and not isinstance(self.pool, ThreadPoolExecutor | ThreadPool)

    @property
    def n_workers(self) -> int | None:
        """Number of items that run at once; None if the pool does not say."""
        sizes = (getattr(self.pool, name, None) for name in ("n_workers", "_max_workers", "_processes", "size"))
        return next((size for size in sizes if isinstance(size, int) and size > 0), None)

    def map(self, function: Callable[[Any], Outcome], items: Iterable[Any]) -> list[Outcome]:
        """Outcomes of a function for every item, in their order; RuntimeError if a worker cannot load the function."""
        items = list(items)
        if self.folder is None:
            self.folder = TemporaryFolder()
        outcomes = self._map(_FunctionReference(function, self.folder.path), items)
        missing = [index for index, outcome in enumerate(outcomes) if isinstance(outcome, _Missing)]
        if missing:
            carried = self._map(
                _FunctionReference(function, self.folder.path, carried=True), [items[index] for index in missing]
            )
            for index, outcome in zip(missing, carried, strict=True):
                outcomes[index] = outcome
        for outcome in outcomes:
            if isinstance(outcome, _Unusable):
                raise_if_refused(outcome.reason)
                raise RuntimeError(
                    f"a worker cannot load the model: {outcome.reason}. Define its classes and functions in modules "
                    "that the workers can import"
                )
        return outcomes

    def _map(self, function: Callable, items: list) -> list:
        return list(self.pool.map(function, items))


class DaskExecutor(PoolExecutor):
    """Executor for the cluster of a ``dask.distributed.Client``, for work on several machines.

    A task costs dask about 2 ms of all processors, so short simulations are sent in groups. The groups are large at
    first and single items at last, so that the workers finish together. No group takes longer than about a second, by
    the duration of earlier simulations, so that little is repeated if a worker dies. dask retries a group whose worker
    died, and gives up after a number of times (``distributed.scheduler.allowed-failures``). The items of such groups
    are then run alone, one after the other, and an item that kills its worker again gets ``(None, reason)``. Workers
    that the cluster has given up are started again, and no map waits for ever (`WorkerWatch`).

    Parameters
    ----------
    pool : dask.distributed.Client
    """

    other_processes = True

    def __init__(self, pool: Any) -> None:
        super().__init__(pool)
        self._seconds: float | None = None  # mean duration of an item in the last map

    @property
    def n_workers(self) -> int | None:
        """Number of threads of all workers that the cluster has at present."""
        return sum(self.pool.nthreads().values()) or None

    def _map(self, function: Callable, items: list) -> list:
        if not (n_workers := self.n_workers):
            logger.warning(
                "The dask cluster has no worker; %d simulations wait for one. Start workers or scale the cluster",
                len(items),
            )
        largest = 1 if self._seconds is None else int(1.0 / max(self._seconds, 1e-3))
        groups = _groups(items, n_workers or 1, largest)
        answers = self._answers(function, groups)
        seconds = sum(answer.seconds for answer in answers if answer is not None)
        done = sum(len(answer.outcomes) for answer in answers if answer is not None)
        self._seconds = seconds / done if done else None
        lost = [item for group, answer in zip(groups, answers, strict=True) if answer is None for item in group]
        # dask also counts the death of a worker against the groups that wait on it: only an item that runs alone and
        # loses its worker is the cause
        singles = iter([None] if len(lost) == 1 else [self._answers(function, [[item]])[0] for item in lost])
        outcomes = []
        for group, answer in zip(groups, answers, strict=True):
            tried = [answer] if answer is not None else [next(singles) for _ in group]
            for one in tried:
                outcomes += [(None, _DIED)] if one is None else one.outcomes
        return outcomes

    def _answers(self, function: Callable, groups: list[list]) -> "list[_Answer | None]":
        """Answer for each group; None where every worker that ran it died."""
        if not groups:
            return []
        futures = self.pool.map(partial(_run_group, function), groups, pure=False)
        with WorkerWatch(self.pool, futures):
            try:
                return self.pool.gather(futures)
            except Exception as error:
                if type(error).__name__ != "KilledWorker":
                    raise
            try:
                return [self._answer(future) for future in futures]
            finally:
                for future in futures:  # otherwise dask repeats the groups whose results were on a dead worker
                    future.release()

    @staticmethod
    def _answer(future: Any) -> "_Answer | None":
        """Result of a future; None if its worker died."""
        error = future.exception()  # waits for the future
        if error is None:
            return future.result()
        if type(error).__name__ != "KilledWorker":
            raise error
        return None


class _Answer(NamedTuple):
    """Outcomes of a group of items, and their total duration [s]."""

    outcomes: list
    seconds: float


def _run_group(function: Callable, items: list) -> _Answer:
    """Run the items of a group one after the other; called in the worker."""
    wait_for_nanny()
    start = time.perf_counter()
    return _Answer([function(item) for item in items], time.perf_counter() - start)


@cache
def wait_for_nanny() -> None:
    """Wait once per process, because dask's nanny does not replace a worker that dies before its start is reported.

    An item that kills every new worker at once would otherwise leave a cluster without workers, and the run would hang.
    """
    time.sleep(0.5)


def _groups(items: list, n_workers: int, largest: int) -> list[list]:
    """Groups of items: each is half of a worker's share of the remaining items, at least one and at most `largest`."""
    groups, start = [], 0
    while start < len(items):
        size = min(max(1, (len(items) - start) // (2 * n_workers)), max(1, largest))
        groups.append(items[start : start + size])
        start += size
    return groups
