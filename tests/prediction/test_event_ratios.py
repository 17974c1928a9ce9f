"""Ratios of events: constant ones and those that depend on the level, against closed forms; coverage, with controls."""

import warnings

import numpy as np
import pytest
from scipy import special, stats

from fe_likelihoods.events.ratios import EventRatios, LevelRatios
from fe_likelihoods.prediction.reliability import exceedance
from tests.prediction.twins import ratio_twin


@pytest.fixture
def events(rng):
    levels = np.exp(rng.standard_normal(8))
    return np.exp(0.1 + 0.3 * np.log(levels) + 0.1 * rng.standard_normal(8)), levels


def test_constant_form_is_that_of_event_ratios(events):
    values, levels = events
    for guess in ({}, {"prior_sd": 0.3, "prior_events": 2.0}):
        plain, constant = EventRatios(values, **guess), LevelRatios(values, levels, "constant", **guess)
        at = np.array([1e-3, 1.0, 50.0])
        np.testing.assert_allclose(constant.quantile(0.5, at), plain.median, rtol=1e-12)
        np.testing.assert_allclose(constant.quantile(0.95, at), plain.median * plain.factor(0.9), rtol=1e-12)
        np.testing.assert_allclose(
            constant.probability_above(np.array([0.7, 1.1, 1.6]), np.log(at)),
            plain.probability_above(np.array([0.7, 1.1, 1.6]), np.log(at)),
            rtol=1e-10,
        )
    equal = LevelRatios(values, np.ones(8))  # without different levels nothing else is possible
    assert equal.forms["constant"] == 1.0
    assert equal.quantile(0.9, 1.0) == pytest.approx(EventRatios(values).median * EventRatios(values).factor(0.8))


def test_a_steep_line_is_the_regression_of_the_textbook(rng):
    """With a slope far above the scatter its prior is nearly flat: mean and t interval of least squares."""
    x = np.linspace(-1.0, 1.0, 12)
    values = np.exp(0.2 + 0.2 * x + 0.02 * rng.standard_normal(12))
    ratios, (slope, offset) = LevelRatios(values, np.exp(x), "linear"), np.polyfit(x, np.log(values), 1)
    at = np.array([-2.0, 0.0, 0.7, 3.0])
    np.testing.assert_allclose(np.log(ratios.quantile(0.5, np.exp(at))), offset + slope * at, atol=5e-3)
    residual = np.sqrt(np.square(np.log(values) - offset - slope * x).sum() / 10)
    textbook = residual * np.sqrt(1.0 + 1.0 / 12 + (at - x.mean()) ** 2 / np.square(x - x.mean()).sum())
    width = np.log(ratios.quantile(0.95, np.exp(at))) - np.log(ratios.quantile(0.5, np.exp(at)))
    np.testing.assert_allclose(width, stats.t.ppf(0.95, 10) * textbook, rtol=0.12)
    assert width[3] > 1.5 * width[1]  # wider where it extrapolates


def test_smooth_form_is_the_gaussian_process_with_unknown_mean_and_variance(events):
    """One amplitude and length, against the posterior of mean, curve and variance by brute force."""
    values, levels = events
    ratios = LevelRatios(values, levels, "smooth")
    part, z_new = ratios._parts[5], 0.4
    y, z = np.log(values), (np.log(levels) - np.log(levels).mean()) / np.log(levels).std()
    a, length = part.kernel.amplitude, part.kernel.length
    far = 1e6  # standard deviation of the mean, in units of s
    points = np.append(z, z_new)
    joint = np.eye(9) + a**2 * np.exp(-0.5 * np.square((points[:, None] - points) / length)) + far**2
    gain = np.linalg.solve(joint[:8, :8], joint[:8, 8])
    mean, factor = gain @ y, joint[8, 8] - gain @ joint[:8, 8]
    scale = np.sqrt(y @ np.linalg.solve(joint[:8, :8], y) / 7 * factor)
    log_level = np.log(levels).mean() + np.log(levels).std() * z_new
    center, found = ratios._components(np.array([log_level]))[5]
    assert center[0] == pytest.approx(mean, abs=1e-4) and found[0] == pytest.approx(scale, rel=1e-3)


def test_draws_populations_and_probabilities_belong_together(events):
    values, levels = events
    ratios, rng = LevelRatios(values, levels), np.random.default_rng(1)
    for level in (0.05, 1.0, 8.0):
        limit = ratios.quantile(0.8, level)
        assert ratios.probability_above(limit, np.log(level)) == pytest.approx(0.2, abs=1e-9)
        drawn = ratios.draw_at(np.full(20_000, level), rng)
        assert abs((drawn > limit).mean() - 0.2) < 4.0 * np.sqrt(0.16 / 20_000)
        populations = ratios.draw_populations(4000, rng, np.log([0.05, level, 8.0]))
        centers = populations.center_at(np.full(4000, np.log(level)))
        above = special.ndtr((centers - np.log(limit)) / populations.sd)
        assert abs(above.mean() - 0.2) < 4.0 * above.std() / np.sqrt(4000) + 1e-3


