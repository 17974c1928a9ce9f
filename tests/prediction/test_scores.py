"""Scores of predictions: closed forms, propriety, missing samples, tables; controls with wrong predictions."""

import numpy as np
import pytest
from scipy import integrate, stats

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import final_value, peak, rms
from fe_likelihoods.prediction.scores import (
    crps_normal,
    crps_samples,
    interval_score,
    pit_samples,
    score_values,
    share_within,
)
from fe_likelihoods.priors.distributions import HalfNormal, TruncatedNormal
from fe_likelihoods.problems import table_motion
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.sampling import interpolate, make_interpolation


@pytest.mark.parametrize("y", (-3.0, 0.2, 1.7))
def test_scores_of_a_normal_distribution_are_those_of_its_definitions(y):
    mean, sd = 0.5, 0.8
    below = integrate.quad(lambda x: stats.norm.cdf(x, mean, sd) ** 2, -12.0, y)[0]
    above = integrate.quad(lambda x: stats.norm.sf(x, mean, sd) ** 2, y, 12.0)[0]
    assert crps_normal(mean, sd, y) == pytest.approx(below + above, abs=1e-7)


def test_crps_of_samples_is_the_sum_over_pairs_and_unbiased(rng):
    values, y = rng.normal(size=(7, 3)), np.array([0.0, 1.0, -2.0])
    pairs = np.abs(values[:, None] - values[None]).sum(axis=(0, 1)) / (2.0 * 7 * 6)
    np.testing.assert_allclose(crps_samples(values, y), np.abs(values - y).mean(axis=0) - pairs, rtol=1e-12)
    few = crps_samples(rng.normal(size=(5, 20_000)), np.full(20_000, 0.7))
    assert abs(few.mean() - crps_normal(0.0, 1.0, 0.7)) < 4.0 * few.std() / np.sqrt(len(few))


def test_interval_score_by_hand():
    np.testing.assert_allclose(interval_score(1.0, 3.0, [2.0, 0.5, 4.0], 0.9), [2.0, 2.0 + 20 * 0.5, 2.0 + 20 * 1.0])


def test_pit_of_samples_is_uniform_for_the_true_distribution_alone(rng):
    pit = pit_samples(rng.normal(size=(99, 3000)), rng.normal(size=3000))
    assert stats.kstest(pit, "uniform").pvalue > 1e-3
    narrow = pit_samples(0.5 * rng.normal(size=(99, 3000)), rng.normal(size=3000))
    assert stats.kstest(narrow, "uniform").pvalue < 1e-10
    assert abs(share_within(pit, 0.9).value - 0.9) < 4.0 * np.sqrt(0.09 / 3000)
    assert share_within(narrow, 0.9).value < 0.65
    assert 0.0 < pit_samples([[1.0], [2.0]], [9.0])[0] < 1.0


def test_missing_values_have_no_score():
    np.testing.assert_array_equal(pit_samples([[1.0, 1.0], [np.nan, 2.0]], [2.0, 1.5]), [np.nan, 0.5])
    assert np.isnan(crps_samples([1.0, np.nan, 3.0], 2.0))


def test_crps_of_copies_is_unbiased_for_the_effective_sample_size(rng):
    """The default is too large for copies, by the stated share of the score of a calibrated normal prediction."""
    copies = np.repeat(rng.normal(size=(20, 20_000)), 20, axis=0)
    y = rng.normal(size=20_000)
    exact = crps_normal(0.0, 1.0, y)
    right, wrong = (crps_samples(copies, y, n) - exact for n in (20, None))
    assert abs(right.mean()) < 4.0 * right.std() / np.sqrt(len(y))
    share = wrong.mean() / exact.mean()
    assert abs(share - (1 / 20 - 1 / 400)) < 4.0 * wrong.std() / np.sqrt(len(y)) / exact.mean()


