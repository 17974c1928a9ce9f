"""Models of tall buildings against eigenvalue solutions, the shear frame, beam elements, and OpenSees."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh

from fe_likelihoods import (
    EquivalentLinear,
    GroupedFrame,
    LinearStructure,
    ModalModel,
    Record,
    ShearFlexuralBeam,
    ShearFrame,
    SimulationFailed,
)
from fe_likelihoods.models.tall_buildings import beam_modes
from tests.opensees_column import require_opensees

DT, N = 0.02, 6
FLOORS = {"middle": 3, "roof": 6}
MASSES, STIFFNESSES = [1.2, 1.0, 1.0, 1.0, 1.0, 0.8], [900.0, 900.0, 800.0, 700.0, 600.0, 500.0]


@pytest.fixture
def record(rng) -> Record:
    return Record("base", DT, rng.normal(size=500))


@pytest.fixture
def modes():
    """Angular frequencies, and effective shapes (floors of FLOORS, modes), of the nominal frame."""
    system = ShearFrame(FLOORS, MASSES, STIFFNESSES).assemble(np.array([1.0] * N + [0.02] * N))
    squares, vectors = eigh(system.stiffness, system.mass)
    participation = vectors.T @ system.mass @ np.ones(N)
    return np.sqrt(squares), (vectors * participation)[[2, 5]]


def close(ours, theirs, tolerance=1e-10):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max())


def test_all_modes_of_a_frame_are_the_frame(record, modes):
    frequencies, shapes = modes
    ratios = np.linspace(0.01, 0.06, N)
    frame = LinearStructure(ShearFrame(FLOORS, MASSES, STIFFNESSES), record)
    model = LinearStructure(ModalModel(["middle", "roof"], N), record)
    assert model.parameter_names[-N:] == tuple(f"shape_roof_{k}" for k in range(1, N + 1))
    theta = np.concatenate([frequencies / (2 * math.pi), ratios, shapes.ravel()])
    close(model.simulate(theta), frame.simulate([1.0] * N + ratios.tolist()))


def test_modes_that_are_left_out_move_with_the_base(record, modes):
    """Two modes of six equal six modes of which four are made 1000 times stiffer."""
    frequencies, shapes = modes
    two = LinearStructure(ModalModel(["middle", "roof"], 2), record)
    kept = np.concatenate([frequencies[:2] / (2 * math.pi), [0.02] * 2, shapes[:, :2].ravel()])
    stiff = np.concatenate([frequencies[:2], 1e3 * frequencies[2:]]) / (2 * math.pi)
    every = LinearStructure(ModalModel(["middle", "roof"], N), record)
    theta = np.concatenate([stiff, [0.02] * 2, [0.7] * 4, shapes.ravel()])
    close(two.simulate(kept)[:, 5:], every.simulate(theta)[:, 5:], 1e-3)
    assert two.parts.assemble(kept).direct[:, 0] == pytest.approx(1.0 - shapes[:, :2].sum(axis=1))


def test_groups_are_the_frame_with_equal_factors(record):
    groups = [1, 1, 1, 2, 2, 3]
    frame = LinearStructure(ShearFrame(FLOORS, MASSES, STIFFNESSES), record)
    grouped = LinearStructure(GroupedFrame(FLOORS, MASSES, STIFFNESSES, groups), record)
    assert grouped.parameter_names == ("stiffness_1", "stiffness_2", "stiffness_3", "damping")
    expected = frame.simulate([1.1, 1.1, 1.1, 0.8, 0.8, 1.3] + [0.03] * N)
    np.testing.assert_array_equal(grouped.simulate([1.1, 0.8, 1.3, 0.03]), expected)


def test_rayleigh_damping_has_the_ratios_of_its_modes():
    parts = GroupedFrame(FLOORS, MASSES, STIFFNESSES, [1] * N, rayleigh=(1, 3))
    assert parts.parameter_names == ("stiffness_1", "damping_1", "damping_3")
    system = parts.assemble(np.array([1.3, 0.02, 0.05]))
    squares, vectors = eigh(system.stiffness, system.mass)
    modal = vectors.T @ system.damping @ vectors
    ratios = np.diag(modal) / (2 * np.sqrt(squares))
    close(modal, np.diag(np.diag(modal)))
    assert ratios[[0, 2]] == pytest.approx([0.02, 0.05])
    a, b = np.linalg.lstsq(np.stack([0.5 / np.sqrt(squares), 0.5 * np.sqrt(squares)], axis=1), ratios, rcond=None)[0]
    close(system.damping, a * system.mass + b * system.stiffness)
    with pytest.raises(SimulationFailed, match="another mode negative"):
        GroupedFrame(FLOORS, MASSES, STIFFNESSES, [1] * N, rayleigh=(1, 2)).assemble(np.array([1.0, 0.2, 0.01]))


def test_rayleigh_frame_equals_opensees():
    """OpenSees steps by Newmark's average acceleration, whose error falls with the square of the step."""
    require_opensees()
    import openseespy.opensees as ops

    time = DT * np.arange(400)
    motion = np.sin(3.0 * time) * np.sin(0.4 * time) ** 2
    parts = GroupedFrame({"roof": N}, MASSES, STIFFNESSES, [1, 1, 1, 2, 2, 2], rayleigh=(1, 2))
    theta = np.array([1.2, 0.8, 0.03, 0.05])
    (ours,) = LinearStructure(parts, Record("pulse", DT, motion)).simulate(theta)
    system = parts.assemble(theta)
    w1, w2 = np.sqrt(eigh(system.stiffness, system.mass, eigvals_only=True)[:2])
    factors = np.linalg.solve([[0.5 / w1, 0.5 * w1], [0.5 / w2, 0.5 * w2]], theta[2:])
    assert np.abs(ours - motion).max() > 0.2 * np.abs(ours).max(), "control: the frame is not rigid"
    errors = [np.abs(_opensees_roof(ops, motion, factors, substeps) - ours).max() for substeps in (4, 8, 16)]
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 4.0, rtol=0.05)
    assert errors[-1] < 1e-3 * np.abs(ours).max()


