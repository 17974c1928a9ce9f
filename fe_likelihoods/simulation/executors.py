"""Executors: a common ``map`` and ``submit`` over any pool, which runs simulations in other processes or on machines.

The rule for ``pool=``:

* None: in this process.
* a whole number: a `LocalPool` of that many processes.
* an object with ``gather`` (a client of dask.distributed): ``map(function, groups of items, pure=False)``.
* any other object with ``map``: ``list(pool.map(function, items))``, and for single items ``submit`` or
  ``apply_async``. This covers the executors of concurrent.futures, loky and mpi4py.futures and the pools of
  multiprocessing and schwimmbad.

The mapped function contains the model and the measurements and may be large; an item is a few parameters. The function
is sent by value (`fe_likelihoods.simulation.by_value`) to each worker process once: through the worker's own pipe in a
`LocalPool`, through a private temporary file, whose digest is checked, in other pools on the same machine, and together
with the items where a worker reports that it has neither the function nor the file. Later tasks consist of a digest of
the function and the parameters. A function is sent again when anything that it uses has changed.

``submit(function, item)`` returns a `concurrent.futures.Future` of the result that ``map`` would give, also where an
item kills every process that runs it, and ``submit_all(function, items)`` a list of them. ``give_up(futures)`` cancels.
`concurrent.futures.as_completed` gives whichever ends first. A pool that has ``map`` only cannot do this; the attribute
``submits`` says so.

Results do not depend on the pool, to the last bit.
"""

from typing import Any

from .by_value import Pickled, dumps
from .dask_executor import DaskExecutor
from .local_pool import LocalPool
from .pool_executor import PoolExecutor

__all__ = ["DaskExecutor", "LocalPool", "PoolExecutor", "as_executor"]


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
        _check_picklable(model)
    return executor


def _check_picklable(model: Any) -> None:
    """Raise ValueError, with the name of the attribute to blame, if a model cannot be sent to other processes."""
    try:
        Pickled.of(model)
    except ValueError as error:
        name, value = _culprit(model)
        what = f"the {name} of {type(model).__name__}, of type {type(value).__name__}," if name else "the model"
        raise ValueError(f"{what} cannot be sent to other processes, as this pool needs. {error}") from error


def _culprit(thing: Any, depth: int = 3) -> tuple[str, Any]:
    """Name and value of the innermost attribute of an object that cannot be pickled."""
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
