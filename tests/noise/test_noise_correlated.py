"""Noise for real measurements: correlated errors, known sensor noise, effective samples, compared with white noise."""

import math
import warnings

import numpy as np
import pytest
from scipy import linalg, stats

from fe_likelihoods import AutoregressiveNoise, GaussianNoise
from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.noise.draws import SampleNoise
from fe_likelihoods.noise.residuals import lag_one_sums
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.priors.distributions import HalfNormal, TruncatedNormal, Uniform
from fe_likelihoods.problems import bridge_column, bridge_column_prior, isolated_bridge
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.simulation.model import SimulationFailed
from tests import lines

CHANNELS = (Channel("top", "absolute acceleration", "g"), Channel("drift", "relative displacement", "in"))


def autoregressive(rng, shape, rho):
    """AR(1) series of unit variance along the last axis, by its definition."""
    errors = rng.standard_normal(shape)
    for t in range(1, shape[-1]):
        errors[..., t] = rho * errors[..., t - 1] + math.sqrt(1.0 - rho**2) * errors[..., t]
    return errors


# autoregressive noise -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [-0.999, -0.6, 0.0, 0.3, 0.9, 0.9999])
@pytest.mark.parametrize("n_steps", [1, 2, 60])
def test_equals_the_normal_density_with_the_toeplitz_covariance(rng, rho, n_steps):
    noise = AutoregressiveNoise(CHANNELS)
    assert noise.parameter_names == ("sigma_top", "sigma_drift", "rho_top", "rho_drift")
    residuals = rng.normal(size=(2, n_steps)) * [[1.0], [0.02]]
    sigma, rhos = np.array([0.7, 0.03]), np.array([rho, 0.5 * rho])
    expected = sum(
        stats.multivariate_normal.logpdf(r, cov=s**2 * linalg.toeplitz(q ** np.arange(n_steps)))
        for r, s, q in zip(residuals, sigma, rhos, strict=True)
    )
    got = noise.log_likelihood(lag_one_sums(residuals)[None], n_steps, np.concatenate([sigma, rhos])[None])
    assert got[0] == pytest.approx(expected, rel=1e-9)


def test_is_white_noise_without_correlation(rng):
    residuals = rng.normal(size=(5, 2, 40))
    statistics = np.array([lag_one_sums(r) for r in residuals])
    sigma = rng.uniform(0.5, 2.0, size=(5, 2))
    np.testing.assert_allclose(
        AutoregressiveNoise(CHANNELS).log_likelihood(statistics, 40, np.hstack([sigma, np.zeros((5, 2))])),
        GaussianNoise(CHANNELS).log_likelihood(statistics[:, :2], 40, sigma),
        rtol=1e-13,
    )


def test_residuals_smoother_than_round_off_do_not_cancel():
    """With products of neighbours instead of differences, Q would cancel completely at this correlation."""
    residuals = 1.0 + 1e-9 * np.sin(np.arange(50.0))[None]
    rho, sigma = 1.0 - 1e-12, 1.3
    new = (residuals[0, 1:] - residuals[0, :-1]) + (1.0 - rho) * residuals[0, :-1]
    spread = (1.0 - rho) * (1.0 + rho)
    expected = stats.norm.logpdf(residuals[0, 0], scale=sigma)
    expected += stats.norm.logpdf(new, scale=sigma * math.sqrt(spread)).sum()
    noise = AutoregressiveNoise(CHANNELS[:1])
    got = noise.log_likelihood(lag_one_sums(residuals)[None], 50, np.array([[sigma, rho]]))[0]
    assert got == pytest.approx(expected, rel=1e-6)


def test_impossible_values_are_minus_infinity_without_a_warning():
    noise = AutoregressiveNoise(CHANNELS[:1])
    statistics = np.tile([5.0, 4.0, 1.0], (10, 1))
    parameters = np.tile([1.0, 0.5], (10, 1))
    parameters[:5, 1] = [1.0, -1.0, 2.0, math.nan, math.inf]
    parameters[5:8, 0] = [0.0, -1.0, math.inf]
    statistics[8] = math.nan
    statistics[9, 1] = math.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = noise.log_likelihood(statistics, 10, parameters)
    assert np.isneginf(values).all()
    assert np.isfinite(noise.log_likelihood(np.zeros((1, 3)), 10, np.array([[1.0, -0.99]])))


