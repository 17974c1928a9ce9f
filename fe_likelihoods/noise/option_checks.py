"""Options of noises: checks and `repr` of the numbers per channel that a user gives."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import update_wrapper
from typing import Any

import numpy as np

from ..signals.channels import Channel

PerChannel = Mapping[str, float] | Sequence[float] | None


class only_if:  # noqa: N801, a decorator
    """Decorator: a method exists only for objects that meet a condition (a function of the object), so ``hasattr`` is
    False for other objects. See also scikit-learn's `available_if`.
    """

    def __init__(self, condition: Callable[[Any], bool]) -> None:
        self.condition = condition

    def __call__(self, method: Callable) -> "only_if":
        self.method = method
        update_wrapper(self, method)
        return self

    def __get__(self, instance: Any, owner: type | None = None) -> Callable:
        if instance is None:
            return self.method
        if not self.condition(instance):
            raise AttributeError(f"{instance!r} has no {self.method.__name__}")
        return self.method.__get__(instance, owner)


def as_number(
    noise: Any, what: str, value: Any, meaning: str, possible: Callable[[float], bool] = lambda number: True
) -> float:
    """A user's number for a noise, as a float; ValueError if it is not a number or not possible."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{type(noise).__name__}: {what} must be a number, {meaning}; got {value!r}: give the number alone; "
            'to_si(0.02, "g") converts other units'
        ) from None
    if not possible(number):
        raise ValueError(f"{type(noise).__name__}: {what} must be {meaning}; got {value!r}")
    return number


def numbers(noise: Any, what: str, given: Any, unit: str) -> tuple[float, ...]:
    """A user's numbers for a noise, given in any sequence; see `as_number`."""
    listed = [given] if isinstance(given, str) else np.ravel(np.asarray(given, dtype=object))
    return tuple(as_number(noise, what, value, unit) for value in listed)


def per_channel(
    noise: Any, channels: Sequence[Channel], what: str, given: PerChannel, default: float, unit: str
) -> tuple[float, ...] | None:
    """One number per channel, or None if none are given; names that a mapping leaves out get the `default`."""
    if given is None:
        return None
    names, kind = [channel.name for channel in channels], type(noise).__name__
    if isinstance(given, Mapping):
        if unknown := sorted(set(given) - set(names)):
            raise ValueError(f"{kind}: {what} has the unknown channels {unknown}; the channels are {', '.join(names)}")
        given = [given.get(name, default) for name in names]
    values = numbers(noise, what, given, unit)
    if len(values) != len(names):
        raise ValueError(f"{kind}: {what} must be one number for each of {', '.join(names)}; got {len(values)}")
    return values


def checked_channels(noise: Any, channels: Sequence[Channel]) -> tuple[Channel, ...]:
    """The channels of a noise; ValueError if there are none."""
    if not (channels := tuple(channels)):
        raise ValueError(f"{type(noise).__name__} expects at least one channel; got none")
    return channels


def sensor_levels(noise: Any, channels: Sequence[Channel], given: PerChannel) -> tuple[float, ...] | None:
    """Known standard deviations of the sensor noise, one per channel [SI]; zero for names that are left out."""
    values = per_channel(noise, channels, "sensor", given, 0.0, "in the SI unit of the channel")
    if values is not None and not all(0.0 <= value < math.inf for value in values):
        raise ValueError(
            f"{type(noise).__name__}: sensor must be standard deviations in SI units, zero or more; got {given!r}"
        )
    return values


def shown(channels: Sequence[Channel], options: Mapping[str, Any]) -> str:
    """Channels and given options for the `repr` of a noise, which enters fingerprints."""
    # display units change no value, so they are left out
    named = [f"{channel.name}: {channel.quantity}" for channel in channels]
    return ", ".join(named + [f"{name}={value!r}" for name, value in options.items() if value is not None])


def weighted(values: Any, weights: np.ndarray) -> np.ndarray | None:
    """Weighted sums (n_others,) of one number per channel, such as sensor levels; None for None."""
    return None if values is None else weights @ np.array(values)
