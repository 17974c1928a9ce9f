r"""Elastic response spectrum of a ground motion: the largest response of linear oscillators against their period.

Each oscillator is solved exactly for a ground acceleration that is linear between its samples
(`fe_likelihoods.signals.sdof.respond`). The response is evaluated at 40 instants or more per period, so that a peak
between two instants is underestimated by less than :math:`1 - \cos(\pi / 40) = 0.3\,\%` of the oscillating part. The
response is followed for one period of free vibration after the end of the motion, because the peak may occur there.

References
----------
N. C. Nigam, P. C. Jennings (1969), Calculation of response spectra from strong-motion earthquake records, Bulletin of
the Seismological Society of America 59(2), 909-922.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .sampling import expect
from .sdof import respond

__all__ = ["ResponseSpectrum", "response_spectrum"]

_INSTANTS = 40  # instants per period at which the response is evaluated
_SHORTEST = 0.1  # shortest period, in steps of the motion


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


def response_spectrum(
    acceleration: NDArray[np.float64], dt: float, periods: ArrayLike | None, damping_ratio: float
) -> ResponseSpectrum:
    """The elastic response spectrum of a ground acceleration (n_steps,) [m/s²]; see `Record.spectrum`."""
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
