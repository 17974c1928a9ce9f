"""Clients with pools of their own: the posterior is sent to spawned processes, as on systems without fork."""

import multiprocessing
import pickle
import random

import numpy as np
import pytest

from fe_likelihoods.adapters import to_bilby

from .problem import make_posterior


@pytest.fixture(scope="module")
def pool():
    with multiprocessing.get_context("spawn").Pool(2) as processes:
        yield processes


def test_bound_methods_pickle():
    posterior = make_posterior()
    x = posterior.sample_prior(5, 1)
    for name in ("log_prob", "log_likelihood", "finite_log_likelihood", "negative_log_prob", "log_prior"):
        method = getattr(posterior, name)
        np.testing.assert_array_equal(pickle.loads(pickle.dumps(method))(x), method(x))


@pytest.mark.parametrize("name", ["emcee", pytest.param("zeus", marks=pytest.mark.slow)])
def test_ensemble_through_a_pool_is_the_same_chain(name, client_named, pool):
    client = client_named(name)
    posterior = make_posterior()
    start = posterior.sample_start(10, 1)
    ensemble = __import__(client.module).EnsembleSampler
    quiet = {"verbose": False} if name == "zeus" else {}

    def chain(**kwargs):
        np.random.seed(3)  # noqa: NPY002 - emcee and zeus draw from the global streams
        random.seed(3)
        sampler = ensemble(10, posterior.ndim, posterior, **kwargs, **quiet)
        sampler.run_mcmc(start, 10, progress=False)
        return sampler.get_chain()

    np.testing.assert_array_equal(chain(pool=pool), chain(vectorize=True))


@pytest.mark.slow
def test_dynesty_through_a_pool(client_named, pool):
    client_named("dynesty")
    import dynesty

    posterior = make_posterior()
    sampler = dynesty.NestedSampler(
        posterior.log_likelihood,
        posterior.prior_transform,
        posterior.ndim,
        nlive=40,
        pool=pool,
        queue_size=2,
        rstate=np.random.default_rng(1),
    )
    sampler.run_nested(maxiter=60, print_progress=False, add_live=False)
    found = sampler.results
    assert posterior.report()["simulations"] == 0, "all simulations run in the processes"
    expected = posterior.finite_log_likelihood(found.samples)
    possible = expected > -1e99
    np.testing.assert_array_equal(found.logl[possible], expected[possible])
    assert possible.any() and np.all(found.logl[~possible] <= -1e99)


@pytest.mark.slow
def test_bilby_with_npool(client_named, monkeypatch, tmp_path):
    client_named("bilby")
    import bilby

    monkeypatch.setattr(multiprocessing, "Pool", multiprocessing.get_context("spawn").Pool)
    posterior = make_posterior()
    likelihood, priors = to_bilby(posterior)
    result = bilby.run_sampler(
        likelihood,
        priors,
        sampler="dynesty",
        npool=2,
        nlive=30,
        sample="unif",
        bound="multi",
        maxiter=50,
        outdir=str(tmp_path),
        save=False,
        resume=False,
        check_point=False,
        check_point_plot=False,
        print_progress=False,
    )
    samples = result.nested_samples
    points = samples[posterior.parameter_names].to_numpy()
    np.testing.assert_array_equal(samples["log_likelihood"], posterior.finite_log_likelihood(points))
