r"""Exact response of a linear oscillator with one degree of freedom to a base acceleration, and response spectra.

The displacement :math:`u` of a mass relative to its base, carried by a spring and a dashpot, satisfies

.. math:: \ddot u + 2 \zeta \omega \dot u + \omega^2 u = -a(t)

for the base acceleration :math:`a`. Between two samples :math:`a` is linear in time, so that the response at the
samples has a closed form without time-stepping error (Nigam & Jennings 1969). With the eigenvalue
:math:`\lambda = \omega (-\zeta + i \sqrt{1 - \zeta^2})` and the complex modal coordinate
:math:`q = \dot u - \bar\lambda u` the equation is of first order, and

.. math:: \dot q = \lambda q - a, \qquad u = \frac{\mathrm{Im}\, q}{\omega_d}, \qquad
          \dot u = \frac{\mathrm{Im}(\lambda q)}{\omega_d}, \qquad \omega_d = \omega \sqrt{1 - \zeta^2} .

See ``docs/theory/time_integration.rst``.

References
----------
N. C. Nigam, P. C. Jennings (1969), Calculation of response spectra from strong-motion earthquake records, Bulletin of
the Seismological Society of America 59(2), 909-922.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .sampling import expect

_INSTANTS = 40  # instants per period at which the response is evaluated
_SHORTEST = 0.1  # shortest period, in steps of the motion


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
    u, v = state.imag / damped_frequency, (eigenvalue * state).imag / damped_frequency
    return OscillatorResponse(u, v, -2.0 * damping_ratio * angular_frequency * v - angular_frequency**2 * u)


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


class ResponseSpectrum(NamedTuple):
    r"""Peak responses of oscillators with one damping ratio.

    Attributes
    ----------
    periods : ndarray, shape (n_periods,)
        Undamped periods [s].
    damping_ratio : float
        Fraction of critical damping [-].
    displacement : ndarray, shape (n_periods,)
        Largest displacement relative to the ground, SD [m].
    pseudo_velocity : ndarray, shape (n_periods,)
        Pseudo-velocity, :math:`\omega` SD [m/s].
    pseudo_acceleration : ndarray, shape (n_periods,)
        Pseudo-acceleration, :math:`\omega^2` SD [m/s²]. Multiplied by the mass, it is the largest spring force.
    """

    periods: NDArray[np.float64]
    damping_ratio: float
    displacement: NDArray[np.float64]
    pseudo_velocity: NDArray[np.float64]
    pseudo_acceleration: NDArray[np.float64]


def spectrum_of(
    acceleration: NDArray[np.float64], dt: float, periods: ArrayLike | None, damping_ratio: float
) -> ResponseSpectrum:
    r"""The elastic response spectrum of a ground acceleration (n_steps,) [m/s²]; see `Record.spectrum`.

    A peak between two of 40 or more instants per period is underestimated by less than :math:`1 - \cos(\pi / 40) = 0.3
    \,\%` of the oscillating part. One period of free vibration after the motion is followed, which may have the peak.
    """
    if periods is None:
        periods = np.geomspace(max(0.02, 2.0 * dt), max(10.0, 4.0 * dt), 120)
    periods = np.array(periods, dtype=float)
    known = periods.ndim == 1 and periods.size and np.all(np.isfinite(periods) & (periods > 0.0))
    expect(known, "periods", "positive numbers of seconds in one dimension", periods)
    expected = f"at least {_SHORTEST * dt:g} s, {_SHORTEST:g} steps of the motion, which has no information below"
    expect(periods.min() >= _SHORTEST * dt, "periods", expected, f"{periods.min():g} s")
    expect(0.0 <= damping_ratio < 1.0, "damping_ratio", "a number in [0, 1) (0.05 is 5 %)", repr(damping_ratio))
    frequencies = 2.0 * math.pi / periods
    displacement = np.empty(periods.size)
    for k, (period, omega) in enumerate(zip(2.0 * math.pi / frequencies, frequencies, strict=True)):
        parts, rest = max(1, math.ceil(_INSTANTS * dt / period)), math.ceil(period / dt) + 1
        samples = np.concatenate([acceleration, np.zeros(rest)])  # and one period of free vibration
        finer = np.interp(np.arange((samples.size - 1) * parts + 1) / parts, np.arange(samples.size), samples)
        displacement[k] = np.abs(respond(finer, dt / parts, omega, damping_ratio).displacement).max()
    velocity = frequencies * displacement
    return ResponseSpectrum(periods, float(damping_ratio), displacement, velocity, frequencies * velocity)
