"""Prediction of a new event: closed forms of the ratio and of the population; coverage, with controls."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import GaussianNoise
from fe_likelihoods.events.hierarchical_posterior import HierarchicalPosterior, Varying
from fe_likelihoods.events.hierarchy_result import Hierarchy
from fe_likelihoods.events.ratios import EventRatios
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.prediction.new_event import event_ratio, predict_new_event
from fe_likelihoods.prediction.quantities import peak, rms
from fe_likelihoods.priors.distributions import HalfNormal, LogNormal
from fe_likelihoods.priors.priors import Prior
from fe_likelihoods.signals.channels import Channel, Measurements

TOP = Channel("top", "displacement", "mm")
TIME = 0.02 * np.arange(100)
SHAPE = np.sin(2.0 * np.pi * TIME)
MEDIAN, SPREAD = 0.03, 0.25


class Amplified(FunctionModel):
    """Response gain * scale * SHAPE, with the scale as its excitation."""

    def __init__(self, scale=1.0):
        super().__init__(self.respond, ["gain"], [TOP], 0.02, len(TIME))
        self.scale = scale
        self.path_dependent = False

    def respond(self, theta):
        return [theta[0] * self.scale * SHAPE]

    def with_record(self, scale):
        return Amplified(scale)


@pytest.fixture
def hierarchy(rng):
    """A population whose hyper-parameters are known: median 0.03 and spread 0.25 of the logarithm of the gain."""
    prior = Prior({"gain": LogNormal(MEDIAN, 1.0), "share_top": HalfNormal(0.5)})
    tests = {}
    for k in range(6):
        gain = np.exp(np.log(MEDIAN) + SPREAD * rng.standard_normal() + 0.05 * rng.standard_normal(400))
        tests[f"EQ{k}"] = {"gain": gain, "share_top": 0.2 * np.exp(0.05 * rng.standard_normal(400))}
    from fe_likelihoods.events.stored_posterior import StoredPosterior

    tests = {name: StoredPosterior(values, prior) for name, values in tests.items()}
    varying = {"gain": Varying(LogNormal(MEDIAN, 0.5), HalfNormal(0.3))}
    varying["share_top"] = Varying(LogNormal(0.2, 0.5), HalfNormal(0.3))
    posterior = HierarchicalPosterior(tests, varying)
    known = np.array([MEDIAN, SPREAD, 0.2, 0.1]) * np.exp(1e-6 * rng.standard_normal((200, 4)))
    return Hierarchy(posterior, known)


@pytest.fixture
def posterior(rng):
    model = Amplified()
    measured = Measurements([TOP], model.dt, model.simulate([MEDIAN]) + 1e-4 * rng.standard_normal((1, 100)))
    noise = GaussianNoise(measured.channels, level="measured")
    return Posterior(FELikelihood(model, measured, noise), {"gain": LogNormal(0.03, 1.0), "share_top": HalfNormal(0.5)})


def test_ratio_of_a_new_event_is_the_t_distribution_of_the_textbook():
    logs = np.array([0.1, -0.05, 0.2, 0.0])
    ratios = EventRatios(np.exp(logs))
    expected = stats.t(3, logs.mean(), logs.std(ddof=1) * np.sqrt(1.25))
    assert float(ratios.median) == pytest.approx(np.exp(expected.mean()), rel=1e-12)
    assert float(ratios.median * ratios.factor(0.9)) == pytest.approx(np.exp(expected.ppf(0.95)), rel=1e-12)
    draws = np.log(ratios.draw(20_000, np.random.default_rng(1)))
    assert stats.kstest(draws, expected.cdf).pvalue > 1e-3
    # a guess that is worth many events replaces the spread of the events
    certain = EventRatios(np.exp(logs), prior_sd=0.3, prior_events=1e6)
    assert float(certain.scale) == pytest.approx(0.3 * np.sqrt(1.25), rel=1e-4)
    one = EventRatios([1.2], prior_sd=0.15, prior_events=3)
    assert float(one.median) == pytest.approx(1.2) and float(one.scale) == pytest.approx(0.15 * np.sqrt(2.0))


@pytest.mark.parametrize("n_events", (2, 5, 10))
def test_intervals_of_ratios_cover_new_events_and_normal_quantiles_do_not(n_events, rng):
    sets = 4000
    ratios = EventRatios(np.exp(0.1 + 0.2 * rng.standard_normal((n_events, sets))))
    new = np.exp(0.1 + 0.2 * rng.standard_normal(sets))
    error = 4.0 * np.sqrt(0.25 / sets)
    for level in (0.5, 0.9):
        inside = np.abs(np.log(new / ratios.median)) < np.log(ratios.factor(level))
        assert abs(inside.mean() - level) < error
    narrow = np.abs(np.log(new / ratios.median)) < stats.norm.ppf(0.95) * np.log(ratios.values).std(axis=0)
    assert narrow.mean() < 0.9 - error


def test_a_guess_of_the_spread_covers_one_event_if_it_is_right(rng):
    sets, degrees = 4000, 4.0
    spread = 0.2 * np.sqrt(degrees / rng.chisquare(degrees, sets))  # as the prior states
    first, new = np.exp(spread * rng.standard_normal((2, sets)))
    ratios = EventRatios(first[None], prior_sd=0.2, prior_events=degrees)
    inside = np.abs(np.log(new / ratios.median)) < np.log(ratios.factor(0.9))
    assert abs(inside.mean() - 0.9) < 4.0 * np.sqrt(0.09 / sets)


def test_peak_of_a_new_event_has_the_spread_of_the_population_and_of_the_ratios(hierarchy):
    ratios = EventRatios(np.exp([0.1, -0.05, 0.2, 0.0]))
    options = {"quantity": peak("top"), "n": 4000, "seed": 1}
    plain = predict_new_event(hierarchy, Amplified(), 2.0, **options)
    median = 2.0 * MEDIAN * np.abs(SHAPE).max()
    assert stats.kstest(np.log(plain.values / median) / SPREAD, "norm").pvalue > 1e-3
    corrected = predict_new_event(hierarchy, Amplified(), 2.0, ratios=ratios, **options)
    rng = np.random.default_rng(2)
    logs = SPREAD * rng.standard_normal(40_000) + np.log(ratios.draw(40_000, rng))
    expected = median * np.exp(np.quantile(logs, [0.05, 0.5, 0.95]))
    np.testing.assert_allclose(corrected.quantiles, expected, rtol=0.04)
    assert corrected.noise and np.isfinite(plain.mean)
    for none in (corrected.mean, corrected.variance, corrected.sd, corrected.standard_error):
        assert none.shape == () and np.isnan(none)  # exp(t) has no mean
    assert "has no mean: use the quantiles" in corrected._repr_html_()
    assert "has no mean" not in plain._repr_html_()
    assert corrected.score(median).measured[0] == median
    again = predict_new_event(hierarchy, Amplified(), 2.0, ratios=ratios, **options)
    np.testing.assert_array_equal(again.values, corrected.values)


def test_histories_of_a_new_event_have_noise_of_its_own_level(hierarchy, posterior):
    prediction = predict_new_event(hierarchy, posterior, 0.1, noise=True, n=2000, seed=1)
    squared = MEDIAN**2 * np.exp(2.0 * SPREAD**2)  # mean square of a log-normal gain
    share = 0.2**2 * np.exp(2.0 * 0.1**2)
    variance = 0.01 * (squared - MEDIAN**2 * np.exp(SPREAD**2)) * SHAPE**2 + 0.01 * squared * share * np.mean(SHAPE**2)
    np.testing.assert_allclose(prediction.sd[0], np.sqrt(variance), rtol=0.06)


def test_shares_of_modulated_noise_have_no_upper_limit(hierarchy):
    wide = Hierarchy(hierarchy.posterior, hierarchy.samples * [1.0, 1e-4, 3.0, 5.0])  # median 0.6, spread 0.5; one gain
    model = Amplified()
    measured = Measurements([TOP], model.dt, model.simulate([MEDIAN]))
    noise = GaussianNoise(model.channels, level="response", window=0.5, sensor=(1e-9,), local=0.0)
    posterior = Posterior(FELikelihood(model, measured, noise), {"gain": HalfNormal(1.0), "share_top": HalfNormal(0.5)})
    prediction = predict_new_event(wide, posterior, 0.1, noise=True, n=2000, seed=1)
    assert prediction.n_samples == 2000
    level = 0.1 * MEDIAN * np.sqrt(np.mean(SHAPE**2))
    expected = level * 0.6 * np.exp(0.5**2)  # root mean square of a log-normal share
    np.testing.assert_allclose(prediction.sd[0].mean(), expected, rtol=0.05)


def test_draws_of_impossible_shares_are_left_out(hierarchy, posterior):
    wide = Hierarchy(hierarchy.posterior, hierarchy.samples * [1.0, 1.0, 3.0, 5.0])  # a median of 0.6, a spread of 0.5
    with pytest.warns(UserWarning, match=r"1\d% of the draws have an impossible noise.*level='response'.*logit"):
        prediction = predict_new_event(wide, posterior, 0.1, noise=True, n=2000, seed=1)
    expected = 2000 * stats.norm.cdf(np.log(1.0 / 0.6) / 0.5)
    assert abs(prediction.n_samples - expected) < 4.0 * np.sqrt(2000 * 0.15 * 0.85)


def test_ratio_of_one_event(posterior):
    samples = np.array([[MEDIAN, 0.1], [0.9 * MEDIAN, 0.1], [1.3 * MEDIAN, 0.1]])
    measured = posterior.likelihood.measurements
    expected = np.abs(measured.values).max() / (MEDIAN * np.abs(SHAPE).max())
    assert float(event_ratio(posterior, samples, peak("top"))) == pytest.approx(expected, rel=1e-12)
    both = event_ratio(posterior, samples, [peak("top"), rms("top")])
    assert both.shape == (2,) and both[0] == pytest.approx(expected, rel=1e-12)


def test_what_cannot_be_predicted_is_refused(hierarchy, posterior):
    with pytest.raises(ValueError, match="one event does not show"):
        EventRatios([1.1])
    for bad in ([], [0.0, 1.0], [np.nan, 1.0], 1.2):
        with pytest.raises(ValueError, match="expected positive ratios"):
            EventRatios(bad)
    with pytest.raises(ValueError, match="prior_sd must be positive"):
        EventRatios([1.0, 1.1], prior_sd=0.0)
    with pytest.raises(ValueError, match="level must be between"):
        EventRatios([1.0, 1.1]).factor(90)
    ratios = EventRatios([1.0, 1.1])
    with pytest.raises(ValueError, match="ratios are for numbers"):
        predict_new_event(hierarchy, posterior, 1.0, ratios=ratios)
    with pytest.raises(ValueError, match="ratios are for numbers"):
        predict_new_event(hierarchy, posterior, 1.0, ratios=ratios, quantity=peak("top"), noise=True)
    with pytest.raises(ValueError, match="needs a posterior"):
        predict_new_event(hierarchy, Amplified(), 1.0, noise=True)
    with pytest.raises(ValueError, match="expected ratios"):
        predict_new_event(hierarchy, posterior, 1.0, ratios=ratios, quantity=[peak("top"), rms("top")], n=20)
    with pytest.raises(ValueError, match="needs a posterior or a likelihood"):
        event_ratio(Amplified(), [[1.0]], peak("top"))
