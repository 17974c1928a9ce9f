"""Ratios of events: the t distributions of the textbook, the prior of their scatter, coverage with controls."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods.population.event_ratios import PRIOR_EVENTS, PRIOR_SD, EventRatios

LOGS = np.array([0.1, -0.05, 0.2, 0.0])


@pytest.fixture
def events(rng):
    predicted = np.exp(rng.standard_normal(8))
    return np.exp(0.1 + 0.3 * np.log(predicted) + 0.1 * rng.standard_normal(8)), predicted


def test_ratio_of_a_new_event_is_the_t_distribution_of_the_textbook():
    ratios = EventRatios(np.exp(LOGS), prior_events=1e-9)
    expected = stats.t(3, LOGS.mean(), LOGS.std(ddof=1) * np.sqrt(1.25))
    p = np.array([0.05, 0.5, 0.95])
    np.testing.assert_allclose(np.log(ratios.quantile(p)), expected.ppf(p), rtol=1e-6)
    assert ratios.prior_share < 1e-6


def test_the_prior_of_the_scatter_is_worth_its_events_and_says_how_much_of_the_width_it_is():
    ratios = EventRatios(np.exp(LOGS), prior_sd=0.2, prior_events=6.0)
    squares = np.square(LOGS - LOGS.mean()).sum()
    assert ratios.degrees_of_freedom == 9.0
    assert ratios.sd == pytest.approx(np.sqrt((6.0 * 0.04 + squares) / 9.0))
    assert ratios.prior_share == pytest.approx(0.24 / (0.24 + squares))
    assert f"{ratios.prior_share:.0%}" in str(ratios) and "is worth 6 events" in str(ratios)
    certain = EventRatios(np.exp(LOGS), prior_sd=0.3, prior_events=1e6)  # replaces the scatter of the events
    assert np.log(certain.quantile(0.95) / certain.quantile(0.5)) == pytest.approx(
        0.3 * np.sqrt(1.25) * stats.norm.ppf(0.95), rel=1e-4
    )
    one = EventRatios([1.2])  # the same formula with one event
    assert one.sd == pytest.approx(PRIOR_SD) and one.degrees_of_freedom == PRIOR_EVENTS and one.prior_share == 1.0
    expected = 1.2 * np.exp(stats.t.ppf(0.95, PRIOR_EVENTS) * PRIOR_SD * np.sqrt(2.0))
    assert one.quantile(0.95) == pytest.approx(expected)
    both = EventRatios(np.exp(np.stack([LOGS, 2.0 * LOGS], axis=1)), prior_sd=[0.1, 0.2])
    np.testing.assert_allclose(both.sd, both.sd[0] * np.array([1.0, 2.0]))


def test_each_ratio_counts_by_its_expected_scatter(rng):
    """The conjugate posterior of a weighted regression with a prior of its slope, in matrices."""
    predicted, sd = np.exp(rng.standard_normal((8, 2))), 0.05 + 0.2 * rng.random((8, 2))
    values = np.exp(0.1 + 0.2 * np.log(predicted) + sd * rng.standard_normal((8, 2)))
    ratios = EventRatios(values, sd, 6.0, predicted, slope_sd=0.3, new_sd=[0.1, 0.2])
    at, p = 1.7, np.array([0.05, 0.5, 0.95])
    for k, new_sd in enumerate((0.1, 0.2)):
        y, x, w = np.log(values[:, k]), np.log(predicted[:, k]), sd[:, k] ** -2
        rows = np.column_stack([np.ones(8), x])
        precision = rows.T @ (w[:, None] * rows) + np.diag([0.0, 0.3**-2])
        line = np.linalg.solve(precision, rows.T @ (w * y))
        factor = (6.0 + w @ np.square(y - rows @ line) + line[1] ** 2 / 0.3**2) / 13.0
        row = np.array([1.0, at])
        scale = np.sqrt(factor * (new_sd**2 + row @ np.linalg.solve(precision, row)))
        expected = stats.t(13, row @ line, scale).ppf(p)
        np.testing.assert_allclose(np.log(ratios.quantile(p[:, None], np.exp(at))[:, k]), expected, rtol=1e-9)
        assert ratios.sd[k] == pytest.approx(np.sqrt(factor) * new_sd)


@pytest.mark.parametrize("slope_sd", (0.0, 1.0))
def test_populations_and_probabilities_belong_together(events, slope_sd):
    values, predicted = events
    ratios, rng = EventRatios(values, predicted=predicted, slope_sd=slope_sd), np.random.default_rng(1)
    populations = ratios.draw_populations(4000, rng)
    for predicted in (0.05, 1.0, 8.0):
        limit = ratios.quantile(0.8, predicted)
        assert ratios.probability_above(limit, np.log(predicted)) == pytest.approx(0.2, abs=1e-9)
        above = populations.probability_above(np.full(4000, limit), np.full(4000, np.log(predicted)))
        assert abs(above.mean() - 0.2) < 4.0 * above.std() / np.sqrt(4000)


def test_what_cannot_be_used_is_refused():
    two = [1.0, 1.1]
    for values, options, message in (
        *((bad, {}, "expected positive ratios") for bad in ([], [0.0, 1.0], [np.nan, 1.0], 1.2)),
        (two, {"prior_sd": 0.0}, "prior_sd and prior_events must be positive"),
        ([two], {"prior_sd": [0.1, 0.1, 0.1]}, r"one prior_sd, one per quantity, \(2,\)"),
        (two, {"prior_events": 0}, "prior_events must be positive"),
        (two, {"new_sd": 0.0}, "new_sd must be positive"),
        (two, {"slope_sd": -0.1}, "slope_sd zero or more"),
        *((two, {"predicted": bad}, "one positive predicted value") for bad in ([1.0], [1.0, 0.0], [1.0, np.inf])),
    ):
        with pytest.raises(ValueError, match=message):
            EventRatios(values, **options)
    for p, predicted in ((1.5, 1.0), (0.5, 0.0)):
        with pytest.raises(ValueError, match="expected probabilities between 0 and 1 and positive"):
            EventRatios(two).quantile(p, predicted)
