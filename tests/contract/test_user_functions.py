"""Functions that a user can get wrong: shapes, a log-likelihood in place of a log-posterior, and the reverse."""

import emcee
import numpy as np
import pytest

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.tempered import TemperedSampler
from tests.contract.targets import Box, Gaussian, WithBlobs
from tests.covering import covering
from tests.faults.resumable_run import InOrder

N = 24
SAMPLERS = [SMCSampler, TMCMCSampler]
every = pytest.mark.parametrize("Sampler", SAMPLERS, ids=lambda s: s.__name__)


def draws(posterior, n=N):
    return posterior.sample_prior(n, np.random.default_rng(1))


def terms(x):
    """Log-densities of the single parameters, not summed."""
    return -0.5 * x**2 - 0.5 * np.log(2 * np.pi)


def run(Sampler, log_prob_fn, posterior=None, nsteps=1, n=N, **kwargs):
    posterior = posterior or Gaussian()
    sampler = Sampler(n, posterior.ndim, log_prob_fn, **{"seed": 1, **kwargs})
    sampler.run_mcmc(draws(posterior, n), nsteps)
    return sampler


# ---------------------------------------------------------------- shapes


GAUSSIAN = Gaussian()
PRIOR, LIKELIHOOD = GAUSSIAN.log_prior, GAUSSIAN.log_likelihood


@every
@pytest.mark.parametrize(
    ("function", "arguments", "match"),
    [
        (lambda x: GAUSSIAN(x), {"log_prior_fn": terms}, r"log_prior_fn must return one number .* of shape \(3,\)"),
        (lambda x: GAUSSIAN(x), {"log_prior_fn": terms, "vectorize": True}, r"one number .* of shape \(3,\)"),
        (lambda x: GAUSSIAN(x), {"log_prior_fn": lambda x: (0.0, "blob")}, "log_prior_fn must return one number"),
        (lambda x: GAUSSIAN(x), {"log_prior_fn": lambda x: None}, "log_prior_fn must return a number"),
        (None, {"log_prior_fn": PRIOR}, "exactly one of log_prob_fn .* got neither"),
        (GAUSSIAN, {"log_likelihood_fn": LIKELIHOOD}, "exactly one of log_prob_fn .* got both"),
        (None, {"log_likelihood_fn": LIKELIHOOD}, "pass log_prior_fn, or a log_likelihood_fn with a method log_prior"),
        (None, {"log_likelihood_fn": 3.0, "log_prior_fn": PRIOR}, "log_likelihood_fn must be callable"),
        (LIKELIHOOD, {"log_prior_fn": PRIOR}, "is the method log_likelihood, .* as log_likelihood_fn="),
    ],
)
def test_functions_that_cannot_be_sampled_are_refused(Sampler, function, arguments, match):
    with pytest.raises(ValueError, match=match):
        run(Sampler, function, **arguments)


@pytest.mark.parametrize("vectorize", [False, True])
@pytest.mark.parametrize("dtype", [None, float])
def test_as_many_values_as_parameters_may_be_blobs(vectorize, dtype):
    """The number and two blobs of three parameters, in an array, as emcee accepts them."""
    sampler = run(SMCSampler, WithBlobs(), vectorize=vectorize, blobs_dtype=dtype)
    chain, blobs = sampler.get_chain(flat=True), sampler.get_blobs(flat=True)
    assert np.allclose(blobs[:, 0], np.sum(chain**2, axis=1)) and np.array_equal(blobs[:, 1], chain[:, 0])

    def coordinates(x):  # each blob changes with one parameter only, the number with all
        return np.concatenate([np.expand_dims(Gaussian()(x), -1), x[..., 1:]], axis=-1)

    sampler = run(SMCSampler, coordinates, log_prior_fn=Gaussian().log_prior, vectorize=vectorize)
    assert np.array_equal(sampler.get_blobs(flat=True), sampler.get_chain(flat=True)[:, 1:])


# ---------------------------------------------------------------- log_likelihood_fn


@pytest.mark.parametrize(
    ("Sampler", "vectorize", "n"), covering([*SAMPLERS, TemperedSampler], [False, True], [N, 250], strength=1)
)
def test_a_log_likelihood_gives_the_run_of_its_posterior(Sampler, vectorize, n):
    posterior = Gaussian()
    expected = run(Sampler, posterior, vectorize=vectorize, n=n)
    sampler = run(
        Sampler,
        None,
        log_likelihood_fn=posterior.log_likelihood,
        log_prior_fn=posterior.log_prior,
        vectorize=vectorize,
        n=n,
    )
    assert np.allclose(sampler.get_chain(), expected.get_chain(), rtol=1e-9)
    assert np.allclose(sampler.get_log_prob(), expected.get_log_prob(), rtol=1e-9)
    assert sampler.log_evidence == pytest.approx(expected.log_evidence, rel=1e-9)
    chain = sampler.get_chain(flat=True)
    assert np.allclose(sampler.compute_log_prob(chain)[0], posterior(chain))


