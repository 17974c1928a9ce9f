"""Modes of posteriors with their Laplace approximations, against closed forms, quadrature and another minimiser."""

import numpy as np
import pytest
from scipy import integrate, optimize

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    JointLikelihood,
    Measurements,
    Posterior,
    problems,
)
from fe_likelihoods import TruncatedNormal as Normal
from fe_likelihoods.emulation.modes import find_modes
from tests.likelihood.linear_gaussian import KnownNoise, exact_log_evidence, likelihood_of

CHANNELS = (Channel("top", "displacement", "m"),)
NAMES = ("a", "b", "c")


def linear(rng, joint):
    """Posterior of linear models, and its log-evidence, mean and covariance."""
    first, second = likelihood_of(NAMES[:2], rng), likelihood_of(NAMES[1:], rng, n_steps=9, sigma=0.3)
    prior = {name: Normal(0.5, 2.0, lower=-1000.0) for name in NAMES}
    if joint:
        likelihood, parts = JointLikelihood({"one": first, "two": second}), [first, second]
    else:
        likelihood = likelihood_of(NAMES, rng)
        parts = [likelihood]
    precision, weighted = np.eye(3) / 2.0**2, np.full(3, 0.5 / 2.0**2)
    for part in parts:
        at = [NAMES.index(name) for name in part.model.parameter_names]
        precision[np.ix_(at, at)] += part.model.design.T @ part.model.design / part.noise.sigma**2
        weighted[at] += part.model.design.T @ part.measurements.values[0] / part.noise.sigma**2
    evidence = exact_log_evidence(parts, NAMES, 0.5, 2.0)
    return Posterior(likelihood, prior), evidence, np.linalg.solve(precision, weighted), np.linalg.inv(precision)


@pytest.mark.parametrize("joint", [False, True])
def test_linear_models_have_their_exact_posterior(joint, rng):
    posterior, evidence, mean, covariance = linear(rng, joint)
    found = find_modes(posterior, seed=1, tolerance=1e-6)  # less than 2e-3 standard deviations from the top
    (mode,) = found.modes
    sd = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(mode.parameters / sd, mean / sd, atol=5e-3)
    np.testing.assert_allclose(mode.parameter_covariance / np.outer(sd, sd), covariance / np.outer(sd, sd), atol=1e-5)
    assert found.log_evidence == pytest.approx(evidence, abs=1e-5)
    assert mode.converged and found.finished
    assert joint or found.simulations == posterior.likelihood.simulations


def test_no_minimiser_finds_more_and_a_repeated_search_simulates_nothing():
    posterior = problems.free_vibration()
    found = posterior.mode(seed=1)
    (mode,) = found.modes
    options = {"xatol": 1e-10, "fatol": 1e-10, "maxiter": 4000}
    best = optimize.minimize(lambda x: -posterior(x), mode.parameters, method="Nelder-Mead", options=options)
    assert posterior.log_prob(mode.parameters) == pytest.approx(-best.fun, abs=0.02)
    sd = np.sqrt(np.diag(mode.parameter_covariance))
    np.testing.assert_allclose(mode.parameters / sd, best.x / sd, atol=0.2)
    simulations = posterior.likelihood.simulations
    text = str(posterior.mode(seed=1))
    assert posterior.likelihood.simulations == simulations
    assert "stiffness" in text and "log-evidence" in text


def of_square(value, prior, sigma=0.05):
    """Posterior of x with measurements of x**2 in ten samples."""
    model = FunctionModel(lambda theta: np.full((1, 10), theta[0] ** 2), ["x"], CHANNELS, dt=1.0, n_steps=10)
    data = Measurements(model.channels, 1.0, value + sigma * np.random.default_rng(2).normal(size=(1, 10)))
    return Posterior(FELikelihood(model, data, KnownNoise(sigma)), {"x": prior})


def evidence_of(posterior, low, high):
    """Log-evidence of one parameter by quadrature."""
    x = np.linspace(low, high, 4001)
    values = posterior.log_prob(x[:, None])
    return values.max() + np.log(integrate.trapezoid(np.exp(values - values.max()), x))


def test_two_modes_share_the_evidence():
    posterior = of_square(1.0, Normal(0.2, 1.0, lower=-20.0))
    found = posterior.mode(seed=1)
    assert np.round([mode.parameters[0] for mode in found.modes], 1).tolist() == [1.0, -1.0]
    assert found.log_evidence == pytest.approx(evidence_of(posterior, -3.0, 3.0), abs=0.005)
    for mode, (low, high) in zip(found.modes, [(0.0, 3.0), (-3.0, 0.0)], strict=True):
        assert mode.log_evidence == pytest.approx(evidence_of(posterior, low, high), abs=0.005)


def test_a_mode_beside_failures_is_found():
    """Above 1.005, a tenth of a standard deviation above the mode, every simulation fails."""

    def respond(theta):
        if theta[0] > 1.005:
            raise RuntimeError("too large")
        return np.full((1, 10), theta[0])

    model = FunctionModel(respond, ["x"], CHANNELS, dt=1.0, n_steps=10)
    data = Measurements(model.channels, 1.0, 1.0 + 0.5 * np.linspace(-1.0, 1.0, 10)[None])
    posterior = Posterior(FELikelihood(model, data, KnownNoise(0.5)), {"x": Normal(0.9, 0.5)})
    (mode,) = posterior.mode(seed=1).modes
    assert mode.parameters[0] == pytest.approx(1.0 - 0.1 / 11.0, abs=0.02) and mode.converged


@pytest.mark.parametrize("make", [problems.free_vibration, lambda: linear(np.random.default_rng(1), True)[0]])
def test_progress_shows_the_simulations_from_the_first_one_on(make, capsys):
    make().mode(seed=1)
    assert capsys.readouterr().err == ""
    found = make().mode(seed=1, progress=True)
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith("search: 0 simulations [")
    assert last.startswith(f"search: {found.simulations:.0f} simulations [")


def test_a_limit_ends_the_search():
    found = problems.free_vibration().mode(seed=1, max_simulations=4)
    assert not found.finished
    with pytest.raises(ValueError, match="starts"):
        problems.free_vibration().mode(starts=0)
