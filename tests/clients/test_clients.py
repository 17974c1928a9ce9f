"""Every client samples a posterior of this library and reproduces the moments and the evidence of quadrature."""

import numpy as np
import pytest

from fe_likelihoods import TruncatedNormal

from .problem import CRITICAL, PRIOR, exact, make_posterior, reference_log_prob, starts_of
from .runs import CLIENTS
from .scoring import Found, check

# emcee and ultranest are quick: test_adapters and test_protocol compare what the others call with the posterior
SLOW = {"bilby", "dynesty", "nautilus", "pints", "pymc-smc", "pymc-mcmc", "pymc-nuts", "pocomc", "zeus"}


def test_quadrature_has_converged_and_is_of_this_posterior(answer):
    for ours, coarser in zip(answer, exact(44), strict=True):
        np.testing.assert_allclose(ours, coarser, rtol=1e-4)
    posterior = make_posterior()
    points = np.concatenate([starts_of(posterior, 20, 1), posterior.sample_prior(20, 2)])
    expected = [reference_log_prob(point) for point in points]
    np.testing.assert_allclose(posterior(points), expected, rtol=1e-10)
    assert np.isinf(expected).any()


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in CLIENTS])
def test_client_agrees_with_quadrature(name, client_named, answer, seed):
    check(client_named(name).run(make_posterior(), seed), answer)


@pytest.mark.slow
def test_wrong_prior_is_detected(client_named, answer, seed):
    """Negative control: a prior with another mean and without its upper bound fails the check."""
    wrong = make_posterior(PRIOR | {"damping": TruncatedNormal(1.0, 0.8, lower=0.7)})
    with pytest.raises(AssertionError, match="means|standard deviations"):
        check(client_named("emcee").run(wrong, seed), answer)


def test_evidence_without_the_failed_runs_is_detected(answer):
    """Negative control: an evidence without the failed three fifths of the prior fails, even at the largest error."""
    shares = make_posterior().prior.distributions["damping"].ppf(np.linspace(0.0, 1.0, 10_001)) < CRITICAL
    small = 0.01 * answer.sd
    without_failures = Found(answer.mean, small, answer.sd, small, answer.log_evidence - np.log(shares.mean()), 0.21)
    with pytest.raises(AssertionError, match="evidence"):
        check(without_failures, answer)
    check(without_failures._replace(log_evidence=answer.log_evidence), answer)
