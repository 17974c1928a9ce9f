"""What a user reads when all simulations fail."""

import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, FunctionModel, HalfNormal, Measurements, Posterior, Uniform
from samplers import SMCSampler


def run(function):
    channel, time = Channel("top", "displacement", "m"), 0.01 * np.arange(50)
    model = FunctionModel(function(time), ("rate",), [channel], dt=0.01, n_steps=50)
    response = np.sin(3.0 * time)[None] + 0.1 * np.cos(90.0 * time)
    likelihood = FELikelihood(model, Measurements([channel], 0.01, response))
    posterior = Posterior(likelihood, {"rate": Uniform(1.0, 5.0), "sigma_top": HalfNormal(0.1)})
    sampler = SMCSampler(20, posterior.ndim, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 1)
    return sampler


def test_a_response_of_the_wrong_shape_is_named_where_the_run_ends():
    with pytest.raises(ValueError, match="no point of the population") as caught:
        run(lambda time: lambda theta: np.sin(theta[0] * time))
    assert "20 x the response has shape (50,), expected (n_channels, n_steps) = (1, 50)" in caught.value.__notes__[0]
    summary = run(lambda time: lambda theta: [np.sin(theta[0] * time)[: 50 if theta[0] < 4.0 else 49]]).describe()
    assert " x the response has shape (1, 49), expected (n_channels, n_steps) = (1, 50))." in summary
