"""Linear oscillator against closed forms, quadrature of Duhamel's integral, and scipy's state-space solver."""

import math

import numpy as np
import pytest
from scipy import signal

from fe_likelihoods import LinearOscillator, Record, SimulationFailed
from fe_likelihoods.signals.response_spectrum import respond
from fe_likelihoods.simulation.model import first_part, simulate_batch

DAMPING = (0.0, 0.02, 0.3, 0.95)


@pytest.fixture
def record(rng):
    return Record("noise", 0.02, rng.normal(size=400))


@pytest.mark.parametrize("zeta", DAMPING)
def test_equals_state_space_solution_with_first_order_hold(record, zeta):
    omega = 7.0
    system = ([[0, 1], [-(omega**2), -2 * zeta * omega]], [[0], [-1]], np.eye(2), [[0], [0]])
    _, expected, _ = signal.lsim(system, record.acceleration, record.time)
    response = respond(record.acceleration, record.dt, omega, zeta)
    for ours, theirs in zip(response[:2], expected.T, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


def test_parameters_are_multiples_of_nominal(record):
    model = LinearOscillator(record, period=0.8, damping_ratio=0.04)
    response = model.simulate(np.array([4.0, 1.5]))
    expected = respond(record.acceleration, record.dt, 2 * math.pi / 0.4, 0.06)
    assert response.shape == (len(model.channels), model.n_steps)
    np.testing.assert_allclose(response[0], expected.acceleration, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(response[1], expected.displacement, rtol=1e-13, atol=1e-15)
    assert (model.dt, model.n_steps) == (record.dt, record.n_steps)


def test_a_batch_equals_its_rows_and_failures_affect_only_their_rows(record):
    model = LinearOscillator(record)
    thetas = np.array([[1.0, 1.0], [-1.0, 1.0], [1.3, 0.5], [1.0, 21.0], [1.0, -0.1], [0.7, 0.0]])
    response, reasons = simulate_batch(model, thetas)
    assert [bool(reason) for reason in reasons] == [False, True, False, True, True, False]
    assert "stiffness" in reasons[1]
    assert "damping" in reasons[3]
    for theta, row, reason in zip(thetas, response, reasons, strict=True):
        if reason:
            assert np.isnan(row).all()
            with pytest.raises(SimulationFailed):
                model.simulate(theta)
        else:
            np.testing.assert_array_equal(row, model.simulate(theta))


@pytest.mark.parametrize(
    "values", [{"period": 0.0}, {"period": math.nan}, {"damping_ratio": 0.0}, {"damping_ratio": 5}]
)
def test_nominal_values_out_of_range_are_rejected(record, values):
    with pytest.raises(ValueError, match="LinearOscillator"):
        LinearOscillator(record, **values)


@pytest.mark.parametrize("zeta", [0.005, 0.05, 0.5])
@pytest.mark.parametrize("period", [5.0, 0.5, 0.08])  # the last one with an eigenvalue times step above one
def test_derivatives_against_differences(record, period, zeta):
    model, theta, step = LinearOscillator(record, period, zeta), np.array([1.2, 0.9]), 5e-5
    found = model.jacobian(theta)
    for slopes, change in zip(found, step * np.eye(2), strict=True):
        far, near = (model.simulate(theta + k * change) - model.simulate(theta - k * change) for k in (2, 1))
        expected = (8.0 * near - far) / (12.0 * step)
        scale = np.abs(expected).max(axis=1, keepdims=True)
        np.testing.assert_allclose(slopes / scale, expected / scale, rtol=0, atol=1e-7)
    np.testing.assert_array_equal(first_part(model, 3.0).jacobian(theta), found[:, :, :151])
    with pytest.raises(SimulationFailed, match="the stiffness must be positive"):
        model.jacobian([-1.0, 1.0])
