"""Prior densities against scipy.stats, and the properties of a joint prior."""

import math
import pickle
import warnings

import numpy as np
import pytest
from scipy import integrate, stats

from fe_likelihoods.probability.priors import HalfNormal, LogNormal, Prior, TruncatedNormal, Uniform


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


@both
def test_quantiles_return_through_both_tails(ours, theirs):
    # effect of the round-off of the value on the distribution function: |dF / F| = density |dx| / F
    u = np.concatenate([np.logspace(-12, -0.31, 60), [0.5]])
    resolution = 8 * np.finfo(float).eps * max(abs(getattr(ours, "mean", 0.0)), getattr(ours, "sd", 0.0))
    for tail, probability in ((theirs.cdf, u), (theirs.sf, 1.0 - u)):
        x = ours.ppf(probability)
        share = (
            u if tail == theirs.cdf else 1.0 - probability
        )  # 1 - u is rounded, so compare with the probability given
        slack = 1e-11 + theirs.pdf(x) * (resolution + 4 * np.spacing(np.abs(x))) / share
        assert (np.abs(tail(x) / share - 1.0) <= slack).all()
    ends = ours.ppf(np.array([0.0, 1.0]))
    np.testing.assert_allclose(ends, ours.bounds, rtol=1e-12, atol=resolution)
    assert (ours.logpdf(ours.ppf(u)) > -np.inf).all()


@both
def test_draws_follow_the_distribution(ours, theirs, seed):
    draws = ours.rvs(4000, seed)
    assert draws.shape == (4000,)
    uniform = theirs.cdf(draws)
    assert stats.kstest(uniform, "uniform").pvalue > 1e-3
    assert stats.kstest(uniform**1.2, "uniform").pvalue < 1e-3  # the test can fail


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
        lambda: TruncatedNormal(1.0, -1.0),
        lambda: TruncatedNormal(math.nan, 1.0),
        lambda: TruncatedNormal(math.inf, 1.0),
        lambda: TruncatedNormal(1.0, math.inf),
        lambda: TruncatedNormal(1.0, 1.0, 2.0, 2.0),
        lambda: TruncatedNormal(1.0, 1.0, 2.0, 1.0),
        lambda: TruncatedNormal(1.0, 1.0, math.nan),
        lambda: TruncatedNormal(-50.0, 1.0),
        lambda: TruncatedNormal(1e10, 1.0, 0.0, 1e-12),
        lambda: TruncatedNormal(0.0, 1e-300, 1e300),
        lambda: HalfNormal(0.0),
        lambda: HalfNormal(math.nan),
        lambda: Uniform(1.0, 1.0),
        lambda: Uniform(0.0, math.inf),
        lambda: Uniform(-1.7e308, 1.7e308),
        lambda: LogNormal(0.0, 1.0),
        lambda: LogNormal(1.0, 0.0),
        lambda: LogNormal(1.0, math.inf),
        lambda: HalfNormal(1.0).ppf(1.5),
        lambda: HalfNormal(1.0).ppf(math.nan),
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


def test_distributions_are_values():
    assert TruncatedNormal(1, 2) == TruncatedNormal(1.0, 2.0, 0, math.inf)
    assert repr(TruncatedNormal(1, 2)) == "TruncatedNormal(mean=1.0, sd=2.0, lower=0.0, upper=inf)"
    assert pickle.loads(pickle.dumps(LogNormal(2.0, 0.3))) == LogNormal(2.0, 0.3)
    assert len({HalfNormal(1), HalfNormal(1.0)}) == 1


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


def test_prior_has_the_attributes_that_clients_expect(prior):
    assert prior.dim == len(PAIRS)
    assert prior.names == tuple(PAIRS)
    assert prior.bounds.shape == (prior.dim, 2)
    np.testing.assert_array_equal(prior.bounds, [ours.bounds for ours, _ in PAIRS.values()])
    x = prior.rvs(50)
    assert x.shape == (50, prior.dim)
    assert np.isfinite(prior.logpdf(x)).all()
    assert prior.rvs().shape == (1, prior.dim)
    assert prior.rvs(0).shape == (0, prior.dim)


def test_priors_and_distributions_name_the_seed_alike(prior):
    """As `scipy.stats`."""
    distribution = Uniform(0.0, 1.0)
    np.testing.assert_array_equal(distribution.rvs(size=3, random_state=1), distribution.rvs(3, 1))
    np.testing.assert_array_equal(prior.rvs(size=3, random_state=1), prior.rvs(3, 1))


def test_draws_depend_on_the_seed_only(prior):
    def draws(random_state):
        return prior.rvs(5, random_state)

    np.testing.assert_array_equal(draws(3), draws(3))
    np.testing.assert_array_equal(draws(3), draws(np.random.default_rng(3)))
    np.testing.assert_array_equal(draws(np.random.RandomState(3)), draws(np.random.RandomState(3)))
    assert (draws(3) != draws(4)).any()
    state = np.random.get_state()  # noqa: NPY002
    try:
        np.random.seed(3)  # noqa: NPY002
        first = draws(None)
        np.random.seed(3)  # noqa: NPY002
        np.testing.assert_array_equal(first, draws(None))
    finally:
        np.random.set_state(state)  # noqa: NPY002


def test_transform_maps_the_unit_cube(prior, rng):
    u = rng.random((20, prior.dim))
    x = prior.transform(u)
    for j, (_, theirs) in enumerate(PAIRS.values()):
        np.testing.assert_allclose(x[:, j], theirs.ppf(u[:, j]), rtol=1e-9)
    np.testing.assert_array_equal(prior.transform(u[0]), x[0])


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
