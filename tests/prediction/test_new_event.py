"""Prediction of a new event: closed forms of numbers and histories; coverage where errors are correlated."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import bilinear, lfilter

from fe_likelihoods import GaussianNoise
from fe_likelihoods.events.hierarchical_posterior import HierarchicalPosterior, Varying
from fe_likelihoods.events.hierarchy_result import Hierarchy
from fe_likelihoods.events.ratios import PRIOR_EVENTS, PRIOR_SD, EventRatios
from fe_likelihoods.events.scatter import REMAINDER
from fe_likelihoods.events.stored_posterior import StoredPosterior
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.prediction.new_event import event_ratios, predict_new_event
from fe_likelihoods.prediction.quantities import arias_intensity, peak, rms
from fe_likelihoods.prediction.reliability import exceedance
from fe_likelihoods.priors.distributions import HalfNormal, LogNormal
from fe_likelihoods.priors.priors import Prior
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record

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
    noise = GaussianNoise(measured.channels, level="measured")
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
    assert found.noise and "with measurement noise" not in str(found)
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


@pytest.mark.slow
@pytest.mark.parametrize("correlation", (0.0, -0.8))
@pytest.mark.parametrize("n_events", (5, 10))
def test_intervals_cover_new_events_whose_ratio_goes_with_their_parameters(n_events, correlation, rng):
    sets, new = 200, 20
    hierarchy = population([f"EQ{k}" for k in range(n_events)], rng)
    scales = 1.0 + 0.3 * np.arange(n_events)
    mixing = np.array([[SPREAD, 0.0], [0.1 * correlation, 0.1 * np.sqrt(1.0 - correlation**2)]])
    together = np.empty((sets, new))
    for row in range(sets):
        gains, ratios = np.exp(mixing @ rng.standard_normal((2, n_events + new)))
        peaks = MEDIAN * LARGEST * gains * ratios
        posteriors = likelihoods(scales * peaks[:n_events])
        options = {"model": Amplified(), "quantity": peak("top"), "n": 400, "seed": row, "prior_events": 1e-9}
        found = predict_new_event(hierarchy, posteriors, 1.0, **options)
        together[row] = np.searchsorted(np.sort(found.values), peaks[n_events:]) / 400.0
    for level in (0.5, 0.9):
        assert abs((np.abs(together - 0.5) <= 0.5 * level).mean() - level) < 0.03


def test_histories_of_a_new_event_have_noise_of_its_own_level(hierarchy, posterior):
    prediction = predict_new_event(hierarchy, {"EQ0": posterior}, 0.1, noise=True, n=2000, seed=1)
    squared = MEDIAN**2 * np.exp(2.0 * SPREAD**2)  # mean square of a log-normal gain
    share = 0.2**2 * np.exp(2.0 * 0.1**2)
    variance = 0.01 * (squared - MEDIAN**2 * np.exp(SPREAD**2)) * SHAPE**2 + 0.01 * squared * share * np.mean(SHAPE**2)
    np.testing.assert_allclose(prediction.sd[0], np.sqrt(variance), rtol=0.06)


def test_draws_of_impossible_shares_are_left_out(hierarchy, posterior):
    wide = Hierarchy(hierarchy.posterior, hierarchy.samples * [1.0, 1.0, 3.0, 5.0])  # a median of 0.6, a spread of 0.5
    with pytest.warns(UserWarning, match=r"1\d% of the draws have an impossible noise.*level='response'"):
        prediction = predict_new_event(wide, {"EQ0": posterior}, 0.1, noise=True, n=2000, seed=1)
    expected = 2000 * stats.norm.cdf(np.log(1.0 / 0.6) / 0.5)
    assert abs(prediction.n_samples - expected) < 4.0 * np.sqrt(2000 * 0.15 * 0.85)


def test_what_cannot_be_predicted_is_refused(events, hierarchy, posterior):
    population_of_four, posteriors = events
    options = {"quantity": peak("top")}
    with pytest.raises(ValueError, match="posteriors of 'EQ0', 'EQ1' are missing"):
        predict_new_event(population_of_four, {k: posteriors[k] for k in ("EQ2", "EQ3")}, 1.0, **options)
    for function in (np.max, [peak("top"), "top"]):
        with pytest.raises(ValueError, match="need numbers such as"):
            predict_new_event(population_of_four, posteriors, 1.0, quantity=function)
    other = Amplified()
    other.parameter_names = ["stiffness"]
    with pytest.raises(ValueError, match="stiffness belong"):
        predict_new_event(population_of_four, posteriors, 1.0, model=other, **options)
    with pytest.raises(ValueError, match="contain the errors of measurements already"):
        predict_new_event(population_of_four, posteriors, 1.0, noise=True, **options)
    with pytest.raises(ValueError, match="noise=True needs a posterior"):
        predict_new_event(hierarchy, {"EQ0": Amplified()}, 1.0, noise=True)
    with pytest.raises(ValueError, match="expected the posteriors of the events by name"):
        predict_new_event(hierarchy, posterior, 1.0, **options)
    with pytest.raises(ValueError, match="needs a posterior or a likelihood with measurements"):
        event_ratios({"gain": 1.0}, {"EQ0": Amplified()}, peak("top"))
    still = {"EQ0": FELikelihood(Amplified(0.0), posterior.likelihood.measurements, NOISE)}
    with pytest.raises(ValueError, match="event 'EQ0': ratios of events need positive values"):
        event_ratios({"gain": 1.0}, still, peak("top"))


class Resonant(FunctionModel):
    """An oscillator of 2 Hz, whose frequency and damping are multiples, under a base acceleration."""

    def __init__(self, motion):
        super().__init__(self.respond, ["frequency", "damping"], [TOP], 0.02, len(motion))
        self.record, self.path_dependent = Record("motion", 0.02, motion), False

    def respond(self, theta):
        omega = 4.0 * np.pi * theta[0]
        system = ([-1.0], [1.0, 2.0 * 0.05 * theta[1] * omega, omega**2])
        return [lfilter(*bilinear(*system, fs=50.0), self.record.acceleration)]

    def with_record(self, motion):
        return Resonant(motion)


@pytest.fixture(scope="module")
def resonant():
    """Six events under filtered noise, whose frequencies and damping ratios differ by 3 and 40 %."""
    rng = np.random.default_rng(4)
    motions = rng.standard_normal((6, 1000))
    truths = np.exp([0.03, 0.4] * rng.standard_normal((6, 2)))
    prior = Prior({"frequency": LogNormal(1.0, 0.2), "damping": LogNormal(1.0, 0.7)})
    posteriors, tests = {}, {}
    for k, (motion, truth) in enumerate(zip(motions, truths, strict=True)):
        model = Resonant(motion)
        posteriors[f"EQ{k}"] = FELikelihood(model, Measurements([TOP], 0.02, model.simulate(truth)), NOISE)
        tests[f"EQ{k}"] = StoredPosterior(truth * np.exp([0.005, 0.05] * rng.standard_normal((200, 2))), prior)
    varying = {name: Varying(each, HalfNormal(0.4)) for name, each in prior.distributions.items()}
    known = [*np.exp(np.log(truths).mean(axis=0)), 0.03, 0.4]
    known = np.array([known[0], 0.03, known[1], 0.4]) * np.exp(1e-3 * rng.standard_normal((50, 4)))
    return Hierarchy(HierarchicalPosterior(tests, varying), known), posteriors


def test_a_harmonic_near_resonance_widens_the_interval_and_other_motions_hardly(resonant):
    hierarchy, posteriors = resonant
    time = 0.02 * np.arange(1000)
    options = {"quantity": peak("top"), "spread": {"frequency": 0.03, "damping": 0.4}, "n": 200, "seed": 1}
    options["calibrated"] = ()
    with pytest.warns(UserWarning, match="as a harmonic has"):
        near = predict_new_event(hierarchy, posteriors, np.sin(4.0 * np.pi * time), **options)
    with pytest.warns(UserWarning, match="as a harmonic has"):
        far = predict_new_event(hierarchy, posteriors, np.sin(np.pi * time), **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alike = predict_new_event(hierarchy, posteriors, np.random.default_rng(9).standard_normal(1000), **options)
    of_events = np.asarray(alike.ratios.prior_sd)
    assert alike.ratios.new_sd < 1.2 * of_events.max() > far.ratios.new_sd / 1.2
    ratios, predicted = near.ratios, near.predicted
    assert ratios.new_sd > 1.4 * of_events.max() and alike.findings == ()
    model, rng = Resonant(np.sin(4.0 * np.pi * time)), np.random.default_rng(5)
    truths = np.exp([0.03, 0.4] * rng.standard_normal((100, 2)))  # of new events under the harmonic
    values = np.array([np.abs(model.simulate(truth)).max() for truth in truths])
    widened, alone = (
        np.mean(np.abs(each.probability_above(values / predicted, np.log(predicted)) - 0.5) <= 0.45)
        for each in (ratios, replace(ratios, new_sd=None))
    )
    assert widened > 0.75 and alone < 0.6, "the control: without the scatter of the new motion"
