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

from .sampling import check_samples, check_step
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
    acceleration: ArrayLike, dt: float, periods: ArrayLike | None = None, damping_ratio: float = 0.05
) -> ResponseSpectrum:
    """Compute the elastic response spectrum of a ground acceleration.

    Parameters
    ----------
    acceleration : (n_steps,) array_like
        Ground acceleration [m/s²], linear between its samples.
    dt : float
        Time step of the samples [s].
    periods : (n_periods,) array_like, optional
        Undamped periods [s], each at least a tenth of the step. Default: 120 periods, equally spaced on a logarithmic
        scale, from twice the step (at least 0.02 s) to 10 s.
    damping_ratio : float
        Fraction of critical damping, 0 <= damping_ratio < 1.

    Returns
    -------
    ResponseSpectrum
        Periods and peak responses.

    Raises
    ------
    ValueError
        If the samples are not a one-dimensional finite array, the step is not positive, the periods are not
        one-dimensional, finite and long enough, or the damping ratio is out of range.

    Examples
    --------
    >>> from fe_likelihoods.signals.response_spectrum import response_spectrum
    >>> response_spectrum(record.acceleration, record.dt, [0.5, 1.0]).displacement.shape
    (2,)
    """
    try:
        acceleration, dt = check_samples(acceleration, "acceleration", "the motion"), check_step(dt, "the motion")
    except ValueError as error:
        raise ValueError(
            f"{error}; for a Record use record.spectrum(), or pass record.acceleration and record.dt"
        ) from None
    if periods is None:
        periods = np.geomspace(max(0.02, 2.0 * dt), max(10.0, 4.0 * dt), 120)
    periods = np.array(periods, dtype=float)
    if periods.ndim != 1 or not periods.size or not np.all(np.isfinite(periods) & (periods > 0.0)):
        raise ValueError(f"periods must be positive numbers of seconds in one dimension; got {periods}")
    if periods.min() < _SHORTEST * dt:
        raise ValueError(
            f"periods must be at least {_SHORTEST * dt:g} s, {_SHORTEST:g} steps of the motion, because the motion has "
            f"no information on shorter periods; got {periods.min():g} s"
        )
    if not 0.0 <= damping_ratio < 1.0:
        raise ValueError(f"damping_ratio must be in [0, 1) (0.05 is 5 %); got {damping_ratio!r}")
    frequencies = 2.0 * math.pi / periods
    displacement = np.array([_peak_displacement(acceleration, dt, omega, damping_ratio) for omega in frequencies])
    velocity = frequencies * displacement
    return ResponseSpectrum(periods, float(damping_ratio), displacement, velocity, frequencies * velocity)


def _peak_displacement(acceleration: NDArray[np.float64], dt: float, omega: float, damping_ratio: float) -> float:
    """Return the largest relative displacement [m] during the motion and one period of free vibration after it."""
    period = 2.0 * math.pi / omega
    parts = max(1, math.ceil(_INSTANTS * dt / period))
    rest = math.ceil(period / dt) + 1
    samples = np.concatenate([acceleration, np.zeros(rest)])
    finer = np.interp(np.arange((samples.size - 1) * parts + 1) / parts, np.arange(samples.size), samples)
    return float(np.abs(respond(finer, dt / parts, omega, damping_ratio).displacement).max())
