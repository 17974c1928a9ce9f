"""A first sampler on a cheap model, a second one that starts where it ended: the result is that of the second model."""

import numpy as np
import pytest
from scipy import stats

from samplers import SMCSampler, TMCMCSampler
from samplers.proposals.starting import StartingProposal
from tests.contract.targets import Box, Gaussian
from tests.statistics.test_posteriors import deviations, evidence_deviation, within

SD, N = 0.01, 400
FINE = Gaussian(7, sd=SD)
CLOSE = Gaussian(7, sd=1.5 * SD, centre=0.7 + 1.5 * SD)
FAR = Gaussian(7, sd=SD, centre=0.7 + 10.0 * SD)


def two_runs(fine, coarse, seed, count=4, Sampler=SMCSampler, n=N):
    made = []
    for k in range(count):
        first = Sampler(n, fine.ndim, coarse, vectorize=True, seed=[seed, k])
        first.run_mcmc(None, 0)
        proposal = first.proposal
        made.append(Sampler(n, fine.ndim, fine, vectorize=True, seed=[seed, k], start_density=proposal.logpdf))
        made[-1].run_mcmc(proposal.rvs(n, k), 2)
    return made


def is_right(samplers, posterior=FINE):
    return within(deviations(samplers, posterior.mean), samplers) and within(
        evidence_deviation(samplers, posterior.log_evidence), samplers
    )


@pytest.mark.filterwarnings("error::samplers.SamplingWarning")
def test_a_close_model_saves_evaluations(seed):
    alone = SMCSampler(N, 7, FINE, vectorize=True, seed=seed)
    alone.run_mcmc(None, 2)
    samplers = two_runs(FINE, CLOSE, seed)
    assert is_right(samplers)
    assert 2 * max(len(sampler.ladder) for sampler in samplers) < len(alone.ladder)
    assert np.mean([sampler.evaluations for sampler in samplers]) < alone.evaluations


@pytest.mark.slow
def test_a_model_far_away_changes_no_result(seed):
    assert is_right(two_runs(FINE, FAR, seed, count=3))


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_a_sampler_that_moves(seed):
    samplers = two_runs(Gaussian(3, sd=0.05), Gaussian(3, sd=0.1), seed, Sampler=TMCMCSampler, n=200)
    assert is_right(samplers, Gaussian(3, sd=0.05))


def test_a_mode_that_the_cheap_model_misses(seed):
    """Two modes, 1:2; the cheap model has the smaller one alone."""

    def modes(weights):
        def log_likelihood(x):
            parts = [np.sum(stats.norm.logpdf(x, c, 0.05), axis=-1) for c in (0.25, 0.75)]
            return np.logaddexp.reduce([np.log(w) + p for w, p in zip(weights, parts, strict=True)])

        return Box([0.0, 0.0], [1.0, 1.0], log_likelihood)

    samplers = two_runs(modes([1 / 3, 2 / 3]), modes([1.0, 1e-300]), seed, count=3)
    shares = [np.mean(sampler.get_chain(flat=True)[:, 0] > 0.5) for sampler in samplers]
    assert np.mean(shares) == pytest.approx(2 / 3, abs=0.05)


def test_the_proposal_is_a_normalised_density(rng):
    """Points at the bound of a box: draws lie inside, and the density integrates to 1 there."""
    box = Box([0.0, 0.0], [1.0, 2.0], lambda x: np.zeros(x.shape[:-1]))
    points = np.column_stack([rng.beta(1.0, 20.0, 300), rng.normal(1.0, 0.1, 300)])
    proposal = StartingProposal(points, box.log_prior, box.sample_prior)
    drawn = proposal.rvs(20_000, 1)
    assert drawn.shape == (20_000, 2) and np.all(np.isfinite(box.log_prior(drawn)))
    np.testing.assert_array_equal(drawn, proposal.rvs(20_000, np.random.RandomState(1)))
    uniform = rng.uniform([0.0, 0.0], [1.0, 2.0], (200_000, 2))
    values = 2.0 * np.exp(proposal.logpdf(uniform))
    assert values.mean() == pytest.approx(1.0, abs=4.0 * values.std() / np.sqrt(len(values)) + 0.02)
    ratios = np.exp(box.log_prior(drawn) - proposal.logpdf(drawn))  # prior over proposal, mean 1 over its draws
    assert ratios.mean() == pytest.approx(1.0, abs=4.0 * ratios.std() / np.sqrt(len(ratios)) + 0.02)
    assert proposal.logpdf(drawn[0]) == pytest.approx(proposal.logpdf(drawn)[0])
    assert proposal.logpdf(np.array([-0.1, 1.0])) == -np.inf


def test_a_proposal_needs_a_finished_run_and_draws_of_the_prior():
    with pytest.raises(ValueError, match="call run_mcmc first"):
        _ = SMCSampler(60, 3, Gaussian(), vectorize=True).proposal
    plain = Gaussian()
    sampler = SMCSampler(60, 3, lambda x: plain(x), vectorize=True, log_prior_fn=plain.log_prior, seed=1)
    sampler.run_mcmc(plain.sample_prior(60, np.random.RandomState(1)), 0)
    with pytest.raises(ValueError, match="no method sample_prior"):
        _ = sampler.proposal
