"""Chains from leaders, the default of TMCMCSampler: right within their stated errors, and not the run of SMCSampler."""

import numpy as np
import pytest

from samplers import TMCMCSampler
from samplers.moves.population_moves import RandomWalkMove
from tests.contract.targets import Gaussian
from tests.statistics.test_posteriors import deviations, runs, within


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "biased"), [({}, False), ({"burn_in": 0, "moves": RandomWalkMove(0.7)}, True)])
def test_burn_in_removes_the_bias_of_chains_from_leaders(settings, biased, seed):
    """Negative control: without burn-in, a random walk has a bias that many points do not remove."""
    posterior = Gaussian(1, sd=0.2)
    variance = posterior.sd**2 + (posterior.mean - 0.7) ** 2
    samplers = runs(posterior, seed, count=40, nwalkers=1000, nsteps=1, Sampler=TMCMCSampler, **settings)
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
