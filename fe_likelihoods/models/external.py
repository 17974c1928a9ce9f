"""What all models of the user's own have in common: what they are made of is checked once, what they return each time.

A response that cannot be used is told with its reason and with how long the run took, so that a report of failures
says whether it is the first second that fails, or the last of an hour.
"""

import json
import math
import time
from collections.abc import Sequence
from hashlib import blake2b
from typing import TYPE_CHECKING, Any

import numpy as np

from ..signals.channels import Channel, Measurements, plot_response
from ..simulation.model import SimulationFailed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


__all__ = ["CheckedModel", "positive"]


def positive(value: Any, what: str, unit: str) -> float:
    """A positive finite number, or ValueError."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not (math.isfinite(number) and number > 0.0):
        raise ValueError(f"{what} must be a positive number of {unit}; got {value!r}")
    return number


class CheckedModel:
    """A model around something that returns a response, `_respond`, of which nothing is taken for granted.

    Parameters
    ----------
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        What the rows of the response are; SI.
    dt : float
        Time step of the response [s].
    n_steps : int
        Number of samples of the response.

    Raises
    ------
    ValueError
        If names are missing, repeat or are no text, or `dt` or `n_steps` is not positive.
    """

    fingerprint = ""

    def __init__(self, parameter_names: Sequence[str], channels: Sequence[Channel], dt: float, n_steps: int) -> None:
        kind = type(self).__name__
        for what, values, expected in (("parameter_names", parameter_names, str), ("channels", channels, Channel)):
            if isinstance(values, str) or not all(isinstance(value, expected) for value in values) or not len(values):
                raise ValueError(f"{kind}: {what} must be one or more {expected.__name__}, in a tuple; got {values!r}")
        self.parameter_names, self.channels = tuple(parameter_names), tuple(channels)
        for what, names in (
            ("parameter_names", self.parameter_names),
            ("channels", [channel.name for channel in self.channels]),
        ):
            if len(set(names)) != len(names) or not all(names):
                raise ValueError(f"{kind}: the names of {what} must differ and not be empty; got {', '.join(names)}")
        self.dt = positive(dt, f"{kind}: dt", "seconds")
        if isinstance(n_steps, bool) or not isinstance(n_steps, int | np.integer) or n_steps < 1:
            raise ValueError(f"{kind}: n_steps must be a positive whole number of samples; got {n_steps!r}")
        self.n_steps = int(n_steps)

    def _digest(self, *parts: Any) -> str:
        """Fingerprint of the names, the channels, the step, the length and `parts`, which JSON can tell."""
        channels = [(channel.name, channel.quantity) for channel in self.channels]
        text = json.dumps([type(self).__name__, self.parameter_names, channels, self.dt, self.n_steps, *parts])
        return blake2b(text.encode(), digest_size=16).hexdigest()

    def _respond(self, theta: np.ndarray) -> Any:
        raise NotImplementedError

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response at one set of parameters.

        Parameters
        ----------
        theta : (n_parameters,) float

        Returns
        -------
        (n_channels, n_steps) float : SI

        Raises
        ------
        SimulationFailed
            Whatever went wrong; the reason ends in how long it took.
        ValueError
            If theta has a wrong shape.
        """
        theta = np.array(theta, dtype=float)
        if theta.shape != (len(self.parameter_names),):
            raise ValueError(
                f"expected values of {', '.join(self.parameter_names)} in an array of shape "
                f"({len(self.parameter_names)},); got shape {theta.shape}"
            )
        start = time.perf_counter()
        try:
            response = self._checked(self._respond(theta))
        except Exception as error:  # the user's code may raise anything
            reason = getattr(error, "reason", None) or f"{type(error).__name__}: {error}"
            seconds = getattr(error, "seconds", None)  # without the start of a process, where that is known
            seconds = time.perf_counter() - start if seconds is None else seconds
            raise SimulationFailed(f"{reason} after {seconds:.3g} s") from error
        return response

    def plot_response(self, theta: np.ndarray, measurements: "Measurements | None" = None) -> "Figure":
        """Plot the response at `theta`, beside measurements if there are any."""
        return plot_response(Measurements(self.channels, self.dt, self.simulate(theta)), measurements)

    def _checked(self, response: Any) -> np.ndarray:
        expected = (len(self.channels), self.n_steps)
        try:
            response = np.asarray(response, dtype=float)
        except (TypeError, ValueError) as error:
            raise SimulationFailed(f"the response is no array of numbers: {error}") from error
        if response.shape != expected:
            raise SimulationFailed(
                f"the response has shape {response.shape}, expected (n_channels, n_steps) = {expected}"
            )
        for channel, values in zip(self.channels, response, strict=True):
            if not np.isfinite(values).all():
                raise SimulationFailed(f"the response of channel {channel.name!r} is not finite")
        return response
