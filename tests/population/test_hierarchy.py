"""Hierarchical model of several tests against closed forms of normal posteriors, and what it says of its errors."""

import itertools
import warnings

import emcee
import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LinearOscillator,
    LogNormal,
    Prior,
    Record,
    StoredPosterior,
    TruncatedNormal,
    Uniform,
    Varying,
    propagate,
)
from fe_likelihoods.priors.multivariate import MultivariateNormal

DATA = np.array([[0.7, -0.2], [1.4, 0.1], [1.0, 0.4], [1.5, -0.1]])  # measured (a, b) of four tests
ERRORS = np.array([[0.04, 0.03], [0.03, 0.09]])  # their covariance
WIDE = 2.0  # standard deviation of the independent priors, whose mean is zero
LINEAR = Varying(TruncatedNormal(0.0, 2.0, -np.inf, np.inf), HalfNormal(1.0), "linear")


def normal(sd: float) -> TruncatedNormal:
    return TruncatedNormal(0.0, sd, -np.inf, np.inf)


def stored(measured: np.ndarray, errors: np.ndarray, n: int, seed: int, sd: float = WIDE) -> StoredPosterior:
    """Exact draws of the posterior of normal data with a normal prior, and its evidence."""
    errors, dim = np.atleast_2d(errors), len(measured)
    covariance = np.linalg.inv(np.linalg.inv(errors) + np.eye(dim) / sd**2)
    draws = np.random.default_rng(seed).multivariate_normal(
        covariance @ np.linalg.solve(errors, measured), covariance, n
    )
    evidence = stats.multivariate_normal(np.zeros(dim), errors + sd**2 * np.eye(dim)).logpdf(measured)
    prior = Prior({name: normal(sd) for name in ("a", "b")[:dim]})
    return StoredPosterior(draws, prior, log_evidence=evidence)


def several(data: np.ndarray, errors: np.ndarray, n: int = 1000, sd: float = WIDE) -> dict[str, StoredPosterior]:
    return {f"T{k}": stored(each, errors, n, k, sd) for k, each in enumerate(data)}


def exact(data: np.ndarray, center: np.ndarray, covariance: np.ndarray) -> float:
    """Log-likelihood of the center and the total covariance of normal data."""
    return stats.multivariate_normal(center, covariance).logpdf(data).sum()


@pytest.fixture(scope="module")
def one() -> HierarchicalPosterior:
    """One varying parameter, from four tests."""
    return HierarchicalPosterior(several(DATA[:, :1], ERRORS[:1, :1]), {"a": LINEAR})


@pytest.fixture(scope="module")
def two() -> HierarchicalPosterior:
    """Two varying parameters, from four tests with correlated errors."""
    return HierarchicalPosterior(several(DATA, ERRORS), {"a": LINEAR, "b": LINEAR})


@pytest.fixture(scope="module")
def grid(one) -> np.ndarray:
    """Samples of the hyper-parameters of `one`, drawn from its density on a grid."""
    mean, sd = (each.ravel() for each in np.meshgrid(np.linspace(-1.0, 3.0, 30), np.linspace(0.02, 2.4, 30)))
    points = np.stack([mean, sd], axis=1)
    log_density = one.log_prob(points)
    density = np.exp(log_density - log_density.max())
    return points[np.random.default_rng(0).choice(len(points), 400, p=density / density.sum())]


@pytest.fixture(scope="module")
def result(one, grid) -> Hierarchy:
    """The hierarchy of `one` and `grid`."""
    return Hierarchy(one, grid)


def test_likelihood_of_one_parameter_is_the_closed_form(one):
    """From no spread, where the samples are too few, to a spread much wider than the posteriors."""
    points = np.array([[m, s] for m in (0.9, 1.1, 1.3) for s in (1e-8, 0.01, 0.1, 0.3, 1.0)])
    expected = [exact(DATA[:, 0], m, 0.04 + s**2) for m, s in points]
    error = one.log_likelihood(points) - expected
    assert np.abs(error).max() < 0.5  # the fits of four tests have errors of about 0.1 each
    assert np.abs(error[points[:, 1] >= 0.3]).max() < 0.1
    assert one.log_likelihood(points[4]) == pytest.approx(one.log_likelihood(points)[4])
    # control: priors that are narrower than the data, and their density forgotten
    two, change = [[0.7, 0.4], [1.2, 0.4]], np.diff([exact(DATA[:, 0], m, 0.04 + 0.16) for m in (0.7, 1.2)])
    narrow = HierarchicalPosterior(several(DATA[:, :1], ERRORS[:1, :1], 400, 0.5), {"a": LINEAR})
    assert np.diff(narrow.log_likelihood(two)) == pytest.approx(change, abs=0.3)
    flat = Prior({"a": Uniform(-50.0, 50.0)})
    narrow.described = {k: each._replace(prior=flat) for k, each in narrow.described.items()}
    assert abs(np.diff(narrow.log_likelihood(two)) - change) > 0.6


