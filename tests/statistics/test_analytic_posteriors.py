"""The analytic posteriors have the evidences, moments and shares that they state."""

import numpy as np
import pytest
from scipy import integrate, stats

from tests.statistics import analytic_posteriors as analytic


def test_modes_have_the_stated_shares_moments_and_evidence(rng):
    posterior = analytic.modes(3, 2, 1, 4.0, 3.0, 2.0, "box")
    grid = np.linspace(-3.0, 3.0, 200_001)
    density = np.exp(posterior(grid[:, None]))
    shares = integrate.trapezoid(density[:, None] * posterior.responsibilities(grid[:, None]), grid, axis=0)
    mean = integrate.trapezoid(density * grid, grid)
    assert integrate.trapezoid(density, grid) == pytest.approx(np.exp(posterior.log_evidence))
    np.testing.assert_allclose(shares, posterior.shares, rtol=1e-6)
    assert max(shares) / min(shares) == pytest.approx(3.0)
    assert mean == pytest.approx(posterior.mean[0])
    assert integrate.trapezoid(density * (grid - mean) ** 2, grid) == pytest.approx(posterior.sd[0] ** 2)


def test_posterior_on_bounds_has_the_stated_moments_and_evidence(rng):
    posterior = analytic.bounds(1)
    grid = np.linspace(0.0, 1.0, 100_001)
    log_evidence = posterior(posterior.mean[None])[0]
    for i in range(posterior.ndim):  # a product: one dimension after the other, the others at their means
        points = np.tile(posterior.mean, (len(grid), 1))
        points[:, i] = grid
        relative = np.exp(posterior(points) - posterior(posterior.mean[None]))
        integral = integrate.trapezoid(relative, grid)
        mean = integrate.trapezoid(relative * grid, grid) / integral
        log_evidence += np.log(integral)
        assert mean == pytest.approx(posterior.mean[i], rel=1e-4)
        assert integrate.trapezoid(relative * (grid - mean) ** 2, grid) / integral == pytest.approx(
            posterior.sd[i] ** 2, rel=1e-3
        )
    assert log_evidence == pytest.approx(posterior.log_evidence, abs=1e-3)


def test_densities_of_the_other_families_are_those_of_scipy(rng):
    x = rng.uniform(-3.0, 3.0, (20, 10))
    student = analytic.student(1)
    np.testing.assert_allclose(student(x), stats.multivariate_t(student.mean, df=3.0).logpdf(x))
    bent = analytic.banana(1)
    steps = [stats.norm(0.0, 1.0).logpdf(x[:, 0])]
    steps += [stats.norm(x[:, 0] ** 2, 0.1).logpdf(x[:, i]) for i in (1, 2)]
    steps += [stats.norm(0.0, 0.1).logpdf(x[:, i]) for i in (3, 4)]
    np.testing.assert_allclose(bent(x[:, :5]), np.sum(steps, axis=0))
    rough = analytic.rough(1, 1.0)
    draws = rough.mean + rough.sd * rng.standard_normal((20_000, 5))
    jumps = rough(draws) - stats.multivariate_normal(rough.mean, np.diag(rough.sd**2)).logpdf(draws)
    assert np.log(np.mean(np.exp(jumps))) == pytest.approx(rough.log_evidence, abs=0.05)
    assert np.std(jumps) == pytest.approx(1.0, abs=0.03)


def test_bent_posteriors_have_the_stated_moments_and_evidence(rng):
    bent = analytic.rotated_banana(2, bend=0.02)
    y = np.column_stack([10.0 * rng.standard_normal(100_000), rng.standard_normal((100_000, 4))])
    assert np.exp(bent.log_evidence) == 1.0
    y[:, 1] -= 0.02 * (y[:, 0] ** 2 - 100.0)
    rotation = np.linalg.qr(np.random.RandomState(2).standard_normal((5, 5)))[0]
    draws = y @ rotation.T
    np.testing.assert_allclose(draws.std(axis=0), bent.sd, rtol=0.02)
    np.testing.assert_allclose(draws.mean(axis=0), bent.mean, atol=0.15)
    chain = analytic.rosenbrock(1)
    wide = stats.multivariate_t(chain.mean, 4.0 * np.diag(chain.sd**2), df=5, seed=1)
    draws = wide.rvs(400_000)
    log_weights = np.where(chain.log_prior(draws) > -np.inf, chain(draws), -np.inf) - wide.logpdf(draws)
    assert np.log(np.mean(np.exp(log_weights))) == pytest.approx(chain.log_evidence, abs=0.06)
    weights = np.exp(log_weights) / np.sum(np.exp(log_weights))
    assert np.all(np.abs(weights @ draws - chain.mean) < 0.2 * chain.sd)
