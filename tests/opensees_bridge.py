"""The isolated bridge built in OpenSees, a peer for tests and benchmarks.

It has beams for the piers, rigid links for the blocks, flat slider bearings with velocity-dependent friction, elastic
springs of odd powers for the rubber and Maxwell dampers. Newmark's average acceleration integrates the equations. The
sliders stick as springs of stiffness fmin W / Y and slip at the friction of the current velocity (elastic-plastic
law). OpenSees has no element for the half loop of the rubber, whose width grows with displacement, so a bridge with a
half loop is refused.

OpenSees has one model per process and may end that process. Each run therefore starts a process
``python -m tests.opensees_bridge JOB RESULT`` and reads its result file.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:  # the process that runs OpenSees does not have to import scipy and numba
    from .scipy_bridge import Definition

__all__ = ["Run", "run"]

GRAVITY = 9.81  # m/s2
MAX_ITERATIONS = 50
STIFF = 1e10  # N/m: the bearings along the vertical
DECK, SECOND = 100, 200  # nodes of the deck, and offset of the numbers of pier 2 from those of pier 1
BASE, TIP, CENTRE, TOP = 1, 2, 3, 4  # nodes of pier 1
BEAM, SLIDER, RUBBER, DAMPER = 1, 2, 3, 4  # its elements


class Run(NamedTuple):
    """Result of one run."""

    response: np.ndarray  # (12, n), rows as `scipy_bridge.CHANNELS` [SI]; shorter if OpenSees did not converge
    seconds: float  # CPU time of the analysis alone


def run(
    bridge: Definition,
    acceleration: np.ndarray,
    dt: float,
    *,
    step: float,
    tolerance: float = 1e-10,
) -> Run:
    """Simulate the bridge, at its parameters and without half loop (``loop=(0.0,)``), from rest.

    `acceleration` (n,) is the table's [m/s²], `dt` the step of the samples and of the response [s], `step` the
    integration step [s], which divides `dt`, and `tolerance` the norm of the last displacement increment [m and rad].
    """
    if any(bridge.loop):
        raise ValueError(f"OpenSees has no half loop for the rubber: expected loop=(0.0,); got {bridge.loop}")
    stride = round(dt / step)
    if abs(stride * step - dt) > 1e-9 * dt:
        raise ValueError(f"expected a step that divides the record's {dt} s; got {step} s")
    values = {name: getattr(bridge, name) for name in bridge._fields}
    values |= {"retardation": bridge.stiffness_damping, "stiffness": bridge.stiffness}
    job = (values, np.asarray(acceleration, dtype=float), float(dt), stride, tolerance)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / "job", Path(folder) / "result"]
        paths[0].write_bytes(pickle.dumps(job))
        command = [sys.executable, "-m", "tests.opensees_bridge", *map(str, paths)]
        done = subprocess.run(command, cwd=Path(__file__).resolve().parents[1], capture_output=True, text=True)
        if not paths[1].exists():
            raise RuntimeError(f"OpenSees ended with code {done.returncode}: {done.stderr[-2000:]}")
        return Run(*pickle.loads(paths[1].read_bytes()))


def _pier(ops, b: dict, i: int) -> None:
    """Build pier `i` with its block, and the isolators between the block and node DECK + i of the deck."""
    n = SECOND * i
    deck = DECK + i
    heights = {BASE: 0.0, TIP: b["length"], CENTRE: b["length"] + b["centre"], TOP: b["length"] + b["height"]}
    for node, z in heights.items():
        ops.node(n + node, 10.0 * i, z)
    ops.node(deck, 10.0 * i, heights[TOP])
    ops.fix(n + BASE, 1, 1, 1)
    ops.fix(deck, 0, 0, 1)
    ops.mass(n + CENTRE, b["mass"], 0.0, b["rotary"])
    # the tip is free vertically: OpenSees 3.7 gives wrong supports if the leading node of a rigid link is fixed
    ops.rigidLink("beam", n + TIP, n + CENTRE)
    ops.rigidLink("beam", n + TIP, n + TOP)
    ops.geomTransf("Linear", 1 + i)
    ops.element("elasticBeamColumn", n + BEAM, n + BASE, n + TIP, 1.0, b["modulus"], b["inertia"], 1 + i)
    ops.region(1 + i, "-ele", n + BEAM, "-rayleigh", 0.0, 0.0, b["retardation"], 0.0)

    weight, slow, rise, rate = (b[name][i] for name in ("weight", "slow", "rise", "rate"))
    ops.uniaxialMaterial("Elastic", n + 1, STIFF)
    ops.uniaxialMaterial("Elastic", n + 2, 0.0)
    ops.frictionModel("VelDependent", 1 + i, slow, slow + rise, rate)
    stick = slow * weight / b["slip"]
    # oriented from the deck down, so that the moment of the eccentric weight stays with the deck, as in the model
    down = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0)
    materials = ("-P", n + 1, "-Mz", n + 2)
    ops.element("flatSliderBearing", n + SLIDER, deck, n + TOP, 1 + i, stick, *materials, "-orient", *down)

    powers = [2 * k + 1 for k in range(len(b["rubber"]))]
    coefficients = [a / b["rubber_length"] ** p for a, p in zip(b["rubber"], powers, strict=True)]
    ops.uniaxialMaterial("ElasticPowerFunc", n + 3, "-coeff", *coefficients, "-exp", *powers)
    ops.element("zeroLength", n + RUBBER, n + TOP, deck, "-mat", n + 3, "-dir", 1)
    spring, dashpot = b["dampers"] * b["spring"][i], b["dampers"] * b["dashpot"][i]
    ops.uniaxialMaterial("ViscousDamper", n + 4, spring, dashpot, 1.0)
    ops.element("zeroLength", n + DAMPER, n + TOP, deck, "-mat", n + 4, "-dir", 1)


def _analysis(ops, integrator: tuple, kind: str, tolerance: float) -> None:
    ops.wipeAnalysis()
    ops.constraints("Transformation")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", tolerance, MAX_ITERATIONS)
    ops.algorithm("Newton")
    ops.integrator(*integrator)
    ops.analysis(kind)


def _shake(ops, b: dict, acceleration: np.ndarray, dt: float, stride: int, tolerance: float, folder: Path) -> Run:
    ops.wipe()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    for i in range(2):
        _pier(ops, b, i)
    ops.equalDOF(DECK, DECK + 1, 1)
    ops.mass(DECK, b["deck_weight"] / GRAVITY, 0.0, 0.0)
    ops.timeSeries("Linear", 1)
    ops.pattern("Plain", 1, 1)
    for i in range(2):
        ops.load(DECK + i, 0.0, -b["weight"][i], 0.0)
    _analysis(ops, ("LoadControl", 1.0), "Static", tolerance)
    if ops.analyze(1):
        raise RuntimeError("OpenSees did not converge under gravity")
    ops.loadConst("-time", 0.0)

    # a path ends at its last point; one more value keeps round-off of the clock from passing the end
    values = np.append(acceleration, acceleration[-1]).tolist()
    ops.timeSeries("Path", 2, "-dt", dt, "-values", *values)
    ops.pattern("UniformExcitation", 2, 1, "-accel", 2)
    tips, tops = (TIP, SECOND + TIP), (TOP, SECOND + TOP)
    isolators = [SECOND * i + k for i in range(2) for k in (SLIDER, RUBBER, DAMPER)]
    files = {name: str(folder / name) for name in ("beams", "deck", "blocks", "absolute", "isolators")}
    ops.recorder("Node", "-binary", files["beams"], "-node", *tips, "-dof", 1, 3, "disp")
    ops.recorder("Node", "-binary", files["blocks"], "-node", *tops, "-dof", 1, "disp")
    ops.recorder("Node", "-binary", files["deck"], "-node", DECK, "-dof", 1, "disp")
    # with the time series, accelerations are absolute
    ops.recorder("Node", "-binary", files["absolute"], "-timeSeries", 2, "-node", DECK, *tops, "-dof", 1, "accel")
    ops.recorder("Element", "-binary", files["isolators"], "-ele", *isolators, "force")
    _analysis(ops, ("Newmark", 0.5, 0.25), "Transient", tolerance)
    start = time.process_time()
    ops.analyze(stride * (len(acceleration) - 1), dt / stride)
    seconds = time.process_time() - start
    ops.wipe()  # closes the files
    parts = {name: _read(file, count) for (name, file), count in zip(files.items(), (4, 1, 2, 3, 36), strict=True)}
    beams, deck, blocks, absolute, forces = (part[stride - 1 :: stride].T for part in parts.values())
    at_rest = np.zeros((12, 1))
    at_rest[8:10] = at_rest[11] = acceleration[0]
    stiffness = b["stiffness"]
    # rotations have opposite signs in OpenSees and in the bridge
    shears = stiffness[0, 0] * beams[0::2] - stiffness[0, 1] * beams[1::2]
    # three elements per isolator with six forces each, of which the one along x on the node of the block is needed
    on_block = -forces.reshape(2, 3, 6, -1)[:, [0, 1, 2], [3, 0, 0]].sum(axis=1)
    rows = [deck - blocks, on_block, blocks, shears, absolute[1:], deck, absolute[:1]]
    return Run(np.hstack([at_rest, np.concatenate(rows)]), seconds)


def _read(file: str, count: int) -> np.ndarray:
    """Read the file of a binary recorder, (n, count); a byte ends each line."""
    return np.fromfile(file, dtype=[("values", float, (count,)), ("end", "u1")])["values"]


def main() -> None:
    """Run one job; the arguments are the file of the job and the file for the result."""
    import openseespy.opensees as ops

    result = Path(sys.argv[2])
    done = _shake(ops, *pickle.loads(Path(sys.argv[1]).read_bytes()), result.parent)
    result.write_bytes(pickle.dumps(tuple(done)))


if __name__ == "__main__":
    main()
