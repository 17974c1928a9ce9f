"""Basins: points of another mode get a component of their own; a mixture that covers its target stays as it is."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from samplers.proposals.basins import cover_basins
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


@pytest.mark.parametrize(("n", "nearest"), [(8, 4.0), (25, 2.0), (80, 1e-3)])
def test_a_mode_is_found_from_points_on_its_flank(rng, n, nearest):
    """With enough points the component is exact, with fewer it is near, with very few it is at the points."""
    coords = np.concatenate([cloud(rng), flank(rng, n)])
    mixture = fit_mixture(coords[:400], uniform(coords[:400]))
    covered = cover_basins(mixture, coords, log_target(coords))
    assert len(mixture.weights) == 1 and (len(covered.weights) == 2 or n == 8)
    assert covered.weights.sum() == pytest.approx(1.0) and 0.1 <= covered.weights[1] <= 0.25
    error = covered.means[1] - np.array([DISTANCE, 0.0, 0.0, 0.0, 0.0])
    scale = np.sqrt(np.diag(covered.roots[1] @ covered.roots[1].T) * 1.5)
    assert np.linalg.norm(error) < nearest * NARROW
    assert np.all(scale < 1.6 * WIDE)
    if n == 80:
        assert np.allclose(scale, np.sqrt(1.2) * NARROW, rtol=1e-2)


def test_a_covered_target_is_left_alone(rng):
    coords = cloud(rng)
    mixture = fit_mixture(coords, uniform(coords))
    assert cover_basins(mixture, coords, log_target(coords, shift=False)) is mixture


def test_roughness_is_no_basin(rng):
    """Errors of the log-density do not make components."""
    coords = cloud(rng)
    mixture = fit_mixture(coords, uniform(coords))
    rough = log_target(coords, shift=False) + rng.uniform(-1.5, 1.5, len(coords))
    assert cover_basins(mixture, coords, rough) is mixture


def test_a_component_that_is_far_from_its_quadratic_is_corrected(rng):
    """A component fitted to points three times as wide as the target."""
    coords = 3.0 * cloud(rng)
    mixture = fit_mixture(coords, uniform(coords))
    covered = cover_basins(mixture, coords, log_target(coords, shift=False))
    assert len(covered.weights) == 2
    assert np.allclose(covered.means[1], 0.0, atol=1e-2)
    assert np.allclose(covered.roots[1] @ covered.roots[1].T * 1.5, 1.2 * np.eye(5), atol=1e-2)


def test_a_constant_and_the_units_change_nothing(rng):
    coords = np.concatenate([cloud(rng), flank(rng, 30)])
    units = np.array([1e-4, 1.0, 3e10, 1e-9, 5.0])
    plain, scaled = (
        cover_basins(fit_mixture(x[:400], uniform(x[:400])), x, log_target(coords) + offset)
        for x, offset in ((coords, 0.0), (coords * units, -np.log(units).sum()))
    )
    assert np.allclose(scaled.means / units, plain.means, atol=1e-3)
    assert np.allclose(scaled.weights, plain.weights, rtol=1e-3)


def several_modes(x, centres, log_masses, width=NARROW):
    """The wide mode at the origin, and narrow ones at given centres."""
    wide = multivariate_normal(np.zeros(5), WIDE**2).logpdf(x)
    narrow = [m + multivariate_normal(c, width**2).logpdf(x) for c, m in zip(centres, log_masses, strict=True)]
    return np.logaddexp.reduce([wide, *narrow])


def flanks(rng, centres, n):
    """Points three to five narrow standard deviations from each centre."""
    return np.concatenate([flank(rng, n) - DISTANCE * np.eye(5)[0] + centre for centre in centres])


def test_two_unknown_modes_are_two_basins(rng):
    """Their points are not fitted as one mode between them."""
    centres = DISTANCE * np.eye(5)[[0, 1]]
    coords = np.concatenate([cloud(rng), flanks(rng, centres, 60)])
    mixture = fit_mixture(coords[:400], uniform(coords[:400]))
    covered = cover_basins(mixture, coords, several_modes(coords, centres, (-2.0, -2.5)))
    assert len(covered.weights) == 3
    distances = np.linalg.norm(covered.means[1:, None] - centres, axis=2)
    assert np.all(distances.min(axis=0) < 0.01) and set(distances.argmin(axis=1)) == {0, 1}


def test_a_flank_that_two_components_share_is_one_basin(rng):
    """Half of the points belong to each of the components, and neither has enough of them alone."""
    middle = 0.5 * DISTANCE * np.array([1.0, 1.4, 0.0, 0.0, 0.0])
    second = DISTANCE * np.eye(5)[0]
    coords = np.concatenate([cloud(rng), second + cloud(rng), flanks(rng, [middle], 34)])
    mixture = fit_mixture(coords[:800], uniform(coords[:800]))
    assert len(mixture.weights) == 2
    values = np.logaddexp(several_modes(coords, [middle], (-1.0,)), multivariate_normal(second, WIDE**2).logpdf(coords))
    owner = np.linalg.norm(coords[800:], axis=1) < np.linalg.norm(coords[800:] - second, axis=1)
    assert 10 <= np.count_nonzero(owner) <= 24
    covered = cover_basins(mixture, coords, values)
    assert min(np.linalg.norm(covered.means[2:] - middle, axis=1)) < 0.1


def test_roughness_far_from_the_mode_is_no_basin(rng):
    """There the fitted quadratic is wrong by more than the errors of the log-density."""
    coords = np.concatenate([cloud(rng), rng.uniform(3.0, 8.0, (200, 1)) * cloud(rng, 200)])
    mixture = fit_mixture(coords[:400], uniform(coords[:400]))
    rough = log_target(coords, shift=False) + rng.uniform(-1.5, 1.5, len(coords))
    assert cover_basins(mixture, coords, rough) is mixture
