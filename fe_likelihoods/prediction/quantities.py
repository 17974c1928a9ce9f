"""What is asked of a response: histories of channels, numbers from the history of one channel, or any function of it.

A `ChannelQuantity` knows its channel, hence what it measures, and a threshold in a wrong unit can be refused.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..signals.channels import Channel

__all__ = ["ChannelQuantity", "Evaluator", "Quantity", "evaluator", "peak"]


@dataclass(frozen=True)
class ChannelQuantity:
    """A number from the history of one channel, of the channel's dimension.

    Parameters
    ----------
    channel : str — its name.
    function : callable — from the history (n_steps,) [SI] to a number [SI unit of the channel].
    """

    channel: str
    function: Callable[[np.ndarray], float]


Quantity = None | str | ChannelQuantity | Sequence[str] | Sequence[ChannelQuantity] | Callable[[np.ndarray], Any]
"""What `fe_likelihoods.prediction.propagation.propagate` takes as a quantity."""


class Evaluator(NamedTuple):
    """A quantity of one model's response: `rows` of the histories wanted (None: not histories), the `function` of the
    response (n_channels, n_steps) otherwise, and the `channels` that the result speaks of."""

    rows: list[int] | None
    function: Callable[[np.ndarray], Any] | None
    channels: tuple[Channel, ...]


def peak(channel: str) -> ChannelQuantity:
    """Largest absolute value of a channel."""
    return ChannelQuantity(channel, _largest)


def _largest(history: np.ndarray) -> float:
    return float(np.max(np.abs(history)))


def evaluator(quantity: Quantity, channels: Sequence[Channel]) -> Evaluator:
    """How a quantity is computed from responses with these channels; ValueError if it is none or names unknown ones."""
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