@pytest.mark.parametrize(("n", "probability"), ((10, 0.9), (19, 0.9), (20, 0.9), (101, 0.9), (30, 0.5)))
def test_intervals_from_few_samples_have_their_level_and_are_those_of_the_pit(n, probability, rng):
    values, y = rng.normal(size=(2, n, 20_000))[0], rng.normal(size=20_000)
    scores = score_values([""] * 20_000, ["SI"] * 20_000, values, y, probability)
    np.testing.assert_array_equal(scores.within, (scores.lower <= y) & (y <= scores.upper))
    assert scores.within.mean() == share_within(scores.pit, probability).value
    nearest = 1.0 / (n + 1.0)  # half a rank at both ends
    assert abs(scores.within.mean() - probability) < nearest + 4.0 * np.sqrt(probability * (1 - probability) / 20_000)


def test_share_within_leaves_missing_values_out_and_refuses_others():
    assert share_within([0.1, np.nan, 0.4, 0.97], 0.9) == (2, 3)
    assert str(share_within([0.5] * 10 + [0.99], 0.9)) == "10 of 11: 62 to 98 %"
    for bad in ([], [np.nan], [1.2]):
        with pytest.raises(ValueError, match="PIT values between 0 and 1"):
            share_within(bad, 0.9)


@pytest.fixture
def oscillator(record):
    return LinearOscillator(record)


def noisy(oscillator, rng, sigma):
    response = oscillator.simulate([1.1, 0.9])
    return response, Measurements(
        oscillator.channels, oscillator.dt, response + np.array(sigma)[:, None] * rng.normal(size=response.shape)
    )


def posterior_of(oscillator, measured):
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    prior |= {"sigma_acceleration": HalfNormal(0.5), "sigma_displacement": HalfNormal(0.05)}
    return Posterior(FELikelihood(oscillator, measured), prior)


SIGMA = (0.05, 0.0003)


def samples(n, factor=1.0):
    return np.tile([1.1, 0.9, factor * SIGMA[0], factor * SIGMA[1]], (n, 1))


def test_scores_of_histories_are_averages_over_the_measured_samples(oscillator, rng):
    _, measured = noisy(oscillator, rng, SIGMA)
    values = measured.values.copy()
    values[0, 5:9] = np.nan
    measured = Measurements(measured.channels, measured.dt, values)
    prediction = propagate(posterior_of(oscillator, measured), samples(200), noise=True, seed=1, progress=False)
    scores = prediction.score(measured)
    there = np.isfinite(values)
    assert scores.samples.tolist() == [46, 50]
    for k in range(2):
        mean, sd, y = (each[k, there[k]] for each in (prediction.mean, prediction.sd, values))
        lower, upper = (prediction.quantile(p)[k, there[k]] for p in (0.05, 0.95))
        assert scores.crps[k] == pytest.approx(crps_normal(mean, sd, y).mean(), rel=1e-12)
        assert scores.interval_score[k] == pytest.approx(interval_score(lower, upper, y, 0.9).mean(), rel=1e-12)
        assert scores.coverage[k] == np.mean((lower <= y) & (y <= upper))
    assert str(scores).splitlines()[1].split()[:2] == ["acceleration", oscillator.channels[0].unit]


def test_scores_of_peaks_and_other_numbers(oscillator, rng):
    response, measured = noisy(oscillator, rng, SIGMA)
    posterior = posterior_of(oscillator, measured)
    for quantity, expected in (
        (peak("displacement"), np.abs(measured.values[1]).max()),
        (rms("displacement"), np.sqrt(np.mean(measured.values[1] ** 2))),
        (final_value("displacement", 5), measured.values[1, -5:].mean()),
    ):
        prediction = propagate(posterior, samples(100), quantity=quantity, noise=True, seed=1, progress=False)
        scores = prediction.score(measured)
        assert scores.measured[0] == pytest.approx(expected, rel=1e-12)
        assert scores.crps[0] == pytest.approx(crps_samples(prediction.values, expected), rel=1e-12)
        assert scores.within[0] == (scores.lower[0] <= expected <= scores.upper[0])
        assert prediction.score(expected)[3:] == scores[3:]
        assert str(scores).splitlines()[1].startswith("displacement")
    both = propagate(
        posterior, samples(100), quantity=[peak("displacement"), peak("acceleration")], noise=True, progress=False
    )
    assert both.score(measured).names == ("displacement", "acceleration")


