"""The test of starting points: what it finds, and how often it is wrong."""

import itertools

import numpy as np
import pytest

from samplers.evaluation.starts import not_of_the_prior


class Prior:
    """A normal prior with draws and a log-density, a centre and a scale."""

    centre, scale = 0.0, 1.0

    def __init__(self, ndim):
        self.ndim = ndim

    def draw(self, n, random):
        return random.standard_normal((n, self.ndim))

    def log_density(self, x):
        return -0.5 * np.sum(x**2, axis=1)

    def fold(self, x):
        """Points inside the support."""
        return x


class Uniform(Prior):
    centre, scale = 0.5, 12**-0.5

    def draw(self, n, random):
        return random.uniform(size=(n, self.ndim))

    def log_density(self, x):
        return np.where(np.all((x > 0.0) & (x < 1.0), axis=1), 0.0, -np.inf)

    def fold(self, x):
        x = np.abs(x)
        return np.where(x > 1.0, 2.0 - x, x)


class LogNormal(Prior):
    centre, scale = 1.65, 2.16

    def draw(self, n, random):
        return np.exp(super().draw(n, random))

    def log_density(self, x):
        inside = np.all(x > 0.0, axis=1)
        log_x = np.log(np.where(inside[:, None], x, 1.0))
        return np.where(inside, -np.sum(0.5 * log_x**2 + log_x, axis=1), -np.inf)

    def fold(self, x):
        return np.abs(x)


class Counts(Prior):
    """Whole numbers, of which many agree."""

    def draw(self, n, random):
        return random.poisson(2.0, size=(n, self.ndim)).astype(float)

    def log_density(self, x):
        whole = np.all((x >= 0.0) & (x == np.round(x)), axis=1)
        log_factorial = np.array([np.sum(np.log(np.arange(1, k + 1))) for k in range(200)])
        k = np.clip(x, 0, 199).astype(int)
        return np.where(whole, np.sum(k * np.log(2.0) - log_factorial[k], axis=1), -np.inf)


def refused(points, prior):
    return not_of_the_prior(points, prior.log_density)


@pytest.mark.parametrize("make", [Prior, Uniform, LogNormal])
@pytest.mark.parametrize("ndim", [1, 3, 10])
@pytest.mark.parametrize("n", [100, 250])
def test_balls_are_found(make, ndim, n, seed):
    """Of 0.001 to 0.5 standard deviations, at the centre of the prior and elsewhere."""
    random, prior = np.random.RandomState(seed), make(ndim)
    for scale, centred in itertools.product((0.001, 0.01, 0.1, 0.2), (True, False)):
        centre = prior.centre if centred else prior.draw(1, random)
        points = prior.fold(centre + scale * prior.scale * random.standard_normal((n, ndim)))
        assert refused(points, prior), (scale, centred)


def test_honest_starts_pass(seed):
    """About one of ten thousand may be refused by chance."""
    random = np.random.RandomState(seed)
    found = [
        refused(prior.draw(n, random), prior)
        for prior in (make(ndim) for make in (Prior, Uniform, LogNormal, Counts) for ndim in (1, 2, 5))
        for n in (12, 40, 300)
    ]
    assert sum(map(bool, found)) <= 1, found


def test_wide_shifted_and_constant_points_are_found(rng):
    n, prior = 300, Prior(3)
    assert refused(2.0 * rng.standard_normal((n, 3)), prior)
    assert refused(rng.standard_normal((n, 3)) + 1.0, prior)
    points = rng.standard_normal((n, 3))
    points[:, 1] = 0.1
    assert refused(points, prior) == "a parameter has the same value in all points"
