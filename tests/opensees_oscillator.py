"""A linear oscillator in OpenSees, as a user would write it for `OpenSeesModel`."""

import os
import time

import numpy as np

from fe_likelihoods.signals.channels import Channel

PERIOD, DAMPING = 0.7, 0.05
CHANNELS = (
    Channel("acceleration", "absolute acceleration", "g"),
    Channel("displacement", "relative displacement", "cm"),
)


class Oscillator:
    """Unit mass on a spring and a dashpot, by Newmark's average acceleration with `substeps` steps per sample.

    The parameters of a run are multiples of stiffness and damping ratio. Some values of the stiffness simulate faults:
    9 crashes the process, 10 hangs, 11 does not converge.
    """

    def __init__(self, acceleration: np.ndarray, dt: float, substeps: int) -> None:
        self.acceleration, self.dt, self.substeps = acceleration, dt, substeps

    def __call__(self, ops, theta: np.ndarray) -> np.ndarray:
        stiffness, damping = theta
        if stiffness == 9.0:
            os.abort()
        if stiffness == 10.0:
            time.sleep(3600)
        omega = 2.0 * np.pi / PERIOD * np.sqrt(stiffness)
        ops.model("basic", "-ndm", 1, "-ndf", 1)
        ops.node(1, 0.0)
        ops.node(2, 0.0)
        ops.fix(1, 1)
        ops.mass(2, 1.0)
        ops.uniaxialMaterial("Elastic", 1, omega**2, 2.0 * damping * DAMPING * omega)
        ops.element("zeroLength", 1, 1, 2, "-mat", 1, "-dir", 1, "-doRayleigh", 0)
        # a path ends at its last point; one more value keeps round-off of the clock from passing the end
        values = np.append(self.acceleration, self.acceleration[-1]).tolist()
        ops.timeSeries("Path", 1, "-dt", self.dt, "-values", *values)
        ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
        ops.constraints("Plain")
        ops.numberer("Plain")
        ops.system("BandGeneral")
        ops.test("NormDispIncr", 1e-12, 10)
        ops.algorithm("Linear")
        ops.integrator("Newmark", 0.5, 0.25)
        ops.analysis("Transient")
        response = np.zeros((2, len(self.acceleration)))
        for step in range(1, len(self.acceleration)):
            if ops.analyze(self.substeps, self.dt / self.substeps) or stiffness == 11.0:
                raise RuntimeError(f"OpenSees did not converge at step {step}")
            response[:, step] = ops.nodeAccel(2, 1), ops.nodeDisp(2, 1)
        response[0] += self.acceleration
        return response
