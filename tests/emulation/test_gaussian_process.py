"""Gaussian processes: exact cases, a regression, and left-out errors by refitting."""

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


def test_left_out_errors_are_those_of_processes_without_the_point():
    rng = np.random.default_rng(3)
    inputs = rng.standard_normal((25, 2))
    outputs = _smooth(inputs) + 0.1 * rng.standard_normal((25, 2))
    process = fit_process(inputs, outputs, np.ones(2))
    for i in (0, 7, 24):
        rest = np.delete(np.arange(25), i)
        # the length scales are kept, and the choice of nuggets is clear
        again = fit_process(inputs[rest], outputs[rest], np.ones(2), process.log_scales)
        left_out = outputs[i] - predict(again, inputs[i : i + 1])[0]
        np.testing.assert_allclose(process.left_out[i], left_out, rtol=1e-5, atol=1e-8)


def test_inputs_far_apart_are_a_linear_regression():
    rng = np.random.default_rng(5)
    inputs, outputs = 30.0 * rng.standard_normal((12, 2)), rng.standard_normal((12, 1))
    process = fit_process(inputs, outputs, np.ones(1), np.array([0.0, 0.0, 4.0]))
    solved = np.linalg.lstsq(np.column_stack([np.ones(12), inputs]), outputs, rcond=None)[0]
    np.testing.assert_allclose(process.linear, solved, rtol=1e-6)
