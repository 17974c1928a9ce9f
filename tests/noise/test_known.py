"""Noise with known parameters: the same density as with the parameters in the sample."""

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    Uniform,
    propagate,
)
from fe_likelihoods.noise.known import KnownNoise

CHANNELS = Channel("a", "displacement", "mm"), Channel("b", "strain", "%")
PRIOR = {"x": Uniform(0.0, 2.0)}


def made(noise=None):
    model = FunctionModel(lambda theta: np.outer([1.0, 2.0], theta * np.arange(1.0, 6.0)), ("x",), CHANNELS, 1.0, 5)
    values = model.simulate([1.0]) + 0.1 * np.random.default_rng(1).normal(size=(2, 5))
    return FELikelihood(model, Measurements(CHANNELS, 1.0, values), noise)


@pytest.mark.parametrize("noise", [GaussianNoise(CHANNELS), AutoregressiveNoise(CHANNELS)])
def test_a_number_instead_of_a_prior_is_a_known_parameter(noise):
    names = noise.parameter_names
    free = made(noise)
    posterior = Posterior(free, PRIOR | {name: HalfNormal(1.0) for name in names if name != names[0]} | {names[0]: 0.2})
    assert posterior.parameter_names == ["x", *names[1:]]
    assert posterior.log_likelihood([1.1, *[0.3] * (len(names) - 1)]) == free([1.1, 0.2, *[0.3] * (len(names) - 1)])
    other = Posterior(free, PRIOR | {name: HalfNormal(1.0) for name in names[1:]} | {names[0]: 0.3})
    assert other.fingerprint != posterior.fingerprint and "= 0.2" in posterior.likelihood.noise.title


def test_all_parameters_may_be_known_and_predictions_have_the_noise():
    posterior = Posterior(made(), PRIOR | {"sigma_a": 0.1, "sigma_b": 0.2})
    assert posterior.parameter_names == ["x"] and not posterior.fast_parameters
    prediction = propagate(posterior, np.ones((4000, 1)), noise=True, seed=1)
    np.testing.assert_allclose(prediction.sd, np.repeat([[0.1], [0.2]], 5, axis=1), rtol=0.05)


def test_known_parameters_of_one_of_several_data_sets():
    joint = JointLikelihood({"one": made(), "two": made()}, separate=["sigma_a", "sigma_b"])
    priors = {f"sigma_{channel}_{key}": HalfNormal(1.0) for channel in "ab" for key in ("one", "two")}
    posterior = Posterior(joint, PRIOR | priors | {"sigma_b_two": 0.2, "sigma_b_one": 0.3})
    assert posterior.parameter_names == ["x", "sigma_a_one", "sigma_a_two"]
    expected = made()([1.1, 0.1, 0.3]) + made()([1.1, 0.4, 0.2])
    assert posterior.log_likelihood([1.1, 0.1, 0.4]) == pytest.approx(expected, rel=1e-14)


def test_whitened_residuals_are_those_of_the_noise_with_all_parameters(rng):
    noise, residuals = AutoregressiveNoise(CHANNELS), rng.normal(size=(2, 50))
    expected = noise.whitened(residuals, residuals, np.array([0.5, 0.6, 0.9, 0.2]))
    found = KnownNoise(noise, {"rho_a": 0.9}).whitened(residuals, residuals, np.array([0.5, 0.6, 0.2]))
    np.testing.assert_array_equal(found, expected)


def test_what_cannot_be_known_is_refused():
    with pytest.raises(ValueError, match="no x, its parameters are sigma_a, sigma_b"):
        Posterior(made(), {"x": 1.0, "sigma_a": HalfNormal(1.0), "sigma_b": 0.1})
    with pytest.raises(ValueError, match="has no parameters sigma_c"):
        KnownNoise(GaussianNoise(CHANNELS), {"sigma_c": 1.0})
    with pytest.raises(ValueError, match="finite number"):
        KnownNoise(GaussianNoise(CHANNELS), {"sigma_a": np.nan})
