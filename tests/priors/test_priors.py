"""Prior densities against scipy.stats, and the properties of a joint prior."""

import math
import pickle
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import log_ndtr, ndtr

from fe_likelihoods.priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from fe_likelihoods.priors.priors import Prior


def truncated(mean, sd, lower=0.0, upper=math.inf):
    return stats.truncnorm((lower - mean) / sd, (upper - mean) / sd, mean, sd)


PAIRS = {
    "truncated normal": (TruncatedNormal(1.0, 0.6), truncated(1.0, 0.6)),
    "both sides": (TruncatedNormal(1.0, 0.5, 0.2, 2.5), truncated(1.0, 0.5, 0.2, 2.5)),
    "plain normal": (TruncatedNormal(-3.0, 2.0, -math.inf), stats.norm(-3.0, 2.0)),
    "upper tail only": (TruncatedNormal(-2.0, 0.1), truncated(-2.0, 0.1)),
    "lower tail only": (TruncatedNormal(3.0, 0.1, 0.0, 1.0), truncated(3.0, 0.1, 0.0, 1.0)),
    "mean at the bound": (TruncatedNormal(0.0, 0.3, 1e-3), truncated(0.0, 0.3, 1e-3)),
    "small unit": (TruncatedNormal(2e-4, 1.2e-4), truncated(2e-4, 1.2e-4)),
    "half normal": (HalfNormal(0.98), stats.halfnorm(0.0, 0.98)),
    "uniform": (Uniform(-1.0, 3.0), stats.uniform(-1.0, 4.0)),
    "log-normal": (LogNormal(2.0, 0.4), stats.lognorm(0.4, scale=2.0)),
    "wide log-normal": (LogNormal(1e-4, 2.0), stats.lognorm(2.0, scale=1e-4)),
}
both = pytest.mark.parametrize(("ours", "theirs"), PAIRS.values(), ids=PAIRS.keys())


@both
def test_density_equals_scipy_far_into_the_tails(ours, theirs):
    low, high = ours.bounds
    centre, sd = theirs.mean(), theirs.std()
    x = np.concatenate([centre + sd * np.linspace(-30, 30, 301), theirs.ppf(np.linspace(0.01, 0.99, 50)), [low, high]])
    expected = theirs.logpdf(x)
    np.testing.assert_allclose(ours.logpdf(x), expected, rtol=1e-12, atol=1e-13)
    assert np.isfinite(expected).sum() >= 50
    assert ours.logpdf(float(x[0])) == ours.logpdf(x)[0]


SCORES = np.concatenate([np.linspace(-37.0, 37.0, 1481), [-1e-3, 1e-9, 1e-3]])


@both
def test_quantiles_are_those_of_normal_scores(ours, theirs):
    """Of small probabilities by `ppf`, and of small probabilities above by `isf`."""
    z = -np.linspace(0.0, 30.0, 301)
    low, high = ours.bounds
    spacing = 8 * np.spacing(max(abs(getattr(ours, "mean", 0.0)), getattr(ours, "sd", 0.0)))
    np.testing.assert_allclose(ours.ppf(ndtr(z)), ours.from_normal(z), rtol=1e-10, atol=spacing)
    np.testing.assert_allclose(ours.isf(ndtr(z)), ours.from_normal(-z), rtol=1e-10, atol=spacing)
    np.testing.assert_allclose(ours.ppf([0.0, 1.0]), [low, high], rtol=1e-12, atol=spacing)
    np.testing.assert_array_equal(ours.isf([0.0, 1.0]), [high, low])


def slope(distribution, x, z):
    """dz / dx = p(x) / phi(z)."""
    return np.exp(distribution.logpdf(x) + 0.5 * z * z + 0.5 * math.log(2.0 * math.pi))


@both
def test_normal_scores_return_through_both_tails(ours, theirs):
    x = ours.from_normal(SCORES)
    low, high = ours.bounds
    assert ((x >= low) & (x <= high)).all()
    assert (np.diff(ours.from_normal(np.sort(SCORES))) >= 0.0).all()
    inside = (x > low) & (x < high)
    z, resolved = SCORES[inside], x[inside]
    # half a unit in the last place of x is lost where x is rounded, nothing else
    slack = 1e-11 + slope(ours, resolved, z) * np.spacing(np.abs(resolved))
    assert (np.abs(ours.to_normal(resolved) - z) <= slack).all()
    # next to a bound that is not zero, x resolves a few standard deviations only
    for side, bound in ((-1.0, low), (1.0, high)):
        reach = 3.7 if bound != 0.0 and np.isfinite(bound) else 37.0
        assert (slack < 1e-9)[(side * z > 0.0) & (side * z <= reach)].all()


