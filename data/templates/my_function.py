"""A model as a Python function: a mass on a bilinear spring with a damper under a base motion."""

import math

import numpy as np

STIFFNESS = (2.0 * math.pi / 0.8) ** 2  # per unit mass [1/s²]: a period of 0.8 s
STRENGTH = 0.02 * STIFFNESS  # per unit mass [m/s²]: yields at 20 mm
HARDENING = 0.05  # ratio of the stiffness after yielding to the initial one
DAMPING = 2.0 * 0.03 * math.sqrt(STIFFNESS)  # per unit mass [1/s]: 3 % of critical damping
SUBSTEPS = 16  # per step of the record


def simulate(theta, record):
    """Response to a base motion.

    Parameters
    ----------
    theta : (2,) float
        Multiples of the nominal stiffness and strength, in the order of `parameters` in the TOML file.
    record : Record
        Base motion: `record.acceleration` [m/s²] at the step `record.dt` [s].

    Returns
    -------
    (2, n_steps) float
        Absolute acceleration [m/s²] and relative displacement [m]: SI units, one row per channel.
    """
    stiffness, strength = STIFFNESS * theta[0], STRENGTH * theta[1]
    step = record.dt / SUBSTEPS
    response = np.zeros((2, record.n_steps))
    displacement = velocity = spring = 0.0
    motion = record.acceleration.tolist()
    for i in range(1, record.n_steps):
        for k in range(SUBSTEPS):  # central differences; the motion is linear between its samples
            base = motion[i - 1] + (motion[i] - motion[i - 1]) * (k + 1) / SUBSTEPS
            velocity += step * (-base - DAMPING * velocity - spring)
            displacement += step * velocity
            centre = HARDENING * stiffness * displacement
            trial = spring + stiffness * step * velocity
            limit = (1.0 - HARDENING) * strength
            spring = min(max(trial, centre - limit), centre + limit)
        response[:, i] = -DAMPING * velocity - spring, displacement
    return response
