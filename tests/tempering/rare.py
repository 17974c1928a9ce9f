"""Rare events whose probabilities are known."""

import numpy as np
from scipy import integrate, stats


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


def summarise(runs, exact):
    """Ratios of estimates to the exact probability, root mean square of stated errors, and which intervals hold it."""
    ratios = np.array([run.probability for run in runs]) / exact
    stated = np.sqrt(np.mean([run.coefficient_of_variation**2 for run in runs]))
    return ratios, stated, np.array([run.lower <= exact <= run.upper for run in runs])