@both
def test_normal_scores_have_the_probabilities_of_scipy(ours, theirs):
    z = SCORES[np.abs(SCORES) <= 30.0]
    x = ours.from_normal(z)
    inside = (x > ours.bounds[0]) & (x < ours.bounds[1])
    x, z = x[inside], z[inside]
    with np.errstate(all="ignore"):
        low, high = theirs.logcdf(x) - log_ndtr(z), theirs.logsf(x) - log_ndtr(-z)
    # scipy's probabilities of a truncated normal lose their digits next to a bound
    scale = max(abs(getattr(ours, "mean", 0.0)), getattr(ours, "sd", 0.0), 1e-300)
    lost = slope(ours, x, z) * (8 * np.finfo(float).eps * scale + np.spacing(np.abs(x)))
    error = np.where(z < 0.0, low, high)
    slack = 1e-10 + 2.0 * (1.0 + np.abs(z)) * lost
    assert (np.abs(error) <= slack)[lost < 1e-3].all()
    assert (lost < 1e-3).sum() > 100
    assert (np.abs(error + 1e-3) > slack)[lost < 1e-5].all()  # the test can fail


@pytest.mark.parametrize(
    ("distribution", "density"),
    [
        (TruncatedNormal(1.0, 0.6), truncated(1.0, 0.6).pdf(0.0)),
        (TruncatedNormal(-2.0, 0.1), truncated(-2.0, 0.1).pdf(0.0)),
        (HalfNormal(0.98), stats.halfnorm(0.0, 0.98).pdf(0.0)),
        (Uniform(0.0, 3.0), 1.0 / 3.0),
    ],
)
def test_values_next_to_a_bound_at_zero_have_all_their_digits(distribution, density):
    z = np.array([-9.0, -20.0, -37.0])
    np.testing.assert_allclose(distribution.from_normal(z), ndtr(z) / density, rtol=1e-11)  # F(x) = p(0) x


@both
def test_normal_scores_at_and_beyond_the_bounds(ours, theirs):
    low, high = ours.bounds
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(ours.from_normal([-np.inf, np.inf]), [low, high])
        beyond = [low, np.nextafter(low, -np.inf), high, np.nextafter(high, np.inf)]
        np.testing.assert_array_equal(ours.to_normal(beyond), [-np.inf, -np.inf, np.inf, np.inf])
        assert math.isnan(ours.to_normal(math.nan))
        assert math.isnan(ours.from_normal(math.nan))
        if low == 0.0:
            assert ours.to_normal(1e-300) < -5.0
    table = ours.from_normal(SCORES[:6].reshape(2, 3))
    np.testing.assert_array_equal(table.ravel(), [ours.from_normal(z) for z in SCORES[:6]])


class Triangular(Distribution):
    """Density 2 x on [0, 1], as a user would write it."""

    bounds = (0.0, 1.0)
    moments = (2.0 / 3.0, math.sqrt(1.0 / 18.0))

    def _log_density(self, x):
        return np.log(2.0 * x)

    def _quantile(self, u):
        return np.sqrt(u)


def test_normal_scores_of_a_distribution_with_quantiles_only():
    ours, theirs = Triangular(), stats.triang(1.0)
    z = np.concatenate([np.linspace(-36.0, 5.0, 400), [0.0]])
    x = ours.from_normal(z)
    np.testing.assert_allclose(theirs.cdf(x), ndtr(z), rtol=1e-12)
    assert (np.abs(ours.to_normal(x) - z) <= 1e-11 + slope(ours, x, z) * 2 * np.spacing(x)).all()
    assert ours.isf(0.19) == pytest.approx(0.9, rel=1e-14)
    assert ours.to_normal(0.0) == -np.inf
    assert ours.to_normal(1.0) == np.inf


@both
def test_moments_are_those_after_truncation(ours, theirs):
    np.testing.assert_allclose(ours.moments, (theirs.mean(), theirs.std()), rtol=1e-8)


@both
def test_outside_is_minus_infinity_without_a_warning(ours, theirs):
    low, high = ours.bounds
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ours.logpdf(math.nan) == -np.inf
        assert ours.logpdf(np.nextafter(low, -np.inf)) == -np.inf
        assert ours.logpdf(np.nextafter(high, np.inf)) == -np.inf
        values = ours.logpdf(np.array([-np.inf, -1e300, -5e-324, 0.0, 5e-324, 1e300, np.inf]))
    assert not np.isnan(values).any()
    assert (values < np.inf).all()


