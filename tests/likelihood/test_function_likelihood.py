"""A log-likelihood of one's own with priors: the samplers, arviz and clients take it; what needs a model says so."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import FunctionLikelihood, LogNormal, Posterior, TruncatedNormal
from samplers import SMCSampler, to_arviz

PRIOR = {"k": TruncatedNormal(0.0, 2.0, lower=-100.0), "c": TruncatedNormal(1.0, 1.0, lower=-100.0)}


def gaussian(thetas):
    return stats.norm.logpdf(thetas, [1.0, 0.5], 0.3).sum(axis=-1)


def made(function=gaussian, vectorize=True):
    return Posterior(FunctionLikelihood(function, ["k", "c"], vectorize), PRIOR)


def test_the_evidence_and_the_means_are_exact_ones():
    posterior = made()
    sampler = SMCSampler(400, 2, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 3)
    variances = np.array([4.0, 1.0]) + 0.09
    evidence = stats.norm.logpdf([1.0, 0.5], [0.0, 1.0], np.sqrt(variances)).sum()
    assert sampler.log_evidence == pytest.approx(evidence, abs=4.0 * sampler.log_evidence_error + 0.01)
    means = (np.array([1.0, 0.5]) / 0.09 + [0.0, 1.0]) / (1.0 / 0.09 + 1.0 / np.array([4.0, 1.0]))
    error = sampler.mean_error()
    assert (abs(sampler.get_chain(flat=True).mean(axis=0) - means) < 4.0 * error).all()
    data = to_arviz(sampler)
    assert list(data.posterior.data_vars) == ["k", "c"]
    assert posterior.report()["simulations"] == sampler.evaluations


def test_points_arrays_and_mappings_have_the_same_values():
    one, many = made(lambda theta: float(gaussian(theta)), vectorize=False), made()
    points = many.sample_prior(5, 1)
    assert one.log_prob(points).tolist() == many.log_prob(points).tolist()
    assert one(points[0]) == many({"k": points[0, 0], "c": points[0, 1]})
    assert many.log_prob([np.inf, 0.0]) == -np.inf


def test_failures_are_counted_with_their_parameters():
    def function(theta):
        if theta[0] < 0.0:
            raise RuntimeError("negative")
        return np.nan if theta[1] < 0.0 else -np.inf if theta[0] > 5.0 else 0.0

    posterior = made(function, vectorize=False)
    assert posterior.log_likelihood([[-1.0, 1.0], [1.0, -1.0], [6.0, 1.0], [1.0, 1.0]]).tolist() == [-np.inf] * 3 + [
        0.0
    ]
    report = posterior.report()
    assert [each["reason"] for each in report["failures"]] == ["RuntimeError: negative", "the log-likelihood is nan"]
    assert report["failures"][0]["parameters"] == {"k": -1.0, "c": 1.0} and report["failure_count"] == 2

    def interrupted(theta):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        made(interrupted, vectorize=False)([1.0, 1.0])


def test_the_fingerprint_follows_the_function_and_its_values():
    def with_width(width):
        return made(lambda theta: stats.norm.logpdf(theta, 0.0, width).sum(axis=-1)).fingerprint

    assert with_width(0.3) == with_width(0.3) != with_width(0.4)
    assert made().fingerprint != Posterior(made().likelihood, PRIOR | {"c": LogNormal(1.0, 0.2)}).fingerprint


@pytest.mark.parametrize(
    "call",
    [
        lambda posterior: posterior.guide(),
        lambda posterior: posterior.mode(),
    ],
)
def test_what_needs_a_model_says_so(call):
    with pytest.raises(ValueError, match="needs the responses of a model"):
        call(made())


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((1.0, ["k"]), "function"),
        ((gaussian, []), "names"),
        ((gaussian, ["k", "k"]), "names"),
        ((gaussian, "k"), "names"),
    ],
)
def test_bad_arguments_are_refused(arguments, word):
    with pytest.raises(ValueError, match=word):
        FunctionLikelihood(*arguments)
