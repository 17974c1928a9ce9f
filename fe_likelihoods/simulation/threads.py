"""Simulations on several threads: compiled kernels release the GIL, and simulations share no memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np

from .model import SimulationFailed

__all__ = ["map_threads", "run_on_threads"]


def map_threads(
    run: Callable[[np.ndarray], np.ndarray],
    thetas: np.ndarray,
    shape: tuple[int, ...],
    measured: np.ndarray | None = None,
) -> tuple[np.ndarray, list[str]]:
    """Results of many simulations, NaN where one failed, and the reasons; on as many threads as numba uses.

    `run` takes one row of `thetas` (n, n_parameters) and returns a response of this shape, or raises
    `SimulationFailed`. With `measured` (n_channels, n_steps) [SI], results are the sums of squared residuals
    (n_channels,) instead.
    """
    out = np.full((len(thetas), *shape), np.nan)
    reasons = [""] * len(thetas)

    def one(i: int) -> None:
        try:
            values = run(thetas[i])
            if measured is not None:
                values = np.square(values - measured).sum(axis=1)
            if np.iscomplexobj(values):  # the assignment would keep the real part
                raise ValueError("expected real numbers, got complex ones")
            out[i] = values
        except SimulationFailed as failure:
            reasons[i] = failure.reason

    if len(thetas) == 1:
        one(0)
    else:
        run_on_threads(one, range(len(thetas)))
    return out, reasons


def run_on_threads(run: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Results of a function for every item, in order, on as many threads as numba uses."""
    n_threads = min(numba.get_num_threads(), len(items), os.cpu_count() or 1)
    if n_threads <= 1:
        return [run(item) for item in items]
    with ThreadPoolExecutor(n_threads) as threads:
        try:
            return list(threads.map(run, items))
        except BaseException:  # Ctrl-C: cancel the simulations that have not begun
            threads.shutdown(wait=False, cancel_futures=True)
            raise
