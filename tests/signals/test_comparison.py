"""Channels with rates and starts of their own: compared at their own times."""

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    LinearOscillator,
    Measurements,
    Record,
    plot_histories,
)
from fe_likelihoods.signals.channels import Comparison, compare_with
from fe_likelihoods.signals.datasets import read_dataset, write_dataset
from fe_likelihoods.signals.sampling import interpolate, make_interpolation

CHANNELS = (Channel("top", "acceleration", "g"), Channel("drift", "displacement", "mm"))
DT, N_STEPS = 0.01, 401
TIME = DT * np.arange(N_STEPS)


def motion(time):
    return np.sin(2.0 * np.pi * 3.0 * time + 0.3) * np.exp(-0.2 * time)


def response(theta):
    return np.stack([theta[0] * motion(TIME), 0.01 * theta[1] * motion(TIME)])


@pytest.fixture
def model():
    return FunctionModel(response, ["size", "stretch"], CHANNELS, DT, N_STEPS)


def sampled(dts, starts=(0.0, 0.0), duration=4.0):
    rows = [
        scale * motion(start + dt * np.arange(1 + int((duration - start) / dt + 1e-9)))
        for scale, dt, start in zip((1.0, 0.01), dts, starts, strict=True)
    ]
    return Measurements(CHANNELS, dts, rows, start=starts)


# interpolation --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("per_period", [10, 20, 40])
def test_interpolation_has_the_stated_error(per_period):
    step = np.arange(2000.0)
    times = np.linspace(10.0, 1980.0, 3333)
    found = interpolate(np.sin(2.0 * np.pi * step / per_period), make_interpolation(1.0, 2000, times))
    error = np.abs(found - np.sin(2.0 * np.pi * times / per_period)).max()
    stated = 0.3125 * (np.pi / per_period) ** 6
    assert 0.7 * stated < error < 1.01 * stated


def test_interpolation_is_exact_at_samples_and_for_polynomials(rng):
    history = rng.normal(size=50)
    times = 0.02 * np.array([0, 1, 7, 48, 49])
    np.testing.assert_array_equal(interpolate(history, make_interpolation(0.02, 50, times)), history[[0, 1, 7, 48, 49]])
    mixed = make_interpolation(0.02, 50, np.append(times, 0.1234))
    np.testing.assert_array_equal(interpolate(history, mixed)[:-1], history[[0, 1, 7, 48, 49]])
    fifth, line = np.arange(9.0) ** 5, np.array([1.0, 3.0])
    np.testing.assert_allclose(interpolate(fifth, make_interpolation(1.0, 9, [0.3, 8.0 - 0.1])), [0.3**5, 7.9**5])
    np.testing.assert_allclose(interpolate(line, make_interpolation(1.0, 2, [0.25])), [1.5])


# measurements ---------------------------------------------------------------------------------------------------------


def test_steps_starts_and_ends_of_channels(tmp_path):
    measurements = sampled((0.01, 0.025), (0.0, 0.37))
    assert (measurements.dt, measurements.start) == ((0.01, 0.025), (0.0, 0.37)) and not measurements.simultaneous
    np.testing.assert_allclose(measurements.times("drift")[:2], [0.37, 0.395])
    assert measurements.end == pytest.approx(4.0) and measurements.n_steps == 401
    with pytest.raises(ValueError, match="different times; call times"):
        _ = measurements.time
    drift = measurements.select(["drift"])
    assert (drift.dt, drift.start) == (0.025, 0.37) and drift.fingerprint != measurements.fingerprint
    later = measurements.trim(0.3, 2.0)
    np.testing.assert_allclose(later.starts, [0.0, 0.07])
    np.testing.assert_array_equal(later.channel("top")[:171], measurements.channel("top")[30:201])
    with pytest.raises(ValueError, match="all samples of 'drift' are missing"):
        measurements.trim(0.0, 0.2)
    with pytest.raises(ValueError, match="0 <= start < stop <= 4 s"):
        measurements.trim(1.0, 5.0)
    every = measurements.decimate(2)
    assert every.dt == (0.02, 0.05) and every.start == (0.0, 0.37)
    record = Record("motion", 0.01, np.ones(401))
    write_dataset(tmp_path / "data.h5", record, measurements)
    back = read_dataset(tmp_path / "data.h5").measurements
    assert back.fingerprint == measurements.fingerprint and back.starts == measurements.starts
    assert len(plot_histories(measurements).axes) == 2


def test_wrong_steps_and_starts_are_refused():
    with pytest.raises(ValueError, match="one time step, or one for each of 2 channels, got 3"):
        Measurements(CHANNELS, (0.1, 0.1, 0.1), np.ones((2, 4)))
    with pytest.raises(ValueError, match="start of the measurements: expected a finite number"):
        Measurements(CHANNELS, 0.1, np.ones((2, 4)), start=np.nan)
    with pytest.raises(ValueError, match="positive number of seconds"):
        Measurements(CHANNELS, (0.1, -0.1), np.ones((2, 4)))


# likelihood -----------------------------------------------------------------------------------------------------------