def test_likelihood_of_two_parameters_is_the_closed_form(two):
    for m_a, s_a, m_b, s_b in [[1.1, 0.3, 0.0, 0.4], [1.1, 0.05, 0.1, 0.02], [1.0, 1.0, -0.2, 0.7]]:
        value = two.log_likelihood([m_a, s_a, m_b, s_b])
        expected = exact(DATA, [m_a, m_b], ERRORS + np.diag([s_a**2, s_b**2]))
        assert value == pytest.approx(expected, abs=0.05 if s_a > 0.1 else 0.5)


def test_common_parameter_has_one_value_in_all_tests():
    tests = several(DATA, ERRORS)
    posterior = HierarchicalPosterior(tests, {"a": LINEAR}, common={"b": normal(2.0)})
    assert posterior.parameter_names == ["mean_a", "sd_a", "b"]
    points = np.array([[1.1, 0.3, 0.1], [1.2, 0.05, 0.0], [0.9, 1.0, -0.1]])
    expected = [exact(DATA, [m, b], ERRORS + np.diag([s**2, 0.0])) for m, s, b in points]
    np.testing.assert_allclose(posterior.log_likelihood(points), expected, atol=0.35)
    hierarchy = Hierarchy(posterior, posterior.sample_prior(50, 1) * [0.1, 0.1, 0.1] + [1.1, 0.2, 0.1])
    assert set(hierarchy.new_test(50, ["b"], 1)["b"]) == set(hierarchy.samples[:, 2])


def test_logarithmic_scale_and_weighted_samples(rng):
    """Log-normal posteriors, drawn from a wider density and weighted."""
    measured, error, tests = [0.1, -0.3, 0.2], 0.2, {}
    sd = 1.0 / np.sqrt(1.0 / error**2 + 1.0)
    for k, each in enumerate(measured):
        mean = each * sd**2 / error**2
        z = mean + 1.3 * sd * rng.standard_normal(900)
        log_weights = stats.norm(mean, sd).logpdf(z) - stats.norm(mean, 1.3 * sd).logpdf(z)
        evidence = stats.norm(0.0, np.hypot(1.0, error)).logpdf(each)
        samples = {"k": 2.0 * np.exp(z), "sigma": rng.random(900)}
        prior = Prior({"sigma": Uniform(0.0, 1.0), "k": LogNormal(2.0, 1.0)})
        tests[f"T{k}"] = StoredPosterior(samples, prior, log_weights + 7.0, evidence)
    posterior = HierarchicalPosterior(tests, {"k": Varying(LogNormal(2.0, 1.0), HalfNormal(0.5))})
    assert posterior.parameter_names == ["median_k", "sd_log_k"]
    for median, spread in ((2.0, 0.3), (2.2, 0.1), (1.5, 0.8)):
        expected = exact(np.array(measured), np.log(median / 2.0), error**2 + spread**2)
        assert posterior.log_likelihood({"median_k": median, "sd_log_k": spread}) == pytest.approx(expected, abs=0.2)


