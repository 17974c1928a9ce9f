"""Shares of the prior that are left: closed forms of linear models, products, and parameters without effect."""

import numpy as np
import pytest
from scipy.stats import norm

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    LogNormal,
    Measurements,
    Posterior,
    identifiability,
)
from fe_likelihoods.information.identifiability import compare_covariances
from fe_likelihoods.priors.multivariate import MultivariateNormal

TOP = (Channel("top", "displacement", "mm"),)
TIME = np.linspace(0.0, 1.0, 60)
SHAPES = np.stack([np.sin(5.0 * TIME), np.cos(3.0 * TIME), np.ones(60)])
NOISE = 0.3


def posterior_of(function, prior, truth):
    """Posterior under white noise of a known level."""
    names = [name for key in prior for name in (key if isinstance(key, tuple) else (key,))]
    model = FunctionModel(function, names, TOP, 0.02, len(TIME))
    errors = NOISE * np.random.default_rng(1).standard_normal((1, len(TIME)))
    measured = Measurements(TOP, 0.02, model.simulate(np.array(truth)) + errors)
    likelihood = FELikelihood(model, measured, GaussianNoise(TOP))
    return Posterior(likelihood, prior | {"sigma_top": LogNormal(NOISE, 1e-4)})


def linear(theta):
    return (theta @ SHAPES[: len(theta)])[None]


def test_a_linear_model_has_the_closed_form():
    sds = np.array([2.0, 0.5, 1.0])
    prior = {name: norm(0.5, sd) for name, sd in zip("abc", sds, strict=True)}
    posterior = posterior_of(linear, prior, [1.0, 0.2, 0.7])
    jacobian = SHAPES.T * sds
    covariance = np.linalg.inv(np.eye(3) + jacobian.T @ jacobian / NOISE**2)
    found = identifiability(posterior)
    np.testing.assert_allclose(found.left, np.sqrt(np.diag(covariance)), rtol=1e-3)
    np.testing.assert_allclose(found.left_of_directions**2, np.linalg.eigvalsh(covariance), rtol=2e-3)
    np.testing.assert_allclose(found.slopes, sds, rtol=1e-6)
    assert found.names == ("a", "b", "c") and found.simulations > 3.0 and not found.remarks
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(3), covariance, 4000)
    samples = np.column_stack([0.5 + sds * draws, np.full(4000, NOISE)])
    made = posterior.likelihood.simulations
    of_samples = identifiability(posterior, samples)
    assert posterior.likelihood.simulations == made and of_samples.simulations == 0.0
    np.testing.assert_allclose(of_samples.left, np.sqrt(np.diag(covariance)), rtol=4.0 / np.sqrt(8000))
    named = dict(zip([*"abc", "sigma_top"], samples.T, strict=True))
    np.testing.assert_array_equal(identifiability(posterior, named).left, of_samples.left)


def test_a_product_is_found_with_its_exponents():
    prior = {"E": LogNormal(1.0, 0.2), "h": LogNormal(1.0, 0.1), "c": norm(0.0, 1.0)}
    posterior = posterior_of(
        lambda t: (np.log(t[0] * t[1] ** 3) * SHAPES[0] + t[2] * SHAPES[1])[None], prior, [1.1, 0.95, 0.4]
    )
    found = identifiability(posterior)
    (product,) = found.combinations
    np.testing.assert_allclose(product.exponents, [1.0, 3.0], rtol=1e-3)
    jacobian = np.stack([np.hypot(0.2, 0.3) * SHAPES[0], SHAPES[1]]) / NOISE  # by the product and by c
    covariance = np.linalg.inv(np.eye(2) + jacobian @ jacobian.T)
    np.testing.assert_allclose(found.left[2] ** 2, covariance[1, 1], rtol=2e-3)
    directions = np.sort(np.append(np.linalg.eigvalsh(covariance), 1.0))
    np.testing.assert_allclose(found.left_of_directions**2, directions, rtol=2e-3)
    assert "They determine the product E h^3.0" in str(found) and "E alone keeps" in str(found)
    assert "determine c (" in str(found)


def test_a_sum_of_parameters_that_may_be_negative():
    prior = {"a": norm(0.0, 1.0), "b": norm(0.0, 0.5)}
    found = identifiability(posterior_of(lambda t: ((t[0] - 2.0 * t[1]) * SHAPES[2])[None], prior, [0.3, 0.1]))
    (combination,) = found.combinations
    np.testing.assert_allclose(combination.exponents, [1.0, -2.0], rtol=1e-3)
    assert str(combination) == "the sum a - 2.0 b"
    assert str(found).startswith("These data determine no parameter alone. They determine the sum a - 2.0 b (")


def test_a_parameter_without_effect_keeps_its_prior():
    prior = {"a": norm(0.0, 1.0), "idle": LogNormal(2.0, 0.3)}
    found = identifiability(posterior_of(lambda t: (t[0] * SHAPES[0])[None], prior, [0.3, 2.0]))
    np.testing.assert_allclose(found.left[1], 1.0, rtol=1e-6)
    assert "They tell less of idle (100 % of the prior's standard deviation is left)." in found.sentences
    assert not found.combinations


def test_control_correlation_alone_makes_no_combination():
    """Parameters that the data determine, and directions of equal parameters, are not named as combinations."""
    determined = compare_covariances(np.array([[0.01, 0.0095], [0.0095, 0.01]]), "ab")
    equal = compare_covariances(0.04 * np.eye(3), "abc")
    weak = compare_covariances(np.array([[0.5, 0.2], [0.2, 0.5]]), "ab")
    assert not determined.combinations + equal.combinations + weak.combinations
    assert str(weak).endswith("They tell less of a and b (71 and 71 % of the prior's standard deviation are left).")
    five = np.full((5, 5), -0.199) + np.diag(np.full(5, 1.0))
    (many,) = compare_covariances(five, "abcde").combinations
    assert str(many) == "a combination of a, b, c, d and e"


def test_a_joint_prior_is_compared_with_its_own_correlation():
    prior_covariance = np.array([[1.0, 0.9], [0.9, 1.0]])
    prior = {("a", "b"): MultivariateNormal([0.0, 0.0], prior_covariance)}
    posterior = posterior_of(lambda t: (t[0] * SHAPES[0])[None], prior, [0.3, 0.2])
    information = np.diag([SHAPES[0] @ SHAPES[0] / NOISE**2, 0.0])
    covariance = np.linalg.inv(np.linalg.inv(prior_covariance) + information)
    found = identifiability(posterior)
    np.testing.assert_allclose(found.left, np.sqrt(np.diag(covariance)), rtol=1e-3)
    np.testing.assert_allclose(found.left_of_directions[1], 1.0, rtol=1e-3)  # one response, one direction


def test_errors_say_what_to_do():
    posterior = posterior_of(linear, {"a": norm(0.0, 1.0), "b": norm(0.0, 1.0)}, [0.3, 0.1])
    with pytest.raises(ValueError, match=r"10 samples for each of the 3 parameters; got 5: give all samples"):
        identifiability(posterior, np.ones((5, 3)))
    with pytest.raises(ValueError, match="positive definite posterior covariance .* give more samples that differ"):
        identifiability(posterior, np.full((100, 3), 0.3))
    with pytest.raises(ValueError, match="found none: allow more"):
        identifiability(posterior, max_simulations=1)
