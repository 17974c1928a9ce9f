"""A model as a Python function: deflections of a simple span under a truck at several places."""

import numpy as np

SPAN, TRUCK, STIFFNESS = 30.0, 400e3, 12e9  # m, N, N m²
SENSORS = np.array([7.5, 15.0])  # m
PLACES = np.array([7.5, 15.0, 22.5])  # of the truck [m], the load cases


def deflections(theta):
    """Deflections (2, 3) [m] of the sensors, for each place of the truck; theta (1,) multiplies the stiffness."""
    x, a = np.meshgrid(SENSORS, PLACES, indexing="ij")
    near, far = np.minimum(x, a), SPAN - np.maximum(x, a)
    return TRUCK * near * far * (SPAN**2 - near**2 - far**2) / (6.0 * theta[0] * STIFFNESS * SPAN)
