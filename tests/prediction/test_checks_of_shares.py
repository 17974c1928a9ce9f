"""Warnings of noises in shares of the response: fits that are too large, correlated errors, peaks with white errors."""

import functools

import numpy as np
import pytest
from scipy.fft import dct, idct
from scipy.optimize import minimize
from scipy.signal import butter, lfilter

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    fit_measures,
    peak,
    propagate,
)

from .test_transfer_checks import DT, TOP, Filter, N, excitation, said

SENSOR = 1e-4
GROUND = LinearOscillator.channels[0]  # absolute acceleration
STEPS, PERIOD = 1000, 0.5


def bouc_wen(ground, yield_displacement, ratio=0.1, damping=0.01, exponent=1.5, substeps=10):
    """Absolute acceleration (n,) [m/s²] of a hysteretic oscillator (Y. K. Wen, 1976), by small explicit steps."""
    omega = 2.0 * np.pi / PERIOD
    h, u, v, z, found = DT / substeps, 0.0, 0.0, 0.0, []
    fine = np.interp(np.arange(len(ground) * substeps) / substeps, np.arange(len(ground)), ground)
    for i, a in enumerate(fine):
        force = omega**2 * (ratio * u + (1.0 - ratio) * yield_displacement * z) + 2.0 * damping * omega * v
        if i % substeps == 0:
            found.append(-force)
        v += h * (-force - a)
        z += h / yield_displacement * (v - 0.5 * abs(z) ** (exponent - 1.0) * z * abs(v) - 0.5 * v * abs(z) ** exponent)
        u += h * v
    return np.array(found)


def earthquake(rng):
    """Base acceleration [m/s²] with a strong part of 5 s and a decay, 3 m/s² at its peak."""
    times = np.arange(STEPS) * DT
    envelope = np.clip(times / 3.0, 0.0, 1.0) ** 2 * np.exp(-0.25 * np.clip(times - 8.0, 0.0, None))
    motion = envelope * lfilter(*butter(2, [0.4, 6.0], "band", fs=1.0 / DT), rng.standard_normal(STEPS + 500))[500:]
    return 3.0 * motion / np.abs(motion).max()


def oscillator(ground):
    linear = LinearOscillator(Record("EQ", DT, ground), period=PERIOD)
    return FunctionModel(lambda theta: linear.simulate(theta)[:1], ["stiffness", "damping"], [GROUND], DT, STEPS)


def calibrated(ground, values, noise, prior, starts=(0.4, 2.0)):
    """Posterior of an oscillator and samples beside its mode."""
    model = oscillator(ground)
    parameters = {"stiffness": LogNormal(1.0, 0.5), "damping": LogNormal(0.6, 1.0)} | prior
    posterior = Posterior(FELikelihood(model, Measurements([GROUND], DT, values[None]), noise), parameters)
    target = functools.partial(_negative, posterior)
    starts = [np.log([1.0, damping, 0.4]) for damping in starts]
    found = [minimize(target, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-3}) for start in starts]
    mode = np.exp(min(found, key=lambda each: each.fun).x)
    return posterior, mode * np.exp(0.003 * np.random.default_rng(1).standard_normal((20, 3)))


def _negative(posterior, logs):
    return -float(posterior(np.exp(np.clip(logs, -20.0, 20.0))))


def modulated(local):
    return GaussianNoise([GROUND], level="response", window=1.0, sensor={"acceleration": 0.03}, local=local)


