"""Subset simulation: closed forms, stated errors against the scatter over seeds, and failed simulations."""

import numpy as np
import pytest
from scipy import stats

from samplers import subset_simulation
from tests.tempering.rare import four_branches, four_branches_exact, linear, summarise

SEEDS = 60


def check(runs, exact):
    """Mean, stated errors and intervals agree with the exact probability and the scatter within four errors."""
    ratios, stated, inside = summarise(runs, exact)
    n, scatter = len(runs), ratios.std()
    assert abs(ratios.mean() - 1.0) < 4.0 * scatter / np.sqrt(n)
    assert abs(stated / scatter - 1.0) < 4.0 / np.sqrt(2.0 * n)
    assert inside.mean() > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / n)
    return scatter


@pytest.mark.parametrize(
    ("ndim", "probability"), [(2, 1e-3), (10, 1e-4), pytest.param(100, 1e-6, marks=pytest.mark.slow)]
)
def test_a_linear_limit_state_has_the_closed_form(ndim, probability):
    threshold = stats.norm.isf(probability)
    runs = [subset_simulation(linear, threshold, ndim, seed=seed) for seed in range(SEEDS)]
    scatter = check(runs, probability)
    # control: levels as if their points were independent
    naive = np.sqrt(np.mean([np.sum((1.0 - run.shares) / (1000 * run.shares)) for run in runs]))
    assert naive < 0.85 * scatter
    assert np.mean([run.simulations for run in runs]) < 1200 * (1 - np.log10(probability))


def test_a_series_system_of_four_branches():
    """Four regions; the published values are 4.416e-3 (Echard et al. 2011) and 4.460e-3 (Schöbi et al. 2017)."""
    exact = four_branches_exact()
    assert abs(exact / 4.460e-3 - 1.0) < 2.0 * 0.0015  # 1e8 simulations: the error of Monte Carlo is 0.15 %
    runs = [subset_simulation(four_branches, 0.0, 2, seed=seed) for seed in range(SEEDS)]
    check(runs, exact)
    regions = [np.unique(np.round(np.arctan2(*run.coords.T) / (0.5 * np.pi) - 0.5) % 4) for run in runs]
    assert np.mean([len(each) for each in regions]) > 3.8


@pytest.mark.parametrize("kind", ["left out", "collapse"])
def test_failed_simulations_are_counted(kind):
    """Failures beyond 3.5: left out, the probability is conditional; or exceedances."""
    calls = []

    def function(points):
        value = linear(points)
        calls.append(np.sum(value > 3.5))
        return np.where(value > 3.5, np.inf if kind == "collapse" else np.nan, value)

    sf = stats.norm.sf
    exact = (sf(3.0) - sf(3.5)) / (1.0 - sf(3.5)) if kind == "left out" else sf(3.0)
    runs = []
    for seed in range(SEEDS):
        calls.clear()
        runs.append(subset_simulation(function, 3.0, 3, seed=seed))
        assert runs[-1].failed == (0 if kind == "collapse" else sum(calls))
    check(runs, exact)
    assert sf(3.5) > 0.1 * sf(3.0)  # the cases differ
    assert ("failed" in str(runs[0])) == (runs[0].failed > 0)


def test_simulations_are_counted_and_seeds_repeat():
    points = []

    def function(coords):
        points.append(len(coords))
        return linear(coords)

    first = subset_simulation(function, 3.0, 3, n=200, seed=3)
    assert first.simulations == sum(points) and first.failed == 0
    again, other = (subset_simulation(linear, 3.0, 3, n=200, seed=seed) for seed in (3, 4))
    assert again.probability == first.probability != other.probability
    np.testing.assert_array_equal(again.coords, first.coords)
    assert first.levels[-1] == 3.0 and np.all(np.diff(first.levels) > 0.0)
    assert np.prod(first.shares) == pytest.approx(first.probability) and np.all(linear(first.coords) > 3.0)
    frequent = subset_simulation(linear, 0.0, 3, n=200, seed=3)  # plain Monte Carlo
    assert len(frequent.levels) == 1 and frequent.simulations == 200
    expected = np.sqrt((1.0 - frequent.probability) / frequent.probability / 200)
    assert frequent.coefficient_of_variation == pytest.approx(expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(ndim=2, n=50), "n must be 100 points or more"),
        (dict(threshold=np.inf, ndim=2), "threshold must be a finite number"),
        (dict(ndim=2.0), "ndim must be a whole number"),
    ],
)
def test_impossible_arguments_are_refused_before_a_simulation(arguments, message):
    def never(points):
        raise AssertionError("simulated")

    with pytest.raises(ValueError, match=message):
        subset_simulation(never, **({"threshold": 1.0} | arguments))


def test_results_that_lead_nowhere_are_explained():
    with pytest.raises(ValueError, match="one number per point"):
        subset_simulation(lambda points: points, 1.0, 2)
    with pytest.raises(ValueError, match="whether the quantity has a largest value"):
        subset_simulation(lambda points: np.minimum(linear(points), 1.0), 2.0, 2, seed=1)
    with pytest.raises(ValueError, match="initial points or more whose simulation succeeds"):
        subset_simulation(lambda points: np.full(len(points), np.nan), 2.0, 2)
