"""Mixtures, shears and support bounds: draws follow the stated density, and fits do not depend on units."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from samplers import MixtureMove
from samplers.proposals.mixture import draw, fit_mixture, fit_normals, log_density, log_responsibilities
from samplers.proposals.transforms import (
    SupportBounds,
    apply_shears,
    find_shears,
    find_support_bounds,
    from_unbounded,
    invert_shears,
    log_abs_det_jacobian,
    to_unbounded,
)


def uniform(n):
    return np.full(n, 1.0 / n)


def banana(rng, n=2000):
    x = rng.standard_normal((n, 3))
    x[:, 1] = 0.1 * x[:, 1] + x[:, 0] ** 2
    return x


def groups(rng, n=2000):
    """Two groups separated in one direction of eight, which is not a principal component."""
    x = rng.standard_normal((n, 8))
    second = rng.uniform(size=n) < 0.3
    x[:, 4] = 0.2 * x[:, 4] + np.where(second, 2.0, -1.0)
    return x, second


def test_groups_are_found(rng):
    x, second = groups(rng)
    mixture = fit_mixture(x, uniform(len(x)))
    assert len(mixture.weights) == 2
    owner = log_responsibilities(mixture, x).argmax(axis=1) == mixture.weights.argmin()
    assert np.mean(owner == second) > 0.995
    assert mixture.weights.min() == pytest.approx(second.mean(), abs=0.01)


@pytest.mark.parametrize("ndim", [2, 5])
def test_degrees_of_freedom_follow_the_tails(ndim, rng):
    """Fits to a Gaussian keep six; fits to a Student t get fewer where the density is better for it."""
    normal = rng.standard_normal((400, ndim))
    assert fit_mixture(normal, uniform(400)).dof == 6.0
    student = stats.multivariate_t(np.zeros(ndim), np.eye(ndim), df=2.5, seed=1)
    x = student.rvs(2000).reshape(-1, ndim)
    mixture = fit_mixture(x[:1000], uniform(1000))
    assert mixture.dof <= 3.0
    fresh = x[1000:]
    found = np.mean(log_density(mixture, fresh) - student.logpdf(fresh))
    six = mixture._replace(dof=6.0)
    assert found > -0.05 and found > np.mean(log_density(six, fresh) - student.logpdf(fresh))


def test_weights_count_as_points(rng):
    """Weighted points give the mixture of the population that they represent."""
    x = 2.0 * rng.standard_normal((40000, 2))
    log_weights = -0.5 * np.sum((x - 1.0) ** 2, axis=1) + 0.5 * np.sum((x / 2.0) ** 2, axis=1)
    weights = np.exp(log_weights - logsumexp(log_weights))
    mixture = fit_mixture(x, weights, max_components=1)
    effective = 1.0 / (weights @ weights)
    assert np.allclose(mixture.means[0], 1.0, atol=5 / np.sqrt(effective))


@pytest.mark.parametrize("population", [lambda rng: groups(rng)[0][:, 3:6], banana], ids=["groups", "banana"])
def test_draws_follow_the_stated_density(rng, population):
    x = population(rng)
    mixture = fit_mixture(x, uniform(len(x)))
    drawn = draw(mixture, 100_000, rng)
    # importance sampling of a known density, a Gaussian narrower than a component: mean weight 1, correct moments
    mean, root = mixture.means[0], 0.7 * mixture.roots[0]
    transformed = apply_shears(mixture.shears, drawn)
    log_reference = stats.multivariate_normal(mean, root @ root.T).logpdf(transformed)
    weights = np.exp(log_reference - log_density(mixture, drawn))
    assert abs(weights.mean() - 1.0) < 4.5 * weights.std() / np.sqrt(len(drawn))
    errors = weights[:, None] * (transformed - mean)
    assert np.all(np.abs(errors.mean(axis=0)) < 4.5 * errors.std(axis=0) / np.sqrt(len(drawn)))
    # negative control: the density of another mixture fails the same test
    wrong = np.exp(log_reference - log_density(mixture._replace(means=mixture.means + 0.1 * x.std(axis=0)), drawn))
    assert abs(wrong.mean() - 1.0) > 4.5 * wrong.std() / np.sqrt(len(drawn))


def test_shears_remove_curvature_and_are_inverted(rng):
    x = banana(rng)
    shears = find_shears(x, uniform(len(x)))
    assert [(s.target, s.source) for s in shears] == [(1, 0)]
    transformed = apply_shears(shears, x)
    assert np.allclose(invert_shears(shears, transformed), x, rtol=0, atol=1e-12)
    assert transformed[:, 1].std() < 0.15
    assert fit_mixture(x, uniform(len(x))).shears == shears


@pytest.mark.parametrize("population", [lambda rng: groups(rng)[0], banana], ids=["groups", "banana"])
def test_fits_follow_units(rng, population):
    x = population(rng)
    units = 10.0 ** rng.uniform(-11, 11, size=x.shape[1])
    plain, scaled = fit_mixture(x, uniform(len(x))), fit_mixture(x * units, uniform(len(x)))
    assert np.allclose(scaled.weights, plain.weights, rtol=1e-6)
    assert np.allclose(log_density(scaled, x * units) + np.sum(np.log(units)), log_density(plain, x), rtol=0, atol=1e-5)
    again = fit_mixture(x * 2.0**-14, uniform(len(x)))
    assert np.array_equal(again.weights, plain.weights)


@pytest.mark.parametrize("kernel", ["draw_independence", "draw_local_walk", "draw_differences"])
def test_each_kernel_keeps_the_target(kernel, rng):
    """Exact draws of a curved target with two groups remain exact, even if the proposal was fitted to other points."""

    def log_target(x):
        curved = stats.norm.logpdf(x[:, 1] - x[:, 0] ** 2, 0, 0.5)
        return np.logaddexp(stats.norm.logpdf(x[:, 0], -1, 0.3), stats.norm.logpdf(x[:, 0], 1.5, 0.5)) + curved

    n = 40_000
    first = np.where(rng.uniform(size=n) < 0.5, rng.normal(-1, 0.3, n), rng.normal(1.5, 0.5, n))
    x = np.column_stack([first, rng.normal(first**2, 0.5)])
    move = MixtureMove()
    fitted = x[:300] * np.array([1.1, 0.9])
    move.calibrate(fitted, uniform(300))
    random = np.random.RandomState(rng.integers(2**31))
    start = x.copy()
    for _ in range(5):
        proposed, factors = getattr(move, kernel)(x, random)
        accepted = np.log(random.uniform(size=n)) < log_target(proposed) - log_target(x) + factors
        x = np.where(accepted[:, None], proposed, x)
    assert accepted.mean() > 0.1
    assert np.mean(np.any(x != start, axis=1)) > 0.3
    for column in (0, 1):
        assert stats.ks_2samp(x[: n // 2, column], start[n // 2 :, column]).pvalue > 1e-4
    assert abs(np.mean(x[:, 0] > 0.2) - np.mean(start[:, 0] > 0.2)) < 4.5 * np.sqrt(0.5 / n)


# ---------------------------------------------------------------- support bounds


def box(low, high):
    return lambda x: np.all((x >= low) & (x <= high), axis=1)


@pytest.mark.parametrize("unit", [1e-11, 1.0, 1e11])
def test_bounds_are_found(rng, unit):
    low, high = np.array([0.0, -3.0, -np.inf, -np.inf]) * unit, np.array([np.inf, 7.0, 5.0, np.inf]) * unit
    points = rng.uniform(-1, 1, size=(100, 4)) * unit + np.array([1.5, 2.0, 3.0, 0.0]) * unit
    bounds = find_support_bounds(box(low, high), points)
    assert np.array_equal(np.isfinite(bounds.low), np.isfinite(low))
    assert np.array_equal(np.isfinite(bounds.high), np.isfinite(high))
    finite = np.isfinite(low)
    assert np.allclose(bounds.low[finite], low[finite], rtol=0, atol=1e-14 * unit)
    assert np.all(bounds.low <= low) and np.all(bounds.high >= high)  # points in the support never lie beyond a bound


def test_transformation_is_inverted_and_its_jacobian_is_right(rng):
    bounds = SupportBounds(np.array([0.0, -3.0, -np.inf, -np.inf]), np.array([np.inf, 7.0, 5.0, np.inf]), np.ones(4))
    x = np.array([1.0, 2.0, 4.0, 0.0]) + 0.9 * rng.uniform(-1, 1, size=(50, 4))
    assert np.allclose(from_unbounded(bounds, to_unbounded(bounds, x)), x, rtol=1e-12)
    step = 1e-6
    slopes = [
        (to_unbounded(bounds, x + step * e) - to_unbounded(bounds, x - step * e))[:, j] for j, e in enumerate(np.eye(4))
    ]
    assert np.allclose(
        log_abs_det_jacobian(bounds, x), np.sum(np.log(np.array(slopes) / (2 * step)), axis=0), atol=1e-6
    )
    assert np.all(log_abs_det_jacobian(bounds, x - [10, 0, 0, 0]) == -np.inf)


def corner(rng, n):
    return rng.exponential(size=(n, 3)) * np.array([1e-3, 1.0, 1e3])


def test_mixture_fits_a_density_at_its_bounds(rng):
    """At the corner of an exponential density, draws follow the density of the mixture, and it fits closely."""
    scale = np.array([1e-3, 1.0, 1e3])
    x = corner(rng, 2000)
    bounds = find_support_bounds(box(np.zeros(3), np.full(3, np.inf)), x)
    mixture = fit_mixture(x, uniform(2000), bounds=bounds)
    assert np.all(np.isfinite(mixture.bounds.low))
    drawn = draw(mixture, 20_000, rng)
    assert drawn.min() > -1e-12
    weights = np.exp(-np.sum(drawn / scale, axis=1) - np.sum(np.log(scale)) - log_density(mixture, drawn))
    assert abs(weights.mean() - 1.0) < 4.5 * weights.std() / np.sqrt(len(drawn))
    assert weights.sum() ** 2 / np.sum(weights**2) > 0.6 * len(drawn)


@pytest.mark.parametrize("kernel", ["draw_independence", "draw_local_walk", "draw_differences"])
def test_each_kernel_keeps_a_target_at_a_bound(kernel, rng):
    n = 20_000
    x = corner(rng, n)
    scale = np.array([1e-3, 1.0, 1e3])
    inside = box(np.zeros(3), np.full(3, np.inf))
    move = MixtureMove()
    move.calibrate(x[:300] * np.array([1.1, 0.9, 1.0]), uniform(300), inside)
    assert move.mixture.bounds is not None
    random = np.random.RandomState(rng.integers(2**31))
    start = x.copy()
    for _ in range(5):
        proposed, factors = getattr(move, kernel)(x, random)
        change = np.where(inside(proposed), -np.sum((proposed - x) / scale, axis=1), -np.inf)
        accepted = np.log(random.uniform(size=n)) < change + factors
        x = np.where(accepted[:, None], proposed, x)
    assert accepted.mean() > 0.1
    for column in range(3):
        assert stats.ks_2samp(x[: n // 2, column], start[n // 2 :, column]).pvalue > 1e-4


@pytest.mark.parametrize("distinct", [1, 2, 3, 4])
def test_a_population_of_few_different_points_gives_finite_mixtures(rng, distinct):
    """After a collapse, three different points are left of 150: every parabola goes through them."""
    points = rng.normal(size=(distinct, 5))
    coords = points[rng.integers(distinct, size=150)]
    weights = np.full(150, 1.0 / 150)
    assert not any(abs(shear.quadratic) > 1e6 for shear in find_shears(coords, weights))
    mixture = fit_mixture(coords, weights)
    assert np.isfinite(mixture.means).all() and np.isfinite(mixture.roots).all()
    assert np.isfinite(draw(mixture, 20, np.random.RandomState(1))).all()


@pytest.mark.parametrize("copies", [1, 5])
def test_normal_components_describe_two_groups_of_points_with_copies(copies, rng):
    """The mean log-density of fresh points is below the true one by what 55 fitted numbers cost: 55 / (2 * 300)."""

    def points(n):
        return 0.5 * rng.standard_normal((n, 6)) + 4.0 * np.outer(rng.random(n) < 0.3, np.eye(6)[0])

    def log_true(x):
        shares = (0.7, 0.0), (0.3, 4.0)
        groups = [np.log(share) + stats.norm(at * np.eye(6)[0], 0.5).logpdf(x).sum(axis=1) for share, at in shares]
        return np.logaddexp(*groups)

    mixture = fit_normals(np.repeat(points(300), copies, axis=0), 300.0)
    assert len(mixture.weights) == 2
    fresh = points(4000)
    assert (log_true(fresh) - log_density(mixture, fresh)).mean() == pytest.approx(0.09, abs=0.04)
    again = fit_normals(points(300), 300.0, start=mixture)
    np.testing.assert_allclose(again.weights, mixture.weights, atol=0.15)


def test_bounds_that_depend_on_other_parameters_are_not_used(rng):
    points = np.sort(rng.uniform(size=(200, 2)), axis=1)
    bounds = find_support_bounds(lambda x: (0 <= x[:, 0]) & (x[:, 0] <= x[:, 1]) & (x[:, 1] <= 1), points)
    assert bounds.high[0] == np.inf and bounds.low[1] == -np.inf
    assert bounds.low[0] == pytest.approx(0, abs=1e-12) and bounds.high[1] == pytest.approx(1)
