"""Uncertainty propagation: closed forms, batches against direct computation, failing models."""

import logging
from multiprocessing.pool import ThreadPool

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.prediction import prediction
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import ChannelQuantity, peak
from fe_likelihoods.priors.distributions import HalfNormal, TruncatedNormal
from fe_likelihoods.priors.priors import Prior
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.model import SimulationFailed

NAMES = ("offset", "slope")
MEAN, COVARIANCE = np.array([1.0, -0.5]), np.array([[0.04, 0.01], [0.01, 0.09]])
NOISE = np.array([0.3, 0.05])


class Line:
    """Responses linear in the parameters, Gaussian for Gaussian parameters. With `fails`, small offsets fail."""

    parameter_names = NAMES
    channels = (Channel("a", "acceleration", "g"), Channel("b", "displacement", "cm"))
    dt = 0.1
    n_steps = 25
    fingerprint = "line"

    def __init__(self, fails=False):
        self.fails = fails
        self.runs = 0
        time = np.arange(self.n_steps) * self.dt
        self.design = np.stack([np.stack([np.ones_like(time), time]), np.stack([time**2, 3.0 * np.ones_like(time)])])

    def simulate(self, theta):
        self.runs += 1
        if self.fails and theta[0] < 0.9:
            raise SimulationFailed("the offset is too small" if theta[0] > 0.7 else "the offset is far too small")
        return np.einsum("cpt,p->ct", self.design, theta)


def closed_form(model):
    mean = np.einsum("cpt,p->ct", model.design, MEAN)
    return mean, np.einsum("cpt,pq,cqt->ct", model.design, COVARIANCE, model.design)


def draws(rng, n):
    return rng.multivariate_normal(MEAN, COVARIANCE, size=n)


def with_noise(model, measured=None):
    values = np.ones((2, model.n_steps)) if measured is None else measured
    prior = Prior(
        {name: TruncatedNormal(1.0, 0.5) for name in model.parameter_names}
        | {f"sigma_{c.name}": HalfNormal(1.0) for c in model.channels}
    )
    return Posterior(FELikelihood(model, Measurements(model.channels, model.dt, values)), prior)


def quiet(*args, **kwargs):
    return propagate(*args, progress=False, **kwargs)


def test_gaussian_closed_form_within_its_stated_errors(rng):
    model = Line()
    p = quiet(model, draws(rng, 4000))
    mean, variance = closed_form(model)
    # All steps depend on two parameters only, so that four standard errors are enough for all of them together.
    assert np.all(np.abs(p.mean - mean) < 4.0 * p.standard_error)
    assert np.allclose(p.standard_error, np.sqrt(p.variance / 4000))
    assert np.all(np.abs(p.variance / variance - 1.0) < 4.0 * np.sqrt(2.0 / 4000))
    for probability, quantile in zip(p.probabilities, p.quantiles, strict=True):
        exact = mean + stats.norm.ppf(probability) * np.sqrt(variance)
        density = stats.norm.pdf(stats.norm.ppf(probability)) / np.sqrt(variance)
        assert np.all(np.abs(quantile - exact) < 5.0 * np.sqrt(probability * (1.0 - probability) / 4000) / density)
    # Negative control: the errors are not so large that any mean would pass.
    assert np.any(np.abs(p.mean - 1.05 * mean) > 4.0 * p.standard_error)


def test_batches_agree_with_direct_computation_and_copies_count(rng, monkeypatch):
    model = Line()
    samples = draws(rng, 300)[rng.integers(0, 300, size=500)]
    responses = np.array([Line().simulate(theta) for theta in samples])
    p = quiet(model, samples)
    assert model.runs == len(np.unique(samples, axis=0)) < 280 and p.n_samples == 500
    assert np.allclose(p.mean, responses.mean(axis=0), rtol=1e-13)
    assert np.allclose(p.variance, responses.var(axis=0), rtol=1e-11)
    assert np.allclose(p.quantiles, np.quantile(responses, p.probabilities, axis=0, method="weibull"), rtol=1e-12)
    with ThreadPool(2) as pool:  # in other batches
        assert np.array_equal(quiet(model, samples, pool=pool).quantiles, p.quantiles)
    monkeypatch.setattr(prediction, "_IN_DOUBLE", 0)
    single = quiet(model, samples)
    assert not np.array_equal(single.quantiles, p.quantiles) and np.allclose(single.quantiles, p.quantiles, rtol=1e-6)
    monkeypatch.setattr(prediction, "_MOST", 1000)
    model.runs = 0
    with pytest.raises(ValueError, match=r"need .* GB.*fewer channels.*or use quantiles=\(\)"):
        quiet(model, samples)
    assert model.runs == 0 and np.array_equal(quiet(model, samples, quantiles=()).mean, p.mean)


