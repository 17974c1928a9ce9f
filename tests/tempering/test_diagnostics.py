"""Alarms: each one on runs that are wrong and on runs that are right."""

import warnings

import numpy as np
import pytest
from scipy import stats

from samplers import EvidenceCheck, SamplingWarning, SMCSampler, TMCMCSampler
from samplers.proposals.mixture import fit_mixture, log_density
from samplers.tempering.diagnostics import check_evidence, check_fallback
from samplers.tempering.evidence_check import expected_yield
from samplers.tempering.population import Stage
from tests.benchmarks import truth_targets


def _check(log_evidence, error=0.05, effective=200.0, shape=0.3):
    return EvidenceCheck(log_evidence, error, effective, shape, 500)


def test_equal_evidences_raise_no_doubt():
    assert check_evidence(-10.0, 0.1, _check(-10.2)) == []
    assert check_evidence(-10.0, 0.1, _check(-10.9, effective=30.0, shape=0.9)) == []


def test_reliable_check_that_differs_by_three_joint_errors_is_reported_without_condemning_the_posterior():
    (doubt,) = check_evidence(-10.0, 0.1, _check(-10.5))
    assert doubt.message.index("more walkers") < doubt.message.index("log_prior is a function of your own")
    assert not doubt.grave


@pytest.mark.parametrize("value", [-8.5, float("-inf")])
def test_unreliable_check_that_differs_by_more_than_one_is_grave(value):
    (doubt,) = check_evidence(-10.0, 0.1, _check(value, error=0.4, effective=12.0, shape=0.9))
    assert "heavier tails" in doubt.message
    assert doubt.message.index("more walkers and more moves") < doubt.message.index("log_prior")
    assert doubt.grave


def test_check_without_information_is_reported():
    (doubt,) = check_evidence(-10.0, 0.1, _check(-10.4, error=0.5, effective=3.0, shape=1.1))
    assert "no mixture fits the final points" in doubt.message


@pytest.mark.parametrize(
    ("recycled", "check_of_it", "lost"), [(-9.3, -9.2, True), (-10.05, -10.0, False), (-9.3, -10.0, False)]
)
@pytest.mark.parametrize("reliable", [True, False])
def test_evidence_that_moves_lose_after_recycling_is_reported(recycled, check_of_it, lost, reliable):
    """Both estimates of recycling must exceed that of the moves: that of the check, or else that of the stages."""
    stages = [Stage(1.0, 250.0, 0.3, 5, 300, -10.0 if not reliable else -9.3, 0.05)]
    check = _check(-10.0) if reliable else _check(-9.3, shape=1.2)
    doubts = check_fallback(stages, check, recycled, 0.05, _check(check_of_it))
    assert [doubt.grave for doubt in doubts] == [True] * lost


@pytest.mark.parametrize(("Sampler", "walkers", "seed"), [(TMCMCSampler, 500, 1), (SMCSampler, 250, 80)])
def test_run_that_does_not_reach_heavy_tails_says_so(Sampler, walkers, seed):
    """Annealing by moves ends with tenfold standard deviations on a Student t in a wide box; nothing said so before."""
    posterior = truth_targets.student(seed)
    sampler = Sampler(walkers, posterior.ndim, posterior, vectorize=True, recycle=False, seed=seed)
    with pytest.warns(SamplingWarning):
        sampler.run_mcmc(None, 1)
    assert abs(sampler.log_evidence - posterior.log_evidence) > 4.0 * sampler.log_evidence_error
    assert sampler.verdict.status == "not usable"


def test_runs_by_moves_on_a_gaussian_are_not_doubted():
    posterior = truth_targets.gaussian(1, ndim=4)
    sampler = SMCSampler(300, 4, posterior, vectorize=True, recycle=False, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", SamplingWarning)
        sampler.run_mcmc(None, 1)
    assert np.abs(sampler.log_evidence - posterior.log_evidence) < 4.0 * sampler.log_evidence_error


def test_expected_yield_is_that_of_fits_to_gaussian_draws(rng):
    yields = []
    for _ in range(8):
        points, draws = rng.standard_normal((400, 6)), rng.standard_normal((4000, 6))
        mixture = fit_mixture(points, np.full(400, 1.0 / 400), max_components=1)
        log_ratio = stats.multivariate_normal(np.zeros(6)).logpdf(draws) - log_density(mixture, draws)
        yields.append(1.0 / np.mean(np.exp(log_ratio)))
    assert np.mean(yields) == pytest.approx(expected_yield(6, mixture.dof, 1, 400), rel=0.05)


@pytest.mark.parametrize("posterior", [truth_targets.rosenbrock(1), truth_targets.rotated_banana(6)])
def test_ends_of_a_bent_posterior_that_may_be_missing_are_reported(posterior):
    sampler = SMCSampler(250, posterior.ndim, posterior, vectorize=True, seed=4)
    with pytest.warns(SamplingWarning, match="Ends of the posterior may be missing"):
        sampler.run_mcmc(None, 1)
    assert sampler.ladder[0].moves == 0  # recycling, without a fallback
    assert sampler.verdict.status == "not usable"


@pytest.mark.parametrize(
    "posterior",
    [truth_targets.gaussian(1), truth_targets.bounds(1), truth_targets.banana(1), truth_targets.student(1)]
    + [truth_targets.modes(4, 2, 4, 10.0, 3.0, 1.0, "normal"), truth_targets.rough(1, 1.0)],
)
def test_posteriors_that_are_followed_are_not_doubted(posterior):
    sampler = SMCSampler(250, posterior.ndim, posterior, vectorize=True, seed=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error", SamplingWarning)
        sampler.run_mcmc(None, 1)
    assert sampler.verdict.status == "converged"
