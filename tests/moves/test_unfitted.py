"""Moves that no annealing has fitted: refused in emcee's own sampler, replaced where a chain goes on alone."""

import emcee
import pytest

from samplers.moves.population_moves import MixtureMove, RandomWalkMove
from tests.statistics.test_tails import StudentProduct


@pytest.mark.parametrize("make", [MixtureMove, RandomWalkMove])
def test_emcees_own_sampler_refuses_them(make, rng):
    sampler = emcee.EnsembleSampler(30, 2, StudentProduct(2), vectorize=True, moves=make())
    with pytest.raises(ValueError, match="use it in SMCSampler or TMCMCSampler"):
        sampler.run_mcmc(rng.standard_normal((30, 2)), 1)
