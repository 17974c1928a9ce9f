"""Prediction of a new event: closed forms of numbers and histories; coverage where errors are correlated."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import GaussianNoise
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.population.event_ratios import PRIOR_EVENTS, PRIOR_SD, EventRatios
from fe_likelihoods.population.event_scatter import REMAINDER
from fe_likelihoods.population.hierarchical_posterior import HierarchicalPosterior, Varying
from fe_likelihoods.population.hierarchy import Hierarchy
from fe_likelihoods.population.stored_posterior import StoredPosterior
from fe_likelihoods.prediction.exceedance import exceedance
from fe_likelihoods.prediction.new_event import event_ratios, predict_new_event
from fe_likelihoods.prediction.quantities import arias_intensity, peak, rms
from fe_likelihoods.priors.distributions import HalfNormal, LogNormal
from fe_likelihoods.priors.priors import Prior
from fe_likelihoods.signals.channels import Channel, Measurements

TOP = Channel("top", "displacement", "mm")
TIME = 0.02 * np.arange(100)
SHAPE = np.sin(2.0 * np.pi * TIME)
MEDIAN, SPREAD = 0.03, 0.25
NOISE = GaussianNoise([TOP])
LOGS = np.array([0.1, -0.2, 0.15, 0.3])  # of measured peaks over those at the median of the population
LARGEST = np.abs(SHAPE).max()


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


def likelihoods(peaks):
    """Events of increasing strength, with these measured peaks."""
    found = {}
    for k, value in enumerate(peaks):
        model = Amplified(1.0 + 0.3 * k)
        found[f"EQ{k}"] = FELikelihood(model, Measurements([TOP], model.dt, [value / LARGEST * SHAPE]), NOISE)
    return found


def population(names, rng):
    """A population of median 0.03 and spread 0.25; its tests have no influence on it."""
    prior = Prior({"gain": LogNormal(MEDIAN, 1.0)})
    tests = {name: StoredPosterior({"gain": MEDIAN * np.exp(0.3 * rng.standard_normal(200))}, prior) for name in names}
    varying = {"gain": Varying(LogNormal(MEDIAN, 0.5), HalfNormal(0.3))}
    known = np.array([MEDIAN, SPREAD]) * np.exp(1e-6 * rng.standard_normal((50, 2)))
    return Hierarchy(HierarchicalPosterior(tests, varying), known)


@pytest.fixture
def events(rng):
    measured = LARGEST * MEDIAN * (1.0 + 0.3 * np.arange(4)) * np.exp(LOGS)
    found = likelihoods(measured)
    return population(found, rng), found


@pytest.fixture
def hierarchy(rng):
    """A population whose hyper-parameters are known: median 0.03 and spread 0.25 of the logarithm of the gain."""
    prior = Prior({"gain": LogNormal(MEDIAN, 1.0), "share_top": HalfNormal(0.5)})
    tests = {}
    for k in range(6):
        gain = np.exp(np.log(MEDIAN) + SPREAD * rng.standard_normal() + 0.05 * rng.standard_normal(400))
        tests[f"EQ{k}"] = {"gain": gain, "share_top": 0.2 * np.exp(0.05 * rng.standard_normal(400))}
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
    noise = GaussianNoise(measured.channels, shares_of="measured")
    return Posterior(FELikelihood(model, measured, noise), {"gain": LogNormal(0.03, 1.0), "share_top": HalfNormal(0.5)})


def test_the_peak_has_the_exact_t_distribution_of_the_ratios_at_the_median(events):
    """The gain explains all residuals, so that the scatter is its spread and the remainder; no simulation noise."""
    hierarchy, posteriors = events
    options = {"model": Amplified(), "quantity": peak("top"), "spread": {"gain": SPREAD}, "n": 200}
    found = predict_new_event(hierarchy, posteriors, 2.0, seed=1, **options)
    sd = np.hypot(SPREAD, REMAINDER)
    levels = LARGEST * MEDIAN * (1.0 + 0.3 * np.arange(4))
    ratios = EventRatios(np.exp(LOGS), sd, PRIOR_EVENTS, levels, new_sd=sd)
    predicted = 2.0 * MEDIAN * LARGEST
    expected = predicted * ratios.quantile(found.probabilities, predicted)
    np.testing.assert_allclose(found.quantiles, expected, rtol=1e-4)  # the median of 50 hyper-samples
    shares = found.ratios.probability_above(np.sort(found.values) / predicted, np.log(predicted))
    np.testing.assert_allclose(1.0 - shares, (np.arange(200) + 0.5) / 200, atol=1e-4)
    limit = predicted * ratios.quantile(0.9, predicted)
    exceeded = exceedance(found, limit)
    assert float(exceeded.probability) == pytest.approx(0.1, abs=1e-4)
    assert exceeded.lower < 0.05 and exceeded.upper > 0.2  # four events tell little about it
    other = predict_new_event(hierarchy, posteriors, 2.0, seed=2, **options)
    np.testing.assert_array_equal(other.quantiles, found.quantiles)
    np.testing.assert_array_equal(np.sort(other.values), np.sort(found.values))
    share = found.ratios.prior_share
    assert f"use the quantiles; {share:.0%} of their squared width is due to the prior" in str(found)
    assert "200 samples, of measured values, by the ratios of 4 events;" in str(found)
    for none in (found.mean, found.variance, found.sd, found.standard_error):
        assert none.shape == () and np.isnan(none)  # exp(t) has no mean
    assert found.noise and "measurement noise" not in str(found)
    options["quantity"] = [peak("top"), rms("top")]
    both = predict_new_event(hierarchy, posteriors, 2.0, seed=1, **options)
    assert both.values.shape == (200, 2) and abs(stats.spearmanr(*both.values.T).statistic) < 0.3
    np.testing.assert_allclose(both.quantiles[:, 0], found.quantiles)


def test_one_event_has_the_same_formula(rng):
    posteriors = likelihoods([1.2 * LARGEST * MEDIAN])
    options = {"quantity": peak("top"), "spread": {"gain": SPREAD}, "seed": 1}
    found = predict_new_event(population(posteriors, rng), posteriors, 1.0, **options)
    scale = np.hypot(SPREAD, REMAINDER) * np.sqrt(2.0)
    expected = np.exp(stats.t(PRIOR_EVENTS, np.log(1.2 * MEDIAN * LARGEST), scale).ppf([0.05, 0.5, 0.95]))
    np.testing.assert_allclose(found.quantiles, expected, rtol=1e-4)
    assert found.ratios.prior_share == 1.0


def test_each_number_has_its_own_scatter_from_the_parameters():
    """Peaks and root mean squares follow the gain, Arias intensities and energies its square; others do not change."""
    channels = [Channel("top", "acceleration", "g"), Channel("base", "acceleration", "g")]
    model = FunctionModel(lambda theta: [theta[0] * SHAPE, SHAPE], ["gain"], channels, 0.02, len(SHAPE))
    likelihood = FELikelihood(model, Measurements(channels, model.dt, model.simulate([1.1])))
    numbers = [peak("top"), rms("top"), arias_intensity("top"), peak("base")]
    ratios = event_ratios({"gain": 1.0}, {"EQ": likelihood}, numbers, spread={"gain": 0.1})
    expected = [np.hypot(0.1, REMAINDER), np.hypot(0.1, REMAINDER), 2.0 * np.hypot(0.1, REMAINDER), REMAINDER]
    np.testing.assert_allclose(ratios.prior_sd, [expected], rtol=1e-6)
    unknown = event_ratios({"gain": 1.0}, {"EQ": likelihood}, numbers[3])  # no parameter is known to differ
    assert unknown.prior_sd > PRIOR_SD * 0.999
    with pytest.raises(ValueError, match="spread: expected positive standard deviations"):
        event_ratios({"gain": 1.0}, {"EQ": likelihood}, numbers, spread={"gain": 0.0})


def test_histories_of_a_new_event_have_noise_of_its_own_level(hierarchy, posterior):
    prediction = predict_new_event(hierarchy, {"EQ0": posterior}, 0.1, noise=True, n=2000, seed=1)
    squared = MEDIAN**2 * np.exp(2.0 * SPREAD**2)  # mean square of a log-normal gain
    share = 0.2**2 * np.exp(2.0 * 0.1**2)
    variance = 0.01 * (squared - MEDIAN**2 * np.exp(SPREAD**2)) * SHAPE**2 + 0.01 * squared * share * np.mean(SHAPE**2)
    np.testing.assert_allclose(prediction.sd[0], np.sqrt(variance), rtol=0.06)


def test_many_draws_of_impossible_shares_are_refused(hierarchy, posterior):
    wide = Hierarchy(hierarchy.posterior, hierarchy.samples * [1.0, 1.0, 3.0, 5.0])  # a median of 0.6, a spread of 0.5
    with pytest.raises(ValueError, match=r"1\d% of the draws have an impossible noise.*shares_of='response'"):
        predict_new_event(wide, {"EQ0": posterior}, 0.1, noise=True, n=2000, seed=1)


def test_what_cannot_be_predicted_is_refused(events, hierarchy, posterior):
    population_of_four, posteriors = events
    other = Amplified()
    other.parameter_names = ["stiffness"]
    few = {name: posteriors[name] for name in ("EQ2", "EQ3")}
    for known, of_events, options, message in (
        (population_of_four, few, {}, "posteriors of 'EQ0', 'EQ1' are missing"),
        (population_of_four, posteriors, {"quantity": np.max}, "need numbers such as"),
        (population_of_four, posteriors, {"quantity": [peak("top"), "top"]}, "need numbers such as"),
        (population_of_four, posteriors, {"model": other}, "stiffness belong"),
        (population_of_four, posteriors, {"noise": True}, "contain the errors of measurements already"),
        (hierarchy, {"EQ0": Amplified()}, {"noise": True, "quantity": None}, "noise=True needs a posterior"),
        (hierarchy, posterior, {}, "expected the posteriors of the events by name"),
    ):
        with pytest.raises(ValueError, match=message):
            predict_new_event(known, of_events, 1.0, **{"quantity": peak("top")} | options)
    still = FELikelihood(Amplified(0.0), posterior.likelihood.measurements, NOISE)
    for event, message in (
        (Amplified(), "needs a posterior or a likelihood with measurements"),
        (still, "event 'EQ0': ratios of events need positive values"),
    ):
        with pytest.raises(ValueError, match=message):
            event_ratios({"gain": 1.0}, {"EQ0": event}, peak("top"))
