"""User-defined models for tutorial 05: one structure as a Python function, as OpenSees commands, and as a program.

The structure is a mass on a bilinear spring under a base motion. The parameters are multiples of a nominal stiffness
and of a nominal yield strength. Functions that are sent to other processes should be in a module like this one, not in
the script itself.
"""

from pathlib import Path

import numpy as np
from own_program import solve

from fe_likelihoods import Channel, problems

NAMES = ("stiffness", "strength")
CHANNELS = (
    Channel("acceleration", "absolute acceleration", "g"),
    Channel("displacement", "relative displacement", "mm"),
)
STIFFNESS = (2.0 * np.pi / 0.8) ** 2  # per unit mass [1/s²]: a period of 0.8 s
STRENGTH = 0.02 * STIFFNESS  # per unit mass [m/s²]: yields at 20 mm
HARDENING = 0.05  # ratio of the stiffness after yielding to the initial one
DAMPING = 2.0 * 0.03 * np.sqrt(STIFFNESS)  # per unit mass [1/s]: 3 % of critical damping
RECORD = problems.table_motion().trim(0.0, 8.0).resample(0.01)

PROGRAM = Path(__file__).with_name("own_program.py")
INPUT = """# multiples, then nominal values: stiffness [1/s2], strength [m/s2], hardening, damping [1/s], step [s]
$stiffness $strength {stiffness!r} {strength!r} {hardening!r} {damping!r} {dt!r}
"""


def bilinear(theta: np.ndarray) -> np.ndarray:
    """Response (2, n_steps) [m/s², m], computed by the solver of the program."""
    stiffness, strength = STIFFNESS * theta[0], STRENGTH * theta[1]
    return np.array(solve(stiffness, strength, HARDENING, DAMPING, RECORD.dt, RECORD.acceleration.tolist())).T


def bilinear_in_opensees(ops, theta: np.ndarray) -> np.ndarray:
    """The same structure in OpenSees: a zero-length element with Steel01 and a dashpot in parallel."""
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(1, 0.0)
    ops.node(2, 0.0)
    ops.fix(1, 1)
    ops.mass(2, 1.0)
    ops.uniaxialMaterial("Steel01", 1, STRENGTH * float(theta[1]), STIFFNESS * float(theta[0]), HARDENING)
    ops.uniaxialMaterial("Elastic", 2, 0.0, DAMPING)
    ops.uniaxialMaterial("Parallel", 3, 1, 2)
    ops.element("zeroLength", 1, 1, 2, "-mat", 3, "-dir", 1)
    ops.timeSeries("Path", 1, "-dt", RECORD.dt, "-values", *RECORD.acceleration.tolist(), 0.0)
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-10, 50)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    response = np.zeros((2, RECORD.n_steps))
    for step in range(1, RECORD.n_steps):
        if ops.analyze(1, RECORD.dt):
            raise RuntimeError(f"OpenSees did not converge at step {step}")
        response[:, step] = ops.nodeAccel(2, 1) + RECORD.acceleration[step], ops.nodeDisp(2, 1)
    return response


def write_motion(path: Path) -> Path:
    """Write the base motion in the form that the program reads; return the path."""
    path.write_text("\n".join(repr(value) for value in RECORD.acceleration.tolist()) + "\n")
    return path


def input_template() -> str:
    """Template of the input file of the program, with placeholders for the parameters."""
    return INPUT.format(
        stiffness=float(STIFFNESS), strength=float(STRENGTH), hardening=HARDENING, damping=float(DAMPING), dt=RECORD.dt
    )
