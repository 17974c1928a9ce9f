"""Every move of emcee, alone and mixed, with both samplers: the right evidence, means and variances."""

import numpy as np
import pytest
from emcee import moves

from samplers import SMCSampler, TMCMCSampler
from tests.contract.targets import Gaussian
from tests.statistics.test_posteriors import deviations, evidence_deviation, runs, within

POSTERIOR = Gaussian(3, sd=0.2)


def jump(coords, random):
    return coords + 0.1 * random.standard_normal(coords.shape), np.zeros(len(coords))


MOVES = {
    "StretchMove": moves.StretchMove(),
    "WalkMove": moves.WalkMove(s=8),
    "DEMove": moves.DEMove(),
    "KDEMove": moves.KDEMove(),
    "GaussianMove": moves.GaussianMove(0.01),
    "MHMove": moves.MHMove(jump),
    "all": [
        (moves.StretchMove(), 0.5),
        (moves.WalkMove(s=8), 0.1),
        (moves.DEMove(), 0.1),
        (moves.KDEMove(), 0.1),
        (moves.GaussianMove([0.01, 0.02, 0.03], mode="random"), 0.1),
        (moves.MHMove(jump), 0.1),
    ],
}


def is_right(samplers):
    centred = deviations(samplers, POSTERIOR.sd**2, lambda x: (x - POSTERIOR.mean) ** 2)
    return (
        within(deviations(samplers, POSTERIOR.mean), samplers)
        and within(centred, samplers)
        and within(evidence_deviation(samplers, POSTERIOR.log_evidence), samplers)
    )


@pytest.mark.parametrize(
    ("name", "Sampler"),
    [
        pytest.param(n, s, marks=() if n == "all" or (n, s) == ("MHMove", SMCSampler) else pytest.mark.slow)
        for n in MOVES
        for s in (SMCSampler, TMCMCSampler)
    ],
)
def test_every_move_of_emcee(name, Sampler, seed):
    settings = {"max_moves": 12} | ({"chains": "equal"} if Sampler is TMCMCSampler else {})
    samplers = runs(POSTERIOR, seed, count=6, nwalkers=100, Sampler=Sampler, moves=MOVES[name], **settings)
    assert is_right(samplers)
    assert all(0.0 < sampler.acceptance_fraction.mean() <= 1.0 for sampler in samplers)


def test_a_wrong_move_is_caught(seed):
    """Negative control: a stretch move without its factor in the acceptance probability."""

    class Unbalanced(moves.StretchMove):
        def get_proposal(self, s, c, random):
            proposed, factors = super().get_proposal(s, c, random)
            return proposed, np.zeros_like(factors)

    assert not is_right(runs(POSTERIOR, seed, count=6, nwalkers=100, moves=Unbalanced(), max_moves=25, min_moves=25))


# ---------------------------------------------------------------- the snooker move


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_the_snooker_move_of_emcee_is_refused_by_name(Sampler):
    for given in (moves.DESnookerMove(), [(moves.DEMove(), 0.8), (moves.DESnookerMove(), 0.2)]):
        with pytest.raises(ValueError, match="DESnookerMove is refused.*DEMove"):
            Sampler(40, 3, POSTERIOR, vectorize=True, moves=given)
