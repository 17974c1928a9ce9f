"""Exact response of a linear oscillator to a base acceleration.

The relative displacement u of a mass on a spring and a dashpot, whose base has the acceleration a, satisfies ::

    u'' + 2 zeta omega u' + omega^2 u = -a(t)

Between two samples a is linear in time, so the response at the samples has a closed form and no time-stepping error
(Nigam & Jennings 1969). In the complex modal coordinate q = u' - conj(lam) u with the eigenvalue
lam = omega (-zeta + i sqrt(1 - zeta^2)), the equation is of first order, q' = lam q - a, and ::

    u = Im(q) / omega_d,    u' = Im(lam q) / omega_d,    omega_d = omega sqrt(1 - zeta^2)
"""

import cmath
import math
from typing import NamedTuple

import numpy as np

__all__ = ["OscillatorResponse", "hold_integrals", "respond"]


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
