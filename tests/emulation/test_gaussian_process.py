"""Gaussian processes: exact cases, left-out errors by refitting, and the spread of errors against the variance."""

import numpy as np

from fe_likelihoods.emulation.gaussian_process import fit_process, left_out_errors, predict


def _smooth(inputs):
    return np.stack([np.sin(inputs[:, 0]) + inputs[:, 1] ** 2, np.exp(0.3 * inputs.sum(axis=1))], axis=1)


def test_training_points_of_a_smooth_function_are_reproduced():
    rng = np.random.default_rng(2)
    inputs = rng.standard_normal((60, 2))
    process = fit_process(inputs, _smooth(inputs), np.ones(2))
    np.testing.assert_allclose(predict(process, inputs)[0], _smooth(inputs), atol=1e-4)
    new = 0.7 * rng.standard_normal((200, 2))
    assert np.sqrt(np.square(predict(process, new)[0] - _smooth(new)).mean()) < 1e-2


def test_left_out_errors_are_those_of_processes_without_the_point():
    rng = np.random.default_rng(3)
    inputs = rng.standard_normal((25, 2))
    outputs = _smooth(inputs) + 0.1 * rng.standard_normal((25, 2))
    process = fit_process(inputs, outputs, np.ones(2))
    errors, variances = left_out_errors(process)
    for i in (0, 7, 24):
        rest = np.delete(np.arange(25), i)
        # iterations=0 keeps the length scales; the nuggets are those of the whole fit if the choice is clear
        again = fit_process(inputs[rest], outputs[rest], np.ones(2), process.log_scales, iterations=0)
        if [level.nugget for level in again.levels] == [level.nugget for level in process.levels]:
            left_out = outputs[i] - predict(again, inputs[i : i + 1])[0][0]
            np.testing.assert_allclose(errors[i], left_out, rtol=1e-5, atol=1e-8)


def test_inputs_far_apart_are_a_linear_regression():
    rng = np.random.default_rng(5)
    inputs, outputs = 30.0 * rng.standard_normal((12, 2)), rng.standard_normal((12, 1))
    process = fit_process(inputs, outputs, np.ones(1), np.array([0.0, 0.0, 4.0]), iterations=0)
    squares = np.linalg.lstsq(np.column_stack([np.ones(12), inputs]), outputs, rcond=None)[1]
    (level,) = process.levels
    np.testing.assert_allclose(process.variances * (1.0 + level.nugget), squares / (12 - 3))


def test_the_variance_covers_the_errors_of_a_rough_function():
    rng = np.random.default_rng(4)
    inputs = rng.standard_normal((120, 2))
    noise = 0.2
    process = fit_process(inputs, _smooth(inputs) + noise * rng.standard_normal((120, 2)), np.ones(2))
    new = 0.8 * rng.standard_normal((400, 2))
    mean, variance = predict(process, new)
    score = np.square(_smooth(new) + noise * rng.standard_normal((400, 2)) - mean) / variance
    assert 0.7 < score.mean() < 1.4
