"""Rare events whose probabilities are known."""

import numpy as np
from scipy import integrate, stats

__all__ = ["correlated", "four_branches", "four_branches_exact", "linear", "summarise"]


def linear(points):
    """Standard normal, of standard normal parameters."""
    return points.sum(axis=1) / np.sqrt(points.shape[1])


def four_branches(points):
    """Four-branch series system (Waarts 2000; p = 6 as in Echard et al. 2011); it fails above zero."""
    a, b = points.T
    bow, sides = 3.0 + 0.1 * (a - b) ** 2, (a + b) / np.sqrt(2.0)
    return -np.min([bow - sides, bow + sides, a - b + 6.0 / np.sqrt(2.0), b - a + 6.0 / np.sqrt(2.0)], axis=0)


def four_branches_exact():
    """By quadrature over d = (a - b) / sqrt(2): the event is |d| > 3 or |s| > 3 + 0.2 d^2, with independent normals."""
    inner = integrate.quad(lambda d: stats.norm.pdf(d) * 2.0 * stats.norm.sf(3.0 + 0.2 * d**2), -3.0, 3.0, epsrel=1e-10)
    return 2.0 * stats.norm.sf(3.0) + inner[0]


class correlated:
    """A correlated normal density as the posterior, and a linear quantity."""

    root = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [0.3, 0.2, 0.5]])
    mean, weights = np.array([1.0, -2.0, 3.0]), np.array([1.0, 1.0, -1.0])

    @classmethod
    def log_prob(cls, points):
        return -0.5 * np.sum(np.linalg.solve(cls.root, (points - cls.mean).T) ** 2, axis=0)

    @classmethod
    def draws(cls, n, seed):
        return cls.mean + np.random.default_rng([seed, 1]).standard_normal((n, 3)) @ cls.root.T

    @classmethod
    def quantity(cls, points):
        return points @ cls.weights

    @classmethod
    def threshold(cls, probability):
        spread = np.linalg.norm(cls.root.T @ cls.weights)
        return cls.mean @ cls.weights + spread * stats.norm.isf(probability)


def summarise(runs, exact):
    """Ratios of estimates to the exact probability, root mean square of stated errors, and which intervals hold it."""
    ratios = np.array([run.probability for run in runs]) / exact
    stated = np.sqrt(np.mean([run.coefficient_of_variation**2 for run in runs]))
    return ratios, stated, np.array([run.lower <= exact <= run.upper for run in runs])
