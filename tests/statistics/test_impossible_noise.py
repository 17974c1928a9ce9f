"""Noise parameters that are impossible whatever is simulated end the support of the density: they are no failures."""

import emcee
import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    SimulationFailed,
    TruncatedNormal,
)
from samplers import SMCSampler

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
CHANNEL, DT, N = (Channel("top", "displacement", "mm"),), 0.02, 100
TIME = DT * np.arange(N)


def make_posterior(limit=np.inf, joint=False):
    """Amplitude and phase of a vibration under noise of the same size, so that evaluated shares are often above 1.

    Simulations of larger amplitudes than `limit` fail.
    """

    def simulate(theta):
        if theta[0] > limit:
            raise SimulationFailed("no convergence")
        return [0.01 * theta[0] * np.sin(9.0 * TIME + theta[1] - 1.0)]

    noise = 0.008 * np.random.default_rng(0).standard_normal((1, N))
    measured = Measurements(CHANNEL, DT, 0.01 * np.sin(9.0 * TIME) + noise)
    model = FunctionModel(simulate, ["amplitude", "phase"], CHANNEL, DT, N, version=str(limit))
    likelihood = FELikelihood(model, measured, GaussianNoise(measured.channels, shares_of="measured"))
    prior = {name: TruncatedNormal(1.0, 0.5) for name in ("amplitude", "phase")} | {"share_top": HalfNormal(1.0)}
    return Posterior(JointLikelihood({"first": likelihood}) if joint else likelihood, prior)


def run(posterior, **options):
    options = {"vectorize": True, "seed": 1, "max_failure_share": 0.99} | options
    sampler = SMCSampler(200, posterior.ndim, posterior, **options)
    sampler.run_mcmc(None, 1 - sampler.iteration)
    return sampler


def shares_beyond_one(sampler):
    """Number of evaluated points whose share of noise is above 1."""
    known = sampler._record.latest(sampler._record.count)
    return np.count_nonzero(known.coords[:, 2] >= 1.0)


@pytest.mark.parametrize("joint", [False, True])
def test_impossible_noise_is_no_failure(joint):
    posterior = make_posterior(joint=joint)
    sampler = run(posterior)
    assert shares_beyond_one(sampler) > 100
    assert posterior.report()["failure_count"] == sampler._near.failed == 0
    assert sampler.verdict.status == "converged"


@pytest.mark.parametrize("vectorize", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_failures_are_told_from_impossible_noise(vectorize):
    """Both border on the samples, and the failures alone are counted as such."""
    posterior = make_posterior(limit=1.0)
    sampler = run(posterior, vectorize=vectorize)
    near = sampler._near
    assert shares_beyond_one(sampler) > 100 and near.place == "border"
    assert near.failed <= posterior.report()["failure_count"] and sampler.verdict.status == "not usable"


@pytest.mark.parametrize("limit", [pytest.param(np.inf, marks=pytest.mark.slow), 1.0])
def test_a_run_that_goes_on_from_its_file_says_the_same(tmp_path, limit):
    """The likelihood of the second process has counted no failure: it took all points from the record."""
    whole = run(make_posterior(limit))
    path = str(tmp_path / "run.h5")
    first = SMCSampler(
        200,
        3,
        make_posterior(limit),
        vectorize=True,
        seed=1,
        max_failure_share=0.99,
        max_simulations=400,
        backend=emcee.backends.HDFBackend(path),
    )
    first.run_mcmc(None, 1)
    first._record.close()
    sampler = run(make_posterior(limit), backend=emcee.backends.HDFBackend(path))
    assert np.array_equal(sampler.get_chain(), whole.get_chain())
    assert (sampler.verdict, sampler._near) == (whole.verdict, whole._near)


def test_what_is_possible_is_known_without_a_simulation():
    for joint in (False, True):
        posterior = make_posterior(joint=joint)
        points = np.array([[1.0, 1.0, 0.5], [1.0, 1.0, 1.0], [1.0, 1.0, 1.5], [1.0, 1.0, -0.5], [np.nan, 1.0, 0.5]])
        possible = posterior.possible(points)
        assert possible.tolist() == [True, False, False, False, False] and posterior.likelihood.simulations == 0
        assert [posterior.possible(point) for point in points] == possible.tolist()
        assert posterior.possible({"amplitude": 1.0, "phase": 1.0, "share_top": 0.5}) is True
        assert np.array_equal(np.isfinite(posterior(points)), possible)
