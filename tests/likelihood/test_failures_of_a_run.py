"""What a user reads of simulations that fail, and what samplers record of them."""

import os
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    SimulationFailed,
    Uniform,
)
from fe_likelihoods.simulation.failure_reasons import TransientReason
from samplers import SMCSampler


def run(function, vectorize=True, pool=None):
    channel, time = Channel("top", "displacement", "m"), 0.01 * np.arange(50)
    model = FunctionModel(function(time), ("rate",), [channel], dt=0.01, n_steps=50)
    response = np.sin(3.0 * time)[None] + 0.1 * np.cos(90.0 * time)
    likelihood = FELikelihood(model, Measurements([channel], 0.01, response))
    posterior = Posterior(likelihood, {"rate": Uniform(1.0, 5.0), "sigma_top": HalfNormal(0.1)})
    sampler = SMCSampler(20, posterior.ndim, posterior, vectorize=vectorize, pool=pool, seed=1)
    sampler.run_mcmc(None, 1)
    return sampler


def test_a_response_of_the_wrong_shape_is_named_where_the_run_ends():
    with pytest.raises(ValueError, match="no point of the population") as caught:
        run(lambda time: lambda theta: np.sin(theta[0] * time))
    assert "80 x the response has shape (50,), expected (n_channels, n_steps) = (1, 50)" in caught.value.__notes__[0]
    summary = run(lambda time: lambda theta: [np.sin(theta[0] * time)[: 50 if theta[0] < 4.0 else 49]]).describe()
    assert " x the response has shape (1, 49), expected (n_channels, n_steps) = (1, 50))." in summary


def limited(theta):
    if theta[0] > 4.0:
        raise SimulationFailed("no convergence")
    return [np.full(50, theta[0])]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the pool forks")
def test_reasons_come_back_from_the_pool_of_a_sampler():
    with get_context("fork").Pool(2) as pool:
        pooled = run(lambda time: limited, vectorize=False, pool=pool)
    assert {each["reason"] for each in pooled.failures} == {"no convergence"}
    assert pooled.failure_count == 0 and len(pooled.failures) > 0  # as in this process


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the pool forks")
def test_what_a_run_writes_is_no_input_of_simulations_in_the_pool_of_a_sampler(tmp_path, monkeypatch):
    (folder := tmp_path / "run").mkdir()
    (tmp_path / "log.txt").write_text("of another program")
    monkeypatch.chdir(folder)  # with the cache, whose SQLite locks must hold
    channel = Channel("top", "displacement", "m")
    model = FunctionModel(limited, ("rate",), [channel], dt=0.01, n_steps=50)
    likelihood = FELikelihood(model, Measurements([channel], 0.01, np.ones((1, 50))), cache="cache.sqlite")
    points = np.column_stack([np.linspace(1.0, 3.9, 40), np.full(40, 0.1)])
    with get_context("fork").Pool(2) as pool:
        for start in range(4):
            Path("chain.txt").write_text(f"{start} batches")
            values = pool.map_async(likelihood.log_likelihood, points[start::4], chunksize=1).get(60.0)
            assert np.isfinite(values).all()
    cache = likelihood.simulator.cache
    assert cache.info().simulations == 40
    assert not [path for _, files, _ in cache.labels_of(model.fingerprint) for path in files if str(tmp_path) in path]


@pytest.mark.parametrize("memory_rows", [0, 100])
def test_reasons_outlast_the_simulations_in_memory_until_one_succeeds(memory_rows):
    broken = [True]

    def function(theta):
        if theta[0] > 4.0:
            raise SimulationFailed("no convergence")
        if broken and theta[0] == 2.0:
            raise SimulationFailed(TransientReason("no licence was free"))
        return [np.full(5, theta[0])]

    channel = Channel("top", "displacement", "m")
    model = FunctionModel(function, ("rate",), [channel], dt=0.01, n_steps=5)
    likelihood = FELikelihood(model, Measurements([channel], 0.01, np.ones((1, 5))), memory_rows=memory_rows)
    posterior = Posterior(likelihood, {"rate": Uniform(1.0, 5.0), "sigma_top": HalfNormal(0.1)})
    points = np.array([[2.0, 0.1], [4.5, 0.1], [3.0, 0.1]])
    posterior(points)
    assert posterior.failures_at(points) == ["no licence was free", "no convergence", ""]
    assert np.isnan(posterior.failure(points[0])[1])
    assert [posterior.failure(point) for point in points[1:]] == [("no convergence", -np.inf), ("", -np.inf)]
    broken.clear()
    assert np.isfinite(posterior(points[0])) == (memory_rows == 0)
    assert posterior.failures_at(points)[0] == ("no licence was free" if memory_rows else "")