def _opensees_roof(ops, motion: np.ndarray, rayleigh: np.ndarray, substeps: int) -> np.ndarray:
    """Absolute acceleration of the roof with a number of steps per sample."""
    ops.wipe()
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.node(0, 0.0)
    ops.fix(0, 1)
    for i, (mass, stiffness, factor) in enumerate(zip(MASSES, STIFFNESSES, [1.2] * 3 + [0.8] * 3, strict=True), 1):
        ops.node(i, 0.0)
        ops.mass(i, mass)
        ops.uniaxialMaterial("Elastic", i, factor * stiffness)
        ops.element("zeroLength", i, i - 1, i, "-mat", i, "-dir", 1, "-doRayleigh", 1)
    ops.rayleigh(*rayleigh.tolist(), 0.0, 0.0)
    ops.timeSeries("Path", 1, "-dt", DT, "-values", *motion.tolist(), motion[-1])
    ops.pattern("UniformExcitation", 1, 1, "-accel", 1)
    ops.constraints("Plain")
    ops.numberer("Plain")
    ops.system("BandGeneral")
    ops.algorithm("Linear")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.analysis("Transient")
    response = np.zeros(len(motion))
    for k in range(1, len(motion)):
        assert ops.analyze(substeps, DT / substeps) == 0
        response[k] = ops.nodeAccel(N, 1) + motion[k]
    ops.wipe()
    return response


def beam_elements(alpha: float, n: int, stations: list[int], n_modes: int):
    """Frequency ratios and effective shapes of a cantilever of n cubic elements of flexural and shear stiffness."""
    h, size = 1.0 / n, 2 * n + 2
    bending = np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]]
        + [[-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
    )
    shear = np.array(
        [[36, 3 * h, -36, 3 * h], [3 * h, 4 * h * h, -3 * h, -h * h]]
        + [[-36, -3 * h, 36, -3 * h], [3 * h, -h * h, -3 * h, 4 * h * h]]
    )
    inertia = np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h]]
        + [[54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]]
    )
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for e in range(n):
        at = slice(2 * e, 2 * e + 4)
        stiffness[at, at] += bending / h**3 + alpha**2 * shear / (30.0 * h)
        mass[at, at] += h * inertia / 420.0
    squares, vectors = eigh(stiffness[2:, 2:], mass[2:, 2:], subset_by_index=[0, n_modes - 1])
    unit = np.zeros(size)
    unit[::2] = 1.0  # rigid translation
    participation = vectors.T @ (mass @ unit)[2:]
    rows = [2 * (station - 1) for station in stations]
    return np.sqrt(squares / squares[0]), (vectors * participation)[rows]


@pytest.mark.parametrize("alpha", [0.0, 0.5, 4.0, 30.0])
def test_modes_of_the_shear_flexural_beam_by_finite_elements(alpha):
    ratios, shapes = beam_elements(alpha, 80, [40, 60, 80], 6)
    found = beam_modes(alpha, 6, np.array([0.5, 0.75, 1.0]))
    np.testing.assert_allclose(found.frequency_ratios, ratios, rtol=3e-5)
    np.testing.assert_allclose(found.shapes, shapes, rtol=0, atol=3e-5)


def test_limits_of_the_shear_flexural_beam():
    """alpha = 0: cos x cosh x = -1 (Blevins 1979, table 8-1); large alpha: frequencies 1, 3, 5 of a shear beam."""
    roots = np.array([1.87510407, 4.69409113, 7.85475744])
    top = np.array([1.0])
    np.testing.assert_allclose(beam_modes(0.0, 3, top).frequency_ratios, (roots / roots[0]) ** 2, rtol=1e-8)
    shear = beam_modes(1000.0, 3, top)
    np.testing.assert_allclose(shear.frequency_ratios, [1.0, 3.0, 5.0], rtol=1e-4)
    np.testing.assert_allclose(shear.shapes[0], 4.0 / np.pi * np.array([1.0, -1.0 / 3.0, 1.0 / 5.0]), rtol=2e-3)
    many = beam_modes(3.0, 50, np.array([0.4, 1.0])).shapes.cumsum(axis=1)
    np.testing.assert_allclose(many[:, -1], 1.0, atol=0.02)  # shapes add to 1
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        assert np.isfinite(beam_modes(1000.0, 50, top).shapes).all()


