"""Priors with draws and densities, and balls of points, for the tests of starting points."""

import numpy as np

from samplers.evaluation.starts import compare_with_draws, draws_to_compare, spread_by_metropolis

__all__ = ["PRIORS", "Cauchy", "Correlated", "LogNormal", "Prior", "Uniform", "ball", "refused"]


class Prior:
    """A prior that can be drawn from, with its log-density, a centre and a scale."""

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


class Correlated(Prior):
    def __init__(self, ndim):
        super().__init__(ndim)
        self.root = np.linalg.cholesky(0.9 * np.ones((ndim, ndim)) + 0.1 * np.eye(ndim))

    def draw(self, n, random):
        return super().draw(n, random) @ self.root.T

    def log_density(self, x):
        return super().log_density(np.linalg.solve(self.root, x.T).T)


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


class Cauchy(Prior):
    def draw(self, n, random):
        return random.standard_cauchy((n, self.ndim))

    def log_density(self, x):
        return -np.sum(np.log1p(x**2), axis=1)


PRIORS = [Correlated, Uniform, LogNormal, Cauchy]


def refused(points: np.ndarray, prior: Prior, by: str = "draws", seed: int = 1) -> str:
    """What the test by fresh draws, or by the density, finds; empty where it finds nothing."""
    if by == "density":
        return spread_by_metropolis(points, prior.log_density)
    return compare_with_draws(points, prior.draw(draws_to_compare(len(points)), np.random.RandomState(seed)))


def ball(prior: Prior, n: int, scale: float, random: np.random.RandomState, centred: bool) -> np.ndarray:
    """Points (n, ndim) with a standard deviation of `scale` times that of the prior, about its centre or one draw."""
    centre = prior.centre if centred else prior.draw(1, random)
    return prior.fold(centre + scale * prior.scale * random.standard_normal((n, prior.ndim)))
