r"""Exact response of a linear single-degree-of-freedom oscillator to a base acceleration.

The displacement :math:`u` of a mass relative to its base, carried by a spring and a dashpot, satisfies

.. math:: \ddot u + 2 \zeta \omega \dot u + \omega^2 u = -a(t)

for the base acceleration :math:`a`. Between two samples :math:`a` is linear in time, so that the response at the
samples has a closed form without time-stepping error (Nigam & Jennings 1969). With the eigenvalue
:math:`\lambda = \omega (-\zeta + i \sqrt{1 - \zeta^2})` and the complex modal coordinate
:math:`q = \dot u - \bar\lambda u` the equation is of first order, and

.. math:: \dot q = \lambda q - a, \qquad u = \frac{\mathrm{Im}\, q}{\omega_d}, \qquad
          \dot u = \frac{\mathrm{Im}(\lambda q)}{\omega_d}, \qquad \omega_d = \omega \sqrt{1 - \zeta^2} .

See ``docs/theory/time_integration.rst``.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np

__all__ = ["OscillatorResponse", "hold_integrals", "respond"]


class OscillatorResponse(NamedTuple):
    """Response of an oscillator.

    Attributes
    ----------
    displacement : ndarray, shape (n_steps,)
        Displacement relative to the base [m].
    velocity : ndarray, shape (n_steps,)
        Velocity relative to the base [m/s].
    acceleration : ndarray, shape (n_steps,)
        Absolute acceleration [m/s²].
    """

    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


def hold_integrals(z: complex) -> tuple[complex, complex]:
    r"""Integrals of a first-order equation over one step, for a constant and for a linear load.

    Parameters
    ----------
    z : complex
        Eigenvalue times step, :math:`\lambda \Delta t` [-].

    Returns
    -------
    constant : complex
        :math:`(e^z - 1) / z`, the value at t = 1 of q' = z q + 1 with q(0) = 0.
    slope : complex
        :math:`(e^z - 1 - z) / z^2`, the value at t = 1 of q' = z q + t with q(0) = 0.
    """
    if abs(z) >= 1.0:
        constant = (cmath.exp(z) - 1.0) / z
        return constant, (constant - 1.0) / z
    # Both differences cancel at small z. The series of the second difference, 1/2 + z/3! + ..., is exact to round-off.
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
    """Compute the exact response to a base acceleration that is linear between its samples.

    Parameters
    ----------
    base_acceleration : ndarray, shape (n_steps,)
        Base acceleration [m/s²].
    dt : float
        Time step of the samples [s].
    angular_frequency : float
        Undamped angular frequency, positive [rad/s].
    damping_ratio : float
        Fraction of critical damping, 0 <= damping_ratio < 1.
    displacement : float
        Displacement relative to the base at the first sample [m].
    velocity : float
        Velocity relative to the base at the first sample [m/s].

    Returns
    -------
    OscillatorResponse
        The response at the samples.

    References
    ----------
    N. C. Nigam, P. C. Jennings (1969), Calculation of response spectra from strong-motion earthquake records, Bulletin
    of the Seismological Society of America 59(2), 909-922.
    """
    from scipy.signal import lfilter  # imported here because scipy.signal takes longer to import than this package

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