@pytest.mark.parametrize("huge", [1e50, 1e200])
def test_unstable_responses_give_numbers(rng, huge, monkeypatch):
    monkeypatch.setattr(prediction, "_IN_DOUBLE", 0)

    class Unstable(Line):
        def simulate(self, theta):
            return super().simulate(theta) * (huge if theta[0] > 1.3 else 1.0)

    p = quiet(Unstable(), draws(rng, 200))
    for values in (p.mean, p.variance, p.standard_error, p.quantiles):
        assert not np.isnan(values).any()
    assert np.all(np.abs(p.quantile(0.5)) < 20.0)


def test_all_numbers_are_retained_in_the_order_of_the_samples(rng):
    samples = draws(rng, 60)[rng.integers(0, 60, size=100)]
    p = quiet(Line(), samples, quantity=peak("b"))
    expected = [np.abs(Line().simulate(theta)[1]).max() for theta in samples]
    assert np.allclose(p.values, expected, rtol=1e-13) and p.dt is None
    assert np.allclose(p.quantiles, np.quantile(expected, p.probabilities, method="weibull"))
    assert p.channels == (Line.channels[1],)
    both = quiet(Line(), samples, quantity=[peak("b"), ChannelQuantity("a", lambda history: history[-1])])
    assert both.values.shape == (100, 2) and np.allclose(both.values[:, 0], expected)
    energy = quiet(Line(), samples, quantity=lambda response: np.square(response).sum(axis=1))
    assert energy.mean.shape == (2,) and energy.values.shape == (100, 2) and energy.channels == ()
    without = quiet(Line(), samples, quantity=peak("b"), quantiles=())
    assert without.quantiles.shape == (0,) and np.array_equal(without.values, p.values)


def test_channels_by_name(rng):
    samples = draws(rng, 50)
    whole = quiet(Line(), samples)
    one = quiet(Line(), samples, quantity="b")
    assert one.mean.shape == (1, Line.n_steps) and np.allclose(one.mean[0], whole.mean[1])
    turned = quiet(Line(), samples, quantity=["b", "a"])
    assert [c.name for c in turned.channels] == ["b", "a"] and np.allclose(turned.quantiles, whole.quantiles[:, ::-1])


def test_noise_adds_its_variance(rng):
    posterior = with_noise(Line())
    sigma = NOISE * rng.uniform(0.5, 1.5, size=(3000, 2))
    samples = np.hstack([draws(rng, 3000), sigma])
    clean, noisy = quiet(posterior, samples), quiet(posterior, samples, noise=True, seed=3)
    assert np.array_equal(clean.mean, noisy.mean) and np.array_equal(clean.standard_error, noisy.standard_error)
    assert np.allclose(noisy.variance - clean.variance, np.mean(sigma**2, axis=0)[:, None])
    # Quantiles from one draw of the noise per sample, against the distribution of the mixture.
    mean = np.einsum("cpt,np->nct", posterior.likelihood.model.design, samples[:, :2])
    below = stats.norm.cdf((noisy.quantile(0.05) - mean) / sigma[:, :, None]).mean(axis=0)
    # 50 quantiles of nearly independent noise, 3000 draws each.
    assert np.all(np.abs(below - 0.05) < 4.5 * np.sqrt(0.05 * 0.95 / 3000))
    peaks = quiet(posterior, samples, noise=True, quantity=peak("a"), seed=3)
    assert peaks.mean > quiet(posterior, samples, quantity=peak("a")).mean + 10.0 * peaks.standard_error


def test_noise_depends_on_the_seed_only(rng):
    posterior = with_noise(Line())
    samples = np.hstack([draws(rng, 40)[rng.integers(0, 40, size=60)], np.tile(NOISE, (60, 1))])
    for quantity in (None, peak("a")):
        first = quiet(posterior, samples, noise=True, seed=5, quantity=quantity)
        again = quiet(posterior, samples, noise=True, seed=5, quantity=quantity)
        other = quiet(posterior, samples, noise=True, seed=6, quantity=quantity)
        assert np.allclose(first.quantiles, again.quantiles) and not np.allclose(first.quantiles, other.quantiles)
    alone = quiet(posterior, samples, noise=True, seed=5, quantity="b")
    whole = quiet(posterior, samples, noise=True, seed=5)
    assert np.allclose(alone.quantiles[:, 0], whole.quantiles[:, 1])