SHARE, SIGMA = {"share_acceleration": HalfNormal(0.5)}, {"sigma_acceleration": HalfNormal(3.0)}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_response_that_is_too_large_under_shares_of_itself_is_said(seed):
    rng = np.random.default_rng([3, seed])
    ground = earthquake(rng)
    values = bouc_wen(ground, 0.01) + 0.03 * rng.standard_normal(STEPS)
    posterior, samples = calibrated(ground, values, modulated(1.0), SHARE)
    found = [text for text in said(propagate, posterior, samples) if "too large" in text]
    assert len(found) == 1 and "local=" in found[0] and 'level="si"' in found[0]
    assert not [text for text in said(propagate, posterior, samples) if "too large" in text], "said once"
    assert any("too large" in text for text in propagate(posterior, samples, progress=False).remarks)
    # the figures are those of the fit, and the noise is its cause
    rrmse, smaller = (float(found[0].split(each)[1].split(";")[0].split()[0]) for each in ("(RRMSE ", "; "))
    assert rrmse == pytest.approx(np.sqrt(np.median(fit_measures(posterior, samples))), abs=0.03)
    for noise, prior in ((modulated(0.0), SHARE), (GaussianNoise([GROUND]), SIGMA)):
        right, samples = calibrated(ground, values, noise, prior)
        assert not [text for text in said(propagate, right, samples) if "too large" in text]
        fitted = np.sqrt(np.median(fit_measures(right, samples)))
        assert fitted < 0.8 * rrmse and smaller < 0.9 * rrmse


@pytest.mark.slow
def test_right_runs_of_an_oscillator_give_no_alarm():
    alarms = []
    for seed in range(20):
        rng = np.random.default_rng([4, seed])
        ground, noise = earthquake(rng), modulated((0.25, 1.0)[seed % 2])
        response = oscillator(ground).simulate([1.0, 0.6])
        deviations = noise.response_deviations(np.array([0.5]), response, dt=DT)
        values = (response + deviations * rng.standard_normal(response.shape))[0]
        posterior, samples = calibrated(ground, values, noise, SHARE, starts=(0.6,))
        alarms += said(propagate, posterior, samples)
    assert alarms == []


def of_gain(rng, noise, errors, shares):
    """Posterior of a known gain, whose errors are a function of the response, and samples of it."""
    model = Filter(excitation(rng))
    response = model.simulate([1.0])
    values = response + errors(noise.with_measurements(Measurements([TOP], DT, response)), response)
    prior = {"gain": LogNormal(1.0, 0.5)} | {name: HalfNormal(0.5) for name in noise.parameter_names}
    posterior = Posterior(FELikelihood(model, Measurements([TOP], DT, values), noise), prior)
    centre = [1.0, *shares(values - response, response)]
    return posterior, centre * np.exp(0.003 * rng.standard_normal((20, len(centre))))


def correlated(rng, rho):
    """Errors that follow the response, with a correlation from sample to sample."""

    def errors(noise, response):
        driving = rng.standard_normal(N + 200)
        series = lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], driving)[200:]
        return noise.response_deviations(np.array([0.3]), response) * series

    return errors


EDGE = 15.0  # [Hz]


def in_bands(series):
    """Coefficients of a history, and whether each is in the lower band."""
    return dct(series, norm="ortho"), np.arange(N) / (2.0 * N * DT) < EDGE


def band_errors(rng, rho):
    """Errors with a share of 0.3 of each band of the response; those of the lower band are at its lowest part."""

    def errors(noise, response):
        coefficients, low = in_bands(response[0])
        drawn, powers = rng.standard_normal(N), [np.mean(coefficients[band] ** 2) for band in (low, ~low)]
        shape = np.where(low, 1.0 / (1.0 - rho * np.cos(np.pi * np.arange(N) / N)), 1.0)
        shape[low] /= np.sqrt(np.mean(shape[low] ** 2))
        return idct(0.3 * shape * drawn * np.sqrt(np.where(low, *powers)), norm="ortho")[None]

    return errors


def band_shares(residuals, response):
    (errors, low), (coefficients, _) = in_bands(residuals[0]), in_bands(response[0])
    return [np.sqrt(np.mean(errors[band] ** 2) / np.mean(coefficients[band] ** 2)) for band in (low, ~low)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ("modulated", "bands"))
