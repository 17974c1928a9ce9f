"""Standard deviations integrated out: the integral by other methods, and the same posterior in fewer dimensions."""

import math
import pickle
import warnings

import numpy as np
import pytest
from scipy import integrate, special, stats

from fe_likelihoods import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.noise.marginal import MarginalNoise
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.priors.distributions import HalfNormal, LogNormal, TruncatedNormal, Uniform
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record

TOP = Channel("top", "absolute acceleration", "g")
DRIFT = Channel("drift", "relative displacement", "in")
PRIORS = {
    "half-normal": HalfNormal(1.0),
    "bounded below": TruncatedNormal(0.0, 0.3, 1e-3),
    "informative": TruncatedNormal(1.0, 0.1),
    "uniform": Uniform(0.05, 2.0),
    "uniform from zero": Uniform(0.0, 3.0),
    "lognormal": LogNormal(0.5, 1.5),
}


def by_quadrature(squares, n, prior):
    """Logarithm of the integral over sigma, by scipy's adaptive quadrature in intervals around the maximum."""

    def log_integrand(t):
        sigma = np.exp(t)
        return -n * (0.5 * math.log(2.0 * math.pi) + t) - 0.5 * squares / sigma**2 + prior.logpdf(sigma) + t

    low, high = math.log(max(prior.bounds[0], 1e-8)) + 1e-14, math.log(min(prior.bounds[1], 1e4)) - 1e-14
    a, b = low, high
    for _ in range(6):
        t = np.linspace(a, b, 2001)
        best = np.argmax(log_integrand(t))
        a, b = t[max(best - 1, 0)], t[min(best + 1, 2000)]
    top, largest = t[best], log_integrand(t[best])
    slope = abs(n * (squares / n * math.exp(-2.0 * top) - 1.0))
    width = min(1.0 / math.sqrt(2.0 * n), 1.0 / (slope + 1e-9))
    steps = [0.0, 1.0, 3.0, 6.0, 10.0, 20.0, 50.0, 200.0, 1e3, 1e4]
    ends = sorted({min(max(top + side * width * step, low), high) for side in (-1, 1) for step in steps} | {low, high})
    pieces = [
        integrate.quad(lambda t: math.exp(log_integrand(t) - largest), *ab, epsabs=1e-14, epsrel=1e-12, limit=200)[0]
        for ab in zip(ends[:-1], ends[1:], strict=True)
    ]
    return largest + math.log(sum(pieces))


@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_equals_an_adaptive_quadrature(prior):
    """From very good to very bad fits, also beyond the bounds of the prior, in one call."""
    for n, tolerance in ((10, 1e-6), (100, 1e-8), (5000, 1e-7)):
        rms = np.array([1e-3, 0.049, 0.3, 1.0, 20.0])
        if n == 10 and prior == PRIORS["informative"]:
            rms = rms[2:]  # two maxima, see the Notes of MarginalNoise
        got = MarginalNoise(GaussianNoise([TOP]), {"sigma_top": prior}).log_likelihood(n * rms[:, None] ** 2, n)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", integrate.IntegrationWarning)
            expected = [by_quadrature(n * r**2, n, prior) for r in rms]
        np.testing.assert_allclose(got, expected, atol=tolerance, rtol=1e-13)


def test_channels_are_a_sum_and_a_shared_sigma_is_one_integral(rng):
    priors = {"sigma_drift": HalfNormal(0.5), "sigma_top": LogNormal(1.0, 0.5)}  # in any order
    misfit = rng.uniform(20.0, 90.0, size=(5, 2))
    each = [MarginalNoise(GaussianNoise([c]), {k: priors[k]}) for c, k in ((TOP, "sigma_top"), (DRIFT, "sigma_drift"))]
    expected = sum(noise.log_likelihood(misfit[:, [k]], 80) for k, noise in enumerate(each))
    both = MarginalNoise(GaussianNoise([TOP, DRIFT]), priors)
    np.testing.assert_allclose(both.log_likelihood(misfit, 80), expected, rtol=1e-14)
    shared = GaussianNoise([TOP, DRIFT], groups="all", scales=[2.0, 0.5])
    grid = np.geomspace(0.2, 4.0, 4001)
    for noise in (shared, GaussianNoise([TOP, DRIFT], groups="all", scales=[2.0, 0.5], effective_samples=(20.0, 1e3))):
        one = MarginalNoise(noise, {"sigma": HalfNormal(1.0)})
        values = [noise.log_likelihood(np.tile(j, (4001, 1)), 80, grid[:, None]) for j in misfit]
        values = np.array(values) + HalfNormal(1.0).logpdf(grid)
        expected = np.log(np.trapezoid(np.exp(values - values.max()), grid, axis=1)) + values.max()
        np.testing.assert_allclose(one.log_likelihood(misfit, 80), expected, rtol=1e-6)


