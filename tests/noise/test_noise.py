"""Gaussian noise against the sum of normal log-densities over all samples."""

import math
import warnings

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    GaussianNoise,
    LinearOscillator,
    Measurements,
    Record,
)

CHANNELS = (Channel("top", "absolute acceleration", "g"), Channel("drift", "relative displacement", "in"))


@pytest.fixture
def noise():
    return GaussianNoise(CHANNELS)


def test_impossible_values_are_minus_infinity_without_a_warning(noise):
    misfit = np.array([[1.0, 1.0]] * 6 + [[math.nan, 1.0], [1.0, math.inf], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    sigma = np.ones((11, 2))
    sigma[:6, 1] = [0.0, -0.0, -1.0, math.nan, -math.inf, math.inf]
    sigma[9:] = 1e-300
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = noise.log_likelihood(misfit, 10, sigma)
    assert np.isneginf(values[:8]).all()
    assert values[8] == pytest.approx(-10.0 * math.log(2.0 * math.pi))
    assert values[9] == pytest.approx(-10.0 * math.log(2.0 * math.pi) + 20.0 * math.log(1e300))  # an exact fit
    assert np.isneginf(values[10])
    assert noise.log_likelihood(np.empty((0, 2)), 10, np.empty((0, 2))).shape == (0,)


def test_a_shared_sigma_is_in_units_of_the_scale_of_each_channel(noise, rng):
    shared = GaussianNoise(CHANNELS, groups="all", scales=[2.0, 0.03])
    assert shared.parameter_names == ("sigma",)
    sigma = rng.uniform(0.1, 3.0, (6, 1))
    misfit = rng.uniform(0.1, 3.0, (6, 2))
    each = sigma * [2.0, 0.03]
    np.testing.assert_array_equal(shared.standard_deviations(sigma), each)
    np.testing.assert_array_equal(
        shared.log_likelihood(misfit, 40, sigma), noise.log_likelihood(misfit, 40, noise.standard_deviations(each))
    )
    assert np.isneginf(shared.log_likelihood(misfit, 40, -sigma)).all()


@pytest.mark.parametrize(
    ("shares_of", "options"), [("measured", {"window": 0.5}), ("response", {"window": 0.6, "sensor": (0.1, 0.001)})]
)
def test_one_share_for_all_channels_is_equal_shares_per_channel(shares_of, options, rng):
    record = Record("motion", 0.02, rng.standard_normal(200))
    model = LinearOscillator(record)
    response = model.simulate([1.0, 1.0])
    measured = Measurements(model.channels, 0.02, response * (1.0 + 0.3 * rng.standard_normal(response.shape)))
    each, one = (
        FELikelihood(model, measured, GaussianNoise(model.channels, groups=groups, shares_of=shares_of, **options))
        for groups in ("channel", "all")
    )
    assert one.parameter_names[2:] == ("share",)
    for share in (0.1, 0.4):
        assert one([1.0, 1.0, share]) == each([1.0, 1.0, share, share])
        np.testing.assert_array_equal(
            one.noise.response_deviations([share], response, 0.02),
            each.noise.response_deviations([share, share], response, 0.02),
        )
    other, weights = one.noise.with_channels(model.channels[:1], np.array([[1.0, 0.0]]))
    assert other.parameter_names == ("share",) and weights.tolist() == [[1.0]]


RESPONSE = {"shares_of": "response", "window": 1.0, "sensor": (1.0, 1.0)}
NUMBER = "must be a number, .*; got .*to_si"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        # combinations
        ({"groups": "each"}, "groups must be one of .'channel', 'all', 'event'.; got 'each'"),
        ({"shares_of": "SI"}, "shares_of must be one of .None, 'measured', 'response'."),
        ({"groups": "event", "shares_of": "measured"}, 'groups="event" has levels in SI units'),
        ({"window": 1.0}, 'window= is for shares_of="measured" or "response"; got window=1.0'),
        ({"local": 0.5, "shares_of": "measured"}, 'local= is for shares_of="response"'),
        ({"effective_samples": (1.0, 1.0), "groups": "event"}, 'effective_samples= is for groups="channel"'),
        (RESPONSE | {"window": None}, 'shares_of="response" needs window='),
        (RESPONSE | {"sensor": {"top": 0.1}}, "needs the noise of the sensor.*quiet part.*levels in SI units"),
        # values
        ({"sensor": {"bottom": 1.0}}, "unknown channels .*bottom.*the channels are top, drift"),
        ({"sensor": [1.0]}, "one number for each of top, drift; got 1"),
        *(({"sensor": [1.0, level]}, "zero or more") for level in (-1.0, math.nan)),
        *(
            ({"effective_samples": number}, "positive numbers of samples")
            for number in ([1.0, 0.0], [1.0, math.nan], {"drift": -3.0})
        ),
        *((RESPONSE | {"local": local}, "local must be from 0") for local in (-0.1, 1.1)),
        *(({"shares_of": "measured", "window": window}, "window must be a positive") for window in (0.0, math.inf)),
        # no numbers
        *(({"sensor": sensor}, f"sensor {NUMBER}") for sensor in ("0.02 g", {"top": "0.02 g"}, {"top": None})),
        ({"effective_samples": "few"}, f"effective_samples {NUMBER}"),
        *(
            (RESPONSE | {name: value}, f"{name} {NUMBER}")
            for name, value in {"window": "1 s", "sensor": "0.02 g", "local": "half"}.items()
        ),
    ],
)
def test_what_has_no_meaning_is_refused_in_words(options, message):
    with pytest.raises(ValueError, match=f"^GaussianNoise.*{message}"):
        GaussianNoise(CHANNELS, **options)
    if list(options) == ["sensor"]:
        with pytest.raises(ValueError, match=f"^AutoregressiveNoise.*{message}"):
            AutoregressiveNoise(CHANNELS, **options)