@pytest.mark.parametrize("alpha", [0.0, 1e-6, 0.5, 6.0, 30.0, 1000.0])
def test_mode_shapes_are_orthogonal_with_the_effective_masses_as_squares(alpha):
    """The shapes s_k = phi_k int phi_k / int phi_k^2 have int s_j s_k = 0, and int s_k^2 = int s_k, the modal mass."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    shapes, weights = beam_modes(alpha, 20, 0.5 * (nodes + 1.0)).shapes, 0.5 * weights
    np.testing.assert_allclose(shapes.T * weights @ shapes, np.diag(weights @ shapes), atol=1e-12)
    assert 0.95 < (weights @ shapes).sum() < 1.0


def test_the_beam_is_the_limit_of_a_frame_with_many_storeys(record):
    """A shear frame of n equal storeys tends to the shear beam; the error of its frequencies is of second order."""
    n, alpha = 60, 1000.0
    frame = ShearFrame({"roof": n}, [1.0] * n, [1e5] * n)
    system = frame.assemble(np.array([1.0] * n + [0.05] * n))
    first = math.sqrt(eigh(system.stiffness, system.mass, eigvals_only=True)[0])
    beam = LinearStructure(ShearFlexuralBeam({"roof": 1.0}, n_modes=20), record)
    smooth = record.resample(0.1).resample(DT)  # without motion above the frequencies that both have
    expected = LinearStructure(frame, smooth).simulate([1.0] * n + [0.05] * n)
    close(beam.with_record(smooth).simulate([first / (2 * math.pi), alpha, 0.05]), expected, 0.03)


def test_the_level_of_a_modal_building_is_that_of_its_sensor(record):
    """The modes are no displacements; the equivalent-linear level is that of the channel and equals the frame's."""
    frame = ShearFrame(FLOORS, MASSES, STIFFNESSES)
    frame_parts = EquivalentLinear(frame, 0.01, "roof")
    system = frame.assemble(np.array([1.0] * N + [0.03] * N))
    squares, vectors = eigh(system.stiffness, system.mass)
    shapes = (vectors * (vectors.T @ system.mass @ np.ones(N)))[[2, 5]]
    modal_parts = EquivalentLinear(ModalModel(["middle", "roof"], N), 0.01, "roof")
    theta = np.concatenate([np.sqrt(squares) / (2 * math.pi), [0.03] * N, shapes.ravel(), [0.2, 0.3]])
    acceleration = record.acceleration[None]
    expected = frame_parts.settle(np.array([1.0] * N + [0.03] * N + [0.2, 0.3]), acceleration, DT).level
    assert modal_parts.settle(theta, acceleration, DT).level == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("parts", "theta", "words"),
    [
        (ModalModel(["roof"], 2), [1.0, 0.9, 0.02, 0.02, 1.0, 0.1], "ascending; they are 1, 0.9 Hz"),
        (ModalModel(["roof"], 1), [-1.0, 0.02, 1.0], "positive and ascending"),
        (ModalModel(["roof"], 1), [1.0, 0.0, 1.0], "damping ratios must be positive"),
        (GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1, 1]), [1.0, -0.1], "not positive: damping"),
        (ShearFlexuralBeam({"roof": 1.0}), [0.2, -1.0, 0.02], "alpha from 0 to 1000"),
        (ShearFlexuralBeam({"roof": 1.0}), [0.2, 1.0, math.nan], "must be positive"),
    ],
)
def test_impossible_parameters_fail_with_reasons(record, parts, theta, words):
    with pytest.raises(SimulationFailed, match=words):
        LinearStructure(parts, record).simulate(theta)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ModalModel([], 2), "names of one or more channels"),
        (lambda: ModalModel("roof", 2), "names of one or more channels"),
        (lambda: ModalModel(["roof"], 0), "between 1 and 50"),
        (lambda: GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1, 3]), "without gaps; got"),
        (lambda: GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1]), "each of 2 storeys"),
        (lambda: GroupedFrame({"roof": 3}, [1, 1], [9, 9], [1, 1]), "floors from 1 to 2"),
        (lambda: GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1, 1], rayleigh=(1, 3)), "two different modes from 1 to 2"),
        (lambda: ShearFlexuralBeam({"roof": 1.2}), "shares of that of the building"),
        (lambda: ShearFlexuralBeam({"roof": 1.0}, 2.5), "n_modes of a ShearFlexuralBeam"),
    ],
)
def test_wrong_arguments_are_rejected(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_fingerprints_differ(record):
    parts = [
        ModalModel(["roof"], 2),
        ModalModel(["roof"], 3),
        GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1, 1]),
        GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1, 2]),
        GroupedFrame({"roof": 2}, [1, 1], [9, 9], [1, 1], (1, 2)),
        ShearFlexuralBeam({"roof": 1.0}),
        ShearFlexuralBeam({"roof": 0.9}),
    ]
    assert len({LinearStructure(each, record).fingerprint for each in parts}) == len(parts)
