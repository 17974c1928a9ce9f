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
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
)
from fe_likelihoods.checks.compared import fit_data_sets
from fe_likelihoods.checks.run import read_run
from fe_likelihoods.noise.draws import sample_noise
from fe_likelihoods.reporting.contents import residual_sentences
from samplers import SMCSampler, compare_models, to_arviz

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


@pytest.mark.parametrize("name", ["envelope", "bands"])
def test_reports_check_whitened_residuals_and_arviz_has_the_blocks(name, rng):
    noise, _, parameters = NOISES[name]
    measured = data_of(noise, parameters, rng)
    likelihood = FELikelihood(MODEL, measured, noise)
    names = likelihood.noise.parameter_names
    posterior = Posterior(likelihood, {"factor": TruncatedNormal(1.0, 0.3)} | {each: HalfNormal(1.0) for each in names})
    sampler = SMCSampler(60, posterior.ndim, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 1, progress=False)
    fits = fit_data_sets(read_run(sampler, posterior))
    checks = fits.fits[0].channels[0].checks
    assert checks.standard_deviation[0] == pytest.approx(1.0, abs=0.15)  # of whitened residuals
    assert checks.white[0] > 1e-3 and checks.normal[0] > 1e-3
    assert "White: " in residual_sentences(fits)[0]
    # the residuals themselves are neither
    plain = posterior.likelihood.residuals(sampler.get_chain(flat=True).mean(axis=0))
    assert abs(np.std(plain) - 1.0) > 0.3
    data = to_arviz(sampler, posterior, draws=20)
    replicates = data.posterior_predictive["top"].values.reshape(-1, N)
    assert replicates.shape == (20, N) and np.isfinite(replicates).all()
    blocks = next(iter(data.log_likelihood.data_vars.values()))
    assert blocks.shape[-1] > 3 and np.isfinite(blocks.values).all()
