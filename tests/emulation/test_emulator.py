"""Emulators: a response that is linear is reproduced; the statistics are those of the predicted response; the model's
interface; errors away from the training points."""

import numpy as np
import pytest

from fe_likelihoods import FELikelihood, SimulationFailed
from fe_likelihoods.emulation.emulator import TrainingSet, fit_emulator
from fe_likelihoods.emulation.target import ResponseTarget

from .problems import free_vibration, vibration

SCALE = np.array([0.01, 0.05])  # of the training points, in standard deviations of the prior


def emulator_of(posterior, n=40, seed=1):
    target = ResponseTarget(posterior)
    centre = target.structural_coordinates(np.array([[1.2, 0.8]]))[0]
    coords = centre + SCALE * np.random.default_rng(seed).standard_normal((n, 2))
    target.run(coords)
    training = TrainingSet(target.archive.coords, np.array(target.archive.residuals))
    statistics = target.archive.statistics
    slopes = target.slopes(statistics[0], target.fit_noise(statistics[0]).coords)
    return target, fit_emulator(target, training, centre, np.diag(SCALE**2), np.array([2e-3, 5.0]), slopes)


@pytest.mark.parametrize("noise", ["marginal", "autoregressive"])
def test_statistics_and_responses_near_the_training_points(noise):
    target, emulator = emulator_of(vibration(noise))
    coords = emulator.centre + 0.7 * SCALE * np.random.default_rng(2).standard_normal((20, 2))
    true = target.run(coords)
    predicted, correction = emulator.statistics(coords)
    error = target.log_likelihood(predicted, np.tile(target.fit_noise(true.statistics[0]).coords, (20, 1)))
    error = error - target.log_likelihood(
        true.statistics, np.tile(target.fit_noise(true.statistics[0]).coords, (20, 1))
    )
    assert np.abs(error).max() < 0.05
    assert (correction <= 0.0).all() and correction.min() > -0.5
    thetas = target.structural_parameters(coords)
    batch = emulator.simulate_batch(thetas)
    assert not any(batch.reasons)
    residuals = target.measured - batch.response
    direct = np.array([target.statistic(one) for one in residuals])
    np.testing.assert_allclose(predicted, direct, rtol=1e-6)


def test_errors_of_left_out_runs_are_those_of_new_ones_or_larger():
    target, emulator = emulator_of(vibration())
    predicted, true = emulator.left_out_statistics()
    left_out = np.abs(predicted - true).max(axis=0)
    coords = emulator.centre + 0.7 * SCALE * np.random.default_rng(3).standard_normal((20, 2))
    new = np.abs(emulator.statistics(coords)[0] - target.run(coords).statistics).max(axis=0)
    assert (new < 3.0 * left_out + 1e-6 * true.max(axis=0)).all()


def test_an_emulator_is_a_model():
    posterior = vibration()
    _, emulator = emulator_of(posterior)
    likelihood = FELikelihood(emulator, posterior.likelihood.measurements, posterior.likelihood.noise)
    at = np.array([1.2, 0.8])
    assert likelihood(at) == pytest.approx(posterior.likelihood(at), abs=0.05)
    difference = emulator.simulate(at) - free_vibration(at)
    assert (np.abs(difference).max(axis=1) < 1e-2 * np.array([5e-3, 1e3])).all()
    assert emulator.fingerprint != emulator_of(posterior, seed=2)[1].fingerprint


def test_it_refuses_points_that_it_was_not_fitted_to():
    _, emulator = emulator_of(vibration())
    with pytest.raises(SimulationFailed, match="outside the region"):
        emulator.simulate(np.array([0.5, 0.8]))
