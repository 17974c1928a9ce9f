"""Modal data: what they are, what is refused, and what several identifications have in common."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods.modal.modal_data import ModalData, real_shapes

FLOORS = ("floor 1", "floor 2", "floor 3")
SHAPES = [[1.0, 2.0, 3.0], [-2.0, -1.0, 2.0]]


def test_shapes_have_a_norm_of_one_and_keep_their_signs():
    data = ModalData([1.0, 3.0], SHAPES, FLOORS, damping=[0.01, 0.02], frequency_cv=0.005, shape_error=[0.02, 0.05])
    np.testing.assert_allclose(data.shapes[0, 1], [-2 / 3, -1 / 3, 2 / 3], rtol=1e-15)
    assert (data.n_sets, data.n_modes, data.n_sensors) == (1, 2, 3) and data.frequency_cv.tolist() == [0.005, 0.005]
    assert "mode  f [Hz]  damping  floor 1  floor 2  floor 3" in repr(data) and "2 %   -0.667" in repr(data)
    same = ModalData([1.0, 3.0], np.multiply(SHAPES, 7.0), FLOORS)
    assert same.fingerprint == data.fingerprint != data.select([1]).fingerprint


def test_modes_and_sensors_can_be_selected():
    data = ModalData([[1.0, 3.0]], [SHAPES], FLOORS, covariance=[[1e-4, 1e-5], [1e-5, 4e-4]], mode_numbers=[2, 5])
    one = data.select([5])
    assert one.frequencies.tolist() == [[3.0]] and one.mode_numbers == (5,) and one.covariance.tolist() == [[4e-4]]
    alone = ModalData([1.0, 3.0]).select([2])
    assert alone.frequencies.tolist() == [[3.0]] and not alone.has_shape.any()
    with pytest.raises(ValueError, match="the modes are 2, 5"):
        data.select([1])


def test_the_mean_of_identifications_has_their_scatter(rng):
    n, truth = 400, np.array(SHAPES) / np.linalg.norm(SHAPES, axis=1, keepdims=True)
    frequencies = np.array([1.0, 3.0]) * (1.0 + 0.01 * rng.normal(size=(n, 2)))
    signs = rng.choice([-1.0, 1.0], (n, 2, 1))
    data = ModalData(frequencies, signs * (truth + 0.02 * rng.normal(size=(n, 2, 3))), FLOORS)
    mean = data.mean()
    assert mean.n_sets == 1 and mean.mode_numbers == (1, 2)
    np.testing.assert_allclose(mean.frequency_cv, 0.01, rtol=4 / np.sqrt(2 * n))
    np.testing.assert_allclose(mean.shape_error, 0.02, rtol=4 / np.sqrt(4 * n))
    assert (np.square((mean.shapes[0] * truth).sum(axis=1)) > 1.0 - 16 * 0.02**2 / n).all()


def test_an_identification_may_miss_a_mode():
    shapes = np.array([SHAPES, SHAPES, SHAPES])
    shapes[1, 0] = np.nan
    data = ModalData([[1.0, 3.0], [np.nan, 3.1], [1.2, 2.9]], shapes, FLOORS)
    assert data.mean_frequencies == pytest.approx([1.1, 3.0]) and data.has_shape.sum(axis=0).tolist() == [2, 3]
    assert data.mean().frequency_cv == pytest.approx([0.2 / np.sqrt(2) / 1.1, 0.1 / 3.0])


def test_complex_shapes_become_real_by_their_mean_phase(rng):
    real = rng.normal(size=(3, 8))
    turned = real * np.exp(1j * rng.uniform(0, 6, (3, 1)))
    shapes, scatter = real_shapes(turned)
    np.testing.assert_allclose(np.abs((shapes * real).sum(axis=1)), np.square(real).sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(scatter, 0.0, atol=1e-6)
    shapes, scatter = real_shapes([1.0, np.exp(0.2j), np.exp(-0.2j)])
    assert scatter == pytest.approx(np.degrees(np.arctan2(np.sqrt(2) * np.sin(0.2), np.sqrt(1 + 2 * np.cos(0.2) ** 2))))
    assert not ModalData([1.0], [[1 + 0j, 2 + 0j]], ("a", "b")).shapes.imag.any()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([1.0, -2.0],), "frequencies must be positive"),
        (([1.0, np.nan],), "leave out modes that were never identified"),
        (("high",), "frequencies must be positive numbers"),
        (([True, True],), r"frequencies must be positive numbers .* got \[True, True\]"),
        (([1.0, 3.0], SHAPES, FLOORS[:2]), "name each sensor"),
        (([1.0, 3.0], np.transpose(SHAPES), FLOORS), "transpose them"),
        (([1.0, 3.0], SHAPES), "name each sensor"),
        (([1.0, 3.0], None, FLOORS), "expected shapes"),
        (([1.0, 3.0], np.multiply(SHAPES, 1 + 0.1j), FLOORS), "real_shapes"),
        (([1.0, 3.0], [SHAPES[0], [1.0, np.nan, 2.0]], FLOORS), "the shape of mode 2 .* floor 2: nan"),
        (([1.0, 3.0], [SHAPES[0], [0.0, 0.0, 0.0]], FLOORS), "the shape of mode 2 .* not all zero"),
        (([1.0, 3.0], [SHAPES[0], [1.0, np.inf, 2.0]], FLOORS), "must be finite numbers"),
        (([1.0, 3.0], SHAPES, ("a", "a", "b")), "sensors must differ"),
        (([3.0, 1.0],), "frequencies must ascend"),
    ],
)
def test_bad_data_are_refused_with_what_to_do(arguments, text):
    with pytest.raises(ValueError, match=text):
        ModalData(*arguments)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"frequency_cv": 0.5}, "0.005 for 0.5 %"),
        ({"frequency_cv": [0.1]}, "one for each of 2 modes"),
        ({"shape_error": 0.0}, "norm of 1"),
        ({"covariance": [[0.01, 0.02], [0.02, 0.01]]}, "positive definite"),
        ({"covariance": [[0.01, 0.005], [0.002, 0.01]]}, "symmetric"),
        ({"covariance": [[100.0, 0.0], [0.0, 100.0]]}, "below 0.5 of the frequencies"),
        ({"covariance": np.eye(2), "frequency_cv": 0.01}, "leave one out"),
        ({"mode_numbers": [1, 1]}, "different whole numbers"),
        ({"mode_numbers": [0, 1]}, "from 1 on"),
        ({"damping": [0.01]}, "damping must be ratios"),
        ({"damping": [-0.02, 0.01]}, "from 0 to below 1"),
        ({"damping": [1.5, 0.01]}, "from 0 to below 1"),
    ],
)
def test_bad_options_are_refused(options, text):
    with pytest.raises(ValueError, match=text):
        ModalData([1.0, 3.0], SHAPES, FLOORS, **options)


def test_close_modes_are_a_group_unless_their_plane_takes_up_all_sensors():
    data = ModalData([2.01, 1.0, 2.0], [*SHAPES, [1.0, 0.0, 0.0]], FLOORS)
    assert data.groups() == ((1,), (2, 0))
    assert len(replace(data, shapes=data.shapes[..., :2], sensors=FLOORS[:2]).groups()) == 3
