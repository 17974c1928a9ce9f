r"""Level of a response over time; the model error is a share of this level.

The squared level in part p of the time is the weighted mean of the squared envelope :math:`e_p^2` and the mean square
:math:`R^2` of the whole response,

.. math:: l_p^2 = \left(\frac{d_p}{d_0}\right)^{2 \gamma} \left[ (1 - w)\, R^2 + w\, e_p^2 \right],

because model errors last longer than the strong response that causes them. The first factor is for tests with an
imposed deformation: the error grows with the largest deformation :math:`d_p` so far. See ``docs/theory/noise.rst``.
"""

from typing import Any, NamedTuple

import numpy as np

from ..signals.events import find_events

__all__ = ["Excited", "excited_parts", "imposed_deformation", "local_level", "squared_levels"]

_ROUND_OFF = 1e-6  # of a part


class Excited(NamedTuple):
    """Excitation data that the level needs, for equal parts of the time from time zero on.

    Attributes
    ----------
    events : tuple of int
        Number of the event (odd) or pause (even) in the middle of each part. Mean squares are computed separately for
        each. Empty for one event.
    reached : tuple of float
        Largest deformation up to the middle of each part [m, or - for a strain]. Empty for no imposed deformation.
    """

    events: tuple[int, ...] = ()
    reached: tuple[float, ...] = ()


def imposed_deformation(model: Any) -> np.ndarray | None:
    """Deformation (n_steps,) [m, or - for a strain] that a test imposes on a model; None for other excitations.

    The first of these attributes with shape (n_steps,): ``deformation``, ``loading.displacement`` or
    ``record.displacement`` (`fe_likelihoods.DisplacementHistory`), ``strain`` (`fe_likelihoods.SteelCoupon`). The
    model's fingerprint must depend on it, as on the excitation.
    """
    histories = (getattr(getattr(model, name, None), "displacement", None) for name in ("loading", "record"))
    for found in (getattr(model, "deformation", None), *histories, getattr(model, "strain", None)):
        if found is not None and np.shape(found) == (model.n_steps,):
            return np.asarray(found, dtype=float)
    return None


def excited_parts(model: Any, part: float, first: int = 0) -> Excited:
    """Events and deformations of a model in parts of the time.

    Parameters
    ----------
    model : Model
        The model under its excitation.
    part : float
        Length of a part [s].
    first : int
        Step of the response at time zero.

    Returns
    -------
    Excited
    """
    time = model.dt * (np.arange(model.n_steps) - first)
    middle = part * (np.arange(int(np.floor(time[-1] / part + _ROUND_OFF)) + 1) + 0.5)
    events, deformation, numbers, reached = find_events(model), imposed_deformation(model), (), ()
    if events is not None:
        edges = np.ravel([(each.start, each.end) for each in events.windows]) - first * model.dt
        numbers = tuple(np.searchsorted(edges, middle).tolist())
    if deformation is not None:
        reached = tuple(np.interp(middle, time, np.maximum.accumulate(np.abs(deformation))).tolist())
    return Excited(numbers, reached)


def squared_levels(
    sums: np.ndarray, counts: np.ndarray, local: float, excited: Excited, reference: float | None, growth: float | None
) -> np.ndarray:
    """Squared levels of responses in each part of the time.

    Parameters
    ----------
    sums : (n, n_parts, n_channels) float
        Sums of squared samples, for n responses [SI unit of the channel, squared].
    counts : (n_parts, n_channels) int
        Number of samples.
    local : float
        Weight w of the squared envelope, which is the mean square of a part and its two neighbours; 1 - w is the weight
        of the event's mean square.
    excited : Excited
        Events and deformations of the parts.
    reference : float or None
        Deformation at which the growth factor is one; None for no growth.
    growth : float or None
        Exponent of the deformation reached.

    Returns
    -------
    (n, n_parts, n_channels) float
        [SI unit of the channel, squared].
    """
    n_parts, whole = len(counts), np.empty(sums.shape)
    numbers = _of_parts(excited.events or (0,), n_parts)
    for number in np.unique(numbers):
        inside = numbers == number
        total = np.maximum(counts[inside].sum(axis=0), 1)
        whole[:, inside] = sums[:, inside].sum(axis=1, keepdims=True) / total
    near = _with_neighbours(sums) / np.maximum(_with_neighbours(counts), 1)
    levels = (1.0 - local) * whole + local * near
    if reference is None:
        return levels
    return levels * (_of_parts(excited.reached, n_parts)[:, None] / reference) ** (2.0 * growth)


def _of_parts(values: tuple[float, ...], n_parts: int) -> np.ndarray:
    """Values (n_parts,) of the parts; the last value also for later parts, in which nothing is measured."""
    return np.array(values)[np.minimum(np.arange(n_parts), len(values) - 1)]


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Sums over each part and its two neighbours, in the last axis but one."""
    total = values.copy()
    total[..., 1:, :] += values[..., :-1, :]
    total[..., :-1, :] += values[..., 1:, :]
    return total


def local_level(response: np.ndarray, steps: float | None) -> np.ndarray:
    """Root mean square of histories within a window around each step.

    Parameters
    ----------
    response : (n_channels, n_steps) float
        Histories.
    steps : float or None
        Length of the window in steps, rounded to an odd number; None for all steps. The window is cut at the ends of
        the histories.

    Returns
    -------
    (n_channels, n_steps) float
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
