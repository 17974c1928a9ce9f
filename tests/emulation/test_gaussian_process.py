"""Gaussian processes: exact cases and a regression."""

import numpy as np

from fe_likelihoods.emulation.gaussian_process import fit_process, predict


def _smooth(inputs):
    return np.stack([np.sin(inputs[:, 0]) + inputs[:, 1] ** 2, np.exp(0.3 * inputs.sum(axis=1))], axis=1)


def test_training_points_of_a_smooth_function_are_reproduced():
    rng = np.random.default_rng(2)
    inputs = rng.standard_normal((60, 2))
    process = fit_process(inputs, _smooth(inputs), np.ones(2))
    np.testing.assert_allclose(predict(process, inputs), _smooth(inputs), atol=1e-4)
    new = 0.7 * rng.standard_normal((200, 2))
    assert np.sqrt(np.square(predict(process, new) - _smooth(new)).mean()) < 1e-2


def test_inputs_far_apart_are_a_linear_regression():
    rng = np.random.default_rng(5)
    inputs, outputs = 30.0 * rng.standard_normal((12, 2)), rng.standard_normal((12, 1))
    process = fit_process(inputs, outputs, np.ones(1), np.array([0.0, 0.0, 4.0]))
    solved = np.linalg.lstsq(np.column_stack([np.ones(12), inputs]), outputs, rcond=None)[0]
    np.testing.assert_allclose(process.linear, solved, rtol=1e-6)