# sensors and effective samples ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [{"drift": 0.03}, (0.0, 0.03)])
def test_a_known_sensor_adds_its_variance(rng, given):
    misfit, sigma = rng.uniform(1.0, 2.0, (4, 2)), rng.uniform(0.1, 1.0, (4, 2))
    total = np.sqrt(sigma**2 + [0.0, 0.03**2])
    noise = GaussianNoise(CHANNELS, sensor=given)
    np.testing.assert_allclose(noise.standard_deviations(sigma), total)
    white = GaussianNoise(CHANNELS)
    np.testing.assert_allclose(noise.log_likelihood(misfit, 30, sigma), white.log_likelihood(misfit, 30, total))
    shared = GaussianNoise(CHANNELS, groups="all", scales=[2.0, 0.5], sensor=given)
    np.testing.assert_allclose(
        shared.standard_deviations(sigma[:, :1]), np.sqrt((sigma[:, :1] * [2.0, 0.5]) ** 2 + [0.0, 0.03**2])
    )
    lasting = AutoregressiveNoise(CHANNELS, sensor=given)
    np.testing.assert_allclose(lasting.standard_deviations(np.hstack([sigma, 0.0 * sigma])), total)
    # a model error of zero is possible only with known sensor noise; a negative one is not possible
    edge = np.array([[0.5, 0.0], [0.0, 0.5], [0.5, -1e-9], [0.5, math.nan]])
    assert np.isfinite(noise.log_likelihood(misfit, 30, edge)).tolist() == [True, False, False, False]
    assert len({repr(noise), repr(white), repr(GaussianNoise(CHANNELS, sensor=(0.0, 0.04)))}) == 3


def test_effective_samples_weigh_the_channels(rng):
    misfit, sigma = rng.uniform(1.0, 2.0, (4, 2)), rng.uniform(0.1, 1.0, (4, 2))
    apart = [GaussianNoise([c]).log_likelihood(misfit[:, [k]], 40, sigma[:, [k]]) for k, c in enumerate(CHANNELS)]
    for given, expected in (
        ((10.0, 4.0), 0.25 * apart[0] + 0.1 * apart[1]),
        ({"drift": 4.0}, apart[0] + 0.1 * apart[1]),
        ((1e9, 40.0), apart[0] + apart[1]),  # at most the number of samples
    ):
        noise = GaussianNoise(CHANNELS, effective_samples=given)
        np.testing.assert_allclose(noise.log_likelihood(misfit, 40, sigma), expected, rtol=1e-13)
        assert noise == GaussianNoise(CHANNELS, effective_samples=given) != GaussianNoise(CHANNELS)
        shared = GaussianNoise(CHANNELS, groups="all", scales=[1.0, 1.0], effective_samples=given)
        np.testing.assert_allclose(
            shared.log_likelihood(misfit, 40, sigma[:, :1]),
            noise.log_likelihood(misfit, 40, sigma[:, [0, 0]]),
            rtol=1e-13,
        )


# in a likelihood ------------------------------------------------------------------------------------------------------


class Line(lines.Line):
    channels = CHANNELS
    n_steps = 12


class BatchLine(lines.Batched):
    channels = CHANNELS
    n_steps = 12


def measured_by(model, rng):
    return Measurements(model.channels, model.dt, rng.normal(size=(2, model.n_steps)))


