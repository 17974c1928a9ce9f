"""Mixtures, shears and support bounds: draws follow the stated density, and fits do not depend on units."""

import numpy as np
import pytest
from scipy import stats

from samplers.moves.population_moves import MixtureMove
from samplers.proposals.mixture import Mixture, draw, fit_mixture, invert_roots, log_density, log_responsibilities
from samplers.proposals.transforms import (
    apply_shears,
    find_shears,
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


@pytest.mark.parametrize("population", [lambda rng: groups(rng)[0], banana], ids=["groups", "banana"])
def test_fits_follow_units(rng, population):
    x = population(rng)
    units = 10.0 ** rng.uniform(-11, 11, size=x.shape[1])
    plain, scaled = fit_mixture(x, uniform(len(x))), fit_mixture(x * units, uniform(len(x)))
    assert np.allclose(scaled.weights, plain.weights, rtol=1e-6)
    assert np.allclose(log_density(scaled, x * units) + np.sum(np.log(units)), log_density(plain, x), rtol=0, atol=1e-5)
    again = fit_mixture(x * 2.0**-14, uniform(len(x)))
    assert np.array_equal(again.weights, plain.weights)


def curved(rng, n):
    """Exact draws of a curved target with two groups, its log-density, and its support."""
    first = np.where(rng.uniform(size=n) < 0.5, rng.normal(-1, 0.3, n), rng.normal(1.5, 0.5, n))

    def log_target(x):
        along = stats.norm.logpdf(x[:, 1] - x[:, 0] ** 2, 0, 0.5)
        return np.logaddexp(stats.norm.logpdf(x[:, 0], -1, 0.3), stats.norm.logpdf(x[:, 0], 1.5, 0.5)) + along

    return np.column_stack([first, rng.normal(first**2, 0.5)]), log_target, None


def corner(rng, n):
    """Exponentials of very different scales, which are largest at the corner of their support."""
    scale = np.array([1e-3, 1.0, 1e3])

    def inside(x):
        return np.all(x >= 0.0, axis=1)

    def log_target(x):
        return np.where(inside(x), -np.sum(x / scale, axis=1), -np.inf)

    return rng.exponential(size=(n, 3)) * scale, log_target, inside


def overlapping(rng, n):
    """Normal draws, and a proposal with two components that overlap."""
    roots = np.repeat(np.eye(2)[None], 2, axis=0)
    mixture = Mixture(np.array([0.7, 0.3]), np.array([[-0.8, 0.0], [0.8, 0.0]]), roots, invert_roots(roots), 6.0)
    return rng.standard_normal((n, 2)), lambda x: stats.norm.logpdf(x).sum(axis=1), None, mixture


def test_bends_are_found_in_correlated_parameters(rng):
    """Ten bends that explain a tenth of the variance, but most of what the other parameters leave of it: 31 to 37 % of
    the draws of five fits are effective. With one linear term, 5 to 9 bends are found, and 6 to 30 % effective."""
    axes = np.linalg.qr(np.random.default_rng(1001).standard_normal((20, 20)))[0]
    root = axes * np.geomspace(0.05, 0.5, 20)

    def bend(x, sign):
        return np.column_stack([x[:, :10], x[:, 10:] + sign * x[:, :10] ** 2])

    for _ in range(2):
        x = bend(rng.standard_normal((400, 20)) @ root.T, 1.0)
        mixture = fit_mixture(x, uniform(400))
        assert len(mixture.shears) == 10
        y = draw(mixture, 4000, np.random.RandomState(1))
        log_target = stats.norm.logpdf(np.linalg.solve(root, bend(y, -1.0).T)).sum(axis=0)
        weights = np.exp(log_target - log_density(mixture, y))
        assert weights.sum() ** 2 / (weights @ weights) > 0.25 * len(y)


@pytest.mark.parametrize("kernel", ["_draw_independence", "_draw_local_walk", "_draw_differences"])
@pytest.mark.parametrize(("target", "n"), [(curved, 40_000), (corner, 20_000), (overlapping, 40_000)])
def test_each_kernel_keeps_the_target(kernel, target, n, rng):
    """Exact draws remain exact, even if the proposal was fitted to other points."""
    start, log_target, inside, *mixture = target(rng, n)
    x, move, random = start.copy(), MixtureMove(), np.random.RandomState(rng.integers(2**31))
    move.calibrate(x[:300] * np.array([1.1, 0.9, 1.0])[: x.shape[1]], uniform(300), inside, *mixture)
    assert bool(move._mixtures[-1].bounds) == (inside is not None)
    for _ in range(5):
        proposed, factors = getattr(move, kernel)(x, random)
        accepted = np.log(random.uniform(size=n)) < log_target(proposed) - log_target(x) + factors
        x = np.where(accepted[:, None], proposed, x)
    assert accepted.mean() > 0.1 and np.mean(np.any(x != start, axis=1)) > 0.3
    for ours, theirs in zip(x[: n // 2].T, start[n // 2 :].T, strict=True):
        assert stats.ks_2samp(ours, theirs).pvalue > 1e-4
    if target is curved:
        assert abs(np.mean(x[:, 0] > 0.2) - np.mean(start[:, 0] > 0.2)) < 4.5 * np.sqrt(0.5 / n)


def test_bounds_of_a_parameter_that_others_follow_linearly_stay(rng):
    """Beside two exponentials at their bounds, four parameters follow a bounded one closely: to remove its bounds too,
    or none, leaves 11 to 21 % of the draws effective instead of 44 to 47 %."""
    n, low, high = 300, np.r_[np.full(4, -np.inf), 0.0, 0.0, -np.inf], np.r_[np.full(4, np.inf), 1.0, np.inf, 1.0]
    slope, width = np.array([0.6, -0.3, 0.2, 0.5]), np.array([0.002, 0.005, 0.01, 0.003])
    x = np.column_stack([np.zeros((n, 4)), stats.truncexpon.rvs(3.0, scale=1 / 3, size=n, random_state=rng)])
    x = np.column_stack([x, rng.exponential(1 / 40, n), 1.0 - rng.exponential(1 / 200, n)])
    x[:, :4] = x[:, 4:5] * slope + width * rng.standard_normal((n, 4))
    mixture = fit_mixture(x, uniform(n), bounds=np.array([low, high]))
    assert [bound.index for bound in mixture.bounds] == [5, 6]

    y = draw(mixture, 20_000, np.random.RandomState(1))
    inside = np.all((y >= low) & (y <= high), axis=1)
    weights = (
        np.exp(
            stats.norm.logpdf(y[:, :4], y[:, 4:5] * slope, width).sum(axis=1)
            - y[:, 4:7] @ [3.0, 40.0, -200.0]
            - 200.0
            - log_density(mixture, y)
        )
        * inside
    )
    assert weights.sum() ** 2 / (weights @ weights) > 0.3 * len(y)


def test_bounds_of_bounded_parameters_that_follow_each_other_stay(rng):
    """Beside three exponentials at their bounds, four parameters pile up at theirs, nearly equal: none of them alone is
    better off in place. With all bounds removed, or none, runs of 250 walkers need 1.4 times the evaluations.
    """
    x = rng.exponential(1.0, 500)[:, None] + np.c_[np.zeros(500), 0.02 * rng.standard_normal((500, 3))]
    x = np.column_stack([x, rng.exponential(0.2, (500, 3))])[np.all(x > 0.0, axis=1)]
    mixture = fit_mixture(x, uniform(len(x)), bounds=np.array([np.zeros(7), np.full(7, 20.0)]))
    assert [bound.index for bound in mixture.bounds] == [4, 5, 6]


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
