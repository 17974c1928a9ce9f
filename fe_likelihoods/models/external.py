"""Base class that validates inputs and outputs of external models: code of the user, programs, assembled matrices.

The reason of a failed simulation ends in its duration, so that a report of failures shows whether runs fail in their
first second or after an hour.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.faults import ChangedModel, TransientReason, reason_of
from ..simulation.model import SimulationFailed, real_response
from .base import StructuralModel, digest
from .dependencies import Dependencies
from .validation import check_theta, positive_float

__all__ = ["ExternalModel"]


class ExternalModel(StructuralModel):
    """Model whose response comes from external code, and is therefore checked after each simulation.

    A subclass defines `_respond`, which may raise any exception and return anything.

    Parameters
    ----------
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        Channels of the response, in the order of its rows.
    dt : float
        Time step of the response [s].
    n_steps : int
        Number of samples of the response.
    depends_on : sequence, optional
        What the response depends on besides the code, as part of the fingerprint: a Path stands for the content of a
        file or of all files in a folder, any other object for its value, such as ``os.environ.get("SOLVER_MODE")``.

    Raises
    ------
    ValueError
        If names are missing, repeated or not text, or `dt` or `n_steps` is not positive, or `depends_on` cannot be
        used.
    """

    fingerprint = ""

    def __init__(
        self,
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float,
        n_steps: int,
        depends_on: Iterable[Any] = (),
    ) -> None:
        kind = type(self).__name__
        for what, values, expected in (("parameter_names", parameter_names, str), ("channels", channels, Channel)):
            if isinstance(values, str) or not all(isinstance(value, expected) for value in values) or not len(values):
                raise ValueError(f"{kind}: {what} must be a tuple of one or more {expected.__name__}; got {values!r}")
        self.parameter_names, self.channels = tuple(parameter_names), tuple(channels)
        for what, names in (
            ("parameter_names", self.parameter_names),
            ("channels", [channel.name for channel in self.channels]),
        ):
            if len(set(names)) != len(names) or not all(names):
                raise ValueError(f"{kind}: the names of {what} must differ and not be empty; got {', '.join(names)}")
        self.dt = positive_float(dt, f"{kind}: dt", "seconds")
        if isinstance(n_steps, bool) or not isinstance(n_steps, int | np.integer) or n_steps < 1:
            raise ValueError(f"{kind}: n_steps must be a positive integer number of samples; got {n_steps!r}")
        self.n_steps = int(n_steps)
        self._dependencies = Dependencies(depends_on, kind)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Simulate the structure for one set of parameters.

        Parameters
        ----------
        theta : ndarray[n_parameters]
            Values of `parameter_names`, in this order. The external code receives a copy.

        Returns
        -------
        ndarray[n_channels, n_steps]
            Response [SI].

        Raises
        ------
        SimulationFailed
            If the external code raises an exception, or its response has a wrong shape, is complex or is not finite.
            The reason ends in the duration of the simulation. It is a `TransientReason` if the cause is not the model
            (see `fe_likelihoods.simulation.faults`).
        ValueError
            If `theta` has another shape, or a worker process has other code (`ChangedModel`).
        """
        theta = check_theta(theta, self.parameter_names).copy()
        start = time.perf_counter()
        try:
            return self._check_response(self._respond(theta))
        except ChangedModel:
            raise
        except Exception as error:  # external code may raise anything
            reason = reason_of(error)
            seconds = getattr(error, "seconds", None)  # excludes the start of a process, where that is known
            seconds = time.perf_counter() - start if seconds is None else seconds
            text = f"{reason} after {seconds:.3g} s"
            raise SimulationFailed(reason.with_text(text) if isinstance(reason, TransientReason) else text) from error

    def _digest(self, *parts: Any) -> str:
        """Fingerprint of the names, the channels, the step, the length and `parts`, which JSON can represent."""
        channels = [(channel.name, channel.quantity) for channel in self.channels]
        named = [type(self).__name__, self.parameter_names, channels, self.dt, self.n_steps]
        return digest(json.dumps([*named, *parts, *self._dependencies.texts()]))

    def _check_response(self, response: Any) -> np.ndarray:
        """Convert a response to floats (n_channels, n_steps); raise SimulationFailed if it cannot be used."""
        response = real_response(response, self.channels, self.n_steps)
        for channel, values in zip(self.channels, response, strict=True):
            if not np.isfinite(values).all():
                raise SimulationFailed(f"the response of channel {channel.name!r} is not finite")
        return response
