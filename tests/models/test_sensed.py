"""Gains and lags of sensors as parameters: exact responses, closed forms, and faults that end in the sensor."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fe_likelihoods import (
    BridgeDeck,
    Channel,
    FELikelihood,
    FunctionModel,
    LinearOscillator,
    LinearStructure,
    LogNormal,
    Measurements,
    Record,
    SensedModel,
    Sensor,
    TruncatedNormal,
    Uniform,
    propagate,
)
from fe_likelihoods.simulation.model import simulate_batch

STEP, N = 0.01, 600
TIME = STEP * np.arange(N)
TOP, DRIFT = Channel("top", "acceleration", "g"), Channel("drift", "displacement", "mm")
GAIN, LAG = LogNormal(1.0, 0.05), TruncatedNormal(0.0, 0.02, lower=-0.1, upper=0.1)


def motion(time, frequency=3.0):
    """A pulse that has decayed at both ends."""
    return np.sin(2.0 * np.pi * frequency * time) * np.exp(-np.square((time - 3.0) / 0.8))


def respond(theta):
    return np.stack([theta[0] * motion(TIME), 0.02 * theta[1] * motion(TIME, 5.0)])


STRUCTURE = FunctionModel(respond, ["size", "stretch"], (TOP, DRIFT), STEP, N)


def test_channels_are_what_the_sensors_show():
    sensed = SensedModel(STRUCTURE, {"top": Sensor(GAIN, LAG), "drift": Sensor(Uniform(-2.0, 2.0))})
    assert sensed.parameter_names == ("size", "stretch", "gain_top", "lag_top", "gain_drift")
    assert list(sensed.priors) == list(sensed.parameter_names[2:]) and sensed.fingerprint != STRUCTURE.fingerprint
    for lag in (-0.1, -0.0234, 0.0, 0.03, 0.0417):
        shown = sensed.simulate([1.1, 0.9, 0.5, lag, -1.0])
        # fifth-degree interpolation of 33 samples per period
        np.testing.assert_allclose(shown[0], 0.55 * motion(TIME - lag), atol=1e-6)
        np.testing.assert_array_equal(shown[1], -respond([1.1, 0.9])[1])
    thetas = np.array([[1.0, 1.0, 1.0, 0.0, 1.0], [1.1, 0.9, 0.5, 0.02, 2.0]])
    batch = simulate_batch(sensed, thetas)
    np.testing.assert_array_equal(batch.response, [sensed.simulate(theta) for theta in thetas])
    np.testing.assert_array_equal(batch.response[0], respond([1.0, 1.0]))
    likelihood = FELikelihood(sensed, Measurements((TOP, DRIFT), STEP, respond([1.0, 1.0])))
    assert [each.label for each in likelihood.parameters[2:5]] == ["gain_top [-]", "lag_top [s]", "gain_drift [-]"]
    structure = propagate(sensed.model, thetas[:, :2], progress=False)
    np.testing.assert_allclose(structure.mean, 0.5 * (respond([1.0, 1.0]) + respond([1.1, 0.9])), atol=1e-12)


def test_records_are_what_the_sensors_of_the_motion_show():
    rng = np.random.default_rng(3)
    motions = [np.concatenate([np.zeros(20), rng.standard_normal(200), np.zeros(20)]) for _ in range(3)]
    right = [Record(f"s{k}", 0.01, each) for k, each in enumerate(motions)]
    shown = [*right[:2], Record("s2", 0.01, 0.5 * np.roll(motions[2], 7))]
    deck, theta = BridgeDeck("deck"), [3.0, 0.05, 0.7]
    sensed = SensedModel(LinearStructure(deck, shown), inputs={2: Sensor(GAIN, LAG)})
    assert sensed.parameter_names[3:] == ("gain_support_2", "lag_support_2")
    expected = LinearStructure(deck, right).simulate(theta)
    np.testing.assert_allclose(sensed.simulate([*theta, 0.5, 0.07]), expected, atol=1e-10)
    np.testing.assert_allclose(
        sensed.with_record(right).simulate([*theta, 1.0, 0.0]), LinearStructure(deck, right).simulate(theta), atol=1e-12
    )
    oscillator = LinearOscillator(right[0], period=0.4)
    one = SensedModel(oscillator, {"displacement": Sensor(GAIN)}, {0: Sensor(GAIN)})
    thetas = np.array([[1.0, 1.0, 2.0, 0.5], [1.1, 0.9, 1.0, 1.0]])
    plain = np.array([oscillator.simulate(theta[:2]) for theta in thetas])
    for response in (simulate_batch(one, thetas).response, np.array([one.simulate(theta) for theta in thetas])):
        np.testing.assert_allclose(response[0], plain[0] * [[2.0], [4.0]], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(response[1], plain[1], rtol=1e-9, atol=1e-12)


def test_a_shortened_model_is_the_first_part():
    rng = np.random.default_rng(4)
    supports = [Record(f"s{k}", 0.01, rng.standard_normal(400)) for k in range(3)]
    for sensed in (
        SensedModel(LinearStructure(BridgeDeck("deck"), supports), {"deck": Sensor(lag=LAG)}, {1: Sensor(lag=LAG)}),
        SensedModel(LinearOscillator(supports[0]), {"acceleration": Sensor(lag=LAG)}, {0: Sensor(GAIN)}),
    ):
        n = len(sensed.model.parameter_names)
        part = sensed.first(2.0)
        assert part.n_steps == 201 and part.fingerprint != sensed.fingerprint
        for late in ([-0.06, 0.05], [0.05, -0.06]):
            theta = [*np.ones(n) * 0.5, *late] if n == 3 else [1.0, 1.0, late[0], 1.2]
            np.testing.assert_allclose(part.simulate(theta), sensed.simulate(theta)[:, :201], atol=1e-9)


def measured(gain=1.0, lag=0.0, seed=0):
    values = np.stack([gain * motion(TIME - lag), 0.02 * motion(TIME, 5.0)])
    noise = np.random.default_rng(seed).standard_normal(values.shape) * [[0.05], [0.001]]
    return Measurements((TOP, DRIFT), STEP, values + noise)


def test_the_gain_has_its_closed_form():
    """y = g r + e with normal g and e: posterior and evidence are as in Gaussian regression."""
    data, prior_sd, sigma = measured(1.2), 0.3, 0.05
    prior = TruncatedNormal(1.0, prior_sd, lower=-np.inf)
    sensed = SensedModel(STRUCTURE, {"top": Sensor(prior)})
    likelihood = FELikelihood(sensed, data)
    gains = np.linspace(0.8, 1.6, 2001)
    rows = np.column_stack([np.ones((len(gains), 2)), gains, np.full(len(gains), sigma), np.full(len(gains), 0.001)])
    log_density = likelihood.log_likelihood(rows) + prior.logpdf(gains)
    y, r = data.values[0], respond([1.0, 1.0])[0]
    precision = r @ r / sigma**2 + 1.0 / prior_sd**2
    mean = (y @ r / sigma**2 + 1.0 / prior_sd**2) / precision
    expected = -0.5 * precision * np.square(gains - mean)
    shift = log_density - expected
    assert np.ptp(shift) < 1e-8 * np.abs(log_density).max()
    # the evidence of the channel is a normal density with the covariance s^2 I + p^2 r r'
    other = multivariate_normal(0.02 * motion(TIME, 5.0), 1e-6 * np.eye(N)).logpdf(data.values[1])
    joint = multivariate_normal(r, sigma**2 * np.eye(N) + prior_sd**2 * np.outer(r, r)).logpdf(y)
    integral = shift.mean() + 0.5 * np.log(2.0 * np.pi / precision)
    assert integral - other == pytest.approx(joint, abs=1e-6)


def test_sensors_that_do_not_exist_are_refused():
    record = Record("EQ", STEP, motion(TIME))
    for make, message in (
        (lambda: Sensor(), "a prior of its gain, of its lag, or both"),
        (lambda: Sensor(gain=0.05), "got gain=0.05"),
        (lambda: SensedModel(STRUCTURE), "expected Sensors"),
        (lambda: SensedModel(STRUCTURE, {"top": GAIN}), "expected Sensors"),
        (lambda: SensedModel(STRUCTURE, {"roof": Sensor(GAIN)}), "channels top, drift; got roof"),
        (lambda: SensedModel(STRUCTURE, inputs={0: Sensor(GAIN)}), "with_record, and numbers of its 0 records"),
        (lambda: SensedModel(LinearOscillator(record), inputs={1: Sensor(GAIN)}), "numbers of its 1 records"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
