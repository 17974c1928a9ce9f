"""Executors: the same ``map`` and ``submit`` for all pools, which run simulations in other processes or machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: a `LocalPool` of that many processes.
* an object with ``gather`` (a client of dask.distributed): ``map(function, items, pure=False)``.
* any other object with ``map``: ``list(pool.map(function, items))``, and for single items ``submit`` if it has that.
  This covers the executors of concurrent.futures, loky and mpi4py.futures and the pools of
  multiprocessing and schwimmbad.

The function (model and measurements) is sent by value (`fe_likelihoods.simulation.by_value`): by a `LocalPool` to each
worker once, and again when anything that it uses has changed; by other pools with each item. Workers load it once.
``submit(function, item)`` returns a `Future` with the result that ``map`` would return, even if the item kills every
process that runs it. A pool that only has ``map`` cannot submit items: its attribute ``submits`` is False. Results do
not depend on the pool, to the last bit.
"""

from typing import Any

from .by_value import Pickled
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
        Pickled.of(model)
    return executor
