"""Missing samples: every noise is the normal density of the samples that are there."""

import math

import numpy as np
import pytest
from scipy import linalg, stats

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    SimulationCache,
    SimulationFailed,
    TruncatedNormal,
    Uniform,
    residual_checks,
)
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.noise.marginal import MarginalNoise
from fe_likelihoods.noise.residuals import effective_samples, innovations
from fe_likelihoods.noise.sufficient_statistics import count_samples
from tests.emulation.problems import CHANNELS as MODES_CHANNELS
from tests.emulation.problems import DT, N_STEPS, free_vibration

CHANNELS = (Channel("top", "acceleration", "g"), Channel("drift", "displacement", "mm"))
TIME = 0.02 * np.arange(60)


def wave(theta):
    """Two channels of sixty samples; fails for a large second parameter."""
    if theta[1] > 3.0:
        raise SimulationFailed("too fast")
    return np.stack([theta[0] * np.sin(9.0 * theta[1] * TIME), 0.1 * theta[0] * np.cos(9.0 * theta[1] * TIME)])


def with_gaps(rng, shape=(2, 60), share=0.3):
    """Mask of samples that are there: a late first sample, an early last one, single ones and a long gap."""
    there = rng.random(shape) > share
    there[0, :4], there[1, -9:], there[0, 20:37] = False, False, False
    return there


def measured(rng, there):
    values = wave(np.array([1.0, 1.0])) + 0.1 * rng.normal(size=(2, 60))
    return Measurements(CHANNELS, 0.02, np.where(there, values, np.nan))


def statistics_of(noise, residuals):
    statistic = getattr(noise, "statistic", None)
    known = np.square(np.nan_to_num(residuals)).sum(axis=1)
    return (known if statistic is None else statistic(residuals))[None]


# the closed form ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 60, "gaps"])
@pytest.mark.parametrize("rho", [-0.999, -0.7, 0.0, 0.5, 0.98, 0.9999])
def test_autoregressive_noise_is_the_normal_density_and_bridges_gaps_exactly(rng, rho, n):
    noise = AutoregressiveNoise(CHANNELS, sensor={"top": 0.3})
    assert noise.parameter_names == ("sigma_top", "sigma_drift", "rho_top", "rho_drift")
    there = with_gaps(rng) if n == "gaps" else np.ones((2, n), dtype=bool)
    residuals = np.where(there, rng.normal(size=there.shape) * [[1.0], [0.02]], np.nan)
    parameters = np.array([[0.7, 0.03, rho, -0.5 * rho]])
    expected = sum(
        stats.multivariate_normal.logpdf(
            r[one], cov=s**2 * linalg.toeplitz(q ** np.arange(1.0 * len(r)))[np.ix_(one, one)]
        )
        for r, one, s, q in zip(residuals, there, (math.hypot(0.7, 0.3), 0.03), (rho, -0.5 * rho), strict=True)
    )
    got = noise.log_likelihood(statistics_of(noise, residuals), count_samples(residuals), parameters)[0]
    assert got == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("share", [0.3, 0.0])
@pytest.mark.parametrize("options", [{}, {"sensor": {"top": 0.3}}, {"effective_samples": {"top": 11.0, "drift": 1e9}}])
def test_white_noises_count_the_samples_that_are_there(rng, options, share):
    there = with_gaps(rng) if share else np.ones((2, 60), dtype=bool)
    residuals = np.where(there, rng.normal(size=(2, 60)) * [[1.0], [0.02]], np.nan)
    counts = count_samples(residuals)
    assert np.broadcast_to(getattr(counts, "samples", counts), 2).tolist() == there.sum(axis=1).tolist()
    powers = [min(11.0 / there[0].sum(), 1.0) if "effective_samples" in options else 1.0, 1.0]
    for noise, parameters in (
        (GaussianNoise(CHANNELS, **options), np.array([[0.7, 0.03]])),
        (GaussianNoise(CHANNELS, groups="all", scales=(2.0, 0.1), **options), np.array([[0.4]])),
    ):
        sigmas = noise.standard_deviations(parameters)[0]
        expected = sum(
            power * stats.multivariate_normal.logpdf(r[one], cov=s**2 * np.eye(one.sum()))
            for r, one, s, power in zip(residuals, there, sigmas, powers, strict=True)
        )
        got = noise.log_likelihood(statistics_of(noise, residuals), counts, parameters)[0]
        assert got == pytest.approx(expected, rel=1e-10)


