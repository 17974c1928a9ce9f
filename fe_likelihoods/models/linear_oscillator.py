"""Linear oscillator under a base acceleration, solved exactly (`fe_likelihoods.signals.response_spectrum`).

One simulation takes tens of microseconds, which makes this the model for first steps, tests and trials of samplers. The
equations are in ``docs/theory/time_integration.rst``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.response_spectrum import respond, response_slopes
from ..simulation.model import SimulationFailed
from .base import StructuralModel, digest
from .validation import check_theta, positive_float


class LinearOscillator(StructuralModel):
    """Single-degree-of-freedom structure under a base acceleration, at rest at the first sample.

    The parameters are multiples of nominal values: ``stiffness`` of the nominal stiffness, ``damping`` of the nominal
    damping ratio. The period is proportional to the inverse square root of the stiffness. The mass is fixed, because
    base excitation identifies only the ratio of stiffness to mass. The channels are the absolute ``acceleration``
    [m/s²] and the ``displacement`` relative to the base [m], at the samples of the record.

    Parameters
    ----------
    record : Record
        Base acceleration.
    period : float
        Nominal undamped period [s], above 0.
    damping_ratio : float
        Nominal fraction of critical damping, between 0 and 1.

    Raises
    ------
    ValueError
        If a nominal value is out of range.

    Examples
    --------
    >>> oscillator = LinearOscillator(record, period=0.8, damping_ratio=0.05)
    >>> acceleration, displacement = oscillator.simulate([1.1, 0.9])
    >>> acceleration.shape
    (200,)
    """

    parameter_names = ("stiffness", "damping")
    channels = (
        Channel("acceleration", "absolute acceleration", "g"),
        Channel("displacement", "relative displacement", "cm"),
    )
    # no `nominal`: a joint likelihood may have one multiple for oscillators with different periods
    parameter_units = {"stiffness": "x nominal", "damping": "x nominal"}
    path_dependent = False

    def __init__(self, record: Record, period: float = 1.0, damping_ratio: float = 0.05) -> None:
        if not 0.0 < damping_ratio < 1.0:
            raise ValueError(
                f"LinearOscillator: damping_ratio must be between 0 and 1 (0.05 is 5 %); got {damping_ratio}"
            )
        self.record = record
        self.period = positive_float(period, "LinearOscillator: period", "seconds")
        self.damping_ratio = float(damping_ratio)
        self.dt = record.dt
        self.n_steps = record.n_steps

    @property
    def fingerprint(self) -> str:
        """Digest of the record and the nominal values."""
        return digest("LinearOscillator", self.record.fingerprint, repr(self.period), repr(self.damping_ratio))

    def with_record(self, record: Record) -> LinearOscillator:
        """Return the same oscillator under another base acceleration; ValueError if it is not a `Record`."""
        if not isinstance(record, Record):
            raise ValueError(f"LinearOscillator: expected a Record as excitation; got {type(record).__name__}")
        return type(self)(record, self.period, self.damping_ratio)

    def first(self, seconds: float) -> LinearOscillator:
        """Return the same oscillator up to the sample at `seconds` [s]; ValueError as `Record.trim`."""
        return self.with_record(self.record.trim(0.0, seconds))

    def jacobian(self, theta: ArrayLike) -> np.ndarray:
        """Exact derivatives (2, 2, n_steps) of the response [SI] by parameter, channel and sample."""
        frequency, damping_ratio = self._frequency_and_damping(check_theta(theta, self.parameter_names))
        by_frequency, by_damping = response_slopes(self.record.acceleration, self.dt, frequency, damping_ratio)
        factors = 0.5 * frequency / float(np.asarray(theta)[0]), self.damping_ratio
        return np.stack(
            [
                factor * np.stack([slopes.acceleration, slopes.displacement])
                for factor, slopes in zip(factors, (by_frequency, by_damping), strict=True)
            ]
        )

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        response = respond(self.record.acceleration, self.dt, *self._frequency_and_damping(theta))
        return np.stack([response.acceleration, response.displacement])

    def _frequency_and_damping(self, theta: np.ndarray) -> tuple[float, float]:
        """Angular frequency [rad/s] and damping ratio; `SimulationFailed` if there is no such oscillator."""
        stiffness, damping = theta.tolist()
        damping_ratio = damping * self.damping_ratio
        if not (stiffness > 0.0 and math.isfinite(stiffness)):
            raise SimulationFailed(f"the stiffness must be positive and finite; it is {stiffness} times nominal")
        if not 0.0 <= damping_ratio < 1.0:
            raise SimulationFailed(f"the damping ratio must be in [0, 1); it is {damping_ratio}")
        return 2.0 * math.pi / self.period * math.sqrt(stiffness), damping_ratio
