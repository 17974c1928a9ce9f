"""The initial state: draws of the prior; anything else is refused before a simulation."""

import emcee
import numpy as np
import pytest

from samplers import SMCSampler, TemperedSampler, TMCMCSampler
from samplers.evaluation.user_target import Target
from tests.contract.targets import Gaussian

N = 60
SAMPLERS = [SMCSampler, TMCMCSampler, TemperedSampler]
every = pytest.mark.parametrize("Sampler", SAMPLERS, ids=lambda s: s.__name__)


def ball(posterior, n=N, scale=0.01, seed=1):
    return posterior.mean + scale * np.random.default_rng(seed).standard_normal((n, posterior.ndim))


# ---------------------------------------------------------------- what is refused


@every
@pytest.mark.parametrize(("n", "scale"), [(N, 0.001), (300, 0.5)])
def test_a_ball_is_refused_before_any_evaluation(Sampler, scale, n):
    posterior = Gaussian()
    sampler = Sampler(n, 3, posterior, vectorize=True, seed=1)
    with pytest.raises(ValueError, match=r"must consist of draws of the prior; .*(x\d|together).* Pass None, so that"):
        sampler.run_mcmc(ball(posterior, n, scale), 1)
    assert posterior.calls == 0
    sampler.run_mcmc(None, 1)
    assert posterior.calls > 0


@every
def test_a_ball_is_refused_without_draws_of_the_prior(Sampler):
    """From the log-prior alone."""
    posterior = Gaussian()
    sampler = Sampler(N, 3, posterior.__call__, log_prior_fn=posterior.log_prior, seed=1)
    with pytest.raises(ValueError, match=r"must consist of draws of the prior; .* population spreads .* Pass draws of"):
        sampler.run_mcmc(ball(posterior), 1)
    assert posterior.calls == 0


@every
def test_draws_pass_and_the_test_changes_no_run(Sampler, monkeypatch):
    posterior = Gaussian()

    def chain():
        np.random.seed(3)  # noqa: NPY002
        sampler = Sampler(N, 3, posterior, vectorize=True)
        sampler.run_mcmc(posterior.sample_prior(N, np.random.default_rng(1)), 2)
        return sampler.get_chain(), np.random.uniform()  # noqa: NPY002

    tested = chain()
    monkeypatch.setattr(Target, "check_start", lambda *args: None)
    for a, b in zip(tested, chain(), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    "sample_prior", [lambda n: None, lambda n, random: np.zeros(n), lambda n, random: np.full((n, 3), np.nan)]
)
def test_a_sample_prior_that_does_not_work(sample_prior, caplog):
    posterior = Gaussian()
    draws = posterior.sample_prior(N, np.random.default_rng(1))
    posterior.sample_prior = sample_prior
    SMCSampler(N, 3, posterior, vectorize=True, seed=1).run_mcmc(draws, 1)
    assert "tested without fresh draws" in caplog.text
    with pytest.raises(ValueError, match="spreads"):
        SMCSampler(N, 3, posterior, vectorize=True, seed=1).run_mcmc(ball(posterior), 1)


def test_a_start_that_was_drawn_by_the_sampler_is_not_tested(monkeypatch, tmp_path):
    """Not in a run that is continued either."""

    def fail(*args):
        raise AssertionError("tested")

    monkeypatch.setattr(Target, "check_start", fail)
    posterior, calls = Gaussian(), []

    def interrupted(x):
        calls.append(len(x))
        if len(calls) == 6:
            raise KeyboardInterrupt
        return posterior(x)

    path = str(tmp_path / "run.h5")

    def make(function):
        class Function:
            log_prior, sample_prior = staticmethod(posterior.log_prior), staticmethod(posterior.sample_prior)
            __call__ = staticmethod(function)

        return SMCSampler(N, 3, Function(), vectorize=True, seed=1, backend=emcee.backends.HDFBackend(path))

    with pytest.raises(KeyboardInterrupt):
        make(interrupted).run_mcmc(None, 2)
    sampler = make(posterior)
    sampler.run_mcmc(None, 2)
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == 4


def test_control_a_start_that_is_not_of_the_prior_would_be_wrong(monkeypatch):
    """Negative control: why starts are tested."""
    monkeypatch.setattr(Target, "check_start", lambda *args: None)
    posterior = Gaussian(3, sd=0.1)
    sampler = SMCSampler(100, 3, posterior, vectorize=True, seed=1, check_draws=0)
    sampler.run_mcmc(ball(posterior, 100, 0.02), 1)
    assert sampler.log_evidence - posterior.log_evidence > 10.0 * sampler.log_evidence_error


def test_a_prior_that_uses_the_global_generator():
    """Its fresh draws leave the generator as it was."""
    posterior = Gaussian()
    posterior.sample_prior = lambda n, random: np.random.standard_normal((n, 3))  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    draws, expected = np.random.standard_normal((N, 3)), np.random.uniform()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    np.random.standard_normal((N, 3))  # noqa: NPY002
    SMCSampler(N, 3, posterior, vectorize=True, seed=1).run_mcmc(draws, 1)
    assert np.random.uniform() == expected  # noqa: NPY002
