"""Populations of bounded parameters (scale "logit"): closed forms, invariance, ranks of the truth; controls."""

import numpy as np
import pytest
from scipy import integrate, special, stats

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Prior,
    StoredPosterior,
    Uniform,
    Varying,
)
from fe_likelihoods.events.scales import Scales, scales_of

SHARE = Varying(Uniform(0.0, 1.0), HalfNormal(1.0), "logit")
ERROR = 0.5  # of measured logits
REPEATS = 10


def measured_logit(data: float, n: int, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Posterior samples of a share with a uniform prior whose logit was measured, and their log-evidence."""
    u = data + ERROR * rng.standard_normal(12 * n)
    density = special.expit(u) * special.expit(-u)  # of the uniform prior on the logit scale, at most 1 / 4
    kept = u[rng.random(12 * n) < 4.0 * density][:n]
    assert len(kept) == n

    def joint(u: float) -> float:
        return stats.norm.pdf(u, data, ERROR) * special.expit(u) * special.expit(-u)

    return special.expit(kept), np.log(integrate.quad(joint, -30.0, 30.0, points=[data])[0])


def population(data: list[float], low: float, high: float, rng: np.random.Generator, n: int = 4000):
    """Hierarchical posterior of shares whose logits were measured, moved to the bounds low and high."""
    prior, tests = Prior({"share": Uniform(low, high)}), {}
    for k, each in enumerate(data):
        share, log_evidence = measured_logit(each, n, rng)
        tests[f"T{k}"] = StoredPosterior({"share": low + (high - low) * share}, prior, log_evidence=log_evidence)
    varying = Varying(Uniform(low, high), HalfNormal(1.0), "logit")
    return HierarchicalPosterior(tests, {"share": varying}, max_samples=n)


def test_scales_have_their_inverse_and_their_derivative():
    scales = scales_of(["log", "linear", "logit"], [None, None, (2.0, 6.0)])
    points = np.column_stack([np.linspace(-5.0, 5.0, 11)] * 3)
    values = scales.from_scale(points)
    np.testing.assert_allclose(values[:, 0], np.exp(points[:, 0]))
    np.testing.assert_array_equal(values[:, 1], points[:, 1])
    np.testing.assert_allclose(values[:, 2], 2.0 + 4.0 * special.expit(points[:, 2]))
    np.testing.assert_allclose(scales.to_scale(values), points, atol=1e-12)
    h = 1e-5
    slope = (scales.from_scale(points + h) - scales.from_scale(points - h)) / (2.0 * h)
    np.testing.assert_allclose(scales.log_jacobian(points), np.log(slope), atol=1e-8)


def test_extreme_points_stay_between_the_bounds():
    scales = scales_of(["logit", "logit"], [(0.1, 0.3), (-1.0, 7.0)])
    points = np.array([[-1e100, 1e100], [-800.0, 800.0], [40.0, -40.0]])
    values = scales.from_scale(points)
    assert ((values > [0.1, -1.0]) & (values < [0.3, 7.0])).all()
    assert np.isfinite(scales.to_scale(values)).all()
    assert not np.isnan(scales.log_jacobian(points)).any()


@pytest.mark.parametrize("low, high", [(0.0, 1.0), pytest.param(2.0, 6.0, marks=pytest.mark.slow)])
def test_marginal_likelihood_is_the_closed_form(low, high, rng, monkeypatch):
    """Normal errors of the logit: the measured logit is normal with the sum of both variances."""
    data, sds = [-1.0, 0.5, 3.0], np.array([0.2, 0.6, 1.5])
    posterior = population(data, low, high, rng)
    assert posterior.parameter_names == ["median_share", "sd_logit_share"]
    centers, spreads = (each.ravel() for each in np.meshgrid([-0.5, 1.0], sds))
    points = np.column_stack([low + (high - low) * special.expit(centers), spreads])
    exact = stats.norm.logpdf(np.array(data), centers[:, None], np.hypot(spreads, ERROR)[:, None])
    found = [posterior.log_marginals(points)]
    found += [population(data, low, high, rng).log_marginals(points) for _ in range(REPEATS - 1)]
    ratios = np.exp(np.array(found) - exact)  # their mean is one; that of their logarithms is not zero
    error = ratios.std(axis=0, ddof=1) / np.sqrt(REPEATS)
    limit = stats.t.ppf(1.0 - 0.5e-3 / exact.size, REPEATS - 1)  # one of 1000 such tests fails by chance
    assert np.median(error) < 0.01 and error.max() < 0.1 and (np.abs(ratios.mean(axis=0) - 1.0) < limit * error).all()
    monkeypatch.setattr(Scales, "log_jacobian", lambda self, points: np.zeros_like(points))  # control
    wrong = population(data, low, high, rng).log_marginals(points) - exact
    assert np.ptp(wrong, axis=0).max() > 0.5


def test_the_unit_of_a_bounded_parameter_does_not_matter(rng):
    one, other = (population([-1.0, 3.0], *ends, np.random.default_rng(1), 500) for ends in ((0.0, 1.0), (2.0, 6.0)))
    points = np.array([[0.3, 0.4], [0.9, 2.0]])
    moved = points * [4.0, 1.0] + [2.0, 0.0]
    np.testing.assert_allclose(one.log_marginals(points), other.log_marginals(moved), atol=1e-6)
    prior = one.log_prior(points) - other.log_prior(moved)
    np.testing.assert_allclose(prior, np.log(4.0))


def test_draws_of_a_new_test_stay_between_the_bounds(rng, recwarn):
    posterior = population([1.0, 2.5, 3.5], 0.0, 1.0, rng, 500)
    samples = np.column_stack([np.full(50, 0.9), 1.0 + 1e-6 * rng.random(50)])
    hierarchy = Hierarchy(posterior, samples)
    share = hierarchy.new_test(20_000, rng=1)["share"]
    assert share.min() > 0.0 and share.max() < 1.0
    assert stats.kstest(special.logit(share), stats.norm(special.logit(0.9), 1.0).cdf).pvalue > 1e-3
    assert hierarchy.median_test() == {"share": pytest.approx(0.9)}
    weights = hierarchy.population_weights({"share": share})
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert not [each for each in recwarn if "outside the bounds" in str(each.message)]
    logarithmic = HierarchicalPosterior(posterior.tests, {"share": Varying(LogNormal(0.9, 0.3), HalfNormal(0.3))})
    control = Hierarchy(logarithmic, np.column_stack([np.full(50, 0.9), 0.1 + 1e-6 * rng.random(50)]))
    with pytest.warns(UserWarning, match=r"outside the bounds of the priors of the tests \(share 1.*scale='logit'"):
        control.new_test(2000, rng=1)


def test_weights_turn_the_draws_into_those_of_one_population(rng):
    posterior = population([0.0, 1.0], 0.0, 1.0, rng, 500)
    samples = np.column_stack([np.repeat([0.4, 0.7], 40), np.repeat([0.8, 0.5], 40) + 1e-6 * rng.random(80)])
    hierarchy = Hierarchy(posterior, samples)
    share = hierarchy.new_test(20_000, rng=1)["share"]
    weights = hierarchy.population_weights({"share": share})
    for row, (median, sd) in ((0, (0.4, 0.8)), (-1, (0.7, 0.5))):
        offsets = special.logit(share) - special.logit(median)
        error = np.sqrt(weights[row] ** 2 @ offsets**2)  # of a mean with weights
        assert abs(weights[row] @ offsets) < 4.0 * error < 0.05
        squares = offsets**2 - sd**2
        error = np.sqrt(weights[row] ** 2 @ squares**2)
        assert abs(weights[row] @ squares) < 4.0 * error < 0.1


def measured_shares(n_tests: int, rng: np.random.Generator, error: float = 0.1) -> tuple[np.ndarray, dict]:
    """True median, spread and shares, with one more share, and stored posteriors of measured shares."""
    median, sd = rng.random(), abs(rng.standard_normal())
    shares = special.expit(special.logit(median) + sd * rng.standard_normal(n_tests + 1))
    prior, tests = Prior({"share": Uniform(0.0, 1.0)}), {}
    for k, each in enumerate(shares[:-1] + error * rng.standard_normal(n_tests)):
        posterior = stats.truncnorm(-each / error, (1.0 - each) / error, loc=each, scale=error)
        tests[f"T{k}"] = StoredPosterior(
            {"share": posterior.ppf((rng.permutation(400) + rng.random(400)) / 400)}, prior
        )
    return np.array([median, sd, shares[-1]]), tests


@pytest.mark.slow
def test_ranks_of_the_truth_are_uniform():
    """Simulation-based calibration: medians, spreads and new tests of 80 data sets drawn from the priors.

    Talts et al. (2018), arXiv:1804.06788. The hyper-parameters are sampled on a grid. The measured shares have
    normal errors of 0.1, so that posteriors end at the bounds. The control leaves the derivative of the scale out.
    """
    cell = np.array([1.0 / 40.0, 3.5 / 30.0])
    points = (np.stack(np.meshgrid(np.arange(40), np.arange(30)), axis=-1).reshape(-1, 2) + 0.5) * cell
    ranks = {"right": [], "control": []}
    for seed in range(80):
        rng = np.random.default_rng([7, seed])
        truth, tests = measured_shares(6, rng)
        posterior = HierarchicalPosterior(tests, {"share": SHARE})
        for kind, found in ranks.items():
            with pytest.MonkeyPatch.context() as patch:
                if kind == "control":
                    patch.setattr(Scales, "log_jacobian", lambda self, points: np.zeros_like(points))
                    zero = {name: each._replace(log_prior=np.zeros(400)) for name, each in posterior.described.items()}
                    patch.setattr(posterior, "described", zero)
                log_density = posterior.log_prob(points)
            density = np.exp(log_density - log_density.max())
            rows = points[rng.choice(len(points), 400, p=density / density.sum())]
            rows = rows + (rng.random(rows.shape) - 0.5) * cell
            new = special.expit(special.logit(rows[:, 0]) + rows[:, 1] * rng.standard_normal(400))
            found.append([(draws < value).mean() for draws, value in zip([*rows.T, new], truth, strict=True)])
    right, control = (np.array(each).T for each in ranks.values())
    assert min(stats.kstest(row, "uniform").pvalue for row in right) > 1e-3
    inside = (np.abs(right[2] - 0.5) < 0.45).mean()
    assert abs(inside - 0.9) < 4.0 * np.sqrt(0.09 / 80)
    assert min(stats.kstest(row, "uniform").pvalue for row in control) < 1e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"location": LogNormal(0.8, 0.3)}, "median between the bounds 0 and 1"),
        ({"bounds": (0.0, np.inf)}, "two finite bounds"),
        ({"bounds": (1.0, 0.0)}, "two finite bounds"),
        ({"scale": "log", "bounds": (0.0, 1.0)}, "bounds are those of scale='logit'"),
        ({"scale": "probit"}, "'log', 'linear', 'logit'"),
    ],
)
def test_bounds_that_cannot_be_used_are_refused(arguments, message):
    options = {"location": Uniform(0.0, 1.0), "sd": HalfNormal(1.0), "scale": "logit", "bounds": (0.0, 1.0)} | arguments
    with pytest.raises(ValueError, match=message):
        Varying(**options)


def test_bounds_are_those_of_the_tests_or_stated(rng):
    share = 0.1 + 0.8 * rng.random(100)
    tests = {
        name: StoredPosterior({"share": share}, Prior({"share": Uniform(*ends)}))
        for name, ends in (("a", (0.0, 1.0)), ("b", (0.05, 0.95)))
    }
    with pytest.raises(ValueError, match="share differ between the tests.*bounds="):
        HierarchicalPosterior(tests, {"share": SHARE})
    stated = Varying(Uniform(0.0, 1.0), HalfNormal(1.0), "logit", bounds=(0.0, 1.0))
    assert np.isfinite(HierarchicalPosterior(tests, {"share": stated}).log_likelihood([0.5, 1.0]))
    narrow = Varying(Uniform(0.2, 0.4), HalfNormal(1.0), "logit", bounds=(0.2, 0.4))
    with pytest.raises(ValueError, match="test 'a': a logit scale needs samples of share between"):
        HierarchicalPosterior(tests, {"share": narrow})
    with pytest.raises(ValueError, match="share: Varying.*two finite bounds"):
        positive = {"a": StoredPosterior({"share": share}, Prior({"share": HalfNormal(1.0)}))}
        HierarchicalPosterior(positive, {"share": SHARE})
