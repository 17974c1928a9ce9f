"""Gradients of posteriors, against differences of log-probabilities with simulations."""

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    LinearOscillator,
    LogNormal,
    Measurements,
    ModalData,
    ModalLikelihood,
    Posterior,
    Record,
    ShearFrame,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.priors.multivariate import MultivariateNormal
from tests.clients.problem import starts_of

STEPS, WEIGHTS = np.array([-2.0, -1.0, 1.0, 2.0]), np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
STRUCTURE = {"stiffness": TruncatedNormal(1.0, 0.2), "damping": LogNormal(1.0, 0.3)}


def oscillator(rng, missing=False, dt=0.05):
    model = LinearOscillator(Record("noise", dt, 2.0 * rng.normal(size=120)), 0.8, 0.1)
    values = model.simulate([1.1, 0.9]) + np.array([[0.4], [0.008]]) * rng.normal(size=(2, 120))
    if missing:
        values[0, 30:40] = np.nan
    return model, Measurements(model.channels, model.dt, values)


def differences(posterior, x, share=2e-3):
    """Gradient by five points along each parameter."""
    found = []
    for k, value in enumerate(x):
        step = share * max(abs(value), 1e-3)
        rows = np.repeat(x[None], 4, axis=0)
        rows[:, k] += step * STEPS
        found.append(WEIGHTS @ posterior.log_prob(rows) / step)
    return np.array(found)


def gaussian(rng):
    return Posterior(
        FELikelihood(*oscillator(rng)),
        STRUCTURE | {"sigma_acceleration": HalfNormal(1.0), "sigma_displacement": Uniform(0.001, 0.1)},
    )


def with_gaps(rng):
    return Posterior(FELikelihood(*oscillator(rng, missing=True)), gaussian(rng).prior)


def marginal(rng):
    return gaussian(rng).marginal()


def known(rng):
    prior = STRUCTURE | {"sigma_acceleration": 0.4, "sigma_displacement": 0.008}
    return Posterior(FELikelihood(*oscillator(rng)), prior)


def autoregressive(rng):
    model, data = oscillator(rng)
    likelihood = FELikelihood(model, data, AutoregressiveNoise(model.channels))
    noise = {name: HalfNormal(1.0) for name in likelihood.parameter_names[2:]}
    return Posterior(likelihood, STRUCTURE | noise)


def two_events(rng):
    joint = JointLikelihood(
        {"first": FELikelihood(*oscillator(rng)), "second": FELikelihood(*oscillator(rng, True))}, separate=["damping"]
    )
    prior = {
        "stiffness": STRUCTURE["stiffness"],
        "damping_first": STRUCTURE["damping"],
        "damping_second": STRUCTURE["damping"],
        "sigma_acceleration": HalfNormal(1.0),
        "sigma_displacement": HalfNormal(0.1),
    }
    return Posterior(joint, prior)


def correlated(rng):
    prior = {("stiffness", "damping"): MultivariateNormal([1.0, 1.0], [[0.04, 0.02], [0.02, 0.09]])}
    return Posterior(
        FELikelihood(*oscillator(rng)),
        prior | {"sigma_acceleration": HalfNormal(1.0), "sigma_displacement": HalfNormal(0.1)},
    )


def modal(rng, student_t=None):
    frame = ShearFrame({"floor": 1, "roof": 2}, [2.0, 1.0], [1000.0, 800.0])
    data = ModalData([2.2, 5.6], [[0.6, 1.0], [-0.9, 1.0]], ["floor", "roof"])
    errors = {"frequency_error": HalfNormal(0.05), "shape_error": HalfNormal(0.2)}
    prior = {"stiffness_1": LogNormal(1.0, 0.3), "stiffness_2": LogNormal(1.0, 0.3)} | errors
    return Posterior(ModalLikelihood(frame, data, student_t=student_t), prior)


def modal_student(rng):
    return modal(rng, student_t=4.0)


