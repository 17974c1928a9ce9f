"""Lags: estimated by cross-correlation, and as parameters that need no simulation."""

import numpy as np
import pytest
from scipy.signal import lfilter

from fe_likelihoods import (
    Channel,
    Measurements,
    align,
)

BASE = Channel("base", "acceleration", "g")
TOP, DRIFT = Channel("top", "acceleration", "g"), Channel("drift", "displacement", "mm")
DT, N_STEPS = 0.01, 800
TIME = DT * np.arange(N_STEPS)


def motion(time, seed=3):
    """A smooth transient with many frequencies, zero before time zero."""
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.uniform(0.5, 6.0, 25), rng.uniform(0.0, 2.0 * np.pi, 25)
    waves = np.sin(2.0 * np.pi * frequencies * time[:, None] + phases).sum(axis=1)
    return np.where(time > 0.0, waves * time**3 * np.exp(-2.0 * np.abs(time)), 0.0)


RECORD = Measurements([BASE], DT, [motion(TIME)])


def late(lag, rng, noise=0.0, correlation=0.0, dt=0.0125, missing=0.0):
    time = dt * np.arange(int(7.5 / dt))
    errors = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], rng.normal(size=time.size))
    values = -0.8 * motion(time - lag) + noise * RECORD.values.std() * errors
    values[rng.random(time.size) < missing] = np.nan
    return Measurements((BASE,), dt, values[None])


# estimates ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [-0.2718, 0.0, 0.3137])
def test_lag_without_noise(rng, lag):
    found = align(RECORD, late(lag, rng, missing=0.1))
    assert found.lag == pytest.approx(lag, abs=1e-5)
    assert found.correlation["base"] == pytest.approx(-1.0, abs=1e-6) and found.second_lag is None
    assert found.statement.startswith("lag ") and "NOT SURE" not in found.statement
    assert found.gain["base"] == pytest.approx(-0.8, abs=1e-5) and "base -0.8 (-1.000)" in found.statement
    corrected = late(lag, rng).shift(-found.lag)
    assert align(RECORD, corrected).lag == pytest.approx(0.0, abs=1e-5)


def test_channels_with_different_clocks_are_aligned_one_by_one(rng):
    channels, noise = (Channel("a", "acceleration", "g"), Channel("b", "acceleration", "g")), 0.05 * motion(TIME).std()
    reference = Measurements(channels, DT, np.stack([motion(TIME), motion(TIME)]))
    apart = Measurements(channels, DT, [motion(TIME - t) + noise * rng.normal(size=TIME.size) for t in (0.1, 0.13)])
    for name, lag in (("a", 0.1), ("b", 0.13)):
        assert align(reference, apart.select([name])).lag == pytest.approx(lag, abs=0.002)
        apart = apart.shift(-lag, [name])
    assert apart.starts == pytest.approx((-0.1, -0.13)) and align(reference, apart).lag == pytest.approx(0.0, abs=0.001)
    with pytest.raises(ValueError, match="channel 'c'"):
        apart.shift(0.1, ["c"])


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_standard_error_is_that_of_repetitions(rng, correlation):
    found = [align(RECORD, late(0.1, rng, 0.7, correlation, missing=0.1), max_lag=1.0) for _ in range(60)]
    scores = np.array([(each.lag - 0.1) / each.standard_error for each in found])
    # the estimated error of one series has itself an error of some ten per cent
    assert 0.75 < scores.std() < 1.35 and abs(scores.mean()) < 4.0 * scores.std() / np.sqrt(60.0)
    assert (np.abs(scores) < 1.96).mean() > 0.85


def test_an_uncertain_lag_says_so(rng):
    for frequency, late, noise, longest in ((1.0, 0.2, 0.5, 3.0), (2.0, 0.1231, 0.05, None)):  # on and off the grid
        sine = Measurements([BASE], DT, [np.sin(2.0 * np.pi * frequency * TIME)])
        waves = np.sin(2.0 * np.pi * frequency * (TIME - late)) + noise * rng.normal(size=N_STEPS)
        found = align(sine, Measurements((BASE,), DT, waves[None]), max_lag=longest)
        assert f"NOT SURE: {found.second_lag:.5g} s is nearly as good" in found.statement
    noise = Measurements((BASE,), DT, rng.normal(size=(1, N_STEPS)))
    assert "NOT SURE: base is not a shifted copy" in align(RECORD, noise, max_lag=1.0).statement


def test_channel_that_is_coarser_than_the_record(rng):
    """With eight samples per second, a period of 5 Hz has fewer than two of them."""
    record = Measurements([BASE], 0.005, [high_waves(0.005 * np.arange(2400))])
    for step in (0.05, 0.125):
        values = high_waves(step * np.arange(int(11.8 / step)) - 0.1234)
        found = align(
            record, Measurements((BASE,), step, [values + 0.05 * values.std() * rng.normal(size=values.size)])
        )
        assert found.lag == pytest.approx(0.1234, abs=1e-3) and "NOT SURE" not in found.statement


def high_waves(time):
    draws = np.random.default_rng(5)
    frequencies, phases = draws.uniform(5.0, 10.0, 25), draws.uniform(0.0, 2.0 * np.pi, 25)
    return np.sin(2.0 * np.pi * frequencies * time[:, None] + phases).sum(axis=1) * np.exp(-(((time - 6.0) / 2.5) ** 2))


@pytest.mark.parametrize(("begin", "lag"), [(0.0, 0.3), (0.0, 14.0), (-9.0, 0.3)])
def test_measurements_longer_than_twice_the_record(rng, begin, lag):
    time = begin + DT * np.arange(2500)
    values = np.where(time - lag < TIME[-1], motion(time - lag), 0.0)
    values += 0.1 * RECORD.values.std() * rng.normal(size=time.size)
    values[rng.random(time.size) < 0.2] = np.nan
    found = align(RECORD, Measurements((BASE,), DT, [values], start=begin), max_lag=16.0)
    assert found.lag == pytest.approx(lag, abs=1e-3) and "NOT SURE" not in found.statement


def test_channels_of_a_simulated_response(rng):
    response = Measurements((TOP, DRIFT), DT, [motion(TIME), 0.01 * motion(TIME, 4)])
    time = 0.02 * np.arange(300)
    measured = Measurements(
        (DRIFT, TOP, BASE),
        (0.02, 0.01, 0.01),
        [0.01 * motion(time + 0.5 - 0.123, 4), motion(TIME - 0.123), rng.normal(size=N_STEPS)],
        start=(0.5, 0.0, 0.0),
    )
    found = align(response, measured, max_lag=1.0)
    assert list(found.correlation) == ["drift", "top"] and found.lag == pytest.approx(0.123, abs=1e-5)
    assert align(RECORD, measured, max_lag=1.0).correlation["base"] < 0.5


def test_lags_that_cannot_be_estimated_are_refused(rng):
    good = late(0.1, rng)
    for arguments, message in (
        ((RECORD, good, -1.0), "end of the range"),
        ((RECORD, late(0.32, rng), 0.3), "end of the range; give a larger max_lag"),
        ((RECORD, Measurements((Channel("base", "displacement", "mm"),), DT, good.values)), "compare like with like"),
        ((RECORD, Measurements((BASE,), DT, np.ones((1, 50)))), "that are not constant"),
        ((good, Measurements((TOP,), DT, good.values)), "the reference has the channels base"),
        ((good.shift(1.0), good), "from time zero"),
    ):
        with pytest.raises(ValueError, match=message):
            align(*arguments)
