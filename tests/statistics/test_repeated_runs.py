"""Several runs of recycling whose points are used together: a mode that one of them loses is kept, and reported."""

import warnings

import numpy as np
import pytest
from emcee.backends import HDFBackend

from samplers import SamplingWarning, SMCSampler
from tests.statistics import analytic_posteriors as analytic
from tests.statistics.analytic_runs import Cell, is_doubted, is_lost, run


def finish(posterior, runs, nwalkers=250, seed=1, **options):
    sampler = SMCSampler(nwalkers, posterior.ndim, posterior, vectorize=True, seed=seed, runs=runs, **options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sampler.run_mcmc(None, 2)
    return sampler, [str(each.message) for each in caught if issubclass(each.category, SamplingWarning)]


def test_a_mode_that_one_run_loses_is_kept_and_reported():
    single, both = (run(Cell("two", 100.0, "SMC", 250), 7, 2, {"runs": runs}) for runs in (1, 2))
    assert is_lost(single) and not is_doubted(single)  # negative control
    assert not is_lost(both) and both["status"] == "not usable"
    assert any(
        "the runs 1 and 2 of the annealing disagree: a part of the posterior" in each for each in both["warnings"]
    )
    assert abs(both["log_evidence_error"]) < 4.0 * both["stated_error"]


@pytest.mark.parametrize(
    "posterior",
    [
        analytic.gaussian(1),
        analytic.bounds(1),
        analytic.modes(4, 2, 4, 10.0, 3.0, 1.0, "normal"),
    ],
    ids=["sharp", "bounds", "two modes"],
)
def test_runs_that_agree_are_not_doubted(posterior):
    sampler, messages = finish(posterior, 2)
    assert messages == [] and sampler.verdict.status == "converged"
    assert abs(sampler.log_evidence - posterior.log_evidence) < 4.0 * sampler.log_evidence_error
    z = (sampler.get_chain(flat=True).mean(axis=0) - posterior.mean) / sampler.mean_error()
    assert np.max(np.abs(z)) < 4.5


@pytest.mark.parametrize("limit", [1100, 1900], ids=["first", "second"])
def test_a_limit_in_one_of_the_runs(limit):
    """In the first run, its points are weighted; in the second, those of the first, which has reached beta = 1."""
    posterior = analytic.gaussian(1, 2)
    sampler, messages = finish(posterior, 2, max_simulations=limit)
    assert any("limit of simulations" in message for message in messages)
    assert sampler.verdict.status == "usable" and sampler.log_evidence_error < 0.3
    assert abs(sampler.log_evidence - posterior.log_evidence) < 4.0 * sampler.log_evidence_error


def test_an_interrupted_second_run_goes_on(tmp_path):
    posterior, left = analytic.gaussian(1), [14]

    def interrupted(x):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return posterior(x)

    interrupted.log_prior, interrupted.sample_prior = posterior.log_prior, posterior.sample_prior
    chains = []
    for name, calls in (("killed", 14), ("whole", 10**9)):
        left[0] = calls
        for _ in range(2):
            sampler = SMCSampler(
                250, posterior.ndim, interrupted, vectorize=True, seed=3, runs=2, backend=HDFBackend(tmp_path / name)
            )
            try:
                sampler.run_mcmc(None, 2)
                break
            except KeyboardInterrupt:
                assert name == "killed"
        chains.append(sampler.get_chain())
    assert left[0] < 10**9 - 20  # the interrupt came in the second of the runs
    np.testing.assert_array_equal(*chains)


def test_runs_that_cannot_act_are_refused():
    with pytest.raises(ValueError, match="runs=2 cannot act here: it belongs to recycling"):
        finish(analytic.gaussian(1), 2, recycle=False)
