"""Predictions of channels that were not measured: their noise is the mean of the noise of the measured ones."""

import re
import warnings

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    Events,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    LinearOscillator,
    Measurements,
    Record,
    peak,
    propagate,
)

N, DT = 120, 0.02
LOW, MIDDLE, TOP = (Channel(name, "acceleration", "m/s2") for name in ("low", "middle", "top"))
DRIFT, FORCE = Channel("drift", "displacement", "mm"), Channel("force", "lateral force", "kN")
WAVES = {"low": (1.0, 5.0), "middle": (2.0, 6.0), "top": (4.0, 7.0), "drift": (0.1, 8.0), "force": (1e3, 9.0)}
SENSORS = {LOW: 0.01, MIDDLE: 0.02, TOP: 0.03, DRIFT: 0.001, FORCE: 10.0}
MEASURED = (TOP, LOW, DRIFT)
SENSORS_OF_ALL = [0.02, 0.01, 0.001, 0.03]  # of middle, the mean of top and low, and of low, drift and top
ALL = (MIDDLE, LOW, DRIFT, TOP)


def wave(channels, factor=1.0, runs=None):
    time = DT * np.arange(N)

    def simulate(theta):
        if runs is not None:
            runs.append(theta)
        waves = [WAVES[channel.name] for channel in channels]
        return factor * np.array([size * theta[0] * np.sin(theta[1] * speed * time) for size, speed in waves])

    return FunctionModel(simulate, ["gain", "speed"], channels, DT, N)


def measured(channels):
    return Measurements(channels, DT, wave(channels).simulate([1.0, 1.0]))


def sensors(channels):
    return [SENSORS[channel] for channel in channels]


KINDS = {
    "white": lambda channels, sensor, levels: GaussianNoise(channels, sensor=sensor),
    "shared": lambda channels, sensor, levels: GaussianNoise(channels, groups="all", scales=levels, sensor=sensor),
    "relative": lambda channels, sensor, levels: GaussianNoise(
        channels, shares_of="measured", scales=levels, window=0.4, sensor=sensor
    ),
    "modulated": lambda channels, sensor, levels: GaussianNoise(
        channels, shares_of="response", window=0.4, sensor=sensor
    ),
    "autoregressive": lambda channels, sensor, levels: AutoregressiveNoise(channels, sensor=sensor),
}


def quiet(*args, **settings):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return propagate(*args, progress=False, check=False, seed=1, **settings)


def drawn(likelihood, rng, n=30):
    """Samples around a gain and a speed of one, with noise parameters from 0.1 to 0.4."""
    n_noise = likelihood.ndim - 2
    return np.hstack([rng.normal(1.0, 0.05, (n, 2)), rng.uniform(0.1, 0.4, (n, n_noise))])