def test_alarms_of_whitened_residuals_in_100_runs(kind):
    """None of 100 runs that are right; most of 100 whose errors have another correlation."""
    counts = []
    for rho in (0.0, 0.8 if kind == "modulated" else 0.999):
        found = []
        for seed in range(100):
            rng = np.random.default_rng([9, seed])
            if kind == "modulated":
                noise = GaussianNoise([TOP], level="response", window=0.5, sensor={"top": SENSOR}, local=0.25)
                posterior, samples = of_gain(rng, noise, correlated(rng, rho), lambda *_: [0.3])
            else:
                noise = GaussianNoise([TOP], groups=(EDGE,), level="response", sensor={"top": SENSOR})
                posterior, samples = of_gain(rng, noise, band_errors(rng, rho), band_shares)
            found += [text for text in said(propagate, posterior, samples) if "not independent" in text]
        counts.append(len(found))
    assert counts[0] == 0 and counts[1] >= 95
    assert "whitened residuals of the calibration" in found[0] and "effective_samples" not in found[0]
    assert ("GaussianNoise with bands" in found[0]) == (kind == "modulated"), "which is the noise in use"


def test_the_check_of_shares_uses_the_excitation_of_the_calibration(rng):
    noise = GaussianNoise([TOP], level="response", window=0.5, sensor={"top": SENSOR})
    posterior, samples = of_gain(rng, noise, correlated(rng, 0.8), lambda *_: [0.3])
    own = [text for text in said(propagate, posterior, samples, noise=True, seed=1) if "not independent" in text]
    again, samples = of_gain(np.random.default_rng(0), noise, correlated(rng, 0.8), lambda *_: [0.3])
    other = said(propagate, again, samples, record=excitation(rng, 20.0), noise=True, seed=1)
    assert len(own) == 1 and sum("not independent" in text for text in other) == 1
    assert again.report()["simulations"] == 1


@pytest.mark.parametrize("kind", ("response", "measured"))
def test_peaks_with_white_errors_in_shares_are_said(kind, rng):
    model = Filter(excitation(rng))
    measured = Measurements([TOP], DT, model.simulate([1.0]))
    noise = GaussianNoise(measured.channels, level="measured")
    noise = noise if kind == "measured" else GaussianNoise([TOP], level="response", window=0.5, sensor={"top": SENSOR})
    prior = {"gain": LogNormal(1.0, 0.5), "share_top": HalfNormal(0.5)}
    posterior = Posterior(FELikelihood(model, measured, noise), prior)
    options = {"noise": True, "seed": 1, "check": False}
    samples = np.array([1.0, 0.5]) * np.exp(0.01 * rng.standard_normal((200, 2)))
    for quantity in (peak("top"), [peak("top")], {"a": None, "b": peak("top")}):
        (text,) = said(propagate, posterior, samples, quantity=quantity, **options)
        assert "peaks with noise=True" in text and 'noise="model"' in text
    ratio = float(text.split("top (")[1].split(" times")[0])
    peaks = propagate(posterior, samples, quantity=peak("top"), progress=False, **options).values
    assert ratio == pytest.approx(np.median(peaks) / np.abs(measured.values).max(), rel=0.02) and ratio > 1.1
    # no remark: errors that change slowly, weak errors, histories, another number
    assert not said(propagate, posterior, samples, quantity=peak("top"), **options | {"noise": "model"})
    assert not said(propagate, posterior, samples * [1.0, 0.1], quantity=peak("top"), **options)
    assert not said(propagate, posterior, samples, **options)


def test_noise_in_si_units_is_compared_with_the_peak_of_the_response_without_it(rng):
    model = Filter(excitation(rng))
    measured = Measurements([TOP], DT, model.simulate([1.0]))
    prior = {"gain": LogNormal(1.0, 0.5), "sigma_top": HalfNormal(0.5)}
    posterior = Posterior(FELikelihood(model, measured, GaussianNoise([TOP])), prior)
    largest = np.abs(measured.values).max()
    samples = np.array([1.0, 0.3 * largest]) * np.exp(0.01 * rng.standard_normal((200, 2)))
    options = {"quantity": peak("top"), "noise": True, "seed": 1, "calibrated": (), "check": False}
    record = 0.1 * excitation(np.random.default_rng(3))
    (text,) = said(propagate, posterior, samples, record=record, **options)
    expected = np.abs(Filter(record).unit).max() / largest
    assert f"top ({expected:.2g} times)" in text and expected < 0.2
    predicted = propagate(posterior, samples, record=record, progress=False, **options)
    assert np.median(predicted.values) > 0.5 * largest, "the predicted peak is that of the noise"


