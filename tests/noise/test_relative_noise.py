"""Noise that is a share of the response level: likelihood, level of a response, predictions under other motions."""

import numpy as np
import pytest

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.noise.gaussian import GaussianNoise
from fe_likelihoods.noise.response_level import local_level
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.priors.distributions import HalfNormal, TruncatedNormal
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record

TOP = Channel("top", "displacement", "mm")


@pytest.fixture
def record(rng):
    time = 0.02 * np.arange(1500)
    return Record("burst", 0.02, np.exp(-(((time - 10.0) / 3.0) ** 2)) * rng.standard_normal(1500))


def posterior_of(model, measured, **options):
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    noise = GaussianNoise(measured.channels, shares_of="measured", **options)
    return Posterior(FELikelihood(model, measured, noise), prior | {n: HalfNormal(0.5) for n in noise.parameter_names})


def test_the_likelihood_is_that_of_white_noise_with_the_scaled_deviations(rng):
    channels = (TOP, Channel("base", "acceleration", "g"))
    values = rng.standard_normal((2, 40)) * [[0.01], [2.0]]
    values[0, 3] = np.nan
    measured = Measurements(channels, 0.01, values)
    misfit, shares = np.array([[1e-4, 3.0], [np.nan, 1.0]]), np.array([[0.2, 0.3], [0.2, 0.3]])
    levels = np.sqrt(np.nanmean(values**2, axis=1))
    for options in ({}, {"sensor": (0.001, 0.1)}, {"effective_samples": (20, 30)}):
        noise = GaussianNoise(channels, shares_of="measured", **options).with_measurements(measured)
        expected = GaussianNoise(channels, **options).log_likelihood(misfit, 40, shares * levels)
        np.testing.assert_array_equal(noise.log_likelihood(misfit, 40, shares), expected)
        assert noise.log_likelihood(misfit, 40, -shares)[0] == -np.inf
        assert noise.log_likelihood(misfit, 40, [[0.2, 1.0], [0.2, 1.0]])[0] == -np.inf
    assert noise.parameter_names == ("share_top", "share_base")
    sensor = GaussianNoise(channels, shares_of="measured", sensor={"base": 0.1}).with_measurements(measured)
    sensor = sensor.standard_deviations(shares)
    np.testing.assert_allclose(sensor[0], [0.2 * levels[0], np.hypot(0.1, 0.3 * levels[1])])
    assert (
        repr(noise)
        != repr(GaussianNoise(measured.channels, shares_of="measured"))
        != repr(GaussianNoise(measured.channels, shares_of="measured", window=1.0))
    )


def test_level_of_a_response():
    time = 0.01 * np.arange(2000)
    history = np.where(time < 10.0, 3.0, 0.1) * np.sin(2.0 * np.pi * 5.0 * time)
    both = np.stack([history, np.ones(2000)])
    np.testing.assert_allclose(local_level(both, None)[:, 0], np.sqrt(np.mean(both**2, axis=1)))
    level = local_level(both, 101.0)
    np.testing.assert_allclose(level[0, 100:900], 3.0 / np.sqrt(2.0), rtol=0.01)
    np.testing.assert_allclose(level[0, 1100:1900], 0.1 / np.sqrt(2.0), rtol=0.01)
    np.testing.assert_allclose(level[1], 1.0, rtol=1e-12)
    np.testing.assert_allclose(local_level(both, 1.0), np.abs(both), rtol=1e-6, atol=1e-6)
    # a mean square is kept, so that the share of the whole motion is that of its parts
    assert np.mean(level[0] ** 2) == pytest.approx(np.mean(history**2), rel=0.02)


@pytest.mark.parametrize("window", (None, 1.0))
def test_a_prediction_of_a_weaker_motion_has_the_noise_of_the_weaker_response(record, window):
    model = LinearOscillator(record)
    response = model.simulate([1.0, 1.0])
    measured = Measurements(model.channels, model.dt, response)
    floor = {"displacement": 1e-6}
    posterior = posterior_of(model, measured, window=window, sensor=floor)
    samples = np.tile([1.0, 1.0, 0.3, 0.2], (300, 1))
    options = {"noise": True, "seed": 1, "progress": False}
    same = propagate(posterior, samples, **options)
    weak = propagate(posterior, samples, record=record.scale(0.1), **options)
    np.testing.assert_allclose(weak.sd[0], 0.1 * same.sd[0], rtol=1e-9)
    expected = 0.3 / np.sqrt(1.0 - 0.3**2) * local_level(response, None if window is None else window / model.dt)[0]
    np.testing.assert_allclose(same.sd[0], expected, rtol=1e-9)
    assert weak.sd[1].min() >= 1e-6
    np.testing.assert_allclose(weak.mean, 0.1 * same.mean, rtol=1e-9, atol=1e-12)  # exact in the noise
    if window:
        assert same.sd[0, 500] > 20.0 * same.sd[0, 0]
    # control: noise in SI units keeps its level
    absolute = Posterior(
        FELikelihood(model, measured, GaussianNoise(model.channels)),
        posterior.prior.subset(["stiffness", "damping"]).distributions
        | {f"sigma_{c.name}": HalfNormal(1.0) for c in model.channels},
    )
    fixed = propagate(absolute, np.tile([1.0, 1.0, 0.3, 0.2], (300, 1)), record=record.scale(0.1), **options)
    np.testing.assert_allclose(fixed.sd[0], 0.3, rtol=1e-9)


def test_what_has_no_level_is_refused():
    model = FunctionModel(lambda theta: [theta[0] * np.ones(5)], ["a"], [TOP], 0.1, 5)
    likelihood = FELikelihood(
        model, Measurements((TOP,), 0.1, [np.ones(5)]), GaussianNoise((TOP,), shares_of="measured", scales=[1.0])
    )
    posterior = Posterior(likelihood, {"a": TruncatedNormal(1.0, 0.1), "share_top": HalfNormal(0.2)})
    assert [each.unit for each in posterior.parameters][-1] == "-"
    with pytest.raises(ValueError, match="positive standard deviation"):
        propagate(posterior, [[1.0, -0.1]], noise=True, progress=False)
    with pytest.raises(ValueError, match="positive standard deviation"):
        propagate(posterior, [[1.0, 1.0]], noise=True, progress=False)