def test_marginal_noise_counts_the_samples_that_are_there(rng):
    there = with_gaps(rng)
    residuals = np.where(there, rng.normal(size=(2, 60)), np.nan)
    priors = {"sigma_top": HalfNormal(2.0), "sigma_drift": Uniform(0.2, 3.0)}
    noise, misfit = MarginalNoise(GaussianNoise(CHANNELS), priors), statistics_of(GaussianNoise(CHANNELS), residuals)
    each = sum(
        MarginalNoise(GaussianNoise([channel]), {name: prior}).log_likelihood(misfit[:, [k]], int(there[k].sum()))[0]
        for k, (channel, (name, prior)) in enumerate(zip(CHANNELS, priors.items(), strict=True))
    )
    assert noise.log_likelihood(misfit, count_samples(residuals))[0] == pytest.approx(each, rel=1e-13)
    draws = noise.draw(np.repeat(misfit, 4000, axis=0), count_samples(residuals), rng.random((4000, 2)))
    known = np.sqrt(misfit[0] / there.sum(axis=1))
    np.testing.assert_allclose(draws.mean(axis=0), known, rtol=0.1)


# the likelihood -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [GaussianNoise, AutoregressiveNoise])
def test_likelihood_with_gaps(rng, tmp_path, noise):
    there = with_gaps(rng)
    data = measured(rng, there)
    model = FunctionModel(wave, ["size", "speed"], CHANNELS, 0.02, 60)
    cache = SimulationCache(tmp_path / "cache.db")
    likelihood = FELikelihood(model, data.select(["drift", "top"]), noise(CHANNELS), cache=cache)
    x = np.column_stack([rng.uniform(0.5, 1.5, (9, 2)), rng.uniform(0.05, 0.3, (9, 2)), rng.uniform(-0.9, 0.9, (9, 2))])
    x = x[:, : likelihood.ndim]
    x[0, 1] = 4.0
    values = likelihood.log_likelihood(x)
    assert values[0] == -np.inf and np.isfinite(values[1:]).all() and likelihood.simulator.failures.count == 1
    for row, value in zip(x[1:], values[1:], strict=True):
        residuals = likelihood.residuals_of(likelihood.model.simulate(row[:2]))
        np.testing.assert_array_equal(np.isnan(residuals), ~there)
        statistics = statistics_of(likelihood.noise, residuals)
        assert value == likelihood.noise.log_likelihood(statistics, count_samples(residuals), row[None, 2:])[0]
    x[:, 2:] *= 0.9
    likelihood.log_likelihood(x)
    assert likelihood.simulations == 9  # sums are sufficient: other parameters of the noise need no simulation
    again = FELikelihood(model, data, noise(CHANNELS), cache=SimulationCache(tmp_path / "cache.db"))
    np.testing.assert_array_equal(again.log_likelihood(x), likelihood.log_likelihood(x))
    assert again.simulations == 0
    shifted = FELikelihood(model, measured(rng, there), noise(CHANNELS), cache=SimulationCache(tmp_path / "cache.db"))
    assert shifted.simulator.fingerprint != likelihood.simulator.fingerprint


class Unaware:
    """A noise whose statistic knows no gaps."""

    parameter_names = ()

    @staticmethod
    def statistic(residuals):
        return np.square(residuals).sum(axis=-1)

    def log_likelihood(self, statistics, n_samples, parameters):
        return -statistics.sum(axis=1)


def test_a_statistic_without_a_rule_for_gaps_is_refused(rng):
    model = FunctionModel(wave, ["size", "speed"], CHANNELS, 0.02, 60)
    FELikelihood(model, measured(rng, np.ones((2, 60), dtype=bool)), Unaware())
    with pytest.raises(ValueError, match="samples are missing, and the statistic"):
        FELikelihood(model, measured(rng, with_gaps(rng)), Unaware())


# guides ---------------------------------------------------------------------------------------------------------------


def gappy_vibration(noise, there, rows=None):
    """Posterior of a vibrating mass with missing samples, or of a model that returns only the samples `rows`."""
    errors = np.array([[2e-3], [5.0]]) * np.random.default_rng(1).standard_normal((2, N_STEPS))
    values = free_vibration([1.2, 0.8]) + errors
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    prior |= {"sigma_top": HalfNormal(0.01), "sigma_base": HalfNormal(20.0)}
    if noise is AutoregressiveNoise:
        prior |= {"rho_top": Uniform(-0.5, 0.9), "rho_base": Uniform(-0.5, 0.9)}
    if rows is None:
        function, data = free_vibration, np.where(there, values, np.nan)
    else:
        function, data = (lambda theta: free_vibration(theta)[:, rows]), values[:, rows]
    model = FunctionModel(function, ["stiffness", "damping"], MODES_CHANNELS, DT, data.shape[1])
    return Posterior(FELikelihood(model, Measurements(MODES_CHANNELS, DT, data), noise(MODES_CHANNELS)), prior)


