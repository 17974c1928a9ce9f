"""Tails of importance weights: known shapes and expectations, and the same numbers as arviz."""

import numpy as np
import pytest
from scipy import stats

from samplers.estimates.pareto import pareto_shape, smoothed_weights


def test_pareto_shape_of_known_tails(rng):
    assert pareto_shape(np.log(rng.pareto(1.0 / 0.8, 20_000))) == pytest.approx(0.8, abs=0.15)
    assert pareto_shape(np.log(rng.exponential(size=20_000))) == pytest.approx(0.0, abs=0.15)
    assert pareto_shape(np.zeros(1000)) == -np.inf
    assert pareto_shape(np.zeros(24)) == np.inf  # too few weights


def test_smoothed_weights_and_shape_are_those_of_arviz(rng):
    psislw = getattr(pytest.importorskip("arviz"), "psislw", None)
    if psislw is None:
        pytest.skip("this arviz has no psislw")
    for power in (0.3, 0.6, 0.9):
        log_weights = power * rng.exponential(size=2000)  # weights with a Pareto tail of this shape
        expected, shape = psislw(log_weights)
        weights, found = smoothed_weights(log_weights)
        assert found == pytest.approx(float(shape), abs=0.02)
        np.testing.assert_allclose(weights, np.exp(expected), rtol=0.05)
        np.testing.assert_allclose(np.sort(weights)[:1500], np.sort(np.exp(expected))[:1500], rtol=0.01)


def test_smoothing_keeps_means_and_its_shape_is_that_of_the_weights(rng):
    """Draws of N(0, 1) weighted to N(0, 1.3^2): the second moment is 1.69, a tail of 1 - 1 / 1.69 = 0.41."""
    errors, shapes = [], []
    for _ in range(200):
        x = rng.standard_normal(1000)
        log_weights = stats.norm(0.0, 1.3).logpdf(x) - stats.norm.logpdf(x)
        raw = np.exp(log_weights) / np.exp(log_weights).sum()
        smoothed, shape = smoothed_weights(log_weights)
        shapes.append(shape)
        errors.append([weights @ x**2 - 1.69 for weights in (raw, smoothed)])
    raw, smoothed = np.sqrt(np.mean(np.square(errors), axis=0))
    assert smoothed < 1.05 * raw and abs(np.mean(errors, axis=0)[1]) < 0.15
    assert np.median(shapes) == pytest.approx(0.41, abs=0.1)


def test_equal_weights_stay_equal():
    weights, shape = smoothed_weights(np.zeros(100))
    np.testing.assert_allclose(weights, 0.01)
    assert shape == -np.inf
