"""Evaluation of a posterior without barriers: points go out when they are submitted, and come back when they are done.

A sampler that proposes points while others still run keeps all workers of a pool busy, however different the durations
of the simulations are. Each point is evaluated in a thread, which waits for its simulations.
"""

import os
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from samplers.evaluation.point_queue import PointQueue

from ..priors.points import as_points
from ..simulation.executors import Threads, settle
from ..simulation.model import has_batch_method

__all__ = ["evaluation_queue"]

_MOST_THREADS = 200  # for a pool that does not say how many simulations run at once


def evaluation_queue(posterior: Any) -> PointQueue:
    """Queue of points at which a posterior is evaluated, see `Posterior.evaluation_queue`.

    Duplicates are simulated once. If a data set has no pool, or one that has ``map`` only, `submit` waits for the
    simulations. Simulations that run when the queue is closed are cached when they end.
    """
    parts, names = [part for part, _ in posterior.likelihood.parts()], posterior.prior.names
    pools = {id(part.simulator.pool): part.simulator.pool for part in parts if part.simulator.pool is not None}
    streams = all(part.simulator.streams for part in parts)  # no model runs in threads of this process
    evaluate = partial(_evaluate, posterior)

    def size() -> int | None:
        if not pools:
            return (os.cpu_count() or 1) if any(has_batch_method(part.model) for part in parts) else 1
        sizes = [getattr(pool, "n_workers", None) for pool in pools.values()]
        return None if None in sizes else sum(sizes)

    def start(coords: Any) -> list[Future]:
        rows = np.array(as_points(coords, names))
        if rows.ndim != 2:
            raise ValueError(f"submit: expected points of shape (n, {len(names)}); got shape {rows.shape}")
        if not streams and len(rows):
            with suppress(Exception):  # raised by `collect`
                evaluate(rows)  # together, which is faster; their simulations are known then
        futures, items = [Future() for _ in rows], [row[None] for row in rows]
        if streams:
            threads.submit_all(futures, items, size() or _MOST_THREADS)
        else:
            for future, item in zip(futures, items, strict=True):
                settle(future, evaluate, item)
        return futures

    threads = Threads(lambda: evaluate)
    return PointQueue(start, size)


def _evaluate(posterior: Any, rows: np.ndarray) -> Any:
    """Log-probability of a point (1, ndim), or those of points (n, ndim)."""
    values = posterior.log_prob(rows)
    return values if len(values) > 1 else float(values[0])
