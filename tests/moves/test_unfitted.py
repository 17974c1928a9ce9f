"""Moves that nobody has calibrated: no walker has a part in the fit of its own proposal."""

import warnings

import emcee
import numpy as np
import pytest
from emcee import State
from emcee.model import Model
from scipy import stats

from samplers import SMCSampler
from samplers.moves.fast_parameters import FastWalk
from samplers.moves.population_moves import MixtureMove, RandomWalkMove, _first_half
from tests.statistics.test_tails import SCALE, StudentProduct

N = 40


def proposals_of(move, coords, sweeps):
    """Points (sweeps, n, ndim) that a move proposes to an ensemble; none of them is accepted."""
    proposed = []

    def compute_log_prob(points):
        proposed.append(points.copy())
        return np.full(len(points), -np.inf), None

    model = Model(compute_log_prob, compute_log_prob, map, np.random.RandomState(3))
    state = State(coords, log_prob=np.zeros(len(coords)))
    for _ in range(sweeps):
        state, _ = move.propose(model, state)
    return np.array(proposed)


@pytest.mark.parametrize("make", [MixtureMove, RandomWalkMove, lambda: FastWalk([1])])
def test_a_walker_has_no_part_in_its_own_proposal(make, rng):
    """Walkers that are far away change the proposals to the other half, and not those to their own half."""
    coords = rng.standard_normal((N, 3))
    changed = coords.copy()
    changed[:3] += [30.0, -20.0, 10.0]
    here, there = (proposals_of(make(), points, 6) for points in (coords, changed))
    own, others = slice(3, N // 2), slice(N // 2, N)
    assert np.array_equal(here[:, own], there[:, own])
    assert not np.array_equal(here[:, others], there[:, others])


@pytest.mark.parametrize("make", [MixtureMove, lambda: RandomWalkMove(adapt=True)])
def test_both_halves_are_tuned(make, rng):
    """Proposals of a rejected walk become shorter for all walkers; the fit does not change."""
    target = StudentProduct(2)
    sampler = emcee.EnsembleSampler(30, 2, target, vectorize=True, moves=make())
    sampler.random_state = np.random.RandomState(4).get_state()
    sampler.run_mcmc(rng.standard_normal((30, 2)), 60, tune=True)
    assert np.all(sampler.backend.accepted > 0)
    move = RandomWalkMove(adapt=True)
    for _ in range(10):
        move.tune(None, np.zeros(N, dtype=bool))
    coords = rng.standard_normal((N, 2))
    proposed = proposals_of(move, coords, 1)[0]
    first = proposed - coords
    for _ in range(10):
        move.tune(None, np.zeros(N, dtype=bool))
    later = proposals_of(move, coords, 1)[0] - coords
    assert np.allclose(later, first * np.exp(-10 * move.target))


@pytest.mark.parametrize("make", [MixtureMove, RandomWalkMove, lambda: FastWalk([1])])
def test_another_number_of_walkers_is_fitted_anew(make, rng):
    """Proposals have the place and the width of the new walkers."""
    move = make()
    proposals_of(move, rng.standard_normal((60, 3)), 1)
    for n in (80, N):
        coords = 100.0 + 1e-3 * rng.standard_normal((n, 3))
        proposed = proposals_of(move, coords, 6)
        assert proposed.shape == (6, n, 3) and np.abs(proposed - coords).max() < 0.1


def test_walkers_that_start_in_one_place_leave_it(rng):
    """Walkers that are copies had been one half: the proposals to the others then had no width."""
    start = rng.standard_normal((60, 2))
    start[:30] = start[0]
    sampler = emcee.EnsembleSampler(
        60, 2, lambda x: -0.5 * np.sum(x**2, axis=-1), vectorize=True, moves=RandomWalkMove()
    )
    sampler.random_state = np.random.RandomState(4).get_state()
    sampler.run_mcmc(start, 1500, skip_initial_state_check=True)
    squares = np.mean(sampler.get_chain(discard=200) ** 2, axis=(0, 2))  # of each walker: they are independent
    for half in (squares[:30], squares[30:]):
        error = half.std(ddof=1) / np.sqrt(len(half))
        assert error < 0.03 and abs(half.mean() - 1.0) < 3.0 * error


def test_copies_are_in_one_half_and_places_are_divided(rng):
    coords = rng.standard_normal((N, 3))
    assert np.array_equal(_first_half(coords), np.arange(N) < N // 2)
    resampled = coords[np.sort(rng.integers(0, N, N))]
    for points in (resampled, rng.permutation(resampled), np.repeat(coords[:2], [35, 5], axis=0)):
        in_first = _first_half(points)
        halves = [{tuple(point) for point in points[rows]} for rows in (in_first, ~in_first)]
        assert not halves[0] & halves[1] and len(halves[1]) - len(halves[0]) in (0, 1)


@pytest.mark.parametrize("make", [MixtureMove, RandomWalkMove, lambda: FastWalk([1])])
def test_walkers_that_span_no_volume_are_refused(make, rng):
    line = rng.standard_normal((N, 1)) * [1.0, 1e6, 1e-6]
    few = np.repeat(rng.standard_normal((6, 3)), 10, axis=0)
    for coords in (line, few, np.ones((N, 3)), rng.standard_normal((N, 3)) * [1.0, 0.0, 1.0]):
        with pytest.raises(ValueError, match="points that span all 3 dimensions.*start from more walkers"):
            proposals_of(make(), coords, 1)


def test_few_walkers_are_warned_of(rng):
    units = np.array([1e-6, 1e9])
    with pytest.warns(UserWarning, match="fitted to 14 distinct points"):
        proposals_of(RandomWalkMove(), units * rng.standard_normal((28, 2)), 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        proposals_of(RandomWalkMove(), units * rng.standard_normal((30, 2)), 1)


def exact_draws(n, ndim, seed):
    """Draws of `StudentProduct` by rejection."""
    random = np.random.default_rng(seed)
    drawn = SCALE * random.standard_t(2.0, size=8 * n * ndim)
    kept = random.uniform(size=drawn.size) < stats.t.pdf(drawn, 3.0, scale=3.0) / stats.t.pdf(0.0, 3.0, scale=3.0)
    return drawn[kept][: n * ndim].reshape(n, ndim)


@pytest.mark.slow
def test_exact_draws_keep_their_variance_in_emcees_sampler(seed):
    """A mixture fitted to the points that it moves gave 0.97 of the variance after one sweep."""
    target = StudentProduct(2)
    _, variance = target.moments()
    squares = []
    for number in range(600):
        start = exact_draws(250, 2, 1000 * seed + number)
        sampler = emcee.EnsembleSampler(250, 2, target, vectorize=True, moves=MixtureMove())
        sampler.random_state = np.random.RandomState(number).get_state()
        sampler.run_mcmc(start, 2)
        squares.append(np.mean(np.stack([start, *sampler.get_chain()]) ** 2, axis=(1, 2)) / variance)
    change = np.array(squares)[:, 1:].mean(axis=1) - np.array(squares)[:, 0]
    error = change.std(ddof=1) / np.sqrt(len(change))
    print(np.mean(squares, axis=0), change.mean(), error)
    assert error < 0.008 and abs(change.mean()) < 3.0 * error


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