def modes_and_history(rng):
    """A data set with modes and one with a history, in other parameters and with a common one."""
    model, data = oscillator(rng)
    history = FunctionModel(
        lambda theta: model.simulate(theta),
        ("stiffness_1", "damping"),
        model.channels,
        model.dt,
        model.n_steps,
        jacobian=lambda theta: model.jacobian(theta),
    )
    joint = JointLikelihood({"modes": modal(rng).likelihood, "history": FELikelihood(history, data)})
    return Posterior(
        joint,
        {name: LogNormal(1.0, 0.3) for name in joint.parameter_names[:3]}
        | {name: HalfNormal(0.1) for name in joint.parameter_names[3:]},
    )


CASES = [
    gaussian,
    with_gaps,
    marginal,
    known,
    autoregressive,
    two_events,
    correlated,
    modal,
    modal_student,
    modes_and_history,
]


@pytest.mark.parametrize("make", CASES)
def test_gradients_agree_with_differences_of_simulations(make, rng):
    posterior = make(rng)
    points = starts_of(posterior, 4, rng)
    found = posterior.grad_log_prob(points)
    for x, gradient in zip(points, found, strict=True):
        expected = differences(posterior, x)
        np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-7 * abs(expected).max())
    prior = Posterior.grad_log_prob(posterior, points[0]) - posterior.grad_log_likelihood(points[0])
    steps = 1e-6 * np.diag(np.maximum(abs(points[0]), 1e-3))
    by_hand = (posterior.log_prior(points[0] + steps) - posterior.log_prior(points[0] - steps)) / (2.0 * np.diag(steps))
    np.testing.assert_allclose(prior, by_hand, rtol=1e-5, atol=1e-5 * abs(by_hand).max())


def test_a_wrong_derivative_shows(rng):
    """Negative control."""
    model, data = oscillator(rng)
    wrong = FunctionModel(
        model.simulate,
        model.parameter_names,
        model.channels,
        model.dt,
        model.n_steps,
        jacobian=lambda theta: 1.001 * model.jacobian(theta),
    )
    posterior = Posterior(FELikelihood(wrong, data), gaussian(rng).prior)
    x = starts_of(posterior, 1, rng)[0]
    assert abs(posterior.grad_log_prob(x)[:2] / differences(posterior, x)[:2] - 1.0).min() > 1e-4


def test_bounds_and_impossible_points(rng):
    posterior = gaussian(rng)
    at_bound = np.array([1.1, 0.9, 0.4, 0.001])
    inside = at_bound + [0.0, 0.0, 0.0, 1e-9]
    np.testing.assert_allclose(posterior.grad_log_prob(at_bound), posterior.grad_log_prob(inside), rtol=1e-4)
    upper = np.array([1.1, 0.9, 0.4, 0.1])
    np.testing.assert_allclose(
        posterior.grad_log_prob(upper), posterior.grad_log_prob(upper * [1, 1, 1, 0.99999]), rtol=1e-3
    )
    outside, failing = [-1.0, 0.9, 0.4, 0.01], [1.1, 12.0, 0.4, 0.01]  # overdamped from ten times the nominal damping
    rows = posterior.grad_log_prob([outside, failing, inside])
    assert (posterior.log_prob([outside, failing, inside]) == -np.inf).tolist() == [True, True, False]
    assert (rows[:2] == 0.0).all() and (rows[2] != 0.0).all()


def test_a_model_without_derivatives_is_refused(rng):
    model, data = oscillator(rng)
    plain = FunctionModel(model.simulate, model.parameter_names, model.channels, model.dt, model.n_steps)
    posterior = Posterior(FELikelihood(plain, data), gaussian(rng).prior)
    with pytest.raises(ValueError, match="needs models with a method jacobian"):
        posterior.grad_log_prob(posterior.prior.mean())
    assert posterior.report()["simulations"] == 0
