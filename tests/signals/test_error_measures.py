"""Errors of predicted histories, and the comparison of time steps that comes before."""

import numpy as np
import pytest

from fe_likelihoods import rrmse
from fe_likelihoods.signals.sampling import same_step


def test_rrmse_is_its_definition(rng):
    measured, predicted = rng.normal(size=(2, 3, 50))
    expected = [np.linalg.norm(p - m) / np.linalg.norm(m) for p, m in zip(predicted, measured, strict=True)]
    np.testing.assert_allclose(rrmse(predicted, measured), expected, rtol=1e-13)
    assert rrmse(predicted[0], measured[0]) == rrmse(predicted, measured)[0]
    assert rrmse([0.0, 0.0], [3.0, 4.0]) == 1.0 and rrmse([3.0, 4.0], [3.0, 4.0]) == 0.0
    assert rrmse(1.1 * measured[0], measured[0]) == pytest.approx(0.1)


@pytest.mark.parametrize("predicted", [np.ones(3), np.ones((2, 4)), 1.0])
def test_histories_of_different_shapes_are_refused(predicted):
    with pytest.raises(ValueError, match="histories of one shape"):
        rrmse(predicted, np.ones((2, 3)))


def test_a_measured_history_of_zeros_has_no_relative_error():
    measured = np.array([[1.0, 2.0], [0.0, 0.0]])
    with pytest.raises(ValueError, match="row 1 is zero"):
        rrmse(measured, measured)
    with pytest.raises(ValueError, match="'drift' is zero"):
        rrmse(measured, measured, ["top", "drift"])


def test_steps_are_compared_within_round_off():
    assert same_step(0.1, 0.1 * (1 + 1e-12)) and not same_step(0.1, 0.1 * (1 + 1e-6))
