"""Stochastic ground motion, for base motions of our own.

The model of Rezaeian & Der Kiureghian (2008, Earthq. Eng. Struct. Dyn. 37(13), 1609-1627; 2010, 39(10), 1155-1180):
white noise through an oscillator filter whose frequency drifts, scaled to unit variance, modulated in time by a gamma
function, then high-pass filtered so that velocity and displacement end at rest.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import signal

__all__ = ["stochastic_motion"]

_MEMORY = 24.0
"""Periods after which the filter has forgotten a pulse."""


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
    """One draw of the ground motion.

    Parameters
    ----------
    seed : int
    dt, duration : float
        [s]
    peak : float
        Largest absolute acceleration, to which the motion is scaled [m/s2].
    peak_time, shape : float
        Of the modulation t^(shape - 1) exp(-(shape - 1) t / peak_time) [s], [-].
    frequencies, drift_time : (float, float), float
        Of the filter at 0 and at `drift_time`, linear between, constant afterwards [Hz], [s].
    filter_damping : float
        Fraction of critical.
    high_pass : float
        Corner frequency [Hz].

    Returns
    -------
    (n_steps,) float [m/s2]
    """
    n = round(duration / dt)
    time = dt * np.arange(n)
    pulses = np.random.default_rng(seed).standard_normal(n)
    frequency = 2.0 * math.pi * np.interp(time, [0.0, drift_time], frequencies)
    damped = frequency * math.sqrt(1.0 - filter_damping**2)
    motion, variance = np.zeros(n), np.zeros(n)
    memory = round(_MEMORY / max(frequencies) / dt)
    for i in range(n):
        t = time[: min(memory, n - i)]
        response = np.exp(-filter_damping * frequency[i] * t) * np.sin(damped[i] * t)
        motion[i : i + t.size] += pulses[i] * response
        variance[i : i + t.size] += response**2
    motion = motion / np.sqrt(np.maximum(variance, 1e-12))
    motion *= (time / peak_time) ** (shape - 1.0) * np.exp((shape - 1.0) * (1.0 - time / peak_time))
    # critically damped oscillator of frequency w: acceleration s^2/(s + w)^2
    w = 2.0 * math.pi * high_pass
    motion = signal.lfilter(*signal.bilinear([1.0, 0.0, 0.0], [1.0, 2.0 * w, w * w], fs=1.0 / dt), motion)
    motion *= signal.windows.tukey(n, 0.04)
    return motion * peak / np.abs(motion).max()
