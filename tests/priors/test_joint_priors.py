"""Priors of several correlated parameters: normalised densities, draws and maps; mixtures fitted to samples."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import HalfNormal, Posterior, Prior, TruncatedNormal, Uniform, fit_mixture
from fe_likelihoods.priors.multivariate import MultivariateNormal
from samplers import SMCSampler
from tests.likelihood.linear_gaussian import exact_log_evidence, likelihood_of

MEAN, COVARIANCE = np.array([1.0, -0.5]), np.array([[0.5, 0.3], [0.3, 0.8]])
NORMAL = TruncatedNormal(1.0, 0.7, -np.inf, np.inf)


def mixed():
    """A prior whose joint distribution is not of neighbours."""
    return Prior(
        {("a", "c"): MultivariateNormal(MEAN, COVARIANCE), "b": HalfNormal(2.0), "d": stats.gamma(2.0, scale=0.5)}
    )


def test_density_and_order_of_a_prior_with_correlated_parameters(rng):
    prior = mixed().reorder(["d", "a", "b", "c"])
    x = np.abs(rng.normal(size=(6, 4)))
    expected = (
        stats.gamma(2.0, scale=0.5).logpdf(x[:, 0])
        + stats.multivariate_normal(MEAN, COVARIANCE).logpdf(x[:, [1, 3]])
        + stats.halfnorm(scale=2.0).logpdf(x[:, 2])
    )
    np.testing.assert_allclose(prior.logpdf(x), expected, rtol=1e-12)
    assert prior.logpdf(x[3]) == prior.logpdf(x)[3] and prior.names == ("d", "a", "b", "c")
    assert prior.bounds.tolist() == [[0.0, np.inf], [-np.inf, np.inf], [0.0, np.inf], [-np.inf, np.inf]]
    x[0, 1], x[1, 0], x[2, 3] = np.nan, -1.0, np.inf
    assert np.isneginf(prior.logpdf(x)).tolist() == [True, True, True, False, False, False]
    np.testing.assert_allclose(
        prior.subset(["c", "a"]).logpdf(x[3:, [3, 1]]), mixed().subset(["a", "c"]).logpdf(x[3:, [1, 3]])
    )


def test_draws_and_maps_of_correlated_parameters(rng):
    prior = mixed()
    draws = prior.rvs(40_000, 1)
    np.testing.assert_allclose(np.cov(draws[:, [0, 1]].T), COVARIANCE, atol=0.03)
    np.testing.assert_allclose(draws.mean(axis=0), prior.mean(), atol=0.03)
    z = rng.normal(size=(50, 4))
    np.testing.assert_allclose(prior.to_normal(prior.from_normal(z)), z, atol=1e-9)
    np.testing.assert_allclose(prior.transform(stats.norm.cdf(z)), prior.from_normal(z), atol=1e-9)
    np.testing.assert_array_equal(prior.rvs(3, 7), prior.rvs(3, 7))
    np.testing.assert_array_equal(prior.transform(stats.norm.cdf(z))[4], prior.transform(stats.norm.cdf(z[4])))


@pytest.fixture(scope="module")
def bent():
    """Samples with a bound and a bent ridge, and their density up to a constant."""
    rng = np.random.default_rng(8)
    prior = Prior({"k": HalfNormal(1.0), "c": Uniform(0.0, 3.0), "sigma": HalfNormal(1.0)})
    k = rng.gamma(2.0, 0.3, size=3000)
    samples = np.column_stack(
        [k, 3.0 * stats.beta.ppf(rng.random(3000), 2.0, 2.0 + 2.0 * k), rng.gamma(3.0, 0.1, 3000)]
    )
    log_prob = stats.gamma(2.0, scale=0.3).logpdf(k) + stats.beta(2.0, 2.0 + 2.0 * k).logpdf(samples[:, 1] / 3.0)
    return prior, samples, log_prob + stats.gamma(3.0, scale=0.1).logpdf(samples[:, 2])


def test_mixture_describes_the_samples_within_its_stated_error(bent):
    prior, samples, log_prob = bent
    mixture = fit_mixture(samples, prior, log_prob=log_prob)
    whole = Prior({mixture.names: mixture})
    draws = whole.rvs(6000, 2)
    assert (draws >= prior.bounds[:, 0]).all() and (draws[:, 1] <= 3.0).all()
    for column in range(3):
        assert stats.ks_2samp(draws[:, column], samples[:, column]).pvalue > 1e-4
    np.testing.assert_allclose(np.corrcoef(draws.T), np.corrcoef(samples.T), atol=0.06)
    # the density is normalised: the mean of truth / mixture over draws of the mixture is one
    truth = stats.gamma(2.0, scale=0.3).logpdf(draws[:, 0]) + stats.gamma(3.0, scale=0.1).logpdf(draws[:, 2])
    truth += stats.beta(2.0, 2.0 + 2.0 * draws[:, 0]).logpdf(draws[:, 1] / 3.0) - np.log(3.0)
    ratio = np.exp(truth - whole.logpdf(draws))
    assert ratio.mean() == pytest.approx(1.0, abs=4.0 * ratio.std() / np.sqrt(6000) + 0.01)
    assert 0.0 < mixture.fit_error < 0.2 and 0.0 < mixture.misfit < 0.4
    assert fit_mixture(samples[:300], prior).fit_error > 2.0 * mixture.fit_error
    z = np.random.default_rng(0).normal(size=(40, 3))
    np.testing.assert_allclose(whole.to_normal(whole.from_normal(z)), z, atol=1e-6)


def test_a_mixture_is_exact_in_both_tails(rng):
    """Scores far out, where a probability above or below is rounded to one."""
    prior = Prior({"a": NORMAL, "b": NORMAL})
    mixture = fit_mixture(prior.rvs(500, 1) + rng.choice([-1.0, 1.0], (500, 1)), prior)
    z = np.array([[-20.0, 20.0], [20.0, -20.0], [9.0, 9.0], [-9.0, -9.0]])
    x = mixture.from_normal(z)
    np.testing.assert_allclose(mixture.to_normal(x), z, rtol=1e-9)
    slopes = [
        (mixture.from_normal(z + 1e-4 * unit) - mixture.from_normal(z - 1e-4 * unit)) / 2e-4 for unit in np.eye(2)
    ]
    jacobian = np.linalg.det(np.moveaxis(slopes, 0, -1))
    density = stats.norm.logpdf(z).sum(axis=1) - np.log(np.abs(jacobian))
    np.testing.assert_allclose(mixture.logpdf(x), density, rtol=1e-5)


def test_a_mixture_gets_its_parameters_by_name(bent):
    prior, samples, _ = bent
    mixture = fit_mixture(samples, prior, ["k", "c"])
    swapped = Prior({("c", "k"): mixture})
    assert swapped.names == ("c", "k")
    np.testing.assert_array_equal(swapped.logpdf(samples[:9, [1, 0]]), mixture.logpdf(samples[:9, :2]))
    np.testing.assert_allclose(swapped.rvs(4000, 1).mean(axis=0), samples[:, [1, 0]].mean(axis=0), atol=0.05)
    np.testing.assert_array_equal(swapped.bounds, mixture.bounds[::-1])
    assert swapped.reorder(["k", "c"]).subset(["k", "c"]).logpdf(samples[0, :2]) == mixture.logpdf(samples[0, :2])
    with pytest.raises(ValueError, match="the names k, m differ from the distribution's, k, c"):
        Prior({("k", "m"): mixture})


def test_two_steps_give_the_joint_posterior_and_evidence(rng):
    """Posterior of the first data set as prior of the second: closed forms of linear models with Gaussian noise."""
    names = ("a", "b")
    first, second = likelihood_of(names, rng, n_steps=4), likelihood_of(names, rng, n_steps=6)
    prior = Prior(dict.fromkeys(names, NORMAL))
    exact = {
        "first": exact_log_evidence([first], list(names), 1.0, 0.7),
        "both": exact_log_evidence([first, second], list(names), 1.0, 0.7),
    }
    step = SMCSampler(1000, 2, Posterior(first, prior), vectorize=True, seed=1)
    step.run_mcmc(None, 5, progress=False)
    samples = step.get_chain(flat=True)
    mixture = fit_mixture(samples, prior, log_prob=step.get_log_prob(flat=True), effective_sample_size=1000)
    assert mixture.misfit < 0.3
    further = SMCSampler(1000, 2, Posterior(second, {names: mixture}), vectorize=True, seed=2)
    further.run_mcmc(None, 5, progress=False)
    error = np.hypot(np.hypot(step.log_evidence_error, further.log_evidence_error), mixture.fit_error)
    assert step.log_evidence == pytest.approx(exact["first"], abs=4.0 * step.log_evidence_error)
    assert abs(step.log_evidence + further.log_evidence - exact["both"]) < 3.0 * error < 0.5
    precision = np.eye(2) / 0.7**2 + sum(
        each.model.design.T @ each.model.design / each.noise.sigma**2 for each in (first, second)
    )
    data = sum(each.model.design.T @ each.measurements.values[0] / each.noise.sigma**2 for each in (first, second))
    mean, covariance = np.linalg.solve(precision, data + 1.0 / 0.7**2), np.linalg.inv(precision)
    found = further.get_chain(flat=True)
    sd = np.sqrt(np.diag(covariance))
    assert (np.abs(found.mean(axis=0) - mean) < 0.2 * sd).all()
    np.testing.assert_allclose(np.cov(found.T) / np.outer(sd, sd), covariance / np.outer(sd, sd), atol=0.15)


def test_posterior_with_a_correlated_prior(rng):
    likelihood = likelihood_of(("a", "c"), rng, noise=None)
    prior = Prior({("c", "a"): MultivariateNormal(MEAN, COVARIANCE), "sigma_top": HalfNormal(1.0)})
    posterior = Posterior(likelihood, prior)
    assert posterior.parameter_names == ["a", "c", "sigma_top"]
    point = [0.3, 0.4, 0.5]
    expected = stats.multivariate_normal(MEAN, COVARIANCE).logpdf([0.4, 0.3]) + HalfNormal(1.0).logpdf(0.5)
    assert posterior.log_prior(point) == pytest.approx(expected)
    other = Posterior(
        likelihood, {("c", "a"): MultivariateNormal(MEAN, 2.0 * COVARIANCE), "sigma_top": HalfNormal(1.0)}
    )
    assert posterior.fingerprint != other.fingerprint and len(posterior.fingerprint) == 32
    marginal = posterior.marginal()
    assert marginal.parameter_names == ["a", "c"] and np.isfinite(marginal(point[:2]))
    together = {("a", "c", "sigma_top"): MultivariateNormal([1.0, 1.0, 1.0], np.diag([0.5, 0.5, 0.5]))}
    with pytest.raises(ValueError, match="sigma_top have a joint prior distribution"):
        Posterior(likelihood, together).marginal()


def test_bad_input_is_refused():
    normal = MultivariateNormal(MEAN, COVARIANCE)
    cases = {
        "3 names, a, b, c, for a distribution of 2 parameters": {("a", "b", "c"): normal},
        "names of the parameters must differ; got a, b, a": {("a", "b"): normal, "a": HalfNormal(1.0)},
        "need a distribution of 2 parameters, such as": {("a", "b"): HalfNormal(1.0)},
        "'a' must be a Distribution": {"a": normal},
        "need a distribution of 2 parameters": {("a", "b"): stats.multivariate_t(MEAN, COVARIANCE)},
    }
    for message, distributions in cases.items():
        with pytest.raises(ValueError, match=message):
            Prior(distributions)
    for message, arguments in {
        "a mean .dim,. and a covariance": ([1.0], COVARIANCE),
        "finite numbers": ([np.nan, 1.0], COVARIANCE),
        "symmetric": (MEAN, [[1.0, 0.5], [0.1, 1.0]]),
        "positive definite": (MEAN, [[1.0, 2.0], [2.0, 1.0]]),
    }.items():
        with pytest.raises(ValueError, match=message):
            MultivariateNormal(*arguments)
    with pytest.raises(ValueError, match="a, b have a joint distribution and cannot be separated"):
        Prior({("a", "b"): normal}).subset(["a"])
    prior = Prior({"k": HalfNormal(1.0), "c": HalfNormal(1.0)})
    samples = np.abs(np.random.default_rng(1).normal(size=(200, 2)))
    for message, arguments in {
        "one value for each of the 2 parameters": (samples[:, :1], prior),
        "needs 10 different samples or more": (samples[:9], prior),
        "impossible under the prior": (-samples, prior),
        "no parameters m; it has k, c": (samples, prior, ["m"]),
        "the samples of k, c are linearly dependent": (samples[:, [0, 0]], prior),
        "all samples have the same value of c": (samples * [1.0, 0.0] + [0.0, 0.5], prior),
    }.items():
        with pytest.raises(ValueError, match=message):
            fit_mixture(*arguments)
    with pytest.raises(ValueError, match="log_prob must have one value for each of the 200 samples"):
        fit_mixture(samples, prior, log_prob=np.ones(3))
