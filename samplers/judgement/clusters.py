"""Modes of a finished run: clusters of its final points, with shares and their errors.

Two components of a mixture fitted to the final points belong to the same mode if the mixture density along the straight
line between their means does not fall below a fifth of its lower end value, which for two equal Gaussian components is
a distance of about 4 standard deviations; components in between connect other components. The share of a mode is the
probability that a point belongs to one of its components, averaged over the chain. A mode without points is not found.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..estimates.genealogy import standard_error_of_mean
from ..proposals.mixture import Mixture, fit_mixture, log_density, log_responsibilities

__all__ = ["Cluster", "find_clusters"]

# ratio of the density in the valley between two modes to the density of the lower mode
DEEPEST_VALLEY = 0.2
POINTS_OF_LINE = 33


class Cluster(NamedTuple):
    """A mode of the posterior, as a cluster of the points of a run.

    Attributes
    ----------
    share : float
        Posterior probability of the mode.
    share_error : float
        Standard error of `share`, from the founders of the walkers (`samplers.estimates.genealogy`).
    mean, sd : (ndim,) float
        Mean and standard deviation of the points in the mode, in the units of the parameters.
    """

    share: float
    share_error: float
    mean: np.ndarray
    sd: np.ndarray


def find_clusters(chain: np.ndarray, founders: np.ndarray) -> tuple[Cluster, ...]:
    """Modes of a chain (nsteps, nwalkers, ndim), the largest first, with shares whose sum is 1; the last step defines
    them.

    `founders` (nwalkers,) are the founder of each walker (`samplers.estimates.genealogy`).
    """
    nsteps, nwalkers, ndim = chain.shape
    flat = chain.reshape(-1, ndim)
    if np.any(np.ptp(chain[-1], axis=0) == 0.0):  # nothing to fit: all walkers agree in a parameter
        return (Cluster(1.0, 0.0, flat.mean(axis=0), flat.std(axis=0)),)
    mixture = fit_mixture(chain[-1], np.full(nwalkers, 1.0 / nwalkers))
    groups = _groups(mixture)
    count = groups.max() + 1
    belongs = np.zeros((len(flat), count))
    np.add.at(belongs.T, groups, np.exp(log_responsibilities(mixture, flat)).T)
    errors = standard_error_of_mean(belongs.reshape(nsteps, nwalkers, count), founders)
    modes = []
    for weights, error in zip(belongs.T, errors, strict=True):
        total = weights.sum()
        mean = weights @ flat / total
        sd = np.sqrt(weights @ (flat - mean) ** 2 / total)
        modes.append(Cluster(float(total / len(flat)), float(error), mean, sd))
    return tuple(sorted(modes, key=lambda mode: -mode.share))


def _groups(mixture: Mixture) -> np.ndarray:
    """Mode number of each component (K,)."""
    # the components are defined after the shears, so lines are straight there
    straight = mixture._replace(shears=(), bounds=None)
    count = len(mixture.means)
    line = np.linspace(0.0, 1.0, POINTS_OF_LINE)[:, None]
    connected = np.eye(count, dtype=bool)
    for i in range(count):
        for j in range(i):
            between = log_density(straight, (1.0 - line) * mixture.means[i] + line * mixture.means[j])
            connected[i, j] = between.min() > min(between[0], between[-1]) + np.log(DEEPEST_VALLEY)
    return connected_components(connected, directed=False)[1]
