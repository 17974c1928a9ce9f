"""Chains from leaders, the default of TMCMCSampler: right within their stated errors, and not the run of SMCSampler."""

import numpy as np
import pytest
from scipy import stats

from samplers import TMCMCSampler
from samplers.moves.population_moves import RandomWalkMove
from tests.contract.targets import Box, Gaussian
from tests.statistics.test_posteriors import deviations, evidence_deviation, runs, within


def test_truncated_prior_edges(seed):
    """The posterior is largest at two edges of the box, which cut it off."""
    posterior = Box([0, 0], [1, 1], lambda x: -10.0 * x[..., 0] + 3.0 * x[..., 1])
    samplers = runs(posterior, seed, count=12, nwalkers=100, nsteps=2, Sampler=TMCMCSampler)
    falling = stats.truncexpon(b=10, scale=0.1).mean()
    rising = 1.0 - stats.truncexpon(b=3, scale=1.0 / 3.0).mean()
    assert within(deviations(samplers, [falling, rising]), samplers)
    log_evidence = np.log((1.0 - np.exp(-10.0)) / 10.0) + np.log((np.exp(3.0) - 1.0) / 3.0)
    assert within(evidence_deviation(samplers, log_evidence), samplers)


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "biased"), [({}, False), ({"burn_in": 0, "moves": RandomWalkMove(0.7)}, True)])
def test_burn_in_removes_the_bias_of_chains_from_leaders(settings, biased, seed):
    """Negative control: without burn-in, a random walk has a bias that many points do not remove."""
    posterior = Gaussian(1, sd=0.2)
    variance = posterior.sd**2 + (posterior.mean - 0.7) ** 2
    samplers = runs(posterior, seed, count=40, nwalkers=1000, nsteps=1, Sampler=TMCMCSampler, check_draws=0, **settings)
    found = within(deviations(samplers, variance, lambda x: (x - 0.7) ** 2), samplers)
    assert found != biased


@pytest.mark.slow
@pytest.mark.parametrize(("burn_in", "right"), [(4, True), (0, False)])
def test_few_walkers_for_many_parameters(burn_in, right, seed):
    """Chains alone leave copies, of which the next fit sees too few distinct points; the control makes no sweeps."""
    posterior = Gaussian(12, sd=0.1)
    samplers = runs(posterior, seed, count=3, nwalkers=100, nsteps=1, Sampler=TMCMCSampler, burn_in=burn_in)
    off = np.array([(s.get_chain(flat=True).mean(axis=0) - posterior.mean) / posterior.sd for s in samplers])
    assert (np.sqrt(np.mean(off**2)) < 0.25) == right
