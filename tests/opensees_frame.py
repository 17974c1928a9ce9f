"""A two-storey steel frame of fiber beams in OpenSees, as a user writes it: the model of someone else's posterior.

Force-based elements with wide-flange fiber sections of Steel02, columns on rotational springs, Rayleigh damping of the
stiffness, Newmark's average acceleration. All dimensions are **assumed**. The five parameters are multiples of
nominal values. Every run has its own process, and two runs are made at a time. The data are synthetic: the response
at `TRUTH` with white noise of 10 % of each channel's root mean square.
"""

import functools
import importlib.util

import numpy as np

from fe_likelihoods import (
    Channel,
    FELikelihood,
    HalfNormal,
    LogNormal,
    Measurements,
    OpenSeesModel,
    Posterior,
    Record,
    TruncatedNormal,
    problems,
)

__all__ = ["NAMES", "TRUTH", "frame", "missing", "posterior"]

NAMES = ("E", "fy", "hardening", "damping", "base")
TRUTH = (0.95, 1.1, 1.3, 0.8, 1.4)
CHANNELS = (
    Channel("roof_acceleration", "absolute acceleration", "g"),
    Channel("first_floor", "relative displacement", "mm"),
)
E, FY, HARDENING = 200e9, 345e6, 0.02  # Pa, Pa, -
DAMPING = 0.03  # of critical, at the first frequency
BASE = 6.0e7  # rotational stiffness at the foot of a column [N m]
SCALE = 5.0  # of the motion: the columns yield
HEIGHT, SPAN, MASS = 3.6, 7.0, 30e3  # m, m, kg per floor
FIRST_FREQUENCY = 2.0 * np.pi * 1.4  # rad/s, of the nominal frame, about
COLUMN, BEAM = (0.36, 0.010, 0.30, 0.018), (0.40, 0.009, 0.18, 0.0135)  # depth, web, width, flange [m]


@functools.cache
def ground() -> Record:
    """Twelve seconds of the bundled motion at 50 Hz, scaled."""
    whole = problems.bridge_column_data().record
    middle = whole.time[np.searchsorted(np.cumsum(whole.acceleration**2), 0.4 * np.sum(whole.acceleration**2))]
    start = max(0.0, float(middle) - 5.0)
    return whole.trim(start, start + 12.0).resample(0.02).scale(SCALE)


def frame(ops, theta: np.ndarray) -> np.ndarray:
    """Response (2, n_steps): absolute acceleration of the roof [m/s²], displacement of the first floor [m]."""
    modulus, strength, hardening, damping, base = theta.tolist()
    motion = ground()
    ops.model("basic", "-ndm", 2, "-ndf", 3)
    for side, x in ((1, 0.0), (2, SPAN)):
        ops.node(side, x, 0.0)
        ops.fix(side, 1, 1, 1)
        for floor in range(3):
            ops.node(10 * side + floor, x, floor * HEIGHT)
            if floor:
                ops.mass(10 * side + floor, 0.5 * MASS, 0.5 * MASS, 1.0)
        ops.equalDOF(side, 10 * side, 1, 2)
    ops.uniaxialMaterial("Steel02", 1, FY * strength, E * modulus, HARDENING * hardening, 18.0, 0.925, 0.15)
    ops.uniaxialMaterial("Elastic", 2, BASE * base)
    for tag, section in ((1, COLUMN), (2, BEAM)):
        ops.section("WFSection2d", tag, 1, *section, 8, 2)
        ops.beamIntegration("Lobatto", tag, tag, 5)
    ops.geomTransf("PDelta", 1)
    ops.geomTransf("Linear", 2)
    for side in (1, 2):
        ops.element("zeroLength", side, side, 10 * side, "-mat", 2, "-dir", 6)
        for floor in range(2):
            ops.element("forceBeamColumn", 10 * side + floor, 10 * side + floor, 10 * side + floor + 1, 1, 1)
    for floor in (1, 2):
        ops.element("forceBeamColumn", 100 + floor, 10 + floor, 20 + floor, 2, 2)
    ops.timeSeries("Linear", 1)
    ops.pattern("Plain", 1, 1)
    for side in (1, 2):
        for floor in (1, 2):
            ops.load(10 * side + floor, 0.0, -0.5 * MASS * 9.81, 0.0)
    ops.constraints("Transformation")
    ops.numberer("RCM")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-9, 30)
    ops.algorithm("Newton")
    ops.integrator("LoadControl", 1.0)
    ops.analysis("Static")
    if ops.analyze(1):
        raise RuntimeError("OpenSees did not converge under the weight")
    ops.loadConst("-time", 0.0)
    ops.wipeAnalysis()
    ops.rayleigh(0.0, 0.0, 2.0 * DAMPING * damping / FIRST_FREQUENCY, 0.0)
    ops.timeSeries("Path", 2, "-dt", motion.dt, "-values", *motion.acceleration.tolist(), 0.0)
    ops.pattern("UniformExcitation", 2, 1, "-accel", 2)
    ops.constraints("Transformation")
    ops.numberer("RCM")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-9, 30)
    ops.algorithm("Newton")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    response = np.zeros((2, motion.n_steps))
    for step in range(1, motion.n_steps):
        if ops.analyze(1, motion.dt):
            raise RuntimeError(f"OpenSees did not converge at step {step}")
        response[:, step] = ops.nodeAccel(12, 1) + motion.acceleration[step], ops.nodeDisp(11, 1)
    return response


def model() -> OpenSeesModel:
    """The frame as a model."""
    return OpenSeesModel(
        frame, NAMES, CHANNELS, ground().dt, ground().n_steps, version=f"two-storey frame {ground().fingerprint}"
    )


def posterior(seed: int) -> Posterior:
    """Posterior given the response at `TRUTH` with noise of a seed; sigmas integrated out."""
    structure = model()
    clean = structure.simulate(np.array(TRUTH))
    rms = np.sqrt(np.square(clean).mean(axis=1, keepdims=True))
    values = clean + 0.1 * rms * np.random.default_rng(seed).standard_normal(clean.shape)
    prior = {
        "E": TruncatedNormal(1.0, 0.1),
        "fy": TruncatedNormal(1.0, 0.15),
        "hardening": LogNormal(1.0, 0.5),
        "damping": LogNormal(1.0, 0.5),
        "base": LogNormal(1.0, 0.7),
    }
    prior |= {f"sigma_{c.name}": HalfNormal(float(scale)) for c, scale in zip(CHANNELS, rms[:, 0], strict=True)}
    measured = Measurements(CHANNELS, structure.dt, values, f"SYNTHETIC, seed {seed}")
    return Posterior(FELikelihood(structure, measured, pool=2), prior).marginal()


def missing() -> str:
    """Why the problem cannot be run, or an empty string."""
    return "" if importlib.util.find_spec("openseespy") else "openseespy is missing: pip install openseespy"
