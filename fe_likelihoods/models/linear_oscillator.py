"""A linear oscillator on a moving base, solved exactly.

The relative displacement u of a mass on a spring and a dashpot, whose base has the acceleration a, obeys ::

    u'' + 2 zeta omega u' + omega^2 u = -a(t)

Between two samples a is a straight line, so the response at the samples has a closed form and no time-stepping error
(Nigam & Jennings 1969). It is shortest in the complex mode q = u' - conj(lam) u, with the eigenvalue
lam = omega (-zeta + i sqrt(1 - zeta^2)): then q' = lam q - a is of first order, and ::

    u = Im(q) / omega_d,    u' = Im(lam q) / omega_d,    omega_d = omega sqrt(1 - zeta^2)

One simulation costs tens of microseconds: the model for first steps, for tests and for trying samplers.
"""

import hashlib
import math
from typing import TYPE_CHECKING

import numpy as np

from ..signals.channels import Channel, Measurements, plot_response
from ..signals.records import Record
from ..signals.sdof import respond
from ..simulation.model import SimulationFailed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


__all__ = ["LinearOscillator"]


class LinearOscillator:
    """Single-degree-of-freedom structure under a base acceleration, at rest at the first sample.

    The parameters are multiples of nominal values: ``stiffness`` of the nominal stiffness (so the period goes with its
    inverse square root; the mass, which base excitation cannot tell from the stiffness, is fixed), ``damping`` of the
    nominal damping ratio. The channels are the absolute ``acceleration`` [m/s²] and the ``displacement`` relative to
    the base [m], at the samples of the record.

    Parameters
    ----------
    record : Record
        Base acceleration.
    period : float
        Nominal undamped period [s], > 0.
    damping_ratio : float
        Nominal fraction of critical damping, between 0 and 1.

    Raises
    ------
    ValueError
        If a nominal value is out of range.

    Examples
    --------
    >>> model = LinearOscillator(record, period=0.8, damping_ratio=0.05)
    >>> acceleration, displacement = model.simulate([1.1, 0.9])
    """

    parameter_names = ("stiffness", "damping")
    channels = (
        Channel("acceleration", "absolute acceleration", "g"),
        Channel("displacement", "relative displacement", "cm"),
    )

    def __init__(self, record: Record, period: float = 1.0, damping_ratio: float = 0.05) -> None:
        if not (math.isfinite(period) and period > 0.0):
            raise ValueError(f"LinearOscillator: period must be a positive number of seconds; got {period}")
        if not 0.0 < damping_ratio < 1.0:
            raise ValueError(
                f"LinearOscillator: damping_ratio must be between 0 and 1 (0.05 is 5 %); got {damping_ratio}"
            )
        self.record = record
        self.period = float(period)
        self.damping_ratio = float(damping_ratio)
        self.dt = record.dt
        self.n_steps = record.n_steps

    @property
    def fingerprint(self) -> str:
        """Digest of the record and the nominal values."""
        text = f"LinearOscillator {self.record.fingerprint} {self.period!r} {self.damping_ratio!r}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def with_record(self, record: Record) -> "LinearOscillator":
        """The same oscillator under another base acceleration; ValueError if it is no `Record`."""
        if not isinstance(record, Record):
            raise ValueError(f"LinearOscillator: expected a Record as excitation; got {type(record).__name__}")
        return type(self)(record, self.period, self.damping_ratio)

    def plot_response(self, theta: np.ndarray, measurements: "Measurements | None" = None) -> "Figure":
        """Plot the response at `theta`, beside measurements if there are any."""
        return plot_response(Measurements(self.channels, self.dt, self.simulate(theta)), measurements)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response at one set of parameters.

        Parameters
        ----------
        theta : (2,) float
            Multiples of the nominal stiffness and of the nominal damping ratio.

        Returns
        -------
        (2, n_steps) float : absolute acceleration [m/s²] and relative displacement [m].

        Raises
        ------
        SimulationFailed
            If the stiffness is not positive, or the oscillator does not oscillate (damping ratio not in [0, 1)).
        """
        stiffness, damping = (float(value) for value in theta)
        damping_ratio = damping * self.damping_ratio
        if not (stiffness > 0.0 and math.isfinite(stiffness)):
            raise SimulationFailed(f"the stiffness must be positive and finite; it is {stiffness} times nominal")
        if not 0.0 <= damping_ratio < 1.0:
            raise SimulationFailed(f"the damping ratio must be in [0, 1); it is {damping_ratio}")
        angular_frequency = 2.0 * math.pi / self.period * math.sqrt(stiffness)
        response = respond(self.record.acceleration, self.dt, angular_frequency, damping_ratio)
        return np.stack([response.acceleration, response.displacement])