@pytest.mark.parametrize("kind", KINDS)
def test_the_prediction_is_that_of_a_noise_of_all_channels_with_mean_parameters(kind, rng):
    """Stacked by the names of the parameters: parameters of middle are the means of low and top, without drift."""
    levels = {LOW: 0.7, MIDDLE: 1.7, TOP: 2.7, DRIFT: 0.07}  # middle has the mean
    likelihood = FELikelihood(
        wave(MEASURED), measured(MEASURED), KINDS[kind](MEASURED, sensors(MEASURED), [levels[c] for c in MEASURED])
    )
    samples = drawn(likelihood, rng)
    values = dict(zip(likelihood.parameter_names, samples.T, strict=True))
    whole = FELikelihood(wave(ALL), measured(ALL), KINDS[kind](ALL, SENSORS_OF_ALL, [levels[c] for c in ALL]))

    def value(name):
        if name in values:
            return values[name]
        return 0.5 * (values[name.replace("middle", "low")] + values[name.replace("middle", "top")])

    stacked = np.stack([value(name) for name in whole.parameter_names], axis=1)
    for settings in ({}, {"quantity": [peak(channel.name) for channel in ALL]}):
        ours = quiet(likelihood, samples, channels_of=wave(ALL), noise=True, **settings)
        theirs = quiet(whole, stacked, noise=True, **settings)
        without = quiet(likelihood, samples, channels_of=wave(ALL), **settings)
        np.testing.assert_allclose(ours.quantiles, theirs.quantiles, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(ours.variance, theirs.variance, rtol=1e-12)
        assert (np.ptp(ours.quantiles[[0, 2]], axis=0) > np.ptp(without.quantiles[[0, 2]], axis=0)).mean() > 0.7
    if kind in ("relative", "modulated"):
        assert quiet(likelihood, samples, channels_of=wave(ALL), noise="model", quantity=peak("middle")).noise


def test_the_noise_of_measured_channels_is_that_of_the_posterior(rng):
    likelihood = FELikelihood(wave(MEASURED), measured(MEASURED))
    samples = drawn(likelihood, rng)
    few = (DRIFT, TOP)
    for settings in ({"channels_of": wave(few), "noise": True}, {"channels_of": wave((*ALL, FORCE))}):
        assert quiet(likelihood, samples, **settings).findings == ()
    ours = quiet(likelihood, samples, channels_of=wave(few), noise=True)
    part = FELikelihood(wave(few), measured(few))
    np.testing.assert_array_equal(ours.quantiles, quiet(part, samples[:, [0, 1, 4, 2]], noise=True).quantiles)
    by_name = dict(zip(likelihood.parameter_names, samples.T, strict=True))
    np.testing.assert_array_equal(
        ours.quantiles, quiet(likelihood, by_name, channels_of=wave(few), noise=True).quantiles
    )


def test_a_model_under_another_excitation_is_compared_with_the_calibration(rng):
    """Peaks of the measured channels that are ten times as large as in the calibration are warned of."""
    likelihood = FELikelihood(wave(MEASURED), measured(MEASURED))
    samples = drawn(likelihood, rng)
    (peaks,) = quiet(likelihood, samples, channels_of=wave(ALL, 10.0), noise=True).findings
    assert "top (" in peaks.text and "middle" not in peaks.text
    assert quiet(likelihood, samples, channels_of=wave(ALL), noise=True).findings[1:] == ()


@pytest.mark.parametrize(
    ("other", "noise", "words"),
    [
        (wave((TOP, FORCE)), True, "no measured channel is 'lateral force'; measured are top (acceleration), low"),
        (wave((Channel("top", "displacement", "mm"),)), True, "calibrated as 'acceleration': give it another name"),
        (
            FunctionModel(lambda theta: np.ones((1, N)), ["gain"], [TOP], DT, N),
            False,
            "in the same order, gain, speed;",
        ),
        (3.0, False, "is not a model"),
    ],
)
def test_other_channels_that_cannot_be_predicted_are_refused(other, noise, words, rng):
    likelihood = FELikelihood(wave(MEASURED), measured(MEASURED))
    with pytest.raises(ValueError, match=re.escape(words)):
        propagate(likelihood, drawn(likelihood, rng), channels_of=other, noise=noise, progress=False)


def test_levels_per_event_are_means_of_the_channels_measured_in_the_event(rng):
    records = [Record(name, 0.02, rng.normal(size=n)) for name, n in (("EQ1", 61), ("EQ2", 51))]
    events = Events(records, rest=0.98)
    oscillator = LinearOscillator(events, period=0.5)
    acceleration = Channel("acceleration", "absolute acceleration", "g")

    def copies(names):
        """An oscillator with one sensor of the acceleration per name."""
        channels = [Channel(name, acceleration.quantity, acceleration.unit) for name in names]
        model = FunctionModel(
            lambda theta, record: np.tile(LinearOscillator(record, period=0.5).simulate(theta)[0], (len(names), 1)),
            oscillator.parameter_names,
            channels,
            oscillator.dt,
            oscillator.n_steps,
            record=events,
        )
        return model, channels

    model, channels = copies(["a", "b"])
    measured_in = {
        "EQ1": Measurements(channels, 0.02, np.ones((2, 61))),
        "EQ2": Measurements(channels[:1], 0.02, np.ones((1, 51))),
    }
    likelihood = FELikelihood(model, measured_in, GaussianNoise(model.channels, groups="event"))
    assert likelihood.parameter_names[2:] == ("sigma_a_EQ1", "sigma_b_EQ1", "sigma_a_EQ2")
    samples = np.hstack([rng.normal(1.0, 0.05, (50, 2)), rng.uniform(0.5, 1.0, (50, 3))])
    other, _ = copies(["c", "b"])
    clean, noisy = (quiet(likelihood, samples, channels_of=other, noise=noise) for noise in (False, True))
    added = noisy.variance - clean.variance
    mean = 0.5 * (samples[:, 2] + samples[:, 3])
    expected = np.zeros_like(added)
    expected[0, :61], expected[1, :61] = np.mean(mean**2), np.mean(samples[:, 3] ** 2)
    expected[0, 110:161] = np.mean(samples[:, 4] ** 2)
    np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-9)
