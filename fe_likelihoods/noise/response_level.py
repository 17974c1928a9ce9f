r"""Level of a response over time; the model error is a share of this level.

The squared level in part p of the time is the weighted mean of the squared envelope :math:`e_p^2` and the mean square
:math:`R^2` of the whole response,

.. math:: l_p^2 = (1 - w)\, R^2 + w\, e_p^2,

because model errors last longer than the strong response that causes them. See ``docs/theory/noise.rst``.
"""

from typing import Any

import numpy as np

from ..signals.records import find_events
from ..signals.sampling import SAME_TIME


def events_of_parts(model: Any, part: float, first: int = 0) -> tuple[int, ...]:
    """Number of the event (odd) or pause (even) in the middle of each part of the time; empty for one event.

    Time is zero at the step `first` of the response; a part is `part` seconds long. Mean squares are computed
    separately for each event and pause.
    """
    events = find_events(model)
    if events is None:
        return ()
    last = model.dt * (model.n_steps - 1 - first)
    middle = part * (np.arange(int(np.floor(last / part + SAME_TIME)) + 1) + 0.5)
    edges = np.ravel([(each.start, each.end) for each in events.windows]) - first * model.dt
    return tuple(np.searchsorted(edges, middle).tolist())


def squared_levels(sums: np.ndarray, counts: np.ndarray, local: float, events: tuple[int, ...]) -> np.ndarray:
    """Squared levels (n, n_parts, n_channels) [SI, squared] of n responses, from sums of squares of this shape.

    `counts` (n_parts, n_channels) are numbers of samples. `local` is the weight w of the squared envelope, the mean
    square of a part and its two neighbours; 1 - w is the weight of the event's mean square (`events_of_parts`).
    """
    n_parts, whole = len(counts), np.empty(sums.shape)
    numbers = np.array(events or (0,))[np.minimum(np.arange(n_parts), len(events or (0,)) - 1)]
    for number in np.unique(numbers):
        inside = numbers == number
        total = np.maximum(counts[inside].sum(axis=0), 1)
        whole[:, inside] = sums[:, inside].sum(axis=1, keepdims=True) / total
    near = _with_neighbours(sums) / np.maximum(_with_neighbours(counts), 1)
    return (1.0 - local) * whole + local * near


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Sums over each part and its two neighbours, in the last axis but one."""
    total = values.copy()
    total[..., 1:, :] += values[..., :-1, :]
    total[..., :-1, :] += values[..., 1:, :]
    return total


def local_level(response: np.ndarray, steps: float | None) -> np.ndarray:
    """Root mean square of histories (n_channels, n_steps) within a window around each step, cut at the ends.

    The window has `steps` steps, rounded to an odd number; None: all steps.
    """
    squares = np.square(response)
    n = squares.shape[1]
    if steps is None or steps >= 2 * n:
        return np.broadcast_to(np.sqrt(squares.mean(axis=1, keepdims=True)), squares.shape)
    half = round(0.5 * (steps - 1.0)) if steps > 1.0 else 0
    sums = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    first, stop = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half + 1, n)
    means = (sums[:, stop] - sums[:, first]) / (stop - first)
    return np.sqrt(np.maximum(means, 0.0))
