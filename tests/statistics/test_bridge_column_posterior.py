"""The main job: is the SMC posterior of the bridge column right, and does it explain the data?

Slow (minutes): ``pytest -m slow -s tests/statistics/test_bridge_column_posterior.py`` prints the figures. One sample in
four of the bundled data is used, as in ``make update``.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import problems
from fe_likelihoods.posterior import Posterior
from samplers import SMCSampler

pytestmark = pytest.mark.slow

TRUTH = np.array([*problems.BRIDGE_COLUMN_MEANS.values(), *problems.BRIDGE_COLUMN_NOISE.values()])
WALKERS, SWEEPS, DRAWS = 500, 4, 2000


class Estimate(NamedTuple):
    """Posterior mean, its Monte-Carlo error, sd, log-evidence and its error."""

    mean: np.ndarray
    error: np.ndarray
    sd: np.ndarray
    log_evidence: float
    log_evidence_error: float


class Run(NamedTuple):
    """One posterior, sampled twice."""

    posterior: Posterior
    samples: np.ndarray
    smc: Estimate
    check: Estimate


def importance_sampling(posterior: Posterior, samples: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Independent of the sampler's own weights: fresh draws of a Student t with the samples' mean and covariance."""
    proposal = stats.multivariate_t(samples.mean(axis=0), np.cov(samples.T) * 4.0 / 6.0, df=6, seed=rng)
    draws = proposal.rvs(DRAWS)
    log_weights = posterior(draws) - proposal.logpdf(draws)
    top = log_weights.max()
    weights = np.exp(log_weights - top)
    log_evidence = float(np.log(weights.mean()) + top)
    weights /= weights.sum()
    mean = weights @ draws
    sd = np.sqrt(weights @ (draws - mean) ** 2)
    error = np.sqrt(weights**2 @ (draws - mean) ** 2)
    return Estimate(mean, error, sd, log_evidence, float(np.sqrt(weights @ weights - 1.0 / DRAWS)))


def sample(posterior: Posterior, seed: int) -> Run:
    """SMC, then importance sampling from a density fitted to its draws."""
    sampler = SMCSampler(WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, SWEEPS)
    samples = sampler.get_chain(flat=True)
    sd = samples.std(axis=0)
    # walkers are nearly independent; what their chains add is not counted
    smc = Estimate(samples.mean(axis=0), sd / np.sqrt(WALKERS), sd, sampler.log_evidence, sampler.log_evidence_error)
    run = Run(posterior, samples, smc, importance_sampling(posterior, samples, np.random.default_rng(seed)))
    report = posterior.report()
    print(f"\n{len(sampler.ladder)} stages, {report['simulations']} simulations, {report['failure_reasons']}")
    for name, mean, s, m2, s2, true in zip(
        posterior.parameter_names, smc.mean, smc.sd, run.check.mean, run.check.sd, TRUTH, strict=True
    ):
        print(
            f"{name:<20} SMC {mean:.5g} +- {s:.3g}   importance sampling {m2:.5g} +- {s2:.3g}   truth {true:.5g}"
            f" ({(m2 - true) / s2:+.2f} sd)"
        )
    print(
        f"log evidence: SMC {smc.log_evidence:.2f} +- {smc.log_evidence_error:.2f}, "
        f"importance sampling {run.check.log_evidence:.2f} +- {run.check.log_evidence_error:.2f}"
    )
    return run


@pytest.fixture(scope="module")
def run():
    return sample(problems.bridge_column(every=4), seed=1)


def test_smc_agrees_with_importance_sampling(run):
    tolerance = 4.0 * np.hypot(run.smc.error, run.check.error)
    assert np.all(np.abs(run.smc.mean - run.check.mean) < tolerance)
    np.testing.assert_allclose(run.smc.sd, run.check.sd, rtol=0.2)
    difference = abs(run.smc.log_evidence - run.check.log_evidence)
    assert difference < 4.0 * np.hypot(run.smc.log_evidence_error, run.check.log_evidence_error)


def test_the_noise_is_found(run):
    """Noise levels within 3 sd; the others are shifted by the long steps of the reduced setting."""
    distance = (run.check.mean - TRUTH) / run.check.sd
    assert np.all(np.abs(distance[5:]) < 3.0), distance


def test_updating_explains_the_response(run):
    model, measured = run.posterior.likelihood.model, run.posterior.likelihood.measurements.values

    def rrmse(theta):
        return np.sqrt(np.sum((model.simulate(theta) - measured) ** 2, axis=1) / np.sum(measured**2, axis=1))

    before, after = rrmse(np.ones(5)), rrmse(run.smc.mean[:5])
    print(f"RRMSE before {before}, after {after}")
    assert np.all(before > 1.0)
    assert after[0] < 0.30 and after[1] < 0.15
