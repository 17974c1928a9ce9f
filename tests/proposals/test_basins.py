"""Basins: points of another mode get a component of their own; a mixture that covers its target stays as it is."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from samplers.proposals.basins import find_basins, with_components
from samplers.proposals.mixture import fit_mixture

WIDE, NARROW = 1.0, 0.6
DISTANCE = 6.0


def log_target(x, shift=True):
    """Two modes in five dimensions, the narrow one with a tenth of the mass; or the wide one alone."""
    centre = np.zeros(5)
    wide = multivariate_normal(centre, WIDE**2).logpdf(x)
    if not shift:
        return wide
    centre[0] = DISTANCE
    return np.logaddexp(np.log(0.9) + wide, np.log(0.1) + multivariate_normal(centre, NARROW**2).logpdf(x))


def cloud(rng, n=400):
    return WIDE * rng.standard_normal((n, 5))


def flank(rng, n):
    """Points on the flank of the narrow mode: three to five of its standard deviations from its centre."""
    away = rng.standard_normal((n, 5))
    away *= rng.uniform(3.0, 5.0, (n, 1)) * NARROW / np.linalg.norm(away, axis=1, keepdims=True)
    return away + np.array([DISTANCE, 0.0, 0.0, 0.0, 0.0])


def uniform(x):
    return np.full(len(x), 1.0 / len(x))


@pytest.mark.parametrize(("n", "nearest"), [(8, 4.0), (25, 4.0), (80, 1e-3)])
def test_a_mode_is_found_from_points_on_its_flank(rng, n, nearest):
    """With enough points the component is exact, with few it is at the points."""
    coords = np.concatenate([cloud(rng), flank(rng, n)])
    mixture = fit_mixture(coords[:400], uniform(coords[:400]))
    covered = with_components(mixture, find_basins(mixture, coords, log_target(coords)))
    assert len(mixture.weights) == 1 and (len(covered.weights) == 2 or n == 8)
    assert covered.weights.sum() == pytest.approx(1.0) and 0.1 <= covered.weights[1] <= 0.25
    error = covered.means[1] - np.array([DISTANCE, 0.0, 0.0, 0.0, 0.0])
    scale = np.sqrt(np.diag(covered.roots[1] @ covered.roots[1].T) * 1.5)
    assert np.linalg.norm(error) < nearest * NARROW
    assert np.all(scale < 1.6 * WIDE)
    if n == 80:
        assert np.allclose(scale, NARROW, rtol=1e-2)


def test_a_covered_target_is_left_alone(rng):
    coords = cloud(rng)
    mixture = fit_mixture(coords, uniform(coords))
    assert find_basins(mixture, coords, log_target(coords, shift=False)) is None


def test_roughness_is_no_basin(rng):
    """Errors of the log-density do not make components."""
    coords = cloud(rng)
    mixture = fit_mixture(coords, uniform(coords))
    rough = log_target(coords, shift=False) + rng.uniform(-1.5, 1.5, len(coords))
    assert find_basins(mixture, coords, rough) is None
