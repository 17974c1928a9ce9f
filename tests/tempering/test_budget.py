"""Counting of simulations."""

import pickle

import numpy as np

from samplers.budget import Budget
from samplers.record import EvaluatedBatch, Record


def enter(record, coords):
    record.evaluated(EvaluatedBatch(coords, np.zeros(len(coords)), None, {}))


def test_distinct_points_in_the_slow_parameters_are_counted(rng):
    record = Record(slow=[0, 1])
    budget, coords = Budget(record), rng.standard_normal((1000, 3))
    enter(record, coords)
    other = coords.copy()
    other[:, 2] += 1.0
    enter(record, other)
    assert budget.simulations == 1000 and record.count == 2000
    other[:7, 0] = np.nextafter(other[:7, 0], np.inf)  # the smallest change is another point
    enter(record, other)
    assert budget.simulations == 1007
    assert pickle.loads(pickle.dumps(budget)).simulations == 1007


def test_the_points_that_fit():
    record = Record(slow=[0])
    budget = Budget(record, limit=5)
    coords = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0], [5.0, 0.0]])
    assert budget.fitting(coords) == 6
    enter(record, coords[:3])
    assert budget.remaining == 3 and budget.fits(3) and not budget.refused
    assert budget.fitting(coords) == 6 and budget.fitting(coords[::-1]) == 3
    assert not budget.fits(4) and budget.refused


def test_points_that_run_count_until_they_are_given_up():
    record, coords = Record(), np.arange(6.0)[:, None]
    budget = Budget(record, limit=4)
    budget.submitted(coords[:3])
    assert budget.simulations == 3 and budget.fitting(coords) == 4
    enter(record, coords[:2])
    assert budget.simulations == 3
    budget.closed()
    assert budget.simulations == 2


class Counts:
    simulations = 0.0


def test_simulations_of_a_run_that_is_made_again_cost_nothing():
    """Ten points are in the record, and a guide makes its 7.5 simulations again from there."""
    record, coords, guide = Record(), np.arange(10.0)[:, None], Counts()
    enter(record, coords)
    budget = Budget(record, limit=17.5)
    budget.begin(guide)
    for cost in (0.1,) * 25 + (5.0,):
        assert budget.fits(cost)
        guide.simulations += cost
    assert abs(budget.simulations - 17.5) < 1e-9
    assert not budget.fits(0.1)
    assert budget.fitting(coords) == 10 and budget.fitting(coords + 0.5) == 0
    budget.limit = 20.0
    assert budget.fitting(coords + 0.5) == 2
    budget.restart(3.0)
    assert budget.of_guides == 3.0 and not budget.refused