def test_evidence_chooses_the_form_and_few_events_choose_none(rng):
    x = np.linspace(-1.5, 1.5, 14)
    noise = 0.03 * rng.standard_normal(14)
    level = np.exp(x)
    assert LevelRatios(np.exp(0.3 * x + noise), level).forms["linear"] > 0.7
    assert LevelRatios(np.exp(0.3 * np.sin(3.0 * x) + noise), level).forms["smooth"] > 0.95
    flat = LevelRatios(np.exp(noise), level).forms
    assert flat["constant"] > max(flat["linear"], flat["smooth"]) and sum(flat.values()) == pytest.approx(1.0)
    assert LevelRatios(np.exp(0.3 * x[:3]), level[:3]).forms == {"constant": 1.0, "linear": 0.0, "smooth": 0.0}
    assert LevelRatios(np.exp(0.3 * x[:9] + noise[:9]), level[:9]).forms["smooth"] == 0.0


@pytest.mark.parametrize("truth", ("slope 0", "slope 0.2"))
def test_intervals_cover_new_events_and_constant_ratios_miss_far_ones(truth):
    found = [ratio_twin(truth, 10, None, seed) for seed in range(40)]
    inside, far, score = (np.array(each) for each in zip(*found, strict=True))
    for k, level in enumerate((0.5, 0.9)):
        assert abs(inside[:, k].mean() - level) < 4.0 * inside[:, k].std() / np.sqrt(40)
    found = [ratio_twin(truth, 10, "constant", seed) for seed in range(40)]
    _, far_constant, score_constant = (np.array(each) for each in zip(*found, strict=True))
    shares = [each[:, 1].sum() / each[:, 2].sum() for each in (far, far_constant)]
    assert shares[0] > 0.8
    if truth == "slope 0":
        assert shares[1] > 0.8 and score.mean() < 1.1 * score_constant.mean()
    else:  # control
        assert shares[1] < 0.65 and score.mean() < 0.85 * score_constant.mean()


def test_what_cannot_be_used_is_refused():
    with pytest.raises(ValueError, match="LevelRatios: expected positive ratios"):
        LevelRatios([[1.0], [1.1]], [1.0, 2.0])
    with pytest.raises(ValueError, match="LevelRatios: one event does not show"):
        LevelRatios([1.1], [1.0])
    for bad in ([1.0], [1.0, 0.0], [1.0, np.inf]):
        with pytest.raises(ValueError, match="one positive predicted value for each of 2 ratios"):
            LevelRatios([1.0, 1.1], bad)
    with pytest.raises(ValueError, match="form must be one of constant, linear, smooth"):
        LevelRatios([1.0, 1.1], [1.0, 2.0], "quadratic")
    with pytest.raises(ValueError, match="a linear dependence needs events of different levels"):
        LevelRatios([1.0, 1.1], [2.0, 2.0], "linear")
    ratios = LevelRatios([1.0, 1.1, 0.9, 1.2], [1.0, 2.0, 3.0, 4.0])
    for p, level in ((1.5, 1.0), (0.5, 0.0)):
        with pytest.raises(ValueError, match="expected a probability between 0 and 1 and positive"):
            ratios.quantile(p, level)
    with pytest.raises(ValueError, match="ratios of one quantity"):
        EventRatios([[1.0, 1.1], [0.9, 1.2]]).draw_populations(3, np.random.default_rng(1), np.zeros(1))


def test_equal_ratios_are_said_and_have_no_nan():
    with pytest.warns(UserWarning, match="EventRatios: the ratios of 2 events are equal.*prior_events=3"):
        equal = EventRatios([1.0, 1.0])
    with pytest.warns(UserWarning, match="LevelRatios: the ratios of 3 events are equal"):
        levels = LevelRatios([1.0] * 3, [1.0, 2.0, 3.0])
    with pytest.warns(UserWarning, match="are equal"):  # one of two quantities
        EventRatios([[1.0, 1.1], [1.0, 1.2]])
    for ratios in (equal, levels):
        found = ratios.probability_above(np.array([0.9, 1.0, 1.1]), np.zeros(3))
        assert found.tolist() == [1.0, 0.0, 0.0]  # strictly above, as without ratios
        for limit, expected in ((0.9, 1.0), (1.0, 0.0), (1.1, 0.0)):
            one = exceedance(np.ones(50), limit, ratios=ratios)
            assert (one.lower, one.probability, one.upper) == (expected,) * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        EventRatios([1.0, 1.0], prior_sd=0.15, prior_events=3)
        EventRatios([1.0, 1.001])
