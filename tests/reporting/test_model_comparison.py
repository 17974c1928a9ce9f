"""Comparison of models: against exact evidences, and propagation of their errors against Monte Carlo."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.special import softmax

from samplers import SMCSampler, compare_models


class Regression:
    """Polynomial regression with standard normal coefficients, whose evidence is known."""

    def __init__(self, degree, x, y, sd):
        self.ndim = degree + 1
        self.design, self.y, self.noise = np.vander(x, self.ndim, increasing=True), y, sd
        covariance = sd**2 * np.eye(len(x)) + self.design @ self.design.T
        self.log_evidence = stats.multivariate_normal(np.zeros(len(x)), covariance).logpdf(y)

    def log_prior(self, theta):
        return stats.norm.logpdf(theta).sum(axis=-1)

    def __call__(self, theta):
        return self.log_prior(theta) + stats.norm.logpdf(self.y, theta @ self.design.T, self.noise).sum(axis=-1)

    def sample_prior(self, n, rng):
        return rng.standard_normal((n, self.ndim))


def test_conjugate_models_by_smc(seed, rng):
    x = np.linspace(-1.0, 1.0, 25)
    y = 0.3 + 0.8 * x + 0.25 * rng.normal(size=25)
    models = {f"degree {d}": Regression(d, x, y, 0.25) for d in (1, 2, 3)}
    samplers = {}
    for k, (name, model) in enumerate(models.items()):
        samplers[name] = SMCSampler(300, model.ndim, model, vectorize=True, seed=[seed, k])
        samplers[name].run_mcmc(None, 1)
    found = compare_models(samplers).loc[list(models)]
    exact = np.array([model.log_evidence for model in models.values()])
    assert [*found.verdict] == [sampler.verdict.status for sampler in samplers.values()]
    assert np.all(np.abs(found.log_evidence - exact) < 4.0 * found.error)
    # the errors are estimates from one run each, so five of them are allowed: the intervals have two
    assert np.all(found.probability - softmax(exact) < 2.5 * (found.probability - found.lower))
    assert np.all(softmax(exact) - found.probability < 2.5 * (found.upper - found.probability))
    assert found.probability.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("values", [(0.0, -1.0), (0.0, -0.3, -2.0), (5000.0, 4999.0, 4990.0)])
def test_errors_against_monte_carlo(values, rng):
    errors = np.linspace(0.02, 0.08, len(values))
    names = [f"m{k}" for k in range(len(values))]
    found = compare_models(dict(zip(names, zip(values, errors, strict=True), strict=True)))
    draws = rng.normal(values, errors, size=(20_000, len(values)))
    probabilities = softmax(draws, axis=1)
    assert np.allclose(found.probability, softmax(values))
    low, high = np.quantile(probabilities, [0.025, 0.975], axis=0)
    assert np.allclose(found.upper - found.lower, high - low, rtol=0.07)


def test_the_interval_is_right_for_large_errors(rng):
    """For two models the log-odds are exactly normal."""
    found = compare_models({"a": (0.0, 2.0), "b": (-1.0, 0.1)})
    low, high = np.quantile(
        softmax(rng.normal([0.0, -1.0], [2.0, 0.1], size=(20_000, 2)), axis=1), [0.025, 0.975], axis=0
    )
    assert np.allclose(found.lower, low, atol=0.01) and np.allclose(found.upper, high, atol=0.01)
    assert np.all((found.lower >= 0.0) & (found.upper <= 1.0))


@pytest.mark.parametrize(
    ("models", "message"),
    [
        ({"a": (0.0, 0.1)}, "two models or more"),
        ([(0.0, 0.1), (1.0, 0.1)], "by name"),
        ({"a": (0.0, 0.1), "b": (np.nan, 0.1)}, "'b'.*finite"),
        ({"a": (0.0, 0.1), "b": (-np.inf, 0.1)}, "'b'.*finite"),
        ({"a": (0.0, -0.1), "b": (0.0, 0.1)}, "'a'.*negative"),
        ({"a": (0.0, 0.1), "b": 3.0}, "'b'.*expected a sampler"),
    ],
)
def test_refused(models, message):
    with pytest.raises(ValueError, match=message):
        compare_models(models)


def finished(data_fingerprint=None):
    """A sampler that has run, of a posterior with the given digest of its measurements."""
    posterior = SimpleNamespace() if data_fingerprint is None else SimpleNamespace(data_fingerprint=data_fingerprint)
    return SimpleNamespace(log_evidence=0.0, log_evidence_error=0.1, log_prob_fn=SimpleNamespace(f=posterior))


def test_different_data_are_refused():
    with pytest.raises(ValueError, match="one, other are of different measurements"):
        compare_models({"one": finished("a1"), "unknown": finished(), "other": finished("b2")})
