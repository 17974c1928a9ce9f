"""Models of tall buildings against eigenvalue solutions and the shear frame."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh

from fe_likelihoods import (
    LinearStructure,
    ModalModel,
    Record,
    ShearFrame,
    SimulationFailed,
)

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
    assert two.structure.assemble(kept).direct[:, 0] == pytest.approx(1.0 - shapes[:, :2].sum(axis=1))


def test_groups_are_the_frame_with_equal_factors(record):
    groups = [1, 1, 1, 2, 2, 3]
    frame = LinearStructure(ShearFrame(FLOORS, MASSES, STIFFNESSES), record)
    grouped = LinearStructure(ShearFrame(FLOORS, MASSES, STIFFNESSES, groups), record)
    assert grouped.parameter_names == ("stiffness_1", "stiffness_2", "stiffness_3", "damping")
    expected = frame.simulate([1.1, 1.1, 1.1, 0.8, 0.8, 1.3] + [0.03] * N)
    np.testing.assert_array_equal(grouped.simulate([1.1, 0.8, 1.3, 0.03]), expected)


@pytest.mark.parametrize(
    ("parts", "theta", "words"),
    [
        (ModalModel(["roof"], 2), [1.0, 0.9, 0.02, 0.02, 1.0, 0.1], "ascending; they are 1, 0.9 Hz"),
        (ModalModel(["roof"], 1), [-1.0, 0.02, 1.0], "positive and ascending"),
        (ModalModel(["roof"], 1), [1.0, 0.0, 1.0], "damping ratios must be positive"),
        (ShearFrame({"roof": 2}, [1, 1], [9, 9], [1, 1]), [1.0, -0.1], "not positive: damping"),
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
        (lambda: ShearFrame({"roof": 2}, [1, 1], [9, 9], [1, 3]), "without gaps; got"),
        (lambda: ShearFrame({"roof": 2}, [1, 1], [9, 9], [1]), "each of 2 storeys"),
        (lambda: ShearFrame({"roof": 3}, [1, 1], [9, 9], [1, 1]), "floors from 1 to 2"),
    ],
)
def test_wrong_arguments_are_rejected(make, words):
    with pytest.raises(ValueError, match=words):
        make()
