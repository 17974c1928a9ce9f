"""The test of starting points: what it finds, and how often it is wrong."""

import itertools

import numpy as np
import pytest
from scipy import stats

from samplers.evaluation.starts import not_of_the_prior

# a law of each parameter, and how points are brought inside its support
NORMAL = stats.norm(), lambda x: x
UNIFORM = stats.uniform(), lambda x: np.where(np.abs(x) > 1.0, 2.0 - np.abs(x), np.abs(x))
LOG_NORMAL = stats.lognorm(1.0), np.abs
COUNTS = stats.poisson(2.0), np.round  # many agree


def draw(law, n, ndim, random):
    return np.asarray(law.rvs((n, ndim), random_state=random), dtype=float)


def refused(points, law):
    log_density = law.logpdf if hasattr(law.dist, "pdf") else law.logpmf
    return not_of_the_prior(points, lambda x: log_density(x).sum(axis=1))


@pytest.mark.parametrize(("law", "inside"), [NORMAL, UNIFORM, LOG_NORMAL], ids=["normal", "uniform", "log-normal"])
@pytest.mark.parametrize("ndim", [1, 3, 10])
@pytest.mark.parametrize("n", [100, 250])
def test_balls_are_found(law, inside, ndim, n, seed):
    """Of 0.001 to 0.5 standard deviations, at the centre of the prior and elsewhere."""
    random = np.random.RandomState(seed)
    for scale, centred in itertools.product((0.001, 0.01, 0.1, 0.2), (True, False)):
        centre = law.mean() if centred else draw(law, 1, ndim, random)
        points = inside(centre + scale * law.std() * random.standard_normal((n, ndim)))
        assert refused(points, law), (scale, centred)


def test_honest_starts_pass(seed):
    """About one of ten thousand may be refused by chance."""
    random = np.random.RandomState(seed)
    found = [
        refused(draw(law, n, ndim, random), law)
        for law, _ in (NORMAL, UNIFORM, LOG_NORMAL, COUNTS)
        for ndim in (1, 2, 5)
        for n in (12, 40, 300)
    ]
    assert sum(map(bool, found)) <= 1, found


def test_wide_shifted_and_constant_points_are_found(rng):
    points = rng.standard_normal((300, 3))
    for given in (2.0 * points, points + 1.0):
        assert refused(given, stats.norm())
    points[:, 1] = 0.1
    assert refused(points, stats.norm()) == "a parameter has the same value in all points"