def test_extreme_hyper_parameters_have_a_density(two):
    """Walkers of a sampler go there."""
    values = (-1e90, 0.0), (1e-300, 1e-6, 1e150), (0.0, 50.0), (1e-9, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = two.log_likelihood(np.array(list(itertools.product(*values))))
    assert np.isfinite(found).all()


def test_values_of_a_common_parameter_beyond_the_bounds_of_a_test_are_impossible(rng):
    prior = Prior({"a": normal(3.0), "b": Uniform(0.0, 1.0)})
    tests = {"T": StoredPosterior(np.column_stack([rng.standard_normal(300), rng.random(300)]), prior)}
    posterior = HierarchicalPosterior(tests, {"a": LINEAR}, common={"b": Uniform(-1.0, 2.0)})
    values = posterior.log_likelihood([[0.0, 0.3, -0.5], [0.0, 0.3, 0.2], [0.0, 0.3, 1.5]])
    np.testing.assert_array_equal(np.isfinite(values), [False, True, False])
    assert not np.isnan(values).any()


def test_new_test_is_drawn_from_the_population(result, grid):
    assert result.checks.findings == ()
    draws = result.new_test(4000, rng=1)["a"]
    assert draws.mean() == pytest.approx(grid[:, 0].mean(), abs=0.05)
    assert draws.std() == pytest.approx(np.sqrt(grid[:, 0].var() + np.square(grid[:, 1]).mean()), rel=0.1)
    np.testing.assert_array_equal(draws, result.new_test(4000, rng=1)["a"])
    with pytest.raises(ValueError, match="no parameter 'damping'"):
        result.new_test(3, ["a", "damping"])


def test_new_test_of_an_oscillator_is_predicted(rng):
    """Draws of a new test are samples for `propagate`; a parameter of each test alone is drawn from its prior."""
    prior = Prior({"stiffness": LogNormal(1.0, 0.5), "damping": LogNormal(1.0, 0.5), "sigma": HalfNormal(1.0)})
    draws = np.exp(0.05 * rng.standard_normal((300, 3)))
    tests = {name: StoredPosterior(draws * each, prior) for name, each in (("A", 1.0), ("B", 1.1), ("C", 0.9))}
    varying = {"stiffness": Varying(LogNormal(1.0, 0.5), HalfNormal(0.2))}
    posterior = HierarchicalPosterior(tests, varying, common={"damping": LogNormal(1.0, 0.5)})
    hierarchy = Hierarchy(posterior, [[1.0, 0.1, 1.0]] * 30 * np.exp(0.01 * rng.standard_normal((30, 3))))
    model = LinearOscillator(Record("noise", 0.02, rng.standard_normal(100)))
    prediction = propagate(model, hierarchy.new_test(20, model.parameter_names, 1), progress=False)
    assert prediction.n_samples == 20
    assert hierarchy.new_test(2000, ["sigma", "damping"], 1)["sigma"].std() == pytest.approx(0.6, rel=0.1)


# ------------------------------------------------------------------ checks


def test_test_beside_the_population_is_a_warning(one):
    """The other tests and a prior of small spread hold the population far from T0."""
    points = np.random.default_rng(1).normal([50.0, 0.3], [0.1, 0.01], (60, 2))
    with pytest.warns(UserWarning, match="the means have errors of up to"):
        Hierarchy(one, points)


def test_prior_narrower_than_the_population_is_a_warning_that_names_the_test():
    """T0 is hardly informed: its samples are draws of a prior that leaves out most of the population."""
    tests = several(4.0 * DATA[1:, :1], ERRORS[:1, :1], 400, 10.0)
    tests["T0"] = stored(np.array([0.5]), np.array([[4.0]]), 400, 0, sd=0.5)
    posterior = HierarchicalPosterior(tests, {"a": LINEAR})
    points = np.random.default_rng(1).normal([4.0, 2.0], [0.5, 0.3], (60, 2))
    with pytest.warns(UserWarning, match="test 'T0': the population reaches values.*wider prior of a") as found:
        hierarchy = Hierarchy(posterior, points)
    assert len(found) == len(hierarchy.checks.findings) == 1
    assert found[0].filename == __file__
    assert "T0" in str(hierarchy.checks)


@pytest.mark.parametrize(("n", "is_named"), [(40, True), (1000, False)])
def test_population_narrower_than_the_samples_is_a_warning_where_it_matters(n, is_named):
    """With 1000 samples the error of the fitted mixture does no harm, with 40 a test is named."""
    posterior = HierarchicalPosterior(several(DATA[:, :1], ERRORS[:1, :1], n), {"a": LINEAR})
    points = np.random.default_rng(1).normal([1.1, 0.002], [0.1, 0.0002], (60, 2))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        checks = Hierarchy(posterior, points).checks
    assert ["Give more samples" in str(each.message) for each in found] == [True] * is_named
    change = posterior.log_likelihood(points) - [exact(DATA[:, 0], m, 0.04 + s**2) for m, s in points]
    weights = np.exp(change - change.max())
    shift = abs((weights @ points[:, 0] / weights.sum() - points[:, 0].mean()) / points[:, 0].std())
    assert (shift > 0.3) == is_named and (checks.mean_errors["mean_a"] > 0.2) == is_named


# ------------------------------------------------------------------ interface


def test_any_sampler_takes_the_hierarchical_posterior(two):
    assert two.ndim == 4 and two.parameter_names[-1] == "sd_b"
    points = two.sample_prior(12, 1)
    np.testing.assert_allclose(two(points), two.log_prior(points) + two.log_likelihood(points))
    sampler = emcee.EnsembleSampler(12, two.ndim, two, vectorize=True)
    sampler.run_mcmc(points, 2)
    assert sampler.get_chain().shape == (2, 12, 4)
    outside = points[:1] * [1.0, -1.0, 1.0, 1.0]
    assert two(outside) == -np.inf
    assert two.prior_transform(np.full(4, 0.5)).shape == (4,)
    other = HierarchicalPosterior(several(DATA, ERRORS, 200), two.varying)
    assert len({two.fingerprint, other.fingerprint}) == 2 and len(two.fingerprint) == 32


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"samples": np.ones((30, 3))}, "2 parameters a, b"),
        ({"samples": np.full((30, 2), np.nan)}, "must be finite"),
        ({"samples": np.full((30, 2), -1.0)}, "30 of 30 samples have no prior density"),
        ({"log_weights": np.ones(3)}, "for each of the 30 samples"),
        ({"log_weights": np.full(30, -np.inf)}, "below infinity"),
        ({"log_evidence": np.nan}, "finite log_evidence"),
        ({"effective_sample_size": 31.0}, "between 1 and the 30 samples"),
        ({"prior": {"a": HalfNormal(1.0)}}, "must be the Prior"),
    ],
)
def test_stored_posterior_refuses(arguments, message):
    good = {"samples": np.ones((30, 2)), "prior": Prior({"a": HalfNormal(1.0), "b": HalfNormal(1.0)})}
    with pytest.raises(ValueError, match=message):
        StoredPosterior(**good | arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tests": {}}, "tests must be a non-empty mapping"),
        ({"varying": {"a": HalfNormal(1.0)}}, "varying must be a non-empty mapping of names to Varying"),
        ({"common": {"a": HalfNormal(1.0)}}, "both varying and common"),
        ({"common": ["b"]}, "common must be a mapping"),
        ({"varying": {"c": LINEAR}}, "test 'T': the stored samples have no parameters c; they have a, b"),
        ({"varying": {"a": Varying(HalfNormal(1.0), HalfNormal(1.0))}}, "needs positive samples of a; use scale"),
    ],
)
def test_hierarchical_posterior_refuses(arguments, message, rng):
    prior = Prior({"a": normal(1.0), "b": normal(1.0)})
    good = {"tests": {"T": StoredPosterior(rng.standard_normal((50, 2)), prior)}, "varying": {"a": LINEAR}}
    with pytest.raises(ValueError, match=message):
        HierarchicalPosterior(**good | arguments)