def test_channels_are_compared_at_their_own_times(model):
    """The true motion at other rates and starts leaves residuals of the size of the interpolation's error."""
    data = sampled((0.0125, 0.003), (0.0, 0.371))
    likelihood = FELikelihood(model, data)
    residuals = likelihood.residuals_of(model.simulate([1.0, 1.0]))
    assert residuals.shape == data.values.shape
    np.testing.assert_array_equal(np.isnan(residuals), np.isnan(data.values))
    scale = np.nanmax(np.abs(data.values), axis=1, keepdims=True)
    assert np.nanmax(np.abs(residuals / scale)) < 1e-6
    counts = [321, 1210]
    assert likelihood.n_samples.samples.tolist() == counts
    x = np.array([1.1, 0.9, 0.2, 0.003])
    misfit = np.nansum(np.square(likelihood.residuals_of(model.simulate(x[:2]))), axis=1)
    expected = -np.array(counts) * (0.5 * np.log(2.0 * np.pi) + np.log(x[2:])) - 0.5 * misfit / x[2:] ** 2
    assert likelihood.log_likelihood(x) == pytest.approx(expected.sum(), rel=1e-12)


def test_samples_at_times_of_the_response_are_compared_bit_by_bit(rng):
    record = Record("motion", 0.01, rng.normal(size=400))
    model = LinearOscillator(record, period=0.5, damping_ratio=0.03)
    theta = np.array([1.0, 1.0])
    noise = 0.01 * rng.normal(size=(len(model.channels), 400))
    fine = Measurements(model.channels, 0.01, model.simulate(theta) + noise)
    likelihood = FELikelihood(model, fine.decimate(3))
    expected = (model.simulate(theta) + noise)[:, ::3] - model.simulate(theta)[:, ::3]
    np.testing.assert_array_equal(likelihood.residuals_of(model.simulate(theta)), expected)
    # as with gaps on the grid of the response
    gaps = np.full(fine.values.shape, np.nan)
    gaps[:, ::3] = fine.values[:, ::3]
    gappy = FELikelihood(model, Measurements(model.channels, 0.01, gaps))
    x = np.array([1.1, 0.8, 0.05, 0.001][: likelihood.ndim])
    assert gappy.log_likelihood(x) == pytest.approx(likelihood.log_likelihood(x), rel=1e-13)
    assert isinstance(likelihood.measured, Comparison) and not likelihood.measured.description
    assert not isinstance(FELikelihood(model, fine).measured, Comparison)
    correlated = likelihood.with_noise(AutoregressiveNoise(model.channels))
    zeros = np.zeros(len(model.channels))
    white = likelihood.with_noise(GaussianNoise(model.channels)).log_likelihood(x)
    assert correlated.log_likelihood(np.concatenate([x, zeros])) == pytest.approx(white, rel=1e-12)


def test_measurements_outside_the_response_are_refused(model):
    good = sampled((0.01, 0.02))
    compare_with(good, DT, N_STEPS)
    early = Measurements(CHANNELS, 0.01, np.ones((2, 402)), start=-0.01)
    with pytest.raises(ValueError, match="channel 'top' from -0.01 to 4 s"):
        FELikelihood(model, early)
    for wrong in (
        Measurements(CHANNELS, 0.005, np.ones((2, 401))),  # a wrong step
        Measurements(CHANNELS, 0.02, np.ones((2, 401))),
        Measurements(CHANNELS, 0.01, np.ones((2, 400))),
        Measurements(CHANNELS, 0.01, np.ones((2, 401)), start=0.37),  # after the end
        sampled((0.01, 0.02)).trim(0.0, 3.9),
    ):
        with pytest.raises(ValueError, match="use the same part of record and measurements"):
            FELikelihood(model, wrong)
    clock = Measurements(CHANNELS, 0.02, np.ones((2, 201)), start=86395.5)
    with pytest.raises(ValueError, match=r'begin at 86395.5 s; give .* zero=12.5 or zero="10:32:07" of read_columns'):
        FELikelihood(model, clock)
    ended = Measurements(CHANNELS, 0.02, np.where(np.arange(201) < 150, 1.0, np.nan) * np.ones((2, 1)))
    assert FELikelihood(model, ended).n_samples.samples.tolist() == [150, 150]


def test_channels_with_steps_of_their_own_may_end_early_with_nan(model):
    """NaN at the end says that the end was not measured, as for channels with one step."""
    data = sampled((0.01, 0.02))
    rows = [np.array(data.values[0]), np.array(data.values[1][:201])]
    rows[0][-40:] = rows[1][-20:] = np.nan
    likelihood = FELikelihood(model, Measurements(CHANNELS, (0.01, 0.02), rows), GaussianNoise(CHANNELS))
    assert likelihood.n_samples.samples.tolist() == [361, 181]
    with pytest.raises(ValueError, match="fill times that were not measured with NaN"):
        FELikelihood(model, Measurements(CHANNELS, (0.01, 0.02), [rows[0][:361], rows[1][:181]]))
    with pytest.raises(ValueError, match="correct the step"):
        FELikelihood(model, Measurements(CHANNELS, (0.005, 0.01), rows))