@pytest.fixture
def oscillator(rng):
    return LinearOscillator(Record("noise", 0.02, rng.normal(size=400)), period=0.6, damping_ratio=0.05)


def test_coverage_of_measurements(oscillator, rng):
    """90 % of the measurements drawn from the predictive distribution lie in the 5-95 % band."""
    sigma = np.array([0.05, 0.002])
    truth = np.array([1.05, 0.9])
    measured = oscillator.simulate(truth) + sigma[:, None] * rng.normal(size=(2, 400))
    posterior = with_noise(oscillator, measured)
    samples = np.hstack([rng.normal(truth, 1e-4, size=(600, 2)), np.tile(sigma, (600, 1))])
    measurements = posterior.likelihood.measurements
    noisy = quiet(posterior, samples, noise=True, seed=0)
    # 400 independent samples per channel, and the error of a band from 600 draws.
    error = np.sqrt(0.9 * 0.1 * (1 / 400 + 1 / (600 * 400) * 2))
    scores, alone = noisy.score(measurements), quiet(posterior, samples).score(measurements)
    assert np.all(np.abs(scores.coverage - 0.9) < 4.0 * error)
    assert np.all(alone.coverage < 0.2)  # the band of the response is much narrower
    swapped = measurements.select(["displacement", "acceleration"])
    assert np.array_equal(noisy.score(swapped).coverage, scores.coverage)
    expected = np.sqrt(np.square(noisy.mean - measured).sum(axis=1) / np.square(measured).sum(axis=1))
    assert np.allclose(scores.rrmse, expected)
    halves = [noisy.score(measurements, part=half) for half in (slice(0, 200), slice(200, 400))]
    inside = [half.coverage for half in halves]
    assert np.allclose(np.mean(inside, axis=0), scores.coverage) and not np.allclose(*inside)
    with pytest.raises(ValueError, match=r"no quantile 0\.01"):
        noisy.score(measurements, interval_probability=0.98)
    with pytest.raises(ValueError, match=r"400 samples with a step of 0\.02 s .* got 200"):
        noisy.score(measurements.trim(0.0, 199 * 0.02))


def test_another_record(oscillator, rng):
    samples = rng.normal(1.0, 0.05, size=(30, 2))
    longer = Record("other", 0.01, rng.normal(size=700))
    p = quiet(with_noise(oscillator), samples, record=longer)
    same = quiet(LinearOscillator(longer, period=0.6, damping_ratio=0.05), samples)
    assert np.array_equal(p.mean, same.mean) and p.dt == 0.01 and len(p.time) == 700
    double = quiet(oscillator, samples, record=oscillator.record.scale(2.0), quantity=peak("displacement"))
    assert np.allclose(double.values, 2.0 * quiet(oscillator, samples, quantity=peak("displacement")).values)


def test_failures_are_counted_and_left_out(rng, caplog):
    samples = draws(rng, 200)[rng.integers(0, 200, size=300)]
    good = samples[:, 0] >= 0.9
    with caplog.at_level(logging.WARNING):
        p = quiet(Line(fails=True), samples)
    assert np.array_equal(p.failed, np.flatnonzero(~good)) and p.n_failed == (~good).sum() > 50
    assert p.failure_reasons == {
        "the offset is too small": int(np.sum(~good & (samples[:, 0] > 0.7))),
        "the offset is far too small": int(np.sum(samples[:, 0] <= 0.7)),
    }
    assert f"{p.n_failed} of 300 samples failed" in caplog.text
    rest = quiet(Line(), samples[good])
    assert np.allclose(p.mean, rest.mean) and np.allclose(p.quantiles, rest.quantiles, atol=1e-6)
    assert np.allclose(p.standard_error, rest.standard_error)
    peaks = quiet(Line(fails=True), samples, quantity=peak("a"))
    assert np.allclose(peaks.values, quiet(Line(), samples[good], quantity=peak("a")).values)
    endless = quiet(Line(), samples, quantity=lambda response: np.inf if response[0, 0] < 0.9 else response[0, 0])
    assert endless.failure_reasons == {"the quantity is not finite": p.n_failed} and len(endless.values) == good.sum()
    noisy = np.hstack([samples, np.tile(NOISE, (300, 1))])
    assert np.array_equal(quiet(with_noise(Line(fails=True)), noisy, noise=True).failed, p.failed)


def test_all_failed():
    with pytest.raises(SimulationFailed, match="all 3 samples failed .3 x the offset is far too small"):
        quiet(Line(fails=True), np.zeros((3, 2)))


