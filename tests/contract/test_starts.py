"""The initial state: draws of the prior; anything else is refused before a simulation."""

import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler
from samplers.evaluation import user_target
from samplers.tempered import TemperedSampler
from tests.contract.targets import Gaussian

N = 60
SAMPLERS = [SMCSampler, TMCMCSampler, TemperedSampler]
every = pytest.mark.parametrize("Sampler", SAMPLERS, ids=lambda s: s.__name__)


def ball(posterior, n=N, scale=0.01, seed=1):
    return posterior.mean + scale * np.random.default_rng(seed).standard_normal((n, posterior.ndim))


@every
@pytest.mark.parametrize(("n", "scale", "known"), [(N, 0.001, True), (300, 0.5, True), (N, 0.01, False)])
def test_a_ball_is_refused_before_any_evaluation(Sampler, n, scale, known):
    """By draws of the prior, or from the log-prior alone."""
    posterior = Gaussian()
    function = posterior if known else posterior.__call__
    sampler = Sampler(n, 3, function, vectorize=True, seed=1, log_prior_fn=posterior.log_prior)
    with pytest.raises(ValueError, match=r"must consist of draws of the prior; .* spreads .* Pass (None|draws of)"):
        sampler.run_mcmc(ball(posterior, n, scale), 1)
    assert posterior.calls == 0
    if known:
        sampler.run_mcmc(None, 1)
        assert posterior.calls > 0


def test_control_a_start_that_is_not_of_the_prior_would_be_wrong(monkeypatch):
    """Negative control: why starts are tested."""
    monkeypatch.setattr(user_target, "not_of_the_prior", lambda *args: "")
    posterior = Gaussian(3, sd=0.1)
    settings = {"vectorize": True, "seed": 1, "recycle": False}
    # a function without `sample_prior`, so that no draws of the prior are added
    sampler = SMCSampler(100, 3, lambda x: posterior(x), log_prior_fn=posterior.log_prior, **settings)
    sampler.run_mcmc(ball(posterior, 100, 0.02), 1)
    assert sampler.log_evidence_ladder - posterior.log_evidence > 10.0 * sampler.ladder[-1].log_evidence_error