@pytest.mark.parametrize(
    ("mean", "sd", "lower", "upper"),
    [(0.0, 1e9, 0.0, 1.0), (0.0, 1.0, 3.0, 3.0 + 1e-6), (1.0, 0.2, -4.0, -4.0 + 1e-4), (0.0, 1.0, 0.999, 1.001)],
)
def test_narrow_truncation_stays_normalised(mean, sd, lower, upper):
    # an independent normalisation: the density relative to the lower bound, integrated over the interval
    distribution = TruncatedNormal(mean, sd, lower, upper)
    a, width = (lower - mean) / sd, (upper - lower) / sd

    def relative(t):
        return math.exp(-0.5 * t * (t + 2.0 * a))

    mass, _ = integrate.quad(relative, 0.0, width, epsabs=0.0, epsrel=1e-13)
    first, _ = integrate.quad(lambda t: t * relative(t), 0.0, width, epsabs=0.0, epsrel=1e-13)
    centre = first / mass
    second, _ = integrate.quad(lambda t: (t - centre) ** 2 * relative(t), 0.0, width, epsabs=0.0, epsrel=1e-13)
    assert distribution.logpdf(lower) == pytest.approx(-math.log(sd * mass), rel=1e-9)
    assert distribution.moments == pytest.approx((lower + sd * centre, sd * math.sqrt(second / mass)), rel=1e-9)


@pytest.mark.parametrize(
    "make",
    [
        lambda: TruncatedNormal(1.0, 0.0),
        lambda: TruncatedNormal(math.nan, 1.0),
        lambda: TruncatedNormal(1.0, math.inf),
        lambda: TruncatedNormal(1.0, 1.0, 2.0, 2.0),
        lambda: TruncatedNormal(1.0, 1.0, math.nan),
        lambda: TruncatedNormal(-50.0, 1.0),
        lambda: TruncatedNormal(1e10, 1.0, 0.0, 1e-12),
        lambda: TruncatedNormal(0.0, 1e-300, 1e300),
        lambda: HalfNormal(0.0),
        lambda: Uniform(1.0, 1.0),
        lambda: Uniform(0.0, math.inf),
        lambda: Uniform(-1.7e308, 1.7e308),
        lambda: LogNormal(0.0, 1.0),
        lambda: LogNormal(1.0, 0.0),
        lambda: HalfNormal(1.0).ppf(1.5),
        lambda: Prior({}),
        lambda: Prior({"a": 1.0}),
        lambda: Prior([HalfNormal(1.0)]),
        lambda: Prior({"a": HalfNormal(1.0)}).logpdf(np.zeros((3, 2))),
        lambda: Prior({"a": HalfNormal(1.0)}).logpdf(0.5),
        lambda: Prior({"a": HalfNormal(1.0)}).transform([1.5]),
    ],
)
def test_invalid_arguments_are_refused(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=r"got|float can hold"):
            make()


@pytest.fixture
def prior():
    return Prior({name: ours for name, (ours, _) in PAIRS.items()})


def test_prior_is_the_sum_of_its_densities(prior, seed):
    x = prior.rvs(200, seed)
    x[::7, 3] = -1.0  # outside
    x[5, 0] = math.nan
    expected = sum(theirs.logpdf(column) for (_, theirs), column in zip(PAIRS.values(), x.T, strict=True))
    expected[5] = -np.inf
    got = prior.logpdf(x)
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert np.isneginf(got).sum() == len(range(0, 200, 7)) + 1
    assert [prior.logpdf(row) for row in x] == got.tolist()  # a point and a batch give the same bits
    assert isinstance(prior.logpdf(x[0]), float)
    assert prior.logpdf(x[:0]).shape == (0,)


def test_draws_depend_on_the_seed_only(prior):
    def draws(random_state):
        return prior.rvs(5, random_state)

    np.testing.assert_array_equal(draws(3), draws(3))
    np.testing.assert_array_equal(draws(3), draws(np.random.default_rng(3)))
    np.testing.assert_array_equal(draws(np.random.RandomState(3)), draws(np.random.RandomState(3)))
    assert (draws(3) != draws(4)).any()
    np.random.seed(3)  # noqa: NPY002
    first = draws(None)
    np.random.seed(3)  # noqa: NPY002
    np.testing.assert_array_equal(first, draws(None))


