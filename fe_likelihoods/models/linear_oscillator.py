"""A linear oscillator on a moving base, solved exactly.

The relative displacement u of a mass on a spring and a dashpot, whose base has the acceleration a, obeys ::

    u'' + 2 zeta omega u' + omega^2 u = -a(t)

Between two samples a is a straight line, so the response at the samples has a closed form and no time-stepping error
(Nigam & Jennings 1969). It is shortest in the complex mode q = u' - conj(lam) u, with the eigenvalue
lam = omega (-zeta + i sqrt(1 - zeta^2)): then q' = lam q - a is of first order, and ::

    u = Im(q) / omega_d,    u' = Im(lam q) / omega_d,    omega_d = omega sqrt(1 - zeta^2)

One simulation costs tens of microseconds: the model for first steps, for tests and for trying samplers.
"""

import cmath
import hashlib
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..channels import Channel
from ..records import Record
from .base import SimulationFailed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..channels import Measurements

__all__ = ["LinearOscillator", "OscillatorResponse", "hold_integrals", "respond"]


class OscillatorResponse(NamedTuple):
    """Response of an oscillator, each (n_steps,): `displacement` [m] and `velocity` [m/s] relative to the base,
    absolute `acceleration` [m/s²]."""

    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


def hold_integrals(z: complex) -> tuple[complex, complex]:
    """(e^z - 1) / z and (e^z - 1 - z) / z^2: one step of q' = z q + 1 and of q' = z q + t, from q = 0 to t = 1."""
    if abs(z) >= 1.0:
        constant = (cmath.exp(z) - 1.0) / z
        return constant, (constant - 1.0) / z
    # both differences cancel at small z: the series of the second, 1/2 + z/3! + ..., to less than round-off
    series = 1.0 + 0.0j
    for k in range(20, 2, -1):
        series = 1.0 + z / k * series
    return 1.0 + z * (0.5 * series), 0.5 * series


def respond(
    base_acceleration: np.ndarray,
    dt: float,
    angular_frequency: float,
    damping_ratio: float,
    displacement: float = 0.0,
    velocity: float = 0.0,
) -> OscillatorResponse:
    """Exact response to a base acceleration that is linear between its samples.

    Parameters
    ----------
    base_acceleration : (n_steps,) float
        [m/s²]
    dt : float
        Time step of the samples [s].
    angular_frequency : float
        Undamped, > 0 [rad/s].
    damping_ratio : float
        Fraction of critical damping, 0 <= damping_ratio < 1.
    displacement, velocity : float
        Relative to the base at the first sample [m], [m/s].

    Returns
    -------
    OscillatorResponse

    References
    ----------
    N. C. Nigam, P. C. Jennings, Calculation of response spectra from strong-motion earthquake records, Bulletin of the
    Seismological Society of America 59(2), 1969, 909-922.
    """
    from scipy.signal import lfilter  # takes longer to start than all else here

    damped_frequency = angular_frequency * math.sqrt(1.0 - damping_ratio**2)
    eigenvalue = complex(-damping_ratio * angular_frequency, damped_frequency)
    decay = cmath.exp(eigenvalue * dt)
    constant, slope = hold_integrals(eigenvalue * dt)
    # q_{k+1} = decay q_k - dt (constant - slope) a_k - dt slope a_{k+1}
    numerator = [-dt * slope, -dt * (constant - slope)]
    first = velocity - eigenvalue.conjugate() * displacement
    state, _ = lfilter(numerator, [1.0, -decay], base_acceleration, zi=[first - numerator[0] * base_acceleration[0]])
    relative_displacement = state.imag / damped_frequency
    relative_velocity = (eigenvalue * state).imag / damped_frequency
    return OscillatorResponse(
        relative_displacement,
        relative_velocity,
        -2.0 * damping_ratio * angular_frequency * relative_velocity - angular_frequency**2 * relative_displacement,
    )


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
        """Histories of the channels at `theta`, and what was measured (`models.figures.plot_response`)."""
        from .figures import plot_response

        return plot_response(self, theta, measurements)

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