def test_the_likelihood_is_not_evaluated_outside_the_prior():
    seen = []

    def log_likelihood(x):
        seen.append(x.copy())
        return -0.5 * np.sum((x / 0.3) ** 2, axis=-1)

    box = Box([0.0, 0.0], [1.0, 1.0], log_likelihood)
    sampler = run(
        SMCSampler, None, box, log_likelihood_fn=log_likelihood, log_prior_fn=box.log_prior, vectorize=True, n=100
    )
    assert np.all(np.isfinite(box.log_prior(np.concatenate(seen))))
    assert sum(map(len, seen)) == sampler.evaluations


class Likelihood:
    """A likelihood with what a posterior may offer beside it, and blobs."""

    ndim, fast_parameters, parameter_names = 3, (2,), ["a", "b", "c"]

    def __init__(self):
        self.posterior = Gaussian()
        self.log_prior, self.sample_prior = self.posterior.log_prior, self.posterior.sample_prior

    def __call__(self, x, factor=1.0):
        return factor * self.posterior.log_likelihood(x), float(x[0])

    def report(self):
        return {"simulations": 7}


def test_attributes_of_a_log_likelihood_count():
    sampler = SMCSampler(N, 3, None, log_likelihood_fn=Likelihood(), kwargs={"factor": 1.0}, seed=1)
    sampler.run_mcmc(None, 2)
    chain = sampler.get_chain(flat=True)
    assert np.array_equal(sampler.get_blobs(flat=True), chain[:, 0])
    assert np.allclose(sampler.get_log_prob(flat=True), Gaussian()(chain))
    assert sampler.simulations < sampler.evaluations  # the fast parameter
    with pytest.raises(ValueError, match="log_likelihood_fn has 3 parameters"):
        SMCSampler(N, 2, None, log_likelihood_fn=Likelihood())


# ---------------------------------------------------------------- functions that change their argument


def spoiling(function):
    """The function, which then changes its argument in place."""

    def spoils(x, *args):
        value = function(x)
        x.clear() if isinstance(x, dict) else np.multiply(x, 2e11, out=x)
        return value

    return spoils


def functions_of(how, wrap):
    """The log-density and the settings of a sampler, whose functions are wrapped."""
    posterior = Gaussian()

    def named(function):
        return (lambda x: function(np.array([*x.values()]))) if how == "names" else function

    settings = {"vectorize": how == "batch", "log_prior_fn": wrap(named(posterior.log_prior))}
    if how == "names":
        settings["parameter_names"] = ["a", "b", "c"]
    if how == "args":
        settings["args"] = (1.0,)
    if how == "asynchronous":
        settings |= {"asynchronous": True, "recycle": True}
    if how in ("pool", "asynchronous"):
        settings["pool"] = InOrder()
    if how == "likelihood":
        return None, settings | {"log_likelihood_fn": wrap(posterior.log_likelihood)}
    return wrap(named(posterior)), settings


WAYS = ("point", "batch", "names", "args", "pool", "likelihood")


@pytest.mark.parametrize(("Sampler", "how"), [*covering(SAMPLERS, WAYS, strength=1), (SMCSampler, "asynchronous")])
def test_a_function_that_changes_its_argument_changes_no_point(Sampler, how, tmp_path):
    """Nor a run that is stopped and goes on from its file."""
    function, settings = functions_of(how, lambda function: lambda x, *args: function(x))
    expected = run(Sampler, function, nsteps=2, **settings)
    function, settings = functions_of(how, spoiling)
    settings["backend"] = emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
    with pytest.warns(SamplingWarning):
        run(Sampler, function, max_simulations=60, **settings)
    sampler = Sampler(N, 3, function, seed=1, **settings)
    sampler.run_mcmc(None, 1)  # and the step that the limit has replaced by an estimate
    assert np.array_equal(sampler.get_chain(), expected.get_chain())
    assert np.array_equal(sampler.get_log_prob(), expected.get_log_prob())
    assert sampler.simulations == expected.simulations
