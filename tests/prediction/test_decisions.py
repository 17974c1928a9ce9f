"""Exceedance and fragility with the error of the model: closed forms, what is unknown of the events, controls."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.noise.gaussian import GaussianNoise
from fe_likelihoods.population.event_ratios import EventRatios
from fe_likelihoods.population.hierarchical_posterior import HierarchicalPosterior, Varying
from fe_likelihoods.population.hierarchy import Hierarchy
from fe_likelihoods.population.stored_posterior import StoredPosterior
from fe_likelihoods.prediction.exceedance import exceedance
from fe_likelihoods.prediction.fragility import fragility
from fe_likelihoods.prediction.model_and_motion import model_error
from fe_likelihoods.prediction.new_event import event_ratios, predict_new_event
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import peak
from fe_likelihoods.priors.distributions import HalfNormal, LogNormal
from fe_likelihoods.priors.priors import Prior
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.model import SimulationFailed
from tests.prediction.flexible import Flexible, strongest, under
from tests.prediction.test_new_event import Amplified, hierarchy  # noqa: F401  a fixture

LOGS = np.array([0.1, -0.05, 0.2, 0.0])
RATIOS = EventRatios(np.exp(LOGS), prior_events=1e-9)
T = stats.t(3, LOGS.mean(), LOGS.std(ddof=1) * np.sqrt(1.25))


class Wave(FunctionModel):
    """A sine wave of five periods in a window, whose amplitude is the gain times the peak of the record."""

    def __init__(self, record):
        super().__init__(self.respond, ["gain"], [Channel("top", "displacement", "m")], record.dt, record.n_steps)
        self.record, self.path_dependent = record, False
        time = np.linspace(0.0, 1.0, record.n_steps)
        self.shape = np.sin(10.0 * np.pi * time) * np.sin(np.pi * time)

    def respond(self, theta):
        return [theta[0] * np.abs(self.record.acceleration).max() * self.shape]

    def with_record(self, record):
        return Wave(record)


class Sharp(Wave):
    """As near a resonance: the third power of the gain."""

    def respond(self, theta):
        return super().respond([theta[0] ** 3])

    def with_record(self, record):
        return Sharp(record)


class Falling(Wave):
    """Collapses beyond an acceleration of 0.9."""

    def respond(self, theta):
        if np.abs(self.record.acceleration).max() > 0.9:
            raise SimulationFailed("collapse")
        return super().respond(theta)

    def with_record(self, record):
        return Falling(record)


@pytest.fixture
def wave():
    return Wave(Record("motion", 0.01, np.linspace(-1.0, 1.0, 500)))


def with_noise(model, shares_of=None):
    measured = Measurements(model.channels, model.dt, model.simulate([1.0]))
    noise = GaussianNoise(model.channels, shares_of=shares_of)
    prior = {"gain": LogNormal(1.0, 0.5), noise.parameter_names[0]: HalfNormal(0.5)}
    return Posterior(FELikelihood(model, measured, noise), prior)


def test_exceedance_with_ratios_is_the_integral_over_samples_and_ratios(rng):
    values = np.exp(0.3 * rng.standard_normal(500))
    limits = np.array([0.5, 1.0, 2.0])
    found = exceedance(values, limits, ratios=RATIOS)
    single = T.sf(np.log(limits / values[:, None]))
    np.testing.assert_allclose(found.probability, single.mean(axis=0), rtol=1e-7)
    np.testing.assert_allclose(found.standard_error, single.std(axis=0) / np.sqrt(500), rtol=1e-10)
    drawn = values * np.exp(T.rvs(size=500, random_state=1))  # the same by draws
    assert np.all(np.abs((drawn[:, None] > limits).mean(axis=0) - found.probability) < 4.0 * np.sqrt(0.25 / 500))
    assert found.uncertainty == (
        "the uncertainty of the parameters and the error of the model, from the ratios of 4 events"
    )
    assert exceedance([-1.0, -2.0], 1.0, ratios=RATIOS).probability == 0.0  # times a positive ratio, it stays negative
    two = exceedance(
        np.stack([values, 2.0 * values], axis=1),
        1.5,
        ratios=EventRatios(np.exp([LOGS, LOGS - 0.1]).T, prior_events=1e-9),
    )
    one = exceedance(2.0 * values, 1.5, ratios=EventRatios(np.exp(LOGS - 0.1), prior_events=1e-9))
    assert two.probability[1] == pytest.approx(one.probability, rel=1e-12)
    assert two.lower[1] == pytest.approx(one.lower, abs=0.05)  # of 1000 other draws


@pytest.mark.parametrize("limit", (0.9, 1.1, 1.5))
def test_intervals_of_the_probability_cover_the_true_probability(limit, rng):
    """Exact for one value and ratios of five events; the interval of Clopper and Pearson of one value is of no use."""
    truth, inside = stats.norm.sf(np.log(limit), 0.1, 0.2), []
    for _ in range(300):
        ratios = EventRatios(np.exp(0.1 + 0.2 * rng.standard_normal(5)), prior_events=1e-9)
        found = exceedance(np.ones(50), limit, ratios=ratios, interval_probability=0.9)
        inside.append(found.lower <= truth <= found.upper)
    assert abs(np.mean(inside) - 0.9) < 4.0 * np.sqrt(0.09 / 300)
    control = exceedance(np.ones(50), limit, interval_probability=0.9)
    assert not control.lower <= truth <= control.upper


def test_intervals_contain_their_own_probability(hierarchy, rng):  # noqa: F811
    # P has the tail of t with 2 degrees of freedom
    few = EventRatios([0.9887505, 1.00023499, 1.00460618], prior_events=1e-9)
    limits = np.array([0.01, 0.1, 0.5, 0.9, 1.0, 1.1, 2.0, 10.0, 100.0])
    found = exceedance(np.ones(200), limits, ratios=few)
    assert np.all(found.lower <= found.probability) and np.all(found.probability <= found.upper)
    exact = stats.t.sf(np.log(limits), 2, np.log(few.quantile(0.5)), few.sd * np.sqrt(4.0 / 3.0))
    np.testing.assert_allclose(found.probability, exact, rtol=1e-7)
    quantile = np.quantile(few.draw_populations(100_000, rng).sd, 0.99)
    assert special.ndtr(-np.log(100.0) / quantile) < 1e-100 < 1e-7 < found.probability[-1]  # what made it fail
    # Shares of samples that are all zero, or all one, are not certain.
    draws, options = hierarchy.new_test(200, ["gain"], 1), {"quantity": peak("top"), "progress": False}
    plain = propagate(Amplified(2.0), draws, **options)
    for limit, share in ((10.0 * plain.values.max(), 0.0), (0.1 * plain.values.min(), 1.0)):
        found = exceedance(plain, limit, noise=False)
        assert found.probability == share
        assert found.upper - found.lower == pytest.approx(1.0 - 0.025 ** (1.0 / 200.0), rel=1e-6)


def test_each_record_has_the_scatter_that_it_makes_of_the_parameters(wave, rng):
    """Fragility of a population is the probability of each new event; near a resonance it is wider than the mean."""
    posteriors = {name: with_noise(wave.with_record(wave.record.scale(k))) for name, k in (("a", 0.5), ("b", 1.0))}
    prior = Prior({"gain": LogNormal(1.0, 0.5)})
    tests = {name: StoredPosterior({"gain": np.exp(0.05 * rng.standard_normal(200))}, prior) for name in posteriors}
    population = HierarchicalPosterior(tests, {"gain": Varying(LogNormal(1.0, 0.5), HalfNormal(0.1))})
    known = Hierarchy(population, [1.0, 0.05] * np.exp(0.01 * rng.standard_normal((50, 2))))
    given = {"quantity": peak("top"), "spread": {"gain": 0.1}}
    ratios = event_ratios(known, posteriors, **given)
    records, model = [wave.record.scale(k) for k in (0.8, 1.0)], Sharp(wave.record)
    options = {"seed": 1, "progress": False}
    predicted = [predict_new_event(known, posteriors, each, model=model, **given, **options) for each in records]
    found = fragility(predicted, strongest(records), 0.9)
    for k, new in enumerate(predicted):
        assert found.exceedance.probability[k] == float(exceedance(new, 0.9).probability)
        assert new.ratios.new_sd == pytest.approx(np.sqrt(0.3**2 + ratios.remainder), rel=0.05)
        assert new.ratios.new_sd > 2.0 * ratios.new_sd  # control: the mean of the calibrated events
    falling = Falling(wave.record)
    predicted = [predict_new_event(known, posteriors, each, model=falling, **given, **options) for each in records]
    found = fragility(predicted, strongest(records), 0.9)
    assert found.exceedance.probability[1] == found.exceedance.lower[1] == 1.0 > found.exceedance.probability[0]
    assert found.n_collapsed.tolist() == [0, 500] and "500 of 500 structures collapsed" in str(
        exceedance(predicted[1], 0.9)
    )


def test_error_of_the_model_has_the_level_of_the_noise_and_the_spectrum_of_the_response(wave):
    noise = GaussianNoise(
        Measurements(wave.channels, wave.dt, wave.simulate([1.0])).channels,
        shares_of="measured",
        window=1.0,
        sensor={"top": 0.1},
    )
    response, rng = wave.simulate([1.0]), np.random.default_rng(1)
    error = model_error(noise, np.full((1, 1), 0.3), wave.dt)
    draws = np.stack([error.draw(0, wave.n_steps, rng, response)[0] for _ in range(4000)])
    expected = np.square(noise.response_deviations([0.3], response, wave.dt)[0]) - 0.1**2  # without that of the sensor
    assert np.all(expected > 0.0)
    np.testing.assert_allclose(draws.std(axis=0), np.sqrt(expected), rtol=0.1)
    powers = np.square(np.abs(np.fft.rfft(draws, axis=1))).mean(axis=0)
    slow = slice(0, 15)  # the response has five periods
    assert powers[slow].sum() > 0.98 * powers.sum()
    assert np.square(np.abs(np.fft.rfft(response[0])))[slow].sum() > 0.99 * wave.n_steps * np.square(response).sum() / 2
    # White errors add to every peak; those of the model do not add more than their own few peaks do.
    posterior, samples = with_noise(wave, "measured"), np.tile([1.0, 0.2], (400, 1))
    plain = np.abs(response).max()
    medians = {
        kind: propagate(posterior, samples, quantity=peak("top"), noise=kind, seed=1, progress=False).quantile(0.5)
        for kind in (True, "model")
    }
    assert medians[True] > 1.15 * plain and 0.98 * plain < medians["model"] < 1.06 * plain
    with pytest.raises(ValueError, match='noise="model" needs a noise that follows the response'):
        propagate(with_noise(wave), samples, quantity=peak("top"), noise="model")


def test_fragility_has_the_error_of_the_model_where_it_is_known(wave, rng):
    posterior = with_noise(wave, "measured")
    samples = np.stack([np.exp(0.02 * rng.standard_normal(300)), 0.3 * np.exp(0.05 * rng.standard_normal(300))], axis=1)
    records = [wave.record.scale(k) for k in (0.7, 0.85, 1.0, 1.15, 1.4)]
    limit, options = float(np.abs(wave.shape).max()), {"quantity": peak("top"), "seed": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fragility(under(records, posterior, samples, noise="model", **options), strongest(records), limit)
    plain = under(records, posterior, samples, **options)
    with pytest.warns(UserWarning, match="fragility: the probabilities leave the error of the model out") as told:
        parameters = fragility(plain, strongest(records), limit)
    assert len(told) == 1 and told[0].filename == __file__
    assert 0.1 < found.curve.dispersion < 0.4
    assert parameters.exceedance.probability[[0, 1, 3, 4]].tolist() == [0.0, 0.0, 1.0, 1.0]
    assert found.exceedance.uncertainty.endswith("the error of the model, from the noise of the calibration")


def test_what_cannot_be_used_with_ratios_is_refused(record):
    with pytest.raises(ValueError, match="thresholds must be positive"):
        exceedance([1.0, 2.0], 0.0, ratios=RATIOS)
    with pytest.raises(ValueError, match=r"ratios \(n_events, ...\) of a quantity of shape \(\)"):
        exceedance([1.0, 2.0], 1.0, ratios=EventRatios([[1.0, 1.0]] * 2))
    (prediction,) = under([record], Flexible(record), np.zeros((3, 1)))
    with pytest.raises(ValueError, match="the prediction contains one"):
        exceedance(replace(prediction, noise=True), 0.1, noise=False)
    with pytest.raises(ValueError, match="contain the error of the model, and the prediction contains it already"):
        exceedance(replace(prediction, noise=True), 0.1, ratios=RATIOS)
