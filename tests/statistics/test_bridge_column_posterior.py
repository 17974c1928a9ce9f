"""The main job: is the SMC posterior of the bridge column right, and does it explain the data?

Slow: ``pytest -m slow -s tests/statistics/test_bridge_column_posterior.py`` prints the figures: minutes for
the bundled data, a quarter of an hour for each posterior of the real record on two cores. ``SEED`` is the sampler's.
"""

import functools
import os
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import problems, rrmse
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.priors.distributions import TruncatedNormal
from fe_likelihoods.signals.readers import read_csv
from fe_likelihoods.signals.records import Record
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


# ------------------------------------------------------------------ the posteriors


def bundled(_: Record) -> Posterior:
    return problems.bridge_column()


def bundled_reduced(_: Record) -> Posterior:
    """One sample in four, and steps four times as long, as in ``make update``."""
    return problems.bridge_column(every=4)


def real(record: Record) -> Posterior:
    """Measured by the finer model, as everywhere."""
    return problems.bridge_column(record=record)


def real_wide_prior(record: Record) -> Posterior:
    """A prior on a1 ten times as wide: what is left is the pull of the coarser mesh and step."""
    posterior = real(record)
    return Posterior(posterior.likelihood, posterior.prior.distributions | {"a1": TruncatedNormal(1.0, 6.0)})


@pytest.fixture(scope="module")
def record(shared):
    return read_csv(shared / "records" / "loma_prieta_1989_apeel2_redwood_city_133.csv").scale(0.85)


@pytest.fixture(scope="module")
def run(request) -> Callable[..., Run]:
    """Samples a posterior, once."""

    @functools.cache
    def run(make: Callable[[Record], Posterior]) -> Run:
        return sample(make(request.getfixturevalue("record")), int(os.environ.get("SEED", "1")))

    return run


@pytest.mark.parametrize("make", [real, real_wide_prior, bundled, bundled_reduced])
def test_smc_agrees_with_importance_sampling(run, make):
    smc, check = run(make).smc, run(make).check
    tolerance = 4.0 * np.hypot(smc.error, check.error)
    assert np.all(np.abs(smc.mean - check.mean) < tolerance)
    np.testing.assert_allclose(smc.sd, check.sd, rtol=0.2)
    difference = abs(smc.log_evidence - check.log_evidence)
    assert difference < 4.0 * np.hypot(smc.log_evidence_error, check.log_evidence_error)


def test_a_start_on_the_coarse_posterior_agrees(run):
    """Mean, sd and evidence of the fine posterior; half the work, counted in samples of the record simulated."""
    alone, posterior = run(bundled_reduced), bundled_reduced(None)
    options = {"vectorize": True, "seed": int(os.environ.get("SEED", "1"))}
    first = SMCSampler(WALKERS, posterior.ndim, posterior.coarse, **options)
    first.run_mcmc(None, 0)
    sampler = SMCSampler(WALKERS, posterior.ndim, posterior, start_density=first.proposal.logpdf, **options)
    sampler.run_mcmc(first.proposal.rvs(WALKERS, 1), SWEEPS)
    samples = sampler.get_chain(flat=True)
    sd = samples.std(axis=0)
    assert np.all(
        np.abs(samples.mean(axis=0) - alone.check.mean) < 4.0 * np.hypot(sd / np.sqrt(WALKERS), alone.check.error)
    )
    np.testing.assert_allclose(sd, alone.check.sd, rtol=0.2)
    difference = abs(sampler.log_evidence - alone.check.log_evidence)
    assert difference < 4.0 * np.hypot(sampler.log_evidence_error, alone.check.log_evidence_error)
    fine, coarse = posterior.likelihood, posterior.coarse.likelihood
    samples_alone = (alone.posterior.likelihood.simulations - DRAWS) * fine.measurements.n_steps
    work = fine.simulations * fine.measurements.n_steps + coarse.simulations * coarse.measurements.n_steps
    print(
        f"\n{fine.simulations} simulations, {coarse.simulations} coarse: {work / samples_alone:.2f} of the work alone"
    )
    assert work < 0.75 * samples_alone


def distance(estimate: Estimate) -> np.ndarray:
    return (estimate.mean - TRUTH) / estimate.sd


@pytest.mark.parametrize("make", [bundled, bundled_reduced, real, real_wide_prior])
def test_the_truth_is_found(run, make):
    """All but the damping pair, whose truth lies 6.3 prior sd out."""
    z = distance(run(make).check)
    assert np.all(np.abs(np.delete(z, [2, 3])) < 3.0), z


def test_the_prior_pulls_the_damping_and_so_does_the_mesh(run):
    """With a wide prior what is left of the pull is that of the coarser mesh and step; the rest is the prior's."""
    both, mesh = (run(make).check.mean[3] for make in (real, real_wide_prior))
    print(
        f"a1: truth {TRUTH[3]}; {mesh:.3f} with a wide prior: mesh and step pull it; {both:.3f} with the paper's prior"
    )
    assert both < mesh < TRUTH[3]


@pytest.mark.parametrize(
    ("make", "before", "after"),
    [(bundled, [0.95, 0.85], [0.35, 0.22]), (real, [0.8, 0.8], [0.25, 0.08])],
)
def test_updating_explains_the_response(run, make, before, after):
    posterior, samples = run(make).posterior, run(make).samples
    model, measured = posterior.likelihood.model, posterior.likelihood.measurements.values
    nominal, updated = (rrmse(model.simulate(theta), measured) for theta in (np.ones(5), samples.mean(axis=0)[:5]))
    print(f"RRMSE before {nominal}, after {updated}")
    assert np.all(nominal > before)
    assert np.all(updated < after)