def test_effective_sample_size_widens_the_errors(rng):
    samples = draws(rng, 400)
    full, quarter = quiet(Line(), samples), quiet(Line(), samples, effective_sample_size=100)
    assert np.allclose(quarter.standard_error, 2.0 * full.standard_error)


@pytest.mark.parametrize(
    ("samples", "settings", "message"),
    [
        (np.ones((5, 3)), {}, r"one value for each of the 4 parameters offset, slope, sigma_a, sigma_b.*\(5, 3\)"),
        (np.ones((5, 7, 4)), {}, r"\(5, 7, 4\)"),
        (np.ones(4), {}, r"shape \(n, 4\)"),
        (np.ones((0, 4)), {}, r"got \(0, 4\)"),
        (np.array([[1.0, 1.0], [1.0, np.nan]]), {}, "first is sample 1"),
        (np.ones((5, 2)), {"noise": True}, r"sigma_a, sigma_b of each sample.*posterior\.draw_noise\(samples\)"),
        (np.array([[1.0, 1.0, 1.0, 0.0]]), {"noise": True}, "positive standard deviation"),
        (np.ones((5, 4)), {"record": Record("r", 0.1, [0.0, 1.0])}, "Line has one excitation only.*with_record"),
        (np.ones((5, 4)), {"quantity": "c"}, "no channel 'c'; the channels of the model are a, b"),
        (np.ones((5, 4)), {"quantity": ["a", "a"]}, "quantity must be"),
        (np.ones((5, 4)), {"quantity": peak("c")}, "no channel 'c'"),
        (np.ones((5, 4)), {"quantity": 3}, "quantity must be"),
        (np.ones((5, 4)), {"quantiles": (0.05, 1.0)}, "between 0 and 1"),
        (np.ones((5, 4)), {"quantiles": 0.5}, "sequence"),
        (np.ones((5, 4)), {"effective_sample_size": 0.0}, "effective_sample_size"),
        (np.ones((5, 4)), {"seed": -1}, "seed must be"),
    ],
)
def test_refused_before_any_simulation(samples, settings, message):
    posterior = with_noise(Line())
    with pytest.raises(ValueError, match=message):
        quiet(posterior, samples, **settings)
    assert posterior.likelihood.model.runs == 0


def test_refused_otherwise(oscillator, rng):
    with pytest.raises(ValueError, match="noise=True needs a posterior"):
        quiet(Line(), np.ones((5, 2)), noise=True)
    with pytest.raises(ValueError, match="expected a Record as excitation; got ndarray"):
        quiet(oscillator, np.ones((5, 2)), record=np.ones(10))
    with pytest.raises(ValueError, match="expected a Posterior"):
        quiet(lambda theta: theta, np.ones((5, 2)))
    with pytest.raises(ValueError, match=r"one shape for every response; got \(1,\), then \(2,\)"):
        shapes = iter([1, 2])
        quiet(Line(), draws(rng, 5), quantity=lambda response: np.ones(next(shapes)))
    with pytest.raises(ZeroDivisionError):
        quiet(Line(), draws(rng, 5), quantity=lambda response: 1 // 0)

    class Mute:
        parameter_names = ("s",)

    posterior = with_noise(Line())
    posterior.likelihood.noise = Mute()
    with pytest.raises(ValueError, match="Mute cannot be drawn from.*standard_deviations"):
        quiet(posterior, np.ones((5, 3)), noise=True)


@pytest.mark.parametrize("noise", [False, True])
def test_several_quantities_are_predicted_from_the_same_simulations(rng, noise):
    model = Line(fails=True)
    posterior = with_noise(model)
    samples = np.column_stack([draws(rng, 60), np.tile(NOISE, (60, 1))])
    wanted = {"histories": None, "peaks": [peak("a"), peak("b")], "first": "a", "size": lambda response: response.size}
    together = quiet(posterior, samples, quantity=wanted, noise=noise, seed=3)
    assert model.runs == 60  # each one once
    assert list(together) == list(wanted)
    for name, quantity in wanted.items():
        alone = quiet(posterior, samples, quantity=quantity, noise=noise, seed=3)
        for field in ("mean", "variance", "quantiles", "failed"):
            np.testing.assert_array_equal(getattr(together[name], field), getattr(alone, field))
        assert together[name].quantity is quantity
        assert together[name].channels == alone.channels and together[name].dt == alone.dt
    with pytest.raises(ValueError, match="at least one quantity by name"):
        quiet(posterior, samples, quantity={})