def test_what_cannot_be_scored_is_refused(oscillator, rng):
    _, measured = noisy(oscillator, rng, SIGMA)
    posterior = posterior_of(oscillator, measured)
    histories = propagate(posterior, samples(30), noise=True, progress=False)
    whole = propagate(posterior, samples(30), quantity=lambda response: np.abs(response).max(axis=1), progress=False)
    assert whole.score([1.0, 0.01]).units == ("SI", "SI")
    top, few = (
        propagate(posterior, samples(n), quantity=peak("displacement"), noise=n < 30, progress=False) for n in (30, 19)
    )
    few_histories = propagate(posterior, samples(19), noise=True, progress=False)
    gaps = measured.values.copy()
    gaps[1, 3] = np.nan
    for prediction, given, options, message in (
        (histories, [1.0, 2.0], {}, "needs Measurements"),
        (histories, measured, {"interval_probability": 0.5}, "no quantile"),
        (histories, measured, {"interval_probability": 90}, "interval_probability must be between"),
        (whole, measured, {}, "give the measured values"),
        (whole, 1.0, {}, "of the shape of the quantity"),
        (top, Measurements(measured.channels, measured.dt, gaps), {}, "samples of channel 'displacement' are missing"),
        (few, measured, {}, "expected 20 samples or more for intervals of 0.9; got 19"),
        (few_histories, measured, {}, "expected 20 samples or more for intervals of 0.9; got 19"),
    ):
        with pytest.raises(ValueError, match=message):
            prediction.score(given, **options)
    with pytest.raises(ValueError, match="whole number"):
        final_value("displacement", 0)


def test_channels_with_steps_of_their_own_are_scored_at_their_samples(oscillator, rng):
    response, _ = noisy(oscillator, rng, SIGMA)
    coarse = Measurements(
        (Channel("displacement", "relative displacement", "mm"),), 2.0 * oscillator.dt, response[1:, ::2]
    )
    prediction = propagate(
        posterior_of(oscillator, noisy(oscillator, rng, SIGMA)[1]), samples(50), quantity="displacement", progress=False
    )
    scores = prediction.score(coarse)
    assert scores.samples.tolist() == [25] and scores.rrmse[0] < 1e-9


def test_a_rough_band_is_scored_between_its_samples():
    """The band of three draws with noise crosses where it is interpolated: its ends are put in order."""
    record = table_motion().trim(0.0, 6.0).resample(0.04)
    model, theta = LinearOscillator(record, 0.8), [1.1, 0.9]
    fine = LinearOscillator(record.resample(0.02), 0.8).simulate(theta)
    likelihood = FELikelihood(model, Measurements(model.channels, 0.04, model.simulate(theta)))
    samples = np.array([[1.1, 0.9, 0.5, 0.003], [1.12, 0.9, 0.5, 0.003], [1.08, 0.92, 0.5, 0.003]])
    found = propagate(likelihood, samples, noise=True, quantiles=(0.35, 0.5, 0.65), seed=1, progress=False)
    measured = Measurements(model.channels, 0.02, fine)
    place = make_interpolation(0.04, model.n_steps, measured.times(model.channels[0].name))
    ends = [interpolate(found.quantile(p), place) for p in (0.35, 0.65)]
    assert (ends[0] > ends[1]).any()
    scores = found.score(measured, 0.3)
    assert np.isfinite(scores.interval_score).all() and (scores.width > 0.0).all()
    lower, upper = np.minimum(*ends), np.maximum(*ends)
    expected = ((lower <= fine) & (fine <= upper)).mean(axis=1)
    np.testing.assert_allclose(scores.coverage, expected)
