"""Residuals of runs in a file: forms of combinations, memory."""

import tracemalloc

import numpy as np
import pytest

from fe_likelihoods.emulation.archive import Archive
from fe_likelihoods.noise.residuals import lag_one_sums
from fe_likelihoods.noise.sufficient_statistics import check_quadratic, sums_of_squares
from fe_likelihoods.priors.distributions import TruncatedNormal
from samplers import SMCSampler
from tests.statistics.hard_posteriors import HardPosterior


@pytest.mark.parametrize("statistic", [sums_of_squares, lag_one_sums])
def test_forms_are_those_of_the_combined_histories(statistic):
    rng = np.random.default_rng(1)
    archive, shape = Archive(statistic, (3, 40)), (3, 40)
    residuals = rng.standard_normal((7, *shape)) * np.array([1.0, 1e-3, 1e4])[:, None]
    first = archive.add(np.zeros((4, 2)), residuals[:4], np.zeros((4, 3)))
    early = archive.weights([rng.standard_normal(4), 2])
    assert archive.forms(early).shape[:2] == (2, 2)  # products of some runs are known before others arrive
    numbers = [*first, *archive.add(np.zeros((3, 2)), residuals[4:], np.zeros((3, 3)))]
    assert numbers == list(range(7)) and len(archive) == 7
    weights = archive.weights([*early, rng.standard_normal(7), 6, rng.standard_normal(3)])
    rounded = residuals.astype(np.float32).astype(float)
    histories = np.tensordot(weights, rounded, axes=1)
    factors = np.array([[statistic(one + other) - statistic(one - other) for other in histories] for one in histories])
    expected = 0.25 * factors  # the bilinear form of a quadratic one
    scale = np.sqrt(np.einsum("kka,lla->kla", np.abs(expected), np.abs(expected)))
    assert (np.abs(archive.forms(weights) - expected) <= 1e-9 * scale).all()
    np.testing.assert_array_equal(archive.read(range(5, 6))[0], rounded[5])


def test_a_statistic_that_is_not_quadratic_is_refused():
    histories = np.random.default_rng(1).standard_normal((2, 50))
    check_quadratic(lag_one_sums, histories)
    with pytest.raises(ValueError, match="not quadratic"):
        check_quadratic(lambda residuals: np.abs(residuals).max(axis=1), histories)


def _linear(theta):
    return theta


@pytest.mark.slow
def test_a_run_does_not_hold_its_responses_in_memory():
    """The responses of 130 simulations have 200 MiB; all copies of them had nearly three times as much."""
    for n_steps in (50, 5000):  # the first run imports what is imported late
        prior = {name: TruncatedNormal(1.0, 0.3) for name in ("a", "b")}
        posterior = HardPosterior("linear", prior, _linear, (1.1, 0.9), n_steps=n_steps, n_channels=40).posterior(1)
        posterior.likelihood.simulator.response_memory.most = 2**24
        guide, limit = posterior.guide(), 400
        sampler = SMCSampler(100, 2, posterior, vectorize=True, guide=guide, max_simulations=limit, seed=1)
        tracemalloc.start()
        try:
            sampler.run_mcmc(None, 0)
            _, largest = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert sampler.verdict.simulations > 120
    assert largest < 300 * 2**20  # three or four copies of the responses that are simulated together, 64 MiB each
