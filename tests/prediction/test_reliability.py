"""Probability of exceedance: closed forms, intervals, units and shapes."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods.prediction.exceedance import exceedance
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import peak
from tests.prediction.flexible import DISPERSION, MEDIAN, Flexible


def test_exceedance_of_a_gaussian(rng):
    values = rng.normal(size=4000)
    limits = np.array([-1.0, 0.0, 1.5, 2.5])
    result = exceedance(values, limits)
    exact = stats.norm.sf(limits)
    assert np.all(np.abs(result.probability - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / 4000))
    assert np.all((result.lower < result.probability) & (result.probability < result.upper))
    # The interval is that of Clopper and Pearson if the counts are whole numbers.
    k = int(round(result.probability[2] * 4000))
    interval = stats.binomtest(k, 4000).proportion_ci(0.95, method="exact")
    assert np.allclose((result.lower[2], result.upper[2]), interval, rtol=1e-6)


def test_none_and_all_of_the_samples_have_a_bound():
    none = exceedance(np.zeros(100), 1.0)
    assert none.probability == 0.0 and none.lower == 0.0
    assert none.upper == pytest.approx(1.0 - 0.025 ** (1 / 100))
    everything = exceedance(np.zeros(100), -1.0)
    assert everything.upper == 1.0 and everything.lower == pytest.approx(0.025 ** (1 / 100))
    assert exceedance(np.zeros(10), 0.0).probability == 0.0  # equal is not larger


def test_intervals_cover(rng):
    """At least 95 % of the intervals of many runs of 60 samples contain the true probability."""
    p = stats.norm.sf(1.3)
    runs = exceedance(rng.normal(size=(60, 2000)), 1.3)
    inside = np.mean((runs.lower <= p) & (p <= runs.upper))
    assert inside > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 2000)


def test_units_and_shapes_of_thresholds(record, rng):
    samples = rng.normal(0.0, DISPERSION, size=(200, 1))
    model = Flexible(record.scale(MEDIAN))
    p = propagate(model, samples, quantity=peak("displacement"), progress=False)
    assert np.array_equal(exceedance(p, 10.0, unit="cm").probability, exceedance(p, 0.1).probability)
    assert exceedance(p, [[0.05, 0.1], [0.15, 0.2]]).probability.shape == (2, 2)
    shown = {"m": 1.0, "cm": 100.0, "mm": 1000.0}[p.channels[0].unit]
    with pytest.raises(ValueError, match=f"give unit=, such as '{p.channels[0].unit}'"):
        exceedance(p, 0.1 * shown)
    assert exceedance(p, 0.3).probability < 0.1  # a rare event is no mistake of units
    assert exceedance(np.zeros((50, 3)), [1.0, -1.0, 2.0]).probability.tolist() == [0.0, 1.0, 0.0]
    for values, limit, options, message in (
        (p, 10.0, {"unit": "kN"}, "expected a unit of displacement, got 'kN'"),
        (p, 10.0, {"unit": "furlong"}, "unknown unit"),
        (p, np.nan, {}, "finite"),
        (p, "10 cm", {}, "must be numbers"),
        (np.zeros((50, 3)), [1.0, 2.0], {}, r"shape \(3,\); got shape \(2,\)"),
        (propagate(model, samples, progress=False), 0.1, {}, "quantity, such as peak"),
        ([1.0, np.nan], 0.1, {}, "values must be finite"),
        (p, 0.1, {"interval_probability": 95}, "interval_probability"),
    ):
        with pytest.raises(ValueError, match=message):
            exceedance(values, limit, **options)
