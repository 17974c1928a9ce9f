"""Moves that no annealing has fitted: refused in emcee's own sampler, replaced where a chain goes on alone."""

import emcee
import numpy as np
import pytest

from samplers import MixtureMove, RandomWalkMove, SMCSampler
from tests.statistics.test_tails import StudentProduct


@pytest.mark.parametrize("make", [MixtureMove, RandomWalkMove])
def test_emcees_own_sampler_refuses_them(make, rng):
    sampler = emcee.EnsembleSampler(30, 2, StudentProduct(2), vectorize=True, moves=make())
    with pytest.raises(ValueError, match="use it in SMCSampler or TMCMCSampler"):
        sampler.run_mcmc(rng.standard_normal((30, 2)), 1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_a_chain_that_goes_on_in_another_sampler_keeps_heavy_tails(seed):
    """The proposal of recycling is lost with the first sampler; a fit to all walkers gave 0.94 of the variance."""
    target = StudentProduct(2)
    _, variance = target.moments()
    change = []
    for number in range(250):
        backend = emcee.backends.Backend()
        settings = {"vectorize": True, "seed": 1000 * seed + number, "backend": backend}
        SMCSampler(250, 2, target, **settings).run_mcmc(None, 1)
        SMCSampler(250, 2, target, **settings).run_mcmc(None, 2)
        before, *after = np.mean(backend.get_chain() ** 2, axis=(1, 2)) / variance
        change.append(np.mean(after) - before)
    error = np.std(change, ddof=1) / np.sqrt(len(change))
    print(np.mean(change), error)
    assert error < 0.013 and abs(np.mean(change)) < 3.0 * error
