"""Clients with pools of their own: the posterior is sent to spawned processes, as on systems without fork."""

import multiprocessing
import pickle
import random

import numpy as np
import pytest

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
