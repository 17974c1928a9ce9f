"""The tasks that emcee's documentation teaches, with each of the three samplers in emcee's place.

Every example is a function of the sampler's class; `log_prior_fn` and a start drawn from the prior are the only
additions for `SMCSampler` and `TMCMCSampler`. The table of docs/from_emcee.rst lists everything that differs.
"""

import functools

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


# ---------------------------------------------------------------- fitting a line: args, discard, thin, flat

TRUTH = np.array([-0.96, 4.3, np.log(0.5)])  # slope, intercept, logarithm of the understated share of the noise
LOW, HIGH = np.array([-5.0, 0.0, -10.0]), np.array([0.5, 10.0, 1.0])


def line_data():
    random = np.random.default_rng(3)
    x = np.sort(10.0 * random.random(50))
    yerr = 0.1 + 0.5 * random.random(50)
    line = TRUTH[0] * x + TRUTH[1]
    y = line + np.abs(np.exp(TRUTH[2]) * line) * random.standard_normal(50) + yerr * random.standard_normal(50)
    return x, y, yerr


def line_log_likelihood(theta, x, y, yerr):
    m, b, log_f = theta
    model = m * x + b
    variance = yerr**2 + model**2 * np.exp(2 * log_f)
    return -0.5 * np.sum((y - model) ** 2 / variance + np.log(2 * np.pi * variance), axis=-1)


def line_log_prior(theta):
    return -np.sum(np.log(HIGH - LOW)) if np.all((theta > LOW) & (theta < HIGH)) else -np.inf


def line_log_probability(theta, x, y, yerr):
    log_prior = line_log_prior(theta)
    return log_prior + line_log_likelihood(theta, x, y, yerr) if np.isfinite(log_prior) else -np.inf


def line_start(Sampler):
    if Sampler is emcee.EnsembleSampler:
        return TRUTH + 1e-4 * np.random.default_rng(1).standard_normal((NWALKERS, 3))
    return np.random.default_rng(1).uniform(LOW, HIGH, (NWALKERS, 3))


@functools.cache
def line_quadrature():
    """Posterior mean and standard deviation on a grid, and the log-evidence."""
    m, b, f = np.linspace(-2.0, 0.0, 41), np.linspace(0.0, 8.0, 41), np.linspace(-3.0, 1.0, 33)
    grid = np.stack(np.meshgrid(m, b, f, indexing="ij"), axis=-1).reshape(-1, 3)
    columns = grid.T[..., None]
    log_density = line_log_likelihood(columns, *line_data()) + line_log_prior(TRUTH)
    weights = np.exp(log_density - log_density.max())
    cell = (m[1] - m[0]) * (b[1] - b[0]) * (f[1] - f[0])
    log_evidence = log_density.max() + np.log(weights.sum() * cell)
    mean = weights @ grid / weights.sum()
    return mean, np.sqrt(weights @ (grid - mean) ** 2 / weights.sum()), log_evidence


@every
def test_fitting_a_line(Sampler):
    data = line_data()
    sampler = Sampler(NWALKERS, 3, line_log_probability, args=data, **extra(Sampler, line_log_prior))
    sampler.run_mcmc(line_start(Sampler), 200)
    samples = sampler.get_chain(discard=100, thin=5, flat=True)
    assert samples.shape == (20 * NWALKERS, 3)
    mean, sd, log_evidence = line_quadrature()
    assert np.all(np.abs(samples.mean(axis=0) - mean) < 0.3 * sd)
    assert np.allclose(samples.std(axis=0), sd, rtol=0.3)
    if Sampler is not emcee.EnsembleSampler and sampler.verdict.status != "not usable":
        assert abs(sampler.log_evidence - log_evidence) < 4 * sampler.log_evidence_error
        assert (
            sampler.log_evidence_error < 2.0
        )  # the stages of 32 walkers scatter by 0.6, and half a difference is stated


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


def with_two_blobs(x):
    return log_prob(x), log_prior(x), float(np.mean(x))


def with_dictionary(x):
    return log_prob(x), {"mean": float(np.mean(x)), "first": float(x[0])}


@every
def test_several_blobs_with_names(Sampler, tmp_path):
    dtype = [("log_prior", float), ("mean", float)]
    backend = emcee.backends.HDFBackend(str(tmp_path / "blobs.h5"))
    sampler = Sampler(NWALKERS, NDIM, with_two_blobs, backend=backend, blobs_dtype=dtype, **extra(Sampler, log_prior))
    sampler.run_mcmc(prior_draws(), 10)
    blobs, chain = sampler.get_blobs(), sampler.get_chain()
    assert blobs.dtype.names == ("log_prior", "mean") and blobs["mean"].shape == (10, NWALKERS)
    assert np.array_equal(blobs["mean"], chain.mean(axis=-1))
    assert np.array_equal(sampler.get_blobs(flat=True)["log_prior"][-1], log_prior(chain[-1, -1]))


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
