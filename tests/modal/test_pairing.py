"""Pairing of modes: closed forms, and invariance to scale, sign, order of modes and order of sensors."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import ModalData
from fe_likelihoods.modal.pairing import pair_modes


def unit(shapes):
    return np.asarray(shapes, dtype=float) / np.linalg.norm(shapes, axis=-1, keepdims=True)


def measured(frequencies, shapes):
    data = ModalData(frequencies, shapes, [f"sensor {k}" for k in range(np.shape(shapes)[-1])])
    return data, data.groups()


def test_pairs_do_not_depend_on_scale_sign_and_order(rng):
    shapes = rng.normal(size=(7, 5))
    frequencies = np.sort(rng.uniform(1.0, 9.0, 7))
    data, groups = measured(
        frequencies[[5, 0, 3]] * [1.01, 0.98, 1.02], shapes[[5, 0, 3]] + 0.1 * rng.normal(size=(3, 5))
    )
    pairs = pair_modes(frequencies, shapes, data, groups)
    assert pairs.columns.tolist() == [5, 0, 3]
    modes, sensors = rng.permutation(7), rng.permutation(5)
    factors = rng.choice([-1.0, 1.0], 7)[:, None] * rng.uniform(0.1, 10.0, (7, 1))
    other = pair_modes(
        frequencies[modes],
        (factors * shapes)[np.ix_(modes, sensors)],
        replace(data, shapes=-data.shapes[:, :, sensors]),
        groups,
    )
    assert modes[other.columns].tolist() == [5, 0, 3]
    np.testing.assert_allclose(other.assurance, pairs.assurance, rtol=1e-12)
    np.testing.assert_allclose(other.shapes, -pairs.shapes[:, :, sensors], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(other.frequencies, pairs.frequencies)
    residuals = np.square(data.shapes - pairs.shapes).sum(axis=2)
    np.testing.assert_allclose(residuals[0], 1.0 - pairs.assurance, rtol=1e-9)


def test_a_local_mode_between_global_ones_is_passed_over():
    shapes = np.array([[1.0, 2.0, 0.0], [0.02, -0.01, 1.0], [2.0, -1.0, 0.0]])
    pairs = pair_modes(np.array([1.0, 2.4, 2.6]), shapes, *measured([1.0, 2.45], shapes[[0, 2]]))
    assert pairs.columns.tolist() == [0, 2] and pairs.frequencies.tolist() == [1.0, 2.6]


def test_close_modes_are_compared_as_a_plane_with_their_frequencies_in_order(rng):
    """Any two shapes in the plane of the computed ones fit; the frequencies are sorted in the pair."""
    plane, third = np.linalg.qr(rng.normal(size=(5, 3)))[0].T[:2], rng.normal(size=5)
    shapes = np.vstack([plane, third])
    turned = np.array([[0.6, 0.8], [-0.5, 0.7]]) @ plane
    data, groups = measured([2.01, 2.0, 5.0], [*turned, third])
    assert groups == ((1, 0), (2,))
    pairs = pair_modes(np.array([1.98, 2.2, 5.0]), shapes, data, groups)
    np.testing.assert_allclose(pairs.assurance, 1.0, rtol=1e-12)
    assert pairs.frequencies.tolist() == [2.2, 1.98, 5.0]
    outside = unit(turned[0] + 0.3 * third)
    pairs = pair_modes(np.array([2.2, 1.98, 5.0]), shapes, *measured([2.0, 2.01, 5.0], [outside, turned[1], third]))
    expected = np.linalg.norm(plane @ outside) ** 2
    assert pairs.assurance[0] == pytest.approx(expected, rel=1e-12) and pairs.frequencies[0] == 1.98


def test_shapes_of_equal_frequencies_are_any_basis_of_their_plane(rng):
    """A structure with two equal directions: the solver returns an arbitrary pair, the result does not depend on it."""
    shapes = np.linalg.qr(rng.normal(size=(4, 3)))[0].T
    data, groups = measured([2.0, 2.2], shapes[:2])
    found = []
    for angle in (0.0, 0.7, 2.0):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        computed = np.vstack([turn @ shapes[:2], shapes[2]])
        found.append(pair_modes(np.array([2.1, 2.1 * (1.0 + 1e-9), 3.0]), computed, data, groups))
    for pairs in found:
        assert sorted(pairs.columns) == [0, 1]
        np.testing.assert_allclose(pairs.assurance, 1.0, rtol=1e-12)


def test_several_identifications_have_one_pairing_and_their_own_scales(rng):
    shapes = rng.normal(size=(3, 4))
    sets = np.stack([shapes[[2, 0]] * [[1.0], [-2.0]], shapes[[2, 0]] * [[-3.0], [1.0]]])
    sets[1, 1] = np.nan
    data, groups = measured([[3.0, 1.0], [3.1, np.nan]], sets)
    pairs = pair_modes(np.array([1.0, 2.0, 3.0]), shapes, data, groups)
    assert pairs.columns.tolist() == [2, 0]
    np.testing.assert_allclose(pairs.shapes[:, 0], data.shapes[:, 0], rtol=1e-12)
    assert not pairs.shapes[1, 1].any() and pairs.assurance == pytest.approx(1.0)


def test_modes_without_shapes_are_paired_by_their_number():
    nothing = ModalData([5.0, 1.0], mode_numbers=[3, 1])
    pairs = pair_modes(np.array([2.0, 4.0, 8.0]), np.empty((3, 0)), nothing, nothing.groups())
    assert pairs.columns.tolist() == [2, 0] and np.isnan(pairs.assurance).all() and not pairs.shapes.any()


def test_one_sensor_leaves_the_pairing_to_the_frequencies():
    pairs = pair_modes(
        np.array([1.0, 2.0, 4.0]), np.array([[1.0], [-1.0], [2.0]]), *measured([2.1, 3.8], [[1.0], [1.0]])
    )
    assert pairs.columns.tolist() == [1, 2]
