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

__all__ = ["OscillatorResponse", "hold_integrals", "respond", "response_slopes"]


class OscillatorResponse(NamedTuple):
    """Response of an oscillator, (n_steps,) each; displacement and velocity are relative to the base."""

    displacement: np.ndarray  # [m]
    velocity: np.ndarray  # [m/s]
    acceleration: np.ndarray  # absolute [m/s²]


def hold_integrals(z: complex) -> tuple[complex, complex]:
    r"""Integrals over one step of q' = z q + load with q(0) = 0, z = :math:`\lambda \Delta t`, for the loads 1 and t.

    They are :math:`(e^z - 1) / z` and :math:`(e^z - 1 - z) / z^2`.
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
    base_acceleration: np.ndarray, dt: float, angular_frequency: float, damping_ratio: float
) -> OscillatorResponse:
    """Exact response from rest to a base acceleration (n_steps,) [m/s²] that is linear between its samples (Nigam &
    Jennings 1969).

    The angular frequency [rad/s] is undamped and positive, 0 <= damping_ratio < 1.
    """
    from scipy.signal import lfilter  # imported here because scipy.signal takes longer to import than this package

    damped_frequency = angular_frequency * math.sqrt(1.0 - damping_ratio**2)
    eigenvalue = complex(-damping_ratio * angular_frequency, damped_frequency)
    decay = cmath.exp(eigenvalue * dt)
    constant, slope = hold_integrals(eigenvalue * dt)
    # q_{k+1} = decay q_k - dt (constant - slope) a_k - dt slope a_{k+1}
    numerator = [-dt * slope, -dt * (constant - slope)]
    state, _ = lfilter(numerator, [1.0, -decay], base_acceleration, zi=[-numerator[0] * base_acceleration[0]])
    relative_displacement = state.imag / damped_frequency
    relative_velocity = (eigenvalue * state).imag / damped_frequency
    return OscillatorResponse(
        relative_displacement,
        relative_velocity,
        -2.0 * damping_ratio * angular_frequency * relative_velocity - angular_frequency**2 * relative_displacement,
    )


def response_slopes(
    base_acceleration: np.ndarray, dt: float, angular_frequency: float, damping_ratio: float
) -> tuple[OscillatorResponse, OscillatorResponse]:
    r"""Exact derivatives of the response from rest, by the angular frequency [per rad/s] and by the damping ratio.

    The derivative :math:`p = \partial q / \partial \lambda` satisfies :math:`\dot p = \lambda p + q`, which is
    integrated as exactly as :math:`q`.
    """
    from scipy.signal import lfilter

    root = math.sqrt(1.0 - damping_ratio**2)
    eigenvalue = angular_frequency * complex(-damping_ratio, root)
    z = eigenvalue * dt
    decay = cmath.exp(z)
    constant, slope = hold_integrals(z)
    ramp = [-dt * slope, -dt * (constant - slope)]  # numerator of q, as in `respond`
    # d/dz of both integrals; near zero by their series, because the differences cancel
    if abs(z) >= 1.0:
        constant_slope = (decay - constant) / z
        slope_slope = (constant_slope - slope) / z
    else:
        constant_slope = sum(k * z ** (k - 1) / math.factorial(k + 1) for k in range(1, 20))
        slope_slope = sum(k * z ** (k - 1) / math.factorial(k + 2) for k in range(1, 20))
    start = base_acceleration[0]
    state, _ = lfilter(ramp, [1.0, -decay], base_acceleration, zi=[-ramp[0] * start])
    ramp_slope = [-(dt**2) * slope_slope, -(dt**2) * (constant_slope - slope_slope)]
    held, _ = lfilter(ramp_slope, [1.0], base_acceleration, zi=[-ramp_slope[0] * start])
    carried = np.concatenate([[0.0], state[:-1]]) * (dt * decay)
    by_eigenvalue = lfilter([1.0], [1.0, -decay], held + carried)
    damped = angular_frequency * root
    by_ratio = -angular_frequency * damping_ratio / root  # of the damped frequency
    u, v = state.imag / damped, (eigenvalue * state).imag / damped
    found = []
    for d_eigenvalue, d_damped, d_stiffness, d_viscous in (
        (complex(-damping_ratio, root), root, 2.0 * angular_frequency, 2.0 * damping_ratio),
        (complex(-angular_frequency, by_ratio), by_ratio, 0.0, 2.0 * angular_frequency),
    ):
        d_state = by_eigenvalue * d_eigenvalue
        d_u = (d_state.imag - u * d_damped) / damped
        d_v = ((d_eigenvalue * state + eigenvalue * d_state).imag - v * d_damped) / damped
        forces = d_viscous * v + 2.0 * damping_ratio * angular_frequency * d_v
        found.append(OscillatorResponse(d_u, d_v, -forces - d_stiffness * u - angular_frequency**2 * d_u))
    return found[0], found[1]