def test_modes_are_those_of_the_samples_that_are_there(rng):
    rows = np.flatnonzero(rng.random(N_STEPS) > 0.4)
    there = np.zeros((2, N_STEPS), dtype=bool)
    there[:, rows] = True
    found, expected = (
        find_modes(gappy_vibration(GaussianNoise, there, which), starts=1, seed=0, tolerance=1e-12).modes[0]
        for which in (None, rows)
    )
    np.testing.assert_allclose(found.parameters[:2], expected.parameters[:2], rtol=1e-6)
    sd = np.sqrt(np.diag(expected.parameter_covariance))  # noise parameters are optimised to a part of it
    np.testing.assert_allclose(found.parameters / sd, expected.parameters / sd, rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-3, atol=1e-8)
    assert found.log_evidence == pytest.approx(expected.log_evidence, abs=1e-3)


# checks of residuals --------------------------------------------------------------------------------------------------


def test_checks_of_residuals_with_gaps(rng):
    """Effective samples from what is there: the variance of the mean square over many series."""
    n, rho = 400, 0.8
    there = rng.random((1, n)) > 0.3
    there[:, 100:180] = False
    z = rng.standard_normal((2000, n))
    for t in range(1, n):
        z[:, t] = rho * z[:, t - 1] + math.sqrt(1.0 - rho**2) * z[:, t]
    gappy = np.where(there, z, np.nan)
    variance = np.nanmean(np.square(gappy), axis=1).var()
    lags = rho ** np.abs(np.subtract.outer(np.flatnonzero(there[0]), np.flatnonzero(there[0])))
    exact = there.sum() ** 2 / np.square(lags).sum()
    assert 2.0 / variance == pytest.approx(exact, rel=0.1)
    estimates = [effective_samples(one[None])[0] for one in gappy[:40]]
    assert np.mean(estimates) == pytest.approx(exact, rel=0.15)
    checks = [residual_checks(one[None]) for one in gappy[:40]]
    assert np.mean([each.lag_one[0] for each in checks]) == pytest.approx(rho, abs=0.05)
    white = [residual_checks(np.where(there, rng.normal(size=(1, n)), np.nan)) for _ in range(100)]
    assert 0.01 < np.mean([each.white[0] < 0.05 for each in white]) < 0.10
    assert 0.0 < np.mean([each.normal[0] < 0.05 for each in white]) < 0.10
    step = innovations(gappy[:1], [rho])[0]
    places = np.flatnonzero(there[0])
    np.testing.assert_array_equal(np.flatnonzero(~np.isnan(step)) + 1, places[1:])
    k = int(np.argmax(np.diff(places)))
    mean = rho ** (places[k + 1] - places[k])
    expected = (z[0, places[k + 1]] - mean * z[0, places[k]]) / math.sqrt(1.0 - mean**2)
    assert step[places[k + 1] - 1] == pytest.approx(expected, rel=1e-12)


def test_checks_refuse_channels_with_too_few_samples():
    alternating = np.where(np.arange(20) % 2, np.nan, np.arange(20.0))[None]
    with pytest.raises(ValueError, match="no two successive samples"):
        residual_checks(alternating)
    with pytest.raises(ValueError, match="two samples or more in each channel"):
        effective_samples(np.where(np.arange(20) == 3, 1.0, np.nan)[None])


# errors, predictions --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"groups": "all"}, {"shares_of": "response", "window": 0.5}])
@pytest.mark.parametrize("gaps", [[(0, 20, 30)], [(1, 20, 30)], [(0, 15, 20), (1, 40, 45)], [(0, 20, 30), (1, 25, 35)]])
def test_a_gap_in_one_channel_leaves_a_density(options, gaps, rng):
    """A channel without samples in a stretch of time has no level there, and nothing is compared with it."""
    there = np.ones((2, 60), dtype=bool)
    for channel, start, stop in gaps:
        there[channel, start:stop] = False
    sensor = {"sensor": (1e-3, 1e-4)} if options.get("shares_of") else {}
    model = FunctionModel(wave, ["size", "speed"], CHANNELS, 0.02, 60)
    likelihood = FELikelihood(model, measured(rng, there), GaussianNoise(CHANNELS, **options, **sensor))
    n = likelihood.ndim - 2
    assert np.isfinite(likelihood([1.0, 1.0] + [0.1] * n))
    assert likelihood([1.0, 1.0, -0.1] + [0.1] * (n - 1)) == -np.inf