@pytest.mark.parametrize("kind", [Line, BatchLine])
def test_sigmas_and_correlations_need_no_simulation(rng, kind):
    model = kind()
    likelihood = FELikelihood(model, measured_by(Line(), rng), AutoregressiveNoise(CHANNELS))
    assert likelihood.fast_parameters == (2, 3, 4, 5)
    x = np.column_stack([rng.normal(size=(30, 2)), rng.uniform(0.5, 1.0, (30, 2)), rng.uniform(-0.9, 0.9, (30, 2))])
    values = likelihood.log_likelihood(x)
    assert np.array_equal(np.isneginf(values), x[:, 1] > 1.0) and 0 < np.isneginf(values).sum() < 30
    x[:, 2:] = 0.9 * x[:, 2:]
    likelihood.log_likelihood(x)
    assert likelihood.simulations == model.runs == 30
    good = x[x[:, 1] <= 1.0]
    residuals = np.array([likelihood.measurements.values - Line().simulate(theta[:2]) for theta in good])
    expected = AutoregressiveNoise(CHANNELS).log_likelihood(
        np.array([lag_one_sums(r) for r in residuals]), 12, good[:, 2:]
    )
    np.testing.assert_allclose(likelihood.log_likelihood(good), expected, rtol=1e-12)
    # the sums of squares are unchanged
    np.testing.assert_allclose(likelihood.misfit(good[:, :2]), np.square(residuals).sum(axis=2), rtol=1e-13)


def test_impossible_noise_parameters_are_not_simulated(rng):
    model = Line()
    likelihood = FELikelihood(model, measured_by(model, rng), AutoregressiveNoise(CHANNELS))
    x = np.array([[0.0, 0.0, 1.0, 1.0, 0.5, 1.0], [0.0, 0.0, 1.0, -1.0, 0.5, 0.5]])
    assert np.isneginf(likelihood.log_likelihood(x)).all() and model.runs == 0


@pytest.mark.parametrize("responses", [False, True])
def test_the_cache_separates_statistics(tmp_path, rng, responses):
    """Rows stored for white noise are not used for another noise, in either order; responses serve every noise."""
    measurements, thetas = measured_by(Line(), rng), rng.uniform(-1.0, 1.0, size=(6, 2))
    cache = SimulationCache(tmp_path / "lines.sqlite", responses=responses)
    expected = {}
    for round_ in range(2):
        for noise in (
            GaussianNoise(CHANNELS),
            AutoregressiveNoise(CHANNELS),
            GaussianNoise(CHANNELS, groups="all", scales=[1, 1]),
        ):
            model = Line()
            likelihood = FELikelihood(model, measurements, noise, cache=cache)
            statistics = likelihood.simulator.statistics(thetas)
            white = not isinstance(noise, AutoregressiveNoise)
            assert statistics.shape == (6, 2 if white else 6)
            assert np.array_equal(expected.setdefault(white, statistics), statistics)
            known = round_ or noise.parameter_names == ("sigma",) or (responses and not white)
            assert (model.runs - likelihood.simulator.verifications, likelihood.simulator.disk_hits) == (
                (0, 6) if known else (6, 0)
            )
    np.testing.assert_array_equal(expected[True], expected[False][:, :2])
    assert cache.damaged == 0


def test_a_noise_of_other_channels_is_refused(rng):
    with pytest.raises(ValueError, match="noise's channels are drift, top, the model's are top, drift"):
        FELikelihood(Line(), measured_by(Line(), rng), GaussianNoise(CHANNELS[::-1]))


def test_residuals_of_a_likelihood(rng):
    likelihood = FELikelihood(Line(), measured_by(Line(), rng))
    expected = likelihood.measurements.values - Line().simulate(np.array([0.2, 0.1]))
    np.testing.assert_array_equal(likelihood.residuals([0.2, 0.1]), expected)
    np.testing.assert_array_equal(likelihood.residuals([0.2, 0.1, 1.0, 1.0]), expected)
    with pytest.raises(ValueError, match=r"shape \(2,\), or \(4,\) with the noise"):
        likelihood.residuals([0.2])
    with pytest.raises(SimulationFailed, match="too steep"):
        likelihood.residuals([0.0, 2.0])


# predictions ----------------------------------------------------------------------------------------------------------


