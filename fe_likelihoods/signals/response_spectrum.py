"""Elastic response spectrum of a ground motion: the largest response of linear oscillators, against their period.

Each oscillator is solved exactly for the motion that a `Record` is, a straight line between its samples
(`models.linear_oscillator.respond`). Peaks are looked for at forty instants or more of every period, so a peak between
two of them is missed by less than 1 - cos(pi/40) = .3 % of what oscillates; that the ground then rests does not end
the response, so one period of free vibration is looked at too.

References
----------
N. C. Nigam, P. C. Jennings, Calculation of response spectra from strong-motion earthquake records, Bulletin of the
Seismological Society of America 59(2), 1969, 909-922.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .records import Record
from .sdof import respond

__all__ = ["ResponseSpectrum", "response_spectrum"]

_INSTANTS = 40  # of a period, at which its peak is looked for
_SHORTEST = 0.1  # period, in steps of the record


class ResponseSpectrum(NamedTuple):
    """Peaks of oscillators with one damping ratio.

    Attributes
    ----------
    periods : (n_periods,) float
        Undamped periods [s].
    damping_ratio : float
        Fraction of critical damping.
    displacement : (n_periods,) float
        Largest displacement relative to the ground, SD [m].
    pseudo_velocity, pseudo_acceleration : (n_periods,) float
        omega SD [m/s] and omega² SD [m/s²]: the latter times the mass is the largest force of the spring.
    """

    periods: NDArray[np.float64]
    damping_ratio: float
    displacement: NDArray[np.float64]
    pseudo_velocity: NDArray[np.float64]
    pseudo_acceleration: NDArray[np.float64]


def response_spectrum(
    record: Record, periods: ArrayLike | None = None, damping_ratio: float = 0.05
) -> ResponseSpectrum:
    """Elastic response spectrum of a record.

    Parameters
    ----------
    record : Record
    periods : (n_periods,) array_like, optional
        Undamped periods [s], at least a tenth of the record's step. By default 120 from twice the step (or .02 s, if
        that is longer) to 10 s, equally spaced in their logarithms.
    damping_ratio : float
        Fraction of critical damping, 0 <= damping_ratio < 1.

    Returns
    -------
    ResponseSpectrum

    Raises
    ------
    ValueError
        If the periods are not one-dimensional, finite and long enough, or the damping ratio is out of range.
    """
    if periods is None:
        periods = np.geomspace(max(0.02, 2.0 * record.dt), max(10.0, 4.0 * record.dt), 120)
    periods = np.array(periods, dtype=float)
    if periods.ndim != 1 or not periods.size or not np.all(np.isfinite(periods) & (periods > 0.0)):
        raise ValueError(f"periods must be positive numbers of seconds in one dimension; got {periods}")
    if periods.min() < _SHORTEST * record.dt:
        raise ValueError(
            f"periods must be at least {_SHORTEST * record.dt:g} s, {_SHORTEST:g} steps of {record.name!r}, which "
            f"tells nothing of faster motion; got {periods.min():g} s"
        )
    if not 0.0 <= damping_ratio < 1.0:
        raise ValueError(f"damping_ratio must be in [0, 1) (0.05 is 5 %); got {damping_ratio!r}")
    frequencies = 2.0 * math.pi / periods
    displacement = np.array([_largest(record, omega, damping_ratio) for omega in frequencies])
    velocity = frequencies * displacement
    return ResponseSpectrum(periods, float(damping_ratio), displacement, velocity, frequencies * velocity)


def _largest(record: Record, omega: float, damping_ratio: float) -> float:
    """Largest relative displacement [m], of the record and one period after it."""
    period = 2.0 * math.pi / omega
    parts = max(1, math.ceil(_INSTANTS * record.dt / period))
    dt = record.dt / parts
    rest = math.ceil(period / record.dt) + 1
    samples = np.concatenate([record.acceleration, np.zeros(rest)])
    finer = np.interp(np.arange((samples.size - 1) * parts + 1) / parts, np.arange(samples.size), samples)
    return float(np.abs(respond(finer, dt, omega, damping_ratio).displacement).max())
