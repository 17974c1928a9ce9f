"""Clients with pools of their own, as joblib.Parallel; a worker that would compute another model is refused."""

import importlib.util
import random
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, FunctionModel, HalfNormal, Measurements, Posterior, Uniform
from fe_likelihoods.problems import bridge_column
from fe_likelihoods.simulation.failure_reasons import ChangedModel
from tests.covering import covering

from .problem import make_posterior, starts_of

CHANNELS = (Channel("u", "displacement", "m"),)
TIME = np.linspace(0.0, 1.0, 20)
GAIN = 2.0


def respond(theta):
    return GAIN * theta[0] * TIME[None]


def posterior_of_a_function():
    model = FunctionModel(respond, ("k",), CHANNELS, 0.01, len(TIME))
    likelihood = FELikelihood(model, Measurements(CHANNELS, 0.01, 2.0 * TIME[None]))
    return Posterior(likelihood, {"k": Uniform(0.5, 1.5), "sigma_u": HalfNormal(0.1)})


@pytest.mark.skipif(importlib.util.find_spec("joblib") is None, reason="NO JOBLIB: `pip install joblib` to test it")
@pytest.mark.parametrize(
    ("backend", "make"),
    covering(["loky", "multiprocessing", "threading"], [posterior_of_a_function, bridge_column], strength=1),
)
def test_parallel_gives_the_values_of_this_process(make, backend):
    from joblib import Parallel, delayed

    posterior = make()
    points = posterior.sample_prior(6, 1)
    expected = [posterior(point) for point in points]
    assert Parallel(n_jobs=2, backend=backend)(delayed(posterior)(point) for point in points) == expected


def test_a_worker_with_other_values_is_refused(monkeypatch):
    """It imports this module, whose value was changed in this process only."""
    posterior = posterior_of_a_function()
    point = posterior.sample_prior(1, 1)[0]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(posterior, point).result() == posterior(point)
        monkeypatch.setattr(f"{__name__}.GAIN", 3.0)
        with pytest.raises(ChangedModel, match=r"is not the one that was sent \(.*GAIN differ\)"):
            pool.submit(posterior_of_a_function(), point).result()


@pytest.mark.parametrize("name", ["emcee", pytest.param("zeus", marks=pytest.mark.slow)])
def test_ensemble_through_a_pool_is_the_same_chain(name, client_named):
    client = client_named(name)
    posterior = make_posterior()
    start = starts_of(posterior, 10, 1)
    ensemble = __import__(client.module).EnsembleSampler
    quiet = {"verbose": False} if name == "zeus" else {}

    def chain(**kwargs):
        np.random.seed(3)  # noqa: NPY002 - emcee and zeus draw from the global streams
        random.seed(3)
        sampler = ensemble(10, posterior.ndim, posterior, **kwargs, **quiet)
        sampler.run_mcmc(start, 10, progress=False)
        return sampler.get_chain()

    with get_context("spawn").Pool(2) as pool:
        np.testing.assert_array_equal(chain(pool=pool), chain(vectorize=True))