@pytest.mark.slow
def test_a_response_below_the_noise_of_its_sensor_is_not_said_to_be_too_large():
    """The best multiple of such a response is anything by chance, but fits hardly better."""
    channels = (Channel("weak", "displacement", "mm"), TOP)
    times = DT * np.arange(STEPS)
    waves = np.sqrt(2.0) * np.array([0.003 * np.sin(6.0 * times), np.sin(7.0 * times)])
    noise = GaussianNoise(channels, level="response", window=1.0, sensor=[0.1, 0.05])
    small = 0
    for seed in range(20):
        rng = np.random.default_rng([5, seed])
        deviations = noise.response_deviations(np.array([0.3, 0.3]), waves, dt=DT)
        values = waves + deviations * rng.standard_normal(waves.shape)
        model = FunctionModel(lambda theta: theta[0] * waves, ["gain"], channels, DT, STEPS)
        likelihood = FELikelihood(model, Measurements(channels, DT, values), noise)
        assert said(propagate, likelihood, np.tile([1.0, 0.3, 0.3], (3, 1))) == []
        small += values[0] @ waves[0] < 0.75 * waves[0] @ waves[0]
    assert small >= 4, "the best multiple alone would be an alarm"


def test_every_judged_sample_is_said_whatever_was_judged_before(rng):
    noise = GaussianNoise([TOP], level="response", window=0.5, sensor={"top": SENSOR}, local=1.0)
    posterior, _ = of_gain(rng, noise, correlated(rng, 0.0), lambda *_: [0.3])
    right, large = np.tile([1.0, 0.3], (3, 1)), np.tile([2.0, 0.52], (3, 1))
    assert not [text for text in said(propagate, posterior, right) if "too large" in text]
    assert [text for text in said(propagate, posterior, large) if "too large" in text]
    for samples, expected in ((right, False), (large, True)):
        remarks = propagate(posterior, samples, progress=False).remarks
        assert any("too large" in text for text in remarks) == expected


def test_peaks_that_do_not_fit_into_memory_are_predicted_without_the_remark(rng):
    channels = (TOP, Channel("low", "displacement", "mm"))
    waves = Filter(excitation(rng)).unit * np.array([[1.0], [0.5]])
    model = FunctionModel(lambda theta: theta[0] * waves, ["gain"], channels, DT, N)
    measured = Measurements(channels, DT, waves)
    likelihood = FELikelihood(model, measured, GaussianNoise(measured.channels, level="measured"))
    samples = np.array([1.0, 0.5, 0.5]) * np.exp(0.01 * rng.standard_normal((50, 3)))
    options = {"quantity": [peak("top"), peak("low")], "noise": True, "seed": 1, "progress": False, "check": False}
    predicted = propagate(likelihood, samples, memory_bytes=400, **options)
    assert predicted.values is None and predicted.remarks == ()
    with pytest.warns(UserWarning, match="peaks with noise=True"):
        whole = propagate(likelihood, samples, **options)
    np.testing.assert_allclose(predicted.mean, whole.mean)


def test_an_unmeasured_channel_or_a_gap_does_not_silence_the_level_of_the_others(rng):
    channels = (TOP, Channel("low", "displacement", "mm"))
    waves = Filter(excitation(rng)).unit * np.array([[1.0], [0.5]])
    values = waves.copy()
    values[1, 10:20] = np.nan
    model = FunctionModel(lambda theta: theta[0] * waves, ["gain"], channels, DT, N)
    others = (*channels, Channel("roof", "displacement", "mm"))
    factors = 10.0 * np.vstack([waves, waves[:1]])
    stronger = FunctionModel(lambda theta: theta[0] * factors, ["gain"], others, DT, N)
    likelihood = FELikelihood(model, Measurements(channels, DT, values))
    samples = np.tile([1.0, 0.001, 0.001], (3, 1))
    options = {"model": stronger, "noise": True, "seed": 1, "calibrated": (), "check": False}
    for other in ("low", "roof"):
        found = said(propagate, likelihood, samples, quantity=[peak("top"), peak(other)], **options)
        (text,) = [each for each in found if "another level" in each]
        assert "top (10 times)" in text and f"{other} (" not in text
