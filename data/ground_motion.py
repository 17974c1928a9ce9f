"""Stochastic ground motion for synthetic data.

In the model of Rezaeian & Der Kiureghian (2008, 2010) white noise passes an oscillator filter whose frequency changes
with time. The result is scaled to unit variance, modulated in time by a gamma function, and high-pass filtered, so that
velocity and displacement are zero at the end.

References
----------
S. Rezaeian, A. Der Kiureghian (2008), A stochastic ground motion model with separable temporal and spectral
nonstationarities, Earthquake Engineering & Structural Dynamics 37(13), 1565-1584, doi:10.1002/eqe.831.
S. Rezaeian, A. Der Kiureghian (2010), Simulation of synthetic ground motions for specified earthquake and site
characteristics, Earthquake Engineering & Structural Dynamics 39(10), 1155-1180, doi:10.1002/eqe.997.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import signal

__all__ = ["stochastic_motion"]

_RESPONSE_PERIODS = 24.0
"""Length of the impulse response of the filter, in periods of its highest frequency."""


def stochastic_motion(
    seed: int,
    *,
    dt: float,
    duration: float,
    peak: float,
    peak_time: float,
    shape: float,
    frequencies: tuple[float, float],
    drift_time: float,
    filter_damping: float,
    high_pass: float,
) -> np.ndarray:
    """Draw one ground motion.

    Parameters
    ----------
    seed : int
        Seed of the white noise.
    dt : float
        Time step [s].
    duration : float
        Duration [s].
    peak : float
        Largest absolute acceleration, to which the motion is scaled [m/s²].
    peak_time : float
        Time of the largest modulation [s].
    shape : float
        Exponent of the modulation t^(shape - 1) exp(-(shape - 1) t / peak_time) [-].
    frequencies : (float, float)
        Frequency of the filter at time 0 and at `drift_time`, linear between them and constant afterwards [Hz].
    drift_time : float
        Time after which the frequency of the filter is constant [s].
    filter_damping : float
        Damping of the filter, fraction of critical damping [-].
    high_pass : float
        Corner frequency of the high-pass filter [Hz].

    Returns
    -------
    ndarray, shape (n_steps,)
        Ground acceleration [m/s²].
    """
    n = round(duration / dt)
    time = dt * np.arange(n)
    pulses = np.random.default_rng(seed).standard_normal(n)
    frequency = 2.0 * math.pi * np.interp(time, [0.0, drift_time], frequencies)
    damped = frequency * math.sqrt(1.0 - filter_damping**2)
    motion, variance = np.zeros(n), np.zeros(n)
    n_response = round(_RESPONSE_PERIODS / max(frequencies) / dt)
    for i in range(n):
        t = time[: min(n_response, n - i)]
        response = np.exp(-filter_damping * frequency[i] * t) * np.sin(damped[i] * t)
        motion[i : i + t.size] += pulses[i] * response
        variance[i : i + t.size] += response**2
    motion = motion / np.sqrt(np.maximum(variance, 1e-12))
    motion *= (time / peak_time) ** (shape - 1.0) * np.exp((shape - 1.0) * (1.0 - time / peak_time))
    # High-pass filter: a critically damped oscillator of frequency w, transfer function s^2/(s + w)^2.
    w = 2.0 * math.pi * high_pass
    motion = signal.lfilter(*signal.bilinear([1.0, 0.0, 0.0], [1.0, 2.0 * w, w * w], fs=1.0 / dt), motion)
    motion *= signal.windows.tukey(n, 0.04)
    return motion * peak / np.abs(motion).max()