def test_drawn_errors_have_the_covariance_that_the_likelihood_assumes(rng):
    noise = SampleNoise(np.array([[0.5, 2.0]]), np.array([[0.9, -0.4]]))
    errors = np.array([noise.draw(0, 6, rng) for _ in range(20_000)])
    for k in range(2):
        expected = noise.deviations[0, k] ** 2 * linalg.toeplitz(noise.lag_one[0, k] ** np.arange(6))
        got = errors[:, k].T @ errors[:, k] / len(errors)
        error = np.sqrt((np.outer(np.diag(expected), np.diag(expected)) + expected**2) / len(errors))
        assert np.all(np.abs(got - expected) < 4.5 * error)


def test_predictions_draw_correlated_errors(rng):
    """The standard deviation of a sample is sigma for any correlation; that of the mean grows with the correlation."""
    sigma, rho, n = 0.3, 0.8, 4000
    likelihood = FELikelihood(Line(), measured_by(Line(), rng), AutoregressiveNoise(CHANNELS))
    names = likelihood.parameter_names
    posterior = Posterior(likelihood, dict(zip(names, [Uniform(-9.0, 9.0)] * len(names), strict=True)))
    samples = np.tile([0.1, 0.2, sigma, sigma, rho, 0.0], (n, 1))
    means = propagate(posterior, samples, quantity=lambda r: r.mean(axis=1), noise=True, seed=1, progress=False)
    covariance = sigma**2 * linalg.toeplitz(rho ** np.arange(12))
    expected = np.array([covariance.mean(), sigma**2 / 12])
    assert np.all(np.abs(means.variance / expected - 1.0) < 4.5 * math.sqrt(2.0 / n))
    histories = propagate(posterior, samples, noise=True, seed=1, progress=False)
    np.testing.assert_allclose(histories.variance, sigma**2, rtol=1e-10)
    low = stats.norm.cdf((histories.quantile(0.05) - histories.mean) / sigma)
    assert np.all(np.abs(low - 0.05) < 4.5 * math.sqrt(0.05 * 0.95 / n))
    with pytest.raises(ValueError, match="correlation between -1 and 1"):
        propagate(posterior, samples + [0, 0, 0, 0, 0.2, 0], noise=True, progress=False)


# problems -------------------------------------------------------------------------------------------------------------


def test_problems_take_another_noise():
    posterior = isolated_bridge(channels=("acc_p1", "Ub_2"), noise="autoregressive", step=1e-3)
    assert posterior.parameter_names[-4:] == ["sigma_acc_p1", "sigma_Ub_2", "rho_acc_p1", "rho_Ub_2"]
    assert posterior.prior.distributions["rho_Ub_2"] == Uniform(-1.0, 1.0)
    measurements = posterior.likelihood.measurements
    noise = GaussianNoise(measurements.channels, groups="all", effective_samples={"Ub_2": 50.0})
    given = isolated_bridge(channels=("acc_p1", "Ub_2"), noise=noise, step=1e-3)
    assert given.likelihood.noise == noise.with_measurements(measurements) and given.ndim == 11
    assert given.fingerprint != isolated_bridge(channels=("acc_p1", "Ub_2"), step=1e-3).fingerprint
    with pytest.raises(ValueError, match='"channel", "all", "autoregressive" or "marginal"'):
        isolated_bridge(noise="pink")
    column = bridge_column(noise="autoregressive", duration=1.0, mesh=20)
    assert column.fast_parameters == (5, 6, 7, 8)
    x = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.2, 2e-3, 0.0, 0.0])
    white = bridge_column(duration=1.0, mesh=20)
    assert column.log_likelihood(x) == pytest.approx(white.log_likelihood(x[:7]), rel=1e-12)
    assert bridge_column(noise="marginal", duration=1.0, mesh=20).parameter_names == white.parameter_names[:5]
    names = AutoregressiveNoise((CHANNELS[0],)).parameter_names
    with pytest.raises(ValueError, match="no default prior for nu_top"):
        bridge_column_prior((*names[1:], "nu_top"))
    prior = bridge_column_prior(("sigma_acceleration", "rho_acceleration"))
    assert prior.names[-2:] == ("sigma_acceleration", "rho_acceleration")
    assert bridge_column_prior(("sigma",)).distributions["sigma"] == HalfNormal(0.3)
    assert prior.distributions["Ec"] == TruncatedNormal(1.0, 0.3)
