"""Executors: the same ``map`` and ``submit`` for all pools, which run simulations in other processes or machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: a `LocalPool` of that many processes.
* an object with ``gather`` (a client of dask.distributed): ``map(function, items, pure=False)``.
* any other object with ``map``: ``list(pool.map(function, items))``, and for single items ``submit`` or
  ``apply_async``. This covers the executors of concurrent.futures, loky and mpi4py.futures and the pools of
  multiprocessing and schwimmbad.

The function (model and measurements) is sent by value (`fe_likelihoods.simulation.by_value`): by a `LocalPool` to each
worker once, and again when anything that it uses has changed; by other pools with each item. Workers load it once.
``submit(function, item)`` returns a `Future` with the result that ``map`` would return, even if the item kills every
process that runs it. A pool that only has ``map`` cannot submit items: its attribute ``submits`` is False. Results do
not depend on the pool, to the last bit.
"""

from typing import Any

from .by_value import Pickled, dumps
from .dask_executor import DaskExecutor
from .local_pool import LocalPool
from .pool_executor import PoolExecutor

__all__ = ["DaskExecutor", "LocalPool", "PoolExecutor", "as_executor"]


def as_executor(pool: Any, model: Any = None) -> "LocalPool | DaskExecutor | PoolExecutor | None":
    """Executor for a pool, by the rule above; None for None.

    Its ``map(function, items)`` returns a list. The functions must return an `Outcome`, also given for an item that
    kills every process that runs it, if the pool survives. ValueError if `pool` is of no such kind, or its workers are
    other processes and the model cannot be sent to them.
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
        _check_picklable(model)
    return executor


def _check_picklable(model: Any) -> None:
    """Raise ValueError, naming the attribute at fault, if a model cannot be sent to other processes."""
    try:
        Pickled.of(model)
    except ValueError as error:
        name, value = _culprit(model)
        what = f"the {name} of {type(model).__name__}, of type {type(value).__name__}," if name else "the model"
        raise ValueError(f"{what} cannot be sent to other processes, as this pool needs. {error}") from error


def _culprit(thing: Any, depth: int = 3) -> tuple[str, Any]:
    """Name and value of an object's innermost attribute that cannot be pickled."""
    try:
        state = thing.__getstate__()
    except Exception:
        return "", thing
    for name, value in (state if isinstance(state, dict) else getattr(thing, "__dict__", {})).items():
        try:
            dumps(value)
        except Exception:
            inner, culprit = _culprit(value, depth - 1) if depth else ("", value)
            return (f"{name}.{inner}", culprit) if inner else (name, value)
    return "", thing