def test_impossible_values_and_exact_fits():
    noise = MarginalNoise(GaussianNoise([TOP]), {"sigma_top": HalfNormal(1.0)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = noise.log_likelihood(np.array([[math.nan], [math.inf], [0.0], [1e-280], [1e280], [3.0]]), 50)
        bounded = MarginalNoise(GaussianNoise([TOP]), {"sigma_top": Uniform(0.1, 1.0)})
        perfect = bounded.log_likelihood(np.zeros((1, 1)), 50)
        assert noise.log_likelihood(np.zeros((0, 1)), 50).shape == (0,)
    assert values[:2].tolist() == [-np.inf] * 2 and values[2] == np.inf and np.isfinite(values[[3, 5]]).all()
    assert values[4] < -1e100
    assert perfect[0] == pytest.approx(by_quadrature(0.0, 50, Uniform(0.1, 1.0)), rel=1e-9)


def test_draws_have_the_conditional_distribution(rng):
    """For a flat prior, J / sigma^2 given J is chi-squared with n - 1 degrees of freedom."""
    n, levels = 12, np.linspace(0.001, 0.999, 500)[:, None]
    noise = MarginalNoise(GaussianNoise([TOP]), {"sigma_top": Uniform(0.0, 1e3)})
    sigma = noise.draw(np.full(levels.shape, 3.0), n, levels)
    np.testing.assert_allclose(stats.chi2(n - 1).sf(3.0 / sigma**2), levels, atol=1e-3)
    bounded = MarginalNoise(GaussianNoise([TOP]), {"sigma_top": Uniform(0.1, 0.4)})
    bounded = bounded.draw(np.full((500, 1), 3.0), n, rng.random((500, 1)))
    assert ((bounded > 0.1) & (bounded < 0.4)).all()
    for misfit in (0.0, math.nan):
        with pytest.raises(ValueError, match="finite and positive; in 1 of 1 rows"):
            noise.draw(np.array([[misfit]]), n, rng.random((1, 1)))


@pytest.mark.parametrize(
    ("noise", "name", "text"),
    [
        *((each, "sigma_top", "keep the parameters of this noise") for each in (AutoregressiveNoise([TOP]), "white")),
        (GaussianNoise([TOP], sensor=[0.1]), "sigma_top", "keep the parameters of this noise"),
        (GaussianNoise([TOP]), "sigma", "expected priors of the noise parameters sigma_top; got priors of sigma"),
    ],
    ids=["AR", "name", "sensor", "priors"],
)
def test_noises_that_cannot_be_integrated_out_are_refused(noise, name, text):
    with pytest.raises(ValueError, match=text):
        MarginalNoise(noise, {name: HalfNormal(1.0)})


# posteriors -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def full(rng):
    model = LinearOscillator(Record("noise", 0.02, rng.normal(size=200)), period=0.6, damping_ratio=0.05)
    values = model.simulate([1.15, 0.8])
    values = values + 0.3 * values.std(axis=1, keepdims=True) * rng.normal(size=values.shape)
    prior = {
        "stiffness": TruncatedNormal(1.0, 0.3),
        "damping": TruncatedNormal(1.0, 0.6),
        "sigma_acceleration": HalfNormal(1.0),
        "sigma_displacement": HalfNormal(0.02),
    }
    return Posterior(FELikelihood(model, Measurements(model.channels, model.dt, values)), prior)


def test_the_posterior_is_the_full_one_summed_over_the_noise(full):
    """The densities agree at each structural point, hence posterior and evidence agree."""
    marginal = full.marginal()
    assert marginal.parameter_names == ["stiffness", "damping"] and marginal.fast_parameters == ()
    thetas = np.array([[1.15, 0.8], [1.1, 1.0], [0.7, 0.5]])
    rms = np.sqrt(full.likelihood.misfit(thetas) / full.likelihood.measurements.n_steps)
    t = np.linspace(-0.5, 0.5, 121)
    for theta, scale in zip(thetas, rms, strict=True):
        grid = scale * np.exp(np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1).reshape(-1, 2))
        values = full.log_prob(np.hstack([np.tile(theta, (len(grid), 1)), grid])) + np.log(grid).sum(axis=1)
        # the trapezoidal rule converges exponentially for a peak within its limits
        expected = special.logsumexp(values) + 2.0 * math.log(t[1] - t[0])
        assert marginal.log_prob(theta) == pytest.approx(expected, abs=1e-8)
    assert np.isneginf(marginal.log_prob([-1.0, 1.0])) and np.isneginf(marginal.log_prob([1.0, 100.0]))
    assert marginal.fingerprint != full.fingerprint == pickle.loads(pickle.dumps(full)).fingerprint
    assert pickle.loads(pickle.dumps(marginal)).fingerprint == marginal.fingerprint == full.marginal().fingerprint
    with pytest.raises(ValueError, match="keep the parameters of this noise"):
        marginal.marginal()


def test_the_noise_is_drawn_afterwards_without_a_simulation(full, rng):
    marginal = full.marginal()
    samples = np.column_stack([rng.normal(1.15, 0.02, 300), rng.normal(0.8, 0.05, 300)])
    marginal.log_prob(samples)
    assert marginal.likelihood.simulations == 300 and full.likelihood.simulations == 0
    named = marginal.draw_noise(samples, 3)
    assert list(named) == full.parameter_names and marginal.likelihood.simulations == 300
    assert np.array_equal(named["damping"], samples[:, 1])
    rms = np.sqrt(marginal.likelihood.misfit(samples) / 200)
    ratio = np.stack([named["sigma_acceleration"], named["sigma_displacement"]], axis=1) / rms
    assert np.all(np.abs(ratio.mean(axis=0) - 1.0) < 0.02) and np.all(np.abs(ratio.std(axis=0) * 20.0 - 1.0) < 0.2)
    assert np.array_equal(marginal.draw_noise(samples, 3)["sigma_displacement"], named["sigma_displacement"])
    with_noise = propagate(marginal, named, noise=True, seed=1, progress=False)
    without = propagate(marginal, samples, progress=False)
    expected = np.square(named["sigma_displacement"]).mean()
    np.testing.assert_allclose((with_noise.variance - without.variance)[1], expected, rtol=1e-9)
    with pytest.raises(ValueError, match="draw_noise"):
        propagate(marginal, samples, noise=True, progress=False)
    with pytest.raises(ValueError, match="are in the samples of this posterior"):
        full.draw_noise(samples)