def test_equal_distributions_are_mapped_together_with_the_same_bits(seed):
    each = [TruncatedNormal(1.0, 0.2), HalfNormal(0.3), TruncatedNormal(1.0, 0.2), LogNormal(1.0, 0.2), HalfNormal(0.3)]
    prior = Prior(dict(zip("abcde", each, strict=True))).reorder("ebcda")
    z = 3.0 * np.random.default_rng(seed).standard_normal((500, 5))
    x, alone = prior.from_normal(z), [each["abcde".index(name)] for name in prior.names]
    np.testing.assert_array_equal(x.T, [one.from_normal(scores) for one, scores in zip(alone, z.T, strict=True)])
    np.testing.assert_array_equal(prior.to_normal(x).T, [one.to_normal(v) for one, v in zip(alone, x.T, strict=True)])
    np.testing.assert_array_equal(prior.from_normal(z[7]), x[7])


@dataclass(frozen=True)
class Histogram(Triangular):
    edges: np.ndarray

    def _quantile(self, u):
        return np.interp(u, [0.0, 0.5, 1.0], self.edges)


class Doubled(LogNormal):
    factor = 1.0

    def _from_normal(self, z):
        return self.factor * super()._from_normal(z)


def test_distributions_of_a_users_class_are_mapped_by_their_own_maps():
    """Also where they compare arrays, or compare equal without being equal."""
    doubled = Doubled(1.0, 0.2)
    object.__setattr__(doubled, "factor", 2.0)
    each = [Histogram(np.array([0.0, 0.1, 1.0])), Histogram(np.array([0.0, 0.9, 1.0])), Doubled(1.0, 0.2), doubled]
    x = Prior(dict(zip("abcd", each, strict=True))).from_normal(np.zeros(4))
    np.testing.assert_allclose(x, [0.1, 0.9, each[2].from_normal(0.0), 2.0 * each[2].from_normal(0.0)])


def test_reorder_keeps_the_density(prior, seed):
    names = prior.names[::-1]
    x = prior.rvs(4, seed)
    turned = prior.reorder(names)
    assert turned.names == names
    np.testing.assert_allclose(turned.logpdf(x[:, ::-1]), prior.logpdf(x), rtol=1e-14)
    np.testing.assert_array_equal(turned.bounds, prior.bounds[::-1])
    with pytest.raises(ValueError, match="uniform.*half normal|half normal.*uniform"):
        prior.reorder(("uniform",))
    assert pickle.loads(pickle.dumps(turned)).names == names


@pytest.mark.parametrize(
    "frozen",
    [
        stats.norm(0.0, 1.0),
        stats.lognorm(0.3),
        stats.uniform(-1.0, 2.0),
        stats.gamma(2.0, scale=0.5),
        stats.truncnorm(-1.0, 2.0, loc=1.0),
        stats.multivariate_normal([0.0, 1.0], [[1.0, 0.3], [0.3, 2.0]]),
    ],
    ids=lambda frozen: getattr(getattr(frozen, "dist", None), "name", "multivariate_normal"),
)
def test_frozen_distributions_of_scipy_are_priors(frozen):
    joint = not hasattr(frozen, "support")
    prior = Prior({("a", "b") if joint else "a": frozen})
    x = prior.rvs(2000, 3)
    assert x.shape == (2000, 1 + joint)
    np.testing.assert_allclose(prior.logpdf(x), frozen.logpdf(x if joint else x[:, 0]), rtol=1e-12, atol=1e-12)
    assert stats.kstest(x[:, 0], stats.norm.cdf if joint else frozen.cdf).pvalue > 1e-3
    np.testing.assert_allclose(prior.transform(np.full(1 + joint, 0.3))[0], (stats.norm if joint else frozen).ppf(0.3))
    assert joint or tuple(prior.bounds[0]) == frozen.support()
    np.testing.assert_allclose(prior.from_normal(prior.to_normal(x[:9])), x[:9], rtol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (stats.poisson(3.0), "frozen continuous distribution of scipy.stats, such as"),
        (stats.norm, "freeze it with its parameters"),
        (stats.norm([0.0, 1.0], 1.0), "has arrays as parameters"),
        (stats.multivariate_normal([0.0, 0.0]), "a tuple of their names"),
        (3.0, "got 3.0"),
    ],
)
def test_other_objects_are_no_priors(wrong, message):
    with pytest.raises(ValueError, match=message):
        Prior({"a": wrong})
