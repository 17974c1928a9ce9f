"""Points are moved by fits to other points, so that many parameters keep their spread."""

import numpy as np
import pytest
from emcee import State
from emcee.model import Model
from scipy.stats import norm

from samplers.estimates.weights import normalised_weights
from samplers.moves import population_moves
from samplers.moves.population_moves import MixtureMove
from samplers.proposals.mixture import fit_mixture, leave_out, log_density
from samplers.resampling import systematic

NDIM, N, RUNS = 30, 400, 4


def log_target(x):
    return norm.logpdf(x).sum(axis=1)


def change_of_variance(seed, parts):
    """Change of the mean square of resampled normal points in the first sweep after a calibration."""
    random = np.random.RandomState(seed)
    variance = 1.3
    points = np.sqrt(variance) * random.standard_normal((N, NDIM))
    weights = normalised_weights(-0.5 * (1.0 - 1.0 / variance) * np.sum(points**2, axis=1))
    move = MixtureMove()
    move.calibrate(points, weights)
    ancestors = systematic(weights, random, N)
    if parts:
        move.follow(ancestors)
    start = points[ancestors]
    model = Model(None, lambda x: (log_target(x), None), map, random)
    state, accepted = move.propose(model, State(start.copy(), log_prob=log_target(start)))
    assert accepted.any()
    return np.mean(state.coords**2) - np.mean(start**2)


@pytest.mark.parametrize(("parts", "low", "high"), [(True, -0.02, 0.02), (False, 0.022, 0.1)])
def test_independent_draws_keep_the_spread_of_many_parameters(parts, low, high):
    """Four runs have a standard error of 0.005. Negative control: one fit to all points makes them too wide."""
    changes = [change_of_variance(seed, parts) for seed in range(RUNS)]
    assert low < np.mean(changes) < high


def test_a_point_has_no_part_in_the_fit_that_moves_it(rng):
    """A point that is far away changes every mixture except the one of its own part."""
    points = rng.standard_normal((200, 6))
    weights, parts = np.full(200, 1.0 / 200), np.arange(200) % 10
    mixture = fit_mixture(points, weights)
    here = leave_out(mixture, points, weights, parts)
    moved = points.copy()
    moved[3] += 0.5  # of part 3
    there = leave_out(mixture, moved, weights, parts)
    differ = [
        not np.allclose(log_density(a, points[:5]), log_density(b, points[:5]))
        for a, b in zip(here, there, strict=True)
    ]
    assert differ == [part != 3 for part in range(10)]


def test_one_step_without_a_part_stays_near_the_fit(rng):
    points = rng.standard_normal((500, 3)) + 8.0 * (np.arange(500) % 2)[:, None]
    weights = np.full(500, 1.0 / 500)
    mixture = fit_mixture(points, weights)
    for each in leave_out(mixture, points, weights, np.arange(500) % 10):
        assert len(each.weights) == 2
        assert np.allclose(each.means, mixture.means, atol=0.1) and np.allclose(
            each.covariances, mixture.covariances, atol=0.2
        )


@pytest.mark.parametrize(("ndim", "fitted"), [(14, 0), (15, population_moves.PARTS)])
def test_few_parameters_need_no_parts(ndim, fitted, rng):
    move = MixtureMove()
    move.calibrate(rng.standard_normal((100, ndim)), np.full(100, 0.01))
    assert len(move._mixtures) == fitted
