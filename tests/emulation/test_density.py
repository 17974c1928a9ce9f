"""The emulated posterior in memory: thin and curved ones, whose runs lie along an arc."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from fe_likelihoods.emulation.density import EmulatedPosterior, Region

RADIUS, THICKNESS = 1.0, 0.01


class Target:
    """Two parameters with standard normal priors; runs along an arc [rad]."""

    ndim = n_structural = 2

    def __init__(self, arc, runs=40):
        angles = np.linspace(-arc, arc, runs)
        coords = RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
        self.archive = SimpleNamespace(coords=coords, statistics=np.hypot(*coords.T)[:, None])

    def log_likelihood(self, statistics, noise):
        return -0.5 * np.square((statistics[:, 0] - RADIUS) / THICKNESS)

    def log_prior(self, coords):
        return -0.5 * np.square(coords).sum(axis=1) - np.log(2.0 * np.pi)

    def parameters(self, coords):
        return coords

    def density_of_parameters(self, log_density, parameters):
        return log_density(parameters)

    def scaled(self, coords, scales):
        return coords

    def unscaled(self, scaled, scales):
        return scaled, np.zeros(len(scaled))


def emulated(arc, runs):
    """A likelihood that depends on the radius alone, on an arc about the mode at an angle of zero."""

    def log_likelihood(coords):
        radius, angle = np.hypot(*coords.T), np.arctan2(coords[:, 1], coords[:, 0])
        return np.where(np.abs(angle) < arc, -0.5 * np.square((radius - RADIUS) / THICKNESS), -np.inf)

    emulator = SimpleNamespace(
        log_likelihood=log_likelihood, squared_distance=lambda coords: np.square(coords).sum(axis=1), scales=None
    )
    region = Region(np.array([RADIUS, 0.0]), np.diag([THICKNESS**2, 1.0]), emulator, 0.0)
    return EmulatedPosterior(Target(runs), [region], np.random.RandomState(1))


def log_evidence(arc):
    """By quadrature over the radius."""
    value, _ = quad(lambda r: r * np.exp(-0.5 * r * r - 0.5 * ((r - RADIUS) / THICKNESS) ** 2), 0.9, 1.1, points=[1.0])
    return np.log(value * arc / np.pi)


@pytest.mark.parametrize("arc", [0.3, 1.5, 3.0])
def test_a_thin_arc_is_covered_where_runs_were_made(arc):
    found = emulated(arc, arc)
    assert abs(found.log_evidence - log_evidence(arc)) < 4.0 * found.known_density.log_density_error < 0.15
