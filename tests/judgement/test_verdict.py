"""``sampler.verdict``: modes with shares, agreement of the estimates, effective sample size, what is not known."""

import numpy as np
import pytest

from samplers import SMCSampler, compare_models, ladder_table
from tests.statistics import analytic_posteriors as analytic


def run(posterior, walkers=300, seed=1, steps=3, **settings):
    sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
    sampler.run_mcmc(None, steps)
    return sampler


@pytest.fixture(scope="module")
def two_modes():
    return analytic.modes(4, 2, 4, 10.0, 3.0, 1.0, "normal")


@pytest.fixture(scope="module")
def sampler(two_modes):
    return run(two_modes, 400)


def test_modes_have_their_shares_and_places(two_modes, sampler):
    modes = sampler.verdict.modes
    assert len(modes) == 2
    assert sum(mode.share for mode in modes) == pytest.approx(1.0)
    for mode, share in zip(modes, sorted(two_modes.shares, reverse=True), strict=True):
        assert abs(mode.share - share) < 4.0 * mode.share_error
        assert 0.0 < mode.share_error < 0.1
    difference = np.linalg.norm(modes[0].mean - modes[1].mean) / modes[0].sd.mean()
    assert difference == pytest.approx(10.0, rel=0.15)


@pytest.mark.parametrize("posterior", [analytic.gaussian(1), analytic.banana(1), analytic.bounds(1)])
def test_one_mode_stays_one(posterior):
    assert len(run(posterior).verdict.modes) == 1


def test_sentence_and_what_it_is_made_of(sampler):
    found = sampler.verdict
    assert found.summary.startswith(f"{sampler.verdict.status.capitalize()}: 2 modes with shares 0.7")
    assert "no failed evaluations" in found.summary
    assert f"by stages {sampler.log_evidence_ladder:.2f} +- " in found.summary
    assert f", check {sampler.log_evidence_check.log_evidence:.2f} +- " in found.summary
    assert found.pareto_shape == sampler.log_evidence_check.pareto_shape
    assert len(found.unknown) == 1 and "another seed" in found.unknown[0]
    assert found.summary in ladder_table(sampler)
    assert found.summary in str(compare_models({"a": sampler, "b": (-3.0, 0.1)}))


def test_modes_need_a_chain(two_modes):
    sampler = SMCSampler(300, 4, two_modes, vectorize=True)
    with pytest.raises(ValueError, match="call run_mcmc first"):
        sampler.verdict  # noqa: B018
    sampler.run_mcmc(None, 0)
    assert len(sampler.verdict.unknown) == 1
    with pytest.raises(ValueError, match="one step or more"):
        sampler.verdict.modes  # noqa: B018
