"""Weights, next beta, resampling, error of the evidence, and proposals that are drawn from the density they state."""

import numpy as np
import pytest
from scipy.special import logsumexp

from samplers.estimates.weights import (
    EvidenceError,
    coarse_weights,
    effective_sample_size,
    log_mean_weight,
    next_beta,
    normalised_weights,
)
from samplers.resampling import RESAMPLING


@pytest.mark.parametrize("offset", [-5000.0, 0.0, 5000.0, 1e8])
def test_weights_do_not_depend_on_an_offset(rng, offset):
    log_weights = 30 * rng.standard_normal(500)
    log_weights[7] = -np.inf
    shifted = log_weights + offset
    assert effective_sample_size(shifted) == pytest.approx(effective_sample_size(log_weights), rel=1e-6)
    assert log_mean_weight(shifted) == pytest.approx(logsumexp(log_weights) - np.log(500) + offset, rel=1e-12)
    assert np.allclose(normalised_weights(shifted), np.exp(log_weights - logsumexp(log_weights)), atol=1e-9)
    if abs(offset) <= 5000:
        assert np.array_equal(coarse_weights(shifted), coarse_weights(log_weights))
    assert np.allclose(coarse_weights(log_weights), normalised_weights(log_weights), rtol=1e-3)


def test_extremes():
    assert effective_sample_size(np.zeros(10)) == pytest.approx(10)
    assert effective_sample_size(np.array([0.0, -np.inf, -np.inf])) == 1
    assert effective_sample_size(np.full(3, -np.inf)) == 0
    assert log_mean_weight(np.full(3, -np.inf)) == -np.inf
    with pytest.raises(ValueError, match="every weight is zero"):
        normalised_weights(np.full(3, -np.inf))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e9])
@pytest.mark.parametrize("beta", [0.0, 1e-9, 0.3])
def test_next_beta_meets_the_target_or_is_one(rng, scale, beta):
    log_likelihood = -scale * rng.chisquare(5, size=400) - 5000
    found = next_beta(log_likelihood, beta, 200)
    assert beta < found <= 1
    reached = effective_sample_size((found - beta) * log_likelihood)
    if found == 1:
        assert reached >= 200
    elif (found - beta) > 1e-9 * found:
        assert reached == pytest.approx(200, rel=1e-4)


def test_next_beta_of_special_likelihoods(rng):
    assert next_beta(np.full(100, -5000.0), 0.0, 99) == 1.0
    half_dead = np.where(np.arange(100) < 50, -np.inf, -1.0)
    assert next_beta(half_dead, 0.0, 95) == 1.0  # the target refers to points of finite likelihood
    log_likelihood = np.where(np.arange(100) < 50, -np.inf, -1e4 * rng.uniform(size=100))
    found = next_beta(log_likelihood, 0.0, 80)
    assert effective_sample_size(found * log_likelihood[50:]) == pytest.approx(40, rel=1e-4)
    with pytest.raises(ValueError, match="no point"):
        next_beta(np.full(5, -np.inf), 0.0, 3)
    cliff = np.append(np.full(99, -1e300), 0.0)  # no representable step keeps the target: beta still increases
    assert 0.5 < next_beta(cliff, 0.5, 50) < 0.5 + 1e-15


@pytest.mark.parametrize("name", sorted(RESAMPLING))
def test_resampling_is_unbiased(rng, name):
    n, repeats = 40, 4000
    weights = rng.dirichlet(2.0 * np.ones(n))
    weights[5] = 0
    weights[-1] = 0
    weights /= weights.sum()
    counts = np.zeros((repeats, n))
    for k in range(repeats):
        ancestors = RESAMPLING[name](weights, rng)
        assert ancestors.shape == (n,)
        counts[k] = np.bincount(ancestors, minlength=n)
    assert counts[:, 5].max() == counts[:, -1].max() == 0
    error = counts.std(axis=0, ddof=1) / np.sqrt(repeats) + 1e-9
    assert np.max(np.abs(counts.mean(axis=0) - n * weights) / error) < 4.5
    if name == "systematic":
        assert np.max(np.abs(counts - n * weights)) < 1


def test_evidence_error_of_independent_points_is_that_of_importance_sampling(rng):
    n, runs, estimates, errors = 300, 400, [], []
    for _ in range(runs):
        log_weights = rng.standard_normal(n)
        estimates.append(log_mean_weight(log_weights))
        errors.append(EvidenceError(n).weigh(normalised_weights(log_weights)))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(estimates), rel=4 * np.sqrt(0.5 / runs) + 0.05)


def test_evidence_error_sees_points_that_never_move(rng):
    """Two half steps without moves in between are one whole step of importance sampling."""
    n = 400
    log_likelihood = 1.5 * rng.standard_normal(n)
    whole = EvidenceError(n).weigh(normalised_weights(log_likelihood))
    halves = EvidenceError(n)
    weights = normalised_weights(0.5 * log_likelihood)
    halves.weigh(weights)
    ancestors = RESAMPLING["systematic"](weights, rng)
    halves.resample(ancestors)
    assert halves.weigh(normalised_weights(0.5 * log_likelihood[ancestors])) == pytest.approx(whole, rel=0.05)
    weights, closed = np.array([0.4, 0.3, 0.2, 0.1]), EvidenceError(4)  # four founders are few
    for count in (1, 2, 3):  # every resampling leaves too few founders, so that the sums of all stages add up
        assert closed.weigh(weights) == pytest.approx(np.sqrt(count * 0.05))
        closed.resample(np.array([0, 0, 1, 2]))
