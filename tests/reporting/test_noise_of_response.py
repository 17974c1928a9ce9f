"""What a report and arviz show of noises whose level depends on the response, and which noise the evidence prefers."""

import numpy as np
import pytest
from scipy.special import logsumexp

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    Measurements,
)
from fe_likelihoods.noise.draws import sample_noise
from samplers import compare_models

N, DT, TOP = 400, 0.02, (Channel("top", "acceleration", "m/s2"),)
SENSOR = (0.05,)


def response(theta):
    time = DT * np.arange(N)
    return theta[0] * (np.exp(-(((time - 3.0) / 1.5) ** 2)) * np.sin(20.0 * time))[None]


MODEL = FunctionModel(response, ["factor"], TOP, DT, N)
SHARES, LEVELS = np.linspace(0.02, 1.5, 45), np.linspace(0.01, 0.75, 45)
RHO = np.linspace(-0.98, 0.98, 45)
NOISES = {  # the noise, the axes of the grid of its parameters, and the parameters that make data
    "white": (GaussianNoise(TOP, sensor=SENSOR), [LEVELS], [0.25]),
    "autoregressive": (AutoregressiveNoise(TOP, sensor=SENSOR), [LEVELS, RHO], [0.25, 0.8]),
    "modulated": (GaussianNoise(TOP, level="response", window=0.6, sensor=SENSOR), [SHARES], [0.6]),
    "envelope": (GaussianNoise(TOP, level="response", window=0.6, sensor=SENSOR, local=1.0), [SHARES], [0.6]),
    "bands": (GaussianNoise(TOP, groups=(5.0,), level="response", sensor=SENSOR), [SHARES, SHARES], [0.8, 0.3]),
}


def data_of(noise, parameters, rng):
    truth = response([1.0])
    fitted = getattr(noise, "with_measurements", lambda _: noise)(Measurements(TOP, DT, truth))
    return Measurements(TOP, DT, truth + sample_noise(fitted, np.array([parameters]), 1, DT).draw(0, N, rng, truth))


def log_evidence(noise, axes, measured):
    """The evidence under uniform priors over the axes, by the midpoint rule."""
    likelihood = FELikelihood(MODEL, measured, noise)
    factors = np.linspace(0.7, 1.3, 61)
    grid = np.stack([each.ravel() for each in np.meshgrid(*axes, indexing="ij")], axis=1)
    statistics = likelihood.simulator.statistics(factors[:, None])
    values = [likelihood.noise.log_likelihood(np.tile(one, (len(grid), 1)), N, grid) for one in statistics]
    return logsumexp(values) - np.log(np.size(values))


@pytest.mark.parametrize("truth", list(NOISES))
def test_the_evidence_prefers_the_noise_that_made_the_data(truth, rng):
    measured = data_of(*[NOISES[truth][k] for k in (0, 2)], rng)
    found = {name: (log_evidence(noise, axes, measured), 0.01) for name, (noise, axes, _) in NOISES.items()}
    if truth == "white":  # a level that hardly changes over this record is nearly white
        assert found.pop("modulated")[0] - found["white"][0] < 2.0
    comparison = compare_models(found)
    assert comparison.best == truth
    others = np.delete(comparison.log_bayes_factor, comparison.names.index(truth))
    # white noise is autoregressive noise without correlation, which costs the width of its prior only
    assert others.max() < (-1.0 if truth == "white" else -10.0)
    # the evidence of shares of the measured channel, not normalised, is near that of white noise, which has the same
    # likelihood
    relative = log_evidence(
        GaussianNoise(measured.channels, level="measured", sensor=SENSOR), [SHARES[SHARES < 1.0]], measured
    )
    assert abs(relative - found["white"][0]) < 2.0
