"""Noise for real measurements: correlated errors, known sensor noise, effective samples, compared with white noise."""

import math
import warnings

import numpy as np
import pytest
from scipy import linalg, stats

from fe_likelihoods import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.priors.distributions import Uniform
from fe_likelihoods.signals.channels import Channel, Measurements
from tests import lines

CHANNELS = (Channel("top", "absolute acceleration", "g"), Channel("drift", "relative displacement", "in"))


# autoregressive noise -------------------------------------------------------------------------------------------------


def test_impossible_values_are_minus_infinity_without_a_warning():
    noise = AutoregressiveNoise(CHANNELS[:1])
    statistics = np.tile([5.0, 4.0, 1.0], (10, 1))
    parameters = np.tile([1.0, 0.5], (10, 1))
    parameters[:5, 1] = [1.0, -1.0, 2.0, math.nan, math.inf]
    parameters[5:8, 0] = [0.0, -1.0, math.inf]
    statistics[8] = math.nan
    statistics[9, 1] = math.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = noise.log_likelihood(statistics, 10, parameters)
    assert np.isneginf(values).all()
    assert np.isfinite(noise.log_likelihood(np.zeros((1, 3)), 10, np.array([[1.0, -0.99]])))


# sensors and effective samples ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [{"drift": 0.03}, (0.0, 0.03)])
def test_a_known_sensor_adds_its_variance(rng, given):
    misfit, sigma = rng.uniform(1.0, 2.0, (4, 2)), rng.uniform(0.1, 1.0, (4, 2))
    total = np.sqrt(sigma**2 + [0.0, 0.03**2])
    noise = GaussianNoise(CHANNELS, sensor=given)
    np.testing.assert_allclose(noise.standard_deviations(sigma), total)
    white = GaussianNoise(CHANNELS)
    shared = GaussianNoise(CHANNELS, groups="all", scales=[2.0, 0.5], sensor=given)
    np.testing.assert_allclose(
        shared.standard_deviations(sigma[:, :1]), np.sqrt((sigma[:, :1] * [2.0, 0.5]) ** 2 + [0.0, 0.03**2])
    )
    lasting = AutoregressiveNoise(CHANNELS, sensor=given)
    np.testing.assert_allclose(lasting.standard_deviations(np.hstack([sigma, 0.0 * sigma])), total)
    # a model error of zero is possible only with known sensor noise; a negative one is not possible
    edge = np.array([[0.5, 0.0], [0.0, 0.5], [0.5, -1e-9], [0.5, math.nan]])
    assert np.isfinite(noise.log_likelihood(misfit, 30, edge)).tolist() == [True, False, False, False]
    assert len({repr(noise), repr(white), repr(GaussianNoise(CHANNELS, sensor=(0.0, 0.04)))}) == 3


# in a likelihood ------------------------------------------------------------------------------------------------------


class Line(lines.Line):
    channels = CHANNELS
    n_steps = 12


def measured_by(model, rng):
    return Measurements(model.channels, model.dt, rng.normal(size=(2, model.n_steps)))


def test_a_noise_of_other_channels_is_refused(rng):
    with pytest.raises(ValueError, match="noise's channels are drift, top, the model's are top, drift"):
        FELikelihood(Line(), measured_by(Line(), rng), GaussianNoise(CHANNELS[::-1]))


# predictions ----------------------------------------------------------------------------------------------------------


def test_predictions_draw_correlated_errors(rng):
    """Samples have the deviation sigma for any correlation; the deviation of the mean grows with the correlation."""
    sigma, rho, n = 0.3, 0.8, 4000
    likelihood = FELikelihood(Line(), measured_by(Line(), rng), AutoregressiveNoise(CHANNELS))
    names = likelihood.parameter_names
    posterior = Posterior(likelihood, dict(zip(names, [Uniform(-9.0, 9.0)] * len(names), strict=True)))
    samples = np.tile([0.1, 0.2, sigma, sigma, rho, 0.0], (n, 1))
    means = propagate(posterior, samples, quantity=lambda r: r.mean(axis=1), noise=True, seed=1, progress=False)
    covariance = sigma**2 * linalg.toeplitz(rho ** np.arange(12))
    expected = np.array([covariance.mean(), sigma**2 / 12])
    assert np.all(np.abs(means.variance / expected - 1.0) < 4.5 * math.sqrt(2.0 / n))
    histories = propagate(posterior, samples, noise=True, seed=1, progress=False)
    np.testing.assert_allclose(histories.variance, sigma**2, rtol=1e-10)
    low = stats.norm.cdf((histories.quantile(0.05) - histories.mean) / sigma)
    assert np.all(np.abs(low - 0.05) < 4.5 * math.sqrt(0.05 * 0.95 / n))
    with pytest.raises(ValueError, match="correlation between -1 and 1"):
        propagate(posterior, samples + [0, 0, 0, 0, 0.2, 0], noise=True, progress=False)
