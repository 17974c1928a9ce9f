"""The tasks that emcee's documentation teaches, with each of the three samplers in emcee's place.

Every example is a function of the sampler's class; `log_prior_fn` and a start drawn from the prior are the only
additions for `SMCSampler` and `TMCMCSampler`. docs/from_emcee.rst fits a line, and lists everything that differs.
"""

import emcee
import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler

NWALKERS = 32  # as in emcee's examples; so few walkers are a reason for warnings, which are tested elsewhere
pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
every = pytest.mark.parametrize("Sampler", [emcee.EnsembleSampler, SMCSampler, TMCMCSampler], ids=lambda s: s.__name__)


@pytest.fixture(autouse=True)
def seeded():
    np.random.seed(42)  # noqa: NPY002  emcee takes its random state from the global generator


def extra(Sampler, log_prior):
    """What the example gains with our samplers."""
    return {} if Sampler is emcee.EnsembleSampler else {"log_prior_fn": log_prior}


# ---------------------------------------------------------------- the quickstart: state, reset, go on

NDIM = 3


def log_prior(x):
    return -0.5 * np.sum(x**2) - 0.5 * NDIM * np.log(2 * np.pi)


def log_prob(x):
    return log_prior(x) - 0.5 * np.sum((x - 0.5) ** 2) / 0.2**2


def prior_draws():
    """A start for all three: emcee can begin anywhere."""
    return np.random.default_rng(2).standard_normal((NWALKERS, NDIM))


@every
def test_burn_in_reset_and_production(Sampler):
    sampler = Sampler(NWALKERS, NDIM, log_prob, **extra(Sampler, log_prior))
    state = sampler.run_mcmc(prior_draws(), 50)
    sampler.reset()
    sampler.run_mcmc(state, 100)
    assert sampler.get_chain().shape == (100, NWALKERS, NDIM)
    exact = 0.5 / (1 + 0.2**2)
    assert np.all(np.abs(sampler.get_chain(flat=True).mean(axis=0) - exact) < 0.1)
    assert 0.1 < np.mean(sampler.acceptance_fraction) < 1.0
    assert sampler.get_autocorr_time(tol=0).shape == (NDIM,)


# ---------------------------------------------------------------- saving and monitoring progress


def log_prob_and_prior(x):
    prior = log_prior(x)
    return prior - 0.5 * np.sum((x - 0.5) ** 2) / 0.2**2, prior


def monitored(sampler, start, most, every_steps):
    """Sample until the autocorrelation time is known well enough and has stopped to change."""
    history, old = [], np.inf
    for _ in sampler.sample(start, iterations=most, progress=False):
        if sampler.iteration % every_steps:
            continue
        tau = sampler.get_autocorr_time(tol=0)
        history.append(np.mean(tau))
        if np.all(tau * 20 < sampler.iteration) and np.all(np.abs(old - tau) / tau < 0.3):
            break
        old = tau
    return history


@every
def test_saving_and_monitoring_progress(Sampler, tmp_path):
    filename = str(tmp_path / "tutorial.h5")
    backend = emcee.backends.HDFBackend(filename)
    backend.reset(NWALKERS, NDIM)
    sampler = Sampler(NWALKERS, NDIM, log_prob_and_prior, backend=backend, **extra(Sampler, log_prior))
    history = monitored(sampler, prior_draws(), 200, 25)
    assert history and sampler.iteration == 25 * len(history)

    reader = emcee.backends.HDFBackend(filename, read_only=True)
    tau = reader.get_autocorr_time(tol=0)
    assert np.array_equal(tau, sampler.get_autocorr_time(tol=0))
    chain = reader.get_chain(discard=2, flat=True, thin=3)
    assert np.array_equal(chain, sampler.get_chain(discard=2, flat=True, thin=3))
    assert np.array_equal(reader.get_log_prob(), sampler.get_log_prob())
    assert np.allclose(reader.get_blobs()[-1], [log_prior(x) for x in reader.get_chain()[-1]], rtol=1e-12)


# ---------------------------------------------------------------- blobs


def with_dictionary(x):
    return log_prob(x), {"mean": float(np.mean(x)), "first": float(x[0])}


@every
def test_a_dictionary_as_blob(Sampler):
    sampler = Sampler(NWALKERS, NDIM, with_dictionary, blobs_dtype=object, **extra(Sampler, log_prior))
    sampler.run_mcmc(prior_draws(), 10)
    blobs = sampler.get_blobs()
    assert blobs.shape == (10, NWALKERS)
    assert blobs[-1, 3]["first"] == sampler.get_chain()[-1, 3, 0]


# ---------------------------------------------------------------- a move of the user's own


class Drift(emcee.moves.RedBlueMove):
    """A walker makes a step along the difference of two others, as in differential evolution."""

    def get_proposal(self, sample, complement, random):
        others = np.concatenate(complement)
        first, second = random.randint(len(others), size=(2, len(sample)))
        return sample + 0.7 * (others[first] - others[second]), np.zeros(len(sample))


@every
def test_a_subclass_of_a_move(Sampler):
    sampler = Sampler(NWALKERS, NDIM, log_prob, moves=Drift(), **extra(Sampler, log_prior))
    sampler.run_mcmc(prior_draws(), 100)
    samples = sampler.get_chain(discard=50, flat=True)
    assert np.all(np.abs(samples.mean(axis=0) - 0.5 / (1 + 0.2**2)) < 0.1)
    assert np.allclose(samples.std(axis=0), 0.2 / np.sqrt(1 + 0.2**2), rtol=0.25)
