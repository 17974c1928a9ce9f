"""Simulations beyond the range of the laws of a model are a finding, also where rows come from a cache."""

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
    TruncatedNormal,
    check_result,
)
from samplers import SMCSampler


def likelihood(path, drift):
    """A column pushed to a drift, of which the bars fracture at 20 %."""
    model = RCColumn.lhpost(DisplacementHistory("push", np.linspace(0.0, 1.0, 30)), parameters=("fy",))
    model = replace(model, loading=DisplacementHistory("push", np.linspace(0.0, drift * model.height, 30)))
    measurements = Measurements(model.channels, model.dt, np.ones((len(model.channels), model.n_steps)))
    return FELikelihood(model, measurements, cache=path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("drift", [0.2, 0.05])
def test_a_law_beyond_its_range_is_a_finding_of_the_result(drift, tmp_path):
    """The second run takes all simulations from the file; those that verify its rows make the remark."""
    for again in (False, True):
        run = likelihood(tmp_path / "cache.sqlite", drift)
        sigmas = {name: HalfNormal(1e6) for name in run.noise.parameter_names}
        posterior = Posterior(run, {"fy": TruncatedNormal(1.0, 0.05)} | sigmas)
        sampler = SMCSampler(24, posterior.ndim, posterior, vectorize=True, seed=1, min_moves=1, max_moves=1)
        sampler.run_mcmc(None, 1)
        assert not (again and run.simulations)  # check_result compares more draws where a simulation took less time
        titles = [finding.kind for finding in check_result(sampler).findings]
        assert ("Beyond the range of a law of the model" in titles) == (drift > 0.1)
