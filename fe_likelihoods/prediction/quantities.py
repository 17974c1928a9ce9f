"""Quantities of a response: histories of channels, numbers from the history of one channel, or any function of it.

A `ChannelQuantity` has a channel and therefore a dimension, so that a threshold in a unit of another dimension is
refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..signals.channels import Channel, Measurements

__all__ = ["ChannelQuantity", "Evaluator", "Quantity", "evaluator", "final_value", "measured_quantity", "peak", "rms"]


@dataclass(frozen=True)
class ChannelQuantity:
    """A number computed from the history of one channel, with the dimension of the channel.

    Parameters
    ----------
    channel : str
        Name of the channel.
    function : callable
        Function of the history (n_steps,) [SI] that returns a number [SI unit of the channel].
    """

    channel: str
    function: Callable[[np.ndarray], float]


Quantity = None | str | ChannelQuantity | Sequence[str] | Sequence[ChannelQuantity] | Callable[[np.ndarray], Any]
"""Quantities that `fe_likelihoods.prediction.propagation.propagate` accepts."""


class Evaluator(NamedTuple):
    """How a quantity is computed from the response of a model.

    Attributes
    ----------
    rows : list of int or None
        Rows of the response whose histories are the quantity, None for another quantity.
    function : callable or None
        Function of the response (n_channels, n_steps) [SI], None for histories.
    channels : tuple of Channel
        Channels of the quantity, empty for a function of the whole response.
    """

    rows: list[int] | None
    function: Callable[[np.ndarray], Any] | None
    channels: tuple[Channel, ...]


def peak(channel: str) -> ChannelQuantity:
    """Return the quantity "largest absolute value of the channel"."""
    return ChannelQuantity(channel, _largest)


def rms(channel: str) -> ChannelQuantity:
    """Return the quantity "root mean square of the channel", a measure of the energy of a motion."""
    return ChannelQuantity(channel, _root_mean_square)


def final_value(channel: str, samples: int = 1) -> ChannelQuantity:
    """Return the quantity "mean of the last samples of the channel", such as the residual drift after a motion.

    Parameters
    ----------
    channel : str
        Name of the channel.
    samples : int
        Number of last samples. Take those of a whole number of periods where the structure still vibrates.

    Raises
    ------
    ValueError
        If the number is not a positive whole number.
    """
    if not isinstance(samples, int | np.integer) or samples < 1:
        raise ValueError(f"final_value: samples must be a whole number, 1 or more; got {samples!r}")
    return ChannelQuantity(channel, _MeanOfLast(int(samples)))


def measured_quantity(quantity: Any, measurements: Measurements) -> np.ndarray:
    """Evaluate a quantity of channels for measurements.

    Parameters
    ----------
    quantity : ChannelQuantity or sequence of ChannelQuantity
        The quantity, as it was predicted.
    measurements : Measurements
        Measurements of these channels.

    Returns
    -------
    ndarray, shape () or (n_quantities,)
        The measured values [SI].

    Raises
    ------
    ValueError
        If the quantity is another one, the measurements lack a channel, or samples of it are missing.
    """
    several = [quantity] if isinstance(quantity, ChannelQuantity) else quantity
    if not isinstance(several, Sequence) or not all(isinstance(each, ChannelQuantity) for each in several):
        raise ValueError(
            "a function of the whole response is not known for measurements: give the measured values [SI] instead"
        )
    values = []
    for each in several:
        (history,) = measurements.select([each.channel]).values
        if np.isnan(history).any():
            raise ValueError(
                f"samples of channel {each.channel!r} are missing, so that its measured quantity is not known: give "
                "the measured values [SI], or measurements that are trimmed to a part without gaps"
            )
        values.append(float(each.function(history)))
    return np.array(values[0] if isinstance(quantity, ChannelQuantity) else values)


class _MeanOfLast(NamedTuple):
    """Function of a history: the mean of its last samples."""

    samples: int

    def __call__(self, history: np.ndarray) -> float:
        return float(np.mean(history[-self.samples :]))


def _root_mean_square(history: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(history))))


def _largest(history: np.ndarray) -> float:
    return float(np.max(np.abs(history)))


def evaluator(quantity: Quantity, channels: Sequence[Channel]) -> Evaluator:
    """Return how a quantity is computed from responses.

    Parameters
    ----------
    quantity : Quantity
        The quantity, as in `fe_likelihoods.prediction.propagation.propagate`.
    channels : sequence of Channel
        Channels of the model.

    Returns
    -------
    Evaluator
        Rows of histories, or a function of the response.

    Raises
    ------
    ValueError
        If this is not a quantity, or it names an unknown channel.
    """
    channels = tuple(channels)
    names = [channel.name for channel in channels]

    def row(name: str) -> int:
        if name not in names:
            raise ValueError(f"no channel {name!r}; the channels of the model are {', '.join(names)}")
        return names.index(name)

    if quantity is None:
        return Evaluator(list(range(len(channels))), None, channels)
    if isinstance(quantity, str):
        return Evaluator([row(quantity)], None, (channels[row(quantity)],))
    if isinstance(quantity, ChannelQuantity):
        k, function = row(quantity.channel), quantity.function
        return Evaluator(None, lambda response: function(response[k]), (channels[k],))
    if callable(quantity):
        return Evaluator(None, quantity, ())
    if isinstance(quantity, Sequence) and quantity:
        if all(isinstance(each, str) for each in quantity) and len(set(quantity)) == len(quantity):
            rows = [row(name) for name in quantity]
            return Evaluator(rows, None, tuple(channels[k] for k in rows))
        if all(isinstance(each, ChannelQuantity) for each in quantity):
            rows = [row(each.channel) for each in quantity]
            functions = [each.function for each in quantity]
            return Evaluator(
                None,
                lambda response: np.array([f(response[k]) for f, k in zip(functions, rows, strict=True)]),
                tuple(channels[k] for k in rows),
            )
    raise ValueError(
        "quantity must be None, a channel's name, different names, peak(name), several of these, or a function of the "
        f"response (n_channels, n_steps); got {quantity!r}"
    )
