"""Counting of simulations."""

import pickle

import numpy as np

from samplers.tempering.budget import Budget


def test_distinct_points_in_the_slow_parameters_are_counted(rng):
    budget = Budget(fast=(2,))
    coords = rng.standard_normal((1000, 3))
    budget.count(coords)
    other = coords.copy()
    other[:, 2] += 1.0
    budget.count(other)
    assert budget.simulations == 1000
    other[:7, 0] = np.nextafter(other[:7, 0], np.inf)  # the smallest change is another point
    budget.count(other)
    assert budget.simulations == 1007
    again = pickle.loads(pickle.dumps(budget))
    again.count(coords)
    assert again.simulations == 1007


def test_similar_points_are_not_confused():
    """Points on a grid, columns exchanged, signs changed."""
    axis = np.arange(-20.0, 21.0)
    coords = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    budget = Budget()
    budget.count(coords)
    assert budget.simulations == len(coords)


def test_the_points_that_fit():
    budget = Budget(fast=(1,), limit=5)
    coords = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0], [5.0, 0.0]])
    assert budget.fitting(coords) == 6
    budget.count(coords[:3])
    assert budget.remaining == 3 and budget.fits(3) and not budget.refused
    assert budget.fitting(coords) == 6 and budget.fitting(coords[::-1]) == 3
    assert not budget.fits(4) and budget.refused


class Counts:
    simulations = 0.0


def test_simulations_of_an_interrupted_run_cost_nothing():
    """Ten points, and 7.5 simulations of a guide, which makes them again from the journal."""
    coords = np.arange(10.0)[:, None]
    budget, guide = Budget(limit=12), Counts()
    budget.restore([coords[:4], coords[3:]], 0.0, 7.5)
    budget.begin(guide)
    assert budget.simulations == 10
    for cost in (0.1,) * 25 + (5.0,):
        assert budget.fits(cost)
        guide.simulations += cost
    assert abs(budget.simulations - 17.5) < 1e-9
    assert not budget.fits(0.1)
    assert budget.fitting(coords) == 10 and budget.fitting(coords + 0.5) == 0
    budget.limit = 20.0
    assert budget.fitting(coords + 0.5) == 2
    assert budget.fits(2) and budget.of_guides_with_batch == 9.5 and budget.of_guides < 7.6
