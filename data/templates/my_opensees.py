"""A model in OpenSees: a mass on a bilinear spring with a damper under a base motion."""

import math

import numpy as np

STIFFNESS = (2.0 * math.pi / 0.8) ** 2  # per unit mass [1/s²]: a period of 0.8 s
STRENGTH = 0.02 * STIFFNESS  # per unit mass [m/s²]: yields at 20 mm
HARDENING = 0.05  # ratio of the stiffness after yielding to the initial one
DAMPING = 2.0 * 0.03 * math.sqrt(STIFFNESS)  # per unit mass [1/s]: 3 % of critical damping
SUBSTEPS = 4  # per step of the record: with one, the period is longer than that of the equations


def simulate(ops, theta, record):
    """Build and run the model.

    Parameters
    ----------
    ops : module
        ``openseespy.opensees``, wiped.
    theta : (2,) float
        Multiples of the nominal stiffness and strength, in the order of `parameters` in the TOML file.
    record : Record
        Base motion: `record.acceleration` [m/s²] at the step `record.dt` [s].

    Returns
    -------
    (2, n_steps) float
        Absolute acceleration [m/s²] and relative displacement [m]: SI units, one row per channel.
    """
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(1, 0.0)
    ops.node(2, 0.0)
    ops.fix(1, 1)
    ops.mass(2, 1.0)
    ops.uniaxialMaterial("Steel01", 1, STRENGTH * float(theta[1]), STIFFNESS * float(theta[0]), HARDENING)
    ops.uniaxialMaterial("Elastic", 2, 0.0, DAMPING)
    ops.uniaxialMaterial("Parallel", 3, 1, 2)
    ops.element("zeroLength", 1, 1, 2, "-mat", 3, "-dir", 1)
    ops.timeSeries("Path", 1, "-dt", record.dt, "-values", *record.acceleration.tolist(), 0.0)
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-10, 50)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    response = np.zeros((2, record.n_steps))
    for step in range(1, record.n_steps):
        if ops.analyze(SUBSTEPS, record.dt / SUBSTEPS):  # OpenSees itself only prints a message
            raise RuntimeError(f"OpenSees did not converge at step {step}")
        response[:, step] = ops.nodeAccel(2, 1) + record.acceleration[step], ops.nodeDisp(2, 1)
    return response
