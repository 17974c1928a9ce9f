"""Emulators: a response that is linear is reproduced; errors of left-out runs; bounds and scales."""

import numpy as np
import pytest

from fe_likelihoods import HalfNormal, LogNormal, TruncatedNormal, Uniform
from fe_likelihoods.emulation.emulator import ResponseEmulator
from fe_likelihoods.emulation.target import ResponseTarget, at_once

from .problems import vibration

AT = np.array([1.2, 0.8])
SCALE = np.array([0.01, 0.05])  # of the training points, in standard deviations of the prior


def structural_coordinates(target, points):
    """Coordinates (n, 2) of structural parameters (n, 2), beside the coordinates of the median noise."""
    median = target.parameters(np.zeros((1, target.ndim)))[:, 2:]
    return target.coordinates(np.column_stack([points, np.repeat(median, len(points), axis=0)]))[:, :2]


def emulator_of(posterior, n=40, seed=1):
    target = ResponseTarget(posterior)
    centre = structural_coordinates(target, AT[None])[0]
    coords = centre + SCALE * np.random.default_rng(seed).standard_normal((n, 2))
    at_once(target.run(coords))
    rows = np.arange(len(target.archive))
    statistics = target.archive.statistics
    slopes = target.slopes(statistics[0], target.fit_noise(statistics[0]).coords)
    return target, ResponseEmulator(target, rows, centre, np.diag(SCALE**2), slopes)


@pytest.mark.parametrize("noise", ["marginal", "autoregressive"])
def test_the_likelihood_near_the_training_points(noise):
    target, emulator = emulator_of(vibration(noise))
    coords = structural_coordinates(target, AT[None]) + 0.7 * SCALE * np.random.default_rng(2).standard_normal((20, 2))
    true = at_once(target.run(coords))
    noises = np.tile(target.fit_noise(true.statistics[0]).coords, (20, 1))
    error = emulator.log_likelihood(np.column_stack([coords, noises]))
    error -= target.log_likelihood(true.statistics, noises)
    assert error.max() < 0.05 and error.min() > -0.5


@pytest.mark.parametrize("prior", [TruncatedNormal(1.0, 1.0), HalfNormal(1.0), Uniform(0.0, 3.0)])
def test_near_a_bound_the_emulator_follows_the_response(prior):
    """There the coordinates go to infinity: these are up to 12 standard deviations from the training points."""
    posterior = vibration(truth=np.array([1.2, 0.03]), damping=prior)
    target = ResponseTarget(posterior)
    centre = structural_coordinates(target, np.array([[1.2, 0.05]]))[0]
    covariance = np.diag(np.square([0.01, 0.3]))
    at_once(target.run(centre + np.random.default_rng(4).standard_normal((40, 2)) @ np.sqrt(covariance)))
    rows = np.arange(len(target.archive))
    slopes = target.slopes(target.archive.statistics[0], np.zeros(0))
    emulator = ResponseEmulator(target, rows, centre, covariance, slopes)
    coords = structural_coordinates(target, np.array([[1.2, 1e-2], [1.2, 1e-3], [1.203, 1e-6], [1.198, 1e-9]]))
    emulated = emulator.log_likelihood(coords)
    true = target.log_likelihood(at_once(target.run(coords)).statistics, np.zeros((4, 0)))
    assert np.abs(emulated - true).max() < 0.3


@pytest.mark.parametrize("coordinate", [-5.0, -8.2])
def test_a_run_at_a_bound_at_zero_hardly_changes_an_emulator(coordinate):
    """Its reciprocal is 1e14 and alone tells a slope; a warning of numpy would be an error here."""
    target = ResponseTarget(vibration(truth=np.array([1.2, 0.03])))
    assert any((scales.power == -1).all() for scales in target.scales)
    centre = structural_coordinates(target, np.array([[1.2, 0.05]]))[0]
    coords = centre + np.random.default_rng(4).standard_normal((40, 2)) * [0.01, 0.3]
    coords[0, 1] = coordinate
    statistics = at_once(target.run(coords)).statistics
    slopes = target.slopes(statistics[0], np.zeros(0))
    emulator = ResponseEmulator(target, np.arange(40), centre, np.diag(np.square([0.01, 0.3])), slopes)
    error = emulator.log_likelihood(coords[1:]) - target.log_likelihood(statistics[1:], np.zeros((39, 0)))
    assert np.abs(error).max() < 0.3


@pytest.mark.parametrize("damping", [LogNormal(0.8, 0.3), TruncatedNormal(1.0, 0.3, -np.inf), Uniform(0.2, 4.0)])
def test_scaled_parameters_are_those_of_the_coordinates(damping):
    """Also below zero; densities over both differ by the volume, and reciprocals have no parameter from zero on."""
    target = ResponseTarget(vibration(damping=damping))
    coords = np.outer(np.linspace(-2.0, 3.0, 9), [1.0, 1.0])
    for scales in target.scales:
        scaled = target.scaled(coords, scales)
        again, volume = target.unscaled(scaled, scales)
        np.testing.assert_allclose(again, coords, atol=1e-6)
        assert (np.diff(scaled, axis=0) > 0.0).all()
        step = 1e-4
        slopes = (target.scaled(coords + step, scales) - target.scaled(coords - step, scales)) / (2.0 * step)
        np.testing.assert_allclose(volume, -np.log(slopes).sum(axis=1), atol=1e-5)
        outside = target.unscaled(np.where(scales.power < 0, 0.5, scaled), scales)[1]
        assert (outside[:, None] == -np.inf).all() or (scales.power >= 0).all()