def test_joint_priors_that_would_be_split_are_refused(rng):
    prior = Prior({("a", "b"): MultivariateNormal([0.0, 0.0], np.eye(2))})
    tests = {"T": StoredPosterior(rng.standard_normal((50, 2)), prior)}
    assert HierarchicalPosterior(tests, {"a": LINEAR, "b": LINEAR}).ndim == 4
    with pytest.raises(ValueError, match="test 'T'.*a, b have a joint distribution"):
        HierarchicalPosterior(tests, {"a": LINEAR})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((LogNormal(1.0, 1.0), normal(1.0)), "prior of positive values"),
        ((normal(1.0), HalfNormal(1.0)), "median, which needs a prior of positive values"),
        ((LogNormal(1.0, 1.0), HalfNormal(1.0), "root"), "one of 'log', 'linear'"),
    ],
)
def test_varying_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        Varying(*arguments)


def test_hierarchy_refuses(one, grid, result):
    for call, message in (
        (lambda: Hierarchy(one, grid[:5]), "20 samples of the hyper-parameters or more"),
        (lambda: Hierarchy(one, -grid), "impossible under their prior"),
        (lambda: result.new_test(0), "1 or more; got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_the_spread_is_printed_beside_the_error_of_one_test(rng):
    prior = Prior({"frequency": LogNormal(5.0, 0.5)})
    tests = {f"E{k}": StoredPosterior(5.0 * np.exp(0.01 * rng.standard_normal((500, 1))), prior) for k in range(4)}
    own = 0.1 * np.exp(0.1 * rng.standard_normal(400))
    varying = {"frequency": Varying(LogNormal(5.0, 0.5), HalfNormal(0.3))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = str(Hierarchy(HierarchicalPosterior(tests, varying), np.column_stack([5.0 + 0.01 * own, own])))
    (row,) = [line.split() for line in text.splitlines() if line.startswith("sd_log_frequency")]
    assert float(row[1]) == pytest.approx(0.1, rel=0.03) and float(row[-1]) == pytest.approx(0.01, rel=0.1)
