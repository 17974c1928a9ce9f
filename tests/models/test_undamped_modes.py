"""Undamped modes: closed forms, dense and sparse matrices, derivatives against differences, what fails."""

import numpy as np
import pytest
from scipy import sparse

from fe_likelihoods import LinearStructure, Record, ShearFrame, SimulationFailed
from fe_likelihoods.models.undamped_modes import mode_derivatives, undamped_modes


def chain(stiffnesses):
    k = np.asarray(stiffnesses, dtype=float)
    return np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)


def squares(frequencies):
    return np.square(2.0 * np.pi * np.asarray(frequencies))


def test_uniform_shear_frames():
    for n, expected in ((3, [0.198062, 1.554958, 3.246980]), (2, [(3 - 5**0.5) / 2, (3 + 5**0.5) / 2])):
        modes = undamped_modes(chain(np.ones(n)), np.eye(n))
        np.testing.assert_allclose(squares(modes.frequencies), expected, rtol=3e-6)
        np.testing.assert_allclose(modes.shapes @ modes.shapes.T, np.eye(n), atol=1e-14)


def test_dense_and_sparse_matrices_have_the_same_modes(rng):
    n = 60
    stiffness, mass = chain(rng.uniform(1, 2, n)), np.diag(rng.uniform(1, 2, n))
    dense = undamped_modes(stiffness, mass, 5)
    thin = undamped_modes(sparse.csr_matrix(stiffness), sparse.diags_array(np.diag(mass)), 5)
    np.testing.assert_allclose(thin.frequencies, dense.frequencies, rtol=1e-10)
    signs = np.sign((thin.shapes * dense.shapes).sum(axis=1))[:, None]
    np.testing.assert_allclose(signs * thin.shapes, dense.shapes, atol=1e-8)
    again = undamped_modes(sparse.csr_matrix(stiffness), mass, 5)
    np.testing.assert_array_equal(again.shapes, thin.shapes)
    all_of_them = undamped_modes(sparse.csr_matrix(stiffness), mass)
    np.testing.assert_allclose(all_of_them.frequencies[:5], dense.frequencies, rtol=1e-10)


def test_derivatives_are_the_limits_of_differences(rng):
    n, step = 6, 1e-6
    slopes = [np.stack([each + each.T for each in rng.normal(size=(2, n, n))]) for _ in range(2)]
    base = chain(np.arange(3.0, 9.0)), np.diag(np.arange(1.0, 7.0))

    def modes(x):
        return undamped_modes(*(matrix + np.tensordot(x, slope, 1) for matrix, slope in zip(base, slopes, strict=True)))

    found = mode_derivatives(modes(np.zeros(2)), *slopes)
    for p, unit in enumerate(np.eye(2)):
        before, after = modes(-step * unit), modes(step * unit)
        signs = np.sign((before.shapes * after.shapes).sum(axis=1))[:, None]
        middle = np.sign((before.shapes * modes(np.zeros(2)).shapes).sum(axis=1))[:, None]
        difference = middle * (signs * after.shapes - before.shapes) / (2 * step)
        np.testing.assert_allclose(found.shapes[p], difference, atol=1e-6 * abs(difference).max())
        slope = (after.frequencies - before.frequencies) / (2 * step)
        np.testing.assert_allclose(found.frequencies[p], slope, atol=1e-6 * abs(slope).max())


def test_modes_that_coincide_have_finite_derivatives():
    """Two equal directions with one parameter: the frequencies move together, the shapes stay."""
    modes = undamped_modes(np.eye(2), np.eye(2))
    found = mode_derivatives(modes, np.eye(2)[None], np.zeros((1, 2, 2)))
    np.testing.assert_allclose(found.frequencies, 0.25 / np.pi, rtol=1e-14)
    assert not found.shapes.any()


@pytest.mark.parametrize(
    ("stiffness", "mass", "n", "text"),
    [
        ([[1.0, -1.0], [-1.0, 1.0]], np.eye(2), 2, "move without deformation"),
        ([[1.0, 0.5], [0.0, 1.0]], np.eye(2), 2, "stiffness matrix is not finite and symmetric"),
        (np.eye(2), [[1.0, np.nan], [np.nan, 1.0]], 2, "mass matrix is not finite"),
        (np.eye(2), -np.eye(2), 2, "fewer than 2 degrees of freedom have a positive mass"),
        (np.eye(2), np.diag([1.0, 0.0]), 2, "fewer than 2 degrees"),
        (-np.eye(2), np.eye(2), 2, "not positive definite"),
        (np.eye(2), np.eye(3), 2, "of one size"),
        (np.eye(2), np.eye(2), 3, "has no 3 modes"),
        (sparse.csr_matrix(chain([0.0] + [1.0] * 9)), sparse.eye_array(10), 2, "without deformation"),
    ],
)
def test_structures_without_such_modes_are_failed_simulations(stiffness, mass, n, text):
    with pytest.raises(SimulationFailed, match=text):
        undamped_modes(stiffness, mass, n)


def test_slender_structures_are_supported_and_free_ones_are_not():
    """A cantilever beam of 150 elements, whose eigenvalues differ by a factor of 1e10, and the same without support."""
    n, length = 150, 1.0 / 150
    one = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], dtype=float)
    mass = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420.0
    scale = np.array([1.0, length, 1.0, length])
    stiff, heavy = np.zeros((2, 2 * n + 2, 2 * n + 2))
    for k in range(n):
        stiff[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += one * np.outer(scale, scale) / length**3
        heavy[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += mass * np.outer(scale, scale) * length
    for n_modes in (3, None):
        found = undamped_modes(stiff[2:, 2:], heavy[2:, 2:], n_modes)
        np.testing.assert_allclose(squares(found.frequencies[:3]) ** 0.25, [1.875104, 4.694091, 7.854757], rtol=5e-7)
        with pytest.raises(SimulationFailed, match="without deformation"):
            undamped_modes(stiff, heavy, n_modes)
    thin = sparse.csr_array(stiff[2:, 2:]), sparse.csr_array(heavy[2:, 2:])
    np.testing.assert_allclose(undamped_modes(*thin, 3).frequencies, found.frequencies[:3], rtol=1e-7)
    heavy[3::2], heavy[:, 3::2] = 0.0, 0.0  # no inertia of rotations
    assert undamped_modes(stiff[2:, 2:], heavy[2:, 2:], 1).frequencies == pytest.approx(found.frequencies[:1], rel=0.01)


def test_a_linear_structure_has_modes_at_its_channels():
    frame = ShearFrame({"low": 1, "roof": 3}, [1.0] * 3, [1.0] * 3)
    model = LinearStructure(frame, Record("motion", 0.01, np.ones(10)))
    modes = model.modes([1.0, 1.0, 1.0, 0.02, 0.02, 0.02], 2)
    np.testing.assert_allclose(squares(modes.frequencies), [0.198062, 1.554958], rtol=3e-6)
    whole = undamped_modes(chain(np.ones(3)), np.eye(3), 2)
    np.testing.assert_allclose(modes.shapes, whole.shapes[:, [0, 2]], rtol=1e-12)
