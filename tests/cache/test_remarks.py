"""The warning of a model about simulations beyond the range of its laws is repeated where rows come from a cache."""

import multiprocessing
import os
from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    DisplacementHistory,
    FELikelihood,
    HalfNormal,
    Measurements,
    Posterior,
    RCColumn,
    SimulationCache,
    TruncatedNormal,
    check_result,
)
from samplers import SMCSampler

THETAS = np.array([[1.0], [1.1]])


def likelihood(path, drift=0.2, cached=True):
    """A column pushed to a drift, of which the bars fracture at 20 %."""
    model = RCColumn.lhpost(DisplacementHistory("push", np.linspace(0.0, 1.0, 30)), parameters=("fy",))
    model = replace(model, loading=DisplacementHistory("push", np.linspace(0.0, drift * model.height, 30)))
    measurements = Measurements(model.channels, model.dt, np.ones((len(model.channels), model.n_steps)))
    cache = SimulationCache(path, verify=False) if cached else None  # a verified row is simulated, with its warning
    return FELikelihood(model, measurements, cache=cache)


def fill(path, drift=0.2):
    likelihood(path, drift).misfit(THETAS)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache.sqlite"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
@pytest.mark.parametrize(("drift", "expected"), [(0.2, 1), (0.05, 0)])
def test_warning_of_another_process_is_repeated_once(drift, expected, path, caplog):
    process = multiprocessing.get_context("fork").Process(target=fill, args=(path, drift))
    process.start()
    process.join()
    assert process.exitcode == 0 and not caplog.records
    for _ in range(2):
        again = likelihood(path, drift)
        again.misfit(THETAS[:1])
        assert (again.simulations, again.simulator.disk_hits) == (0, 1)
    assert len(caplog.records) == expected
    if expected:
        assert f"simulations of this model in {path}: a bar strain of" in caplog.text
        assert "exceeds the ultimate strain of the steel" in caplog.text and "{'fy': " in caplog.text


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("drift", [0.2, 0.05])
def test_a_stored_remark_is_a_finding_of_the_result(drift, path):
    """The second run takes all simulations from the file, so that its model has made no remark."""
    for again in (False, True):
        run = likelihood(path, drift)
        sigmas = {name: HalfNormal(1e6) for name in run.noise.parameter_names}
        posterior = Posterior(run, {"fy": TruncatedNormal(1.0, 0.05)} | sigmas)
        sampler = SMCSampler(24, posterior.ndim, posterior, vectorize=True, seed=1, min_moves=1, max_moves=1)
        sampler.run_mcmc(None, 1)
        assert not (again and run.simulations)  # check_result compares more draws where a simulation took less time
        titles = [finding.kind for finding in check_result(sampler).findings]
        assert ("Beyond the range of a law of the model" in titles) == (drift > 0.1)
