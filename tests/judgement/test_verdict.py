"""``sampler.verdict``: modes with shares, agreement of the estimates, effective sample size, what is not known."""

import numpy as np
import pytest

from samplers import SMCSampler, compare_models
from samplers.finding import Finding
from samplers.judgement.clusters import error_between_modes, find_clusters
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
    modes = sampler.modes
    assert len(modes) == 2
    assert sum(mode.share for mode in modes) == pytest.approx(1.0)
    for mode, share in zip(modes, sorted(two_modes.shares, reverse=True), strict=True):
        assert abs(mode.share - share) < 4.0 * mode.share_error
        assert 0.0 < mode.share_error < 0.1
    difference = np.linalg.norm(modes[0].mean - modes[1].mean) / modes[0].sd.mean()
    assert difference == pytest.approx(10.0, rel=0.15)


@pytest.mark.parametrize("posterior", [analytic.gaussian(1), analytic.banana(1), analytic.bounds(1)])
def test_one_mode_stays_one(posterior):
    assert len(run(posterior).modes) == 1


def test_sentence_and_what_it_is_made_of(sampler):
    found = sampler.verdict
    assert sampler.describe().startswith(f"{sampler.verdict.status.capitalize()}: 2 modes with shares 0.7")
    assert "no failed simulations" in sampler.describe()
    assert compare_models({"a": sampler, "b": (-3.0, 0.1)}).verdict.to_dict() == {"a": found.status, "b": ""}


def test_findings_print_as_sentences():
    found = Finding("A mode may be lost", "care", "Two of three were.", "Use more walkers.", {"lost": 2.0})
    assert f"{(found,)}" == "(A mode may be lost: Two of three were. Use more walkers.,)"


@pytest.mark.parametrize("higher", [-3.0, 0.0, 3.0])
def test_the_summary_has_the_evidence_that_counts(higher, sampler, monkeypatch):
    """A reliable check that is higher counts."""
    check = sampler.log_evidence_check._replace(error=0.02, pareto_shape=0.1)
    check = check._replace(log_evidence=sampler.log_evidence_ladder + higher)
    monkeypatch.setattr(sampler, "_result", sampler._result._replace(check=check))
    value, error = sampler.log_evidence, sampler.log_evidence_error
    assert f"; log-evidence {value:.2f} +- {error:.2g};" in sampler.describe()
    assert higher < 0.0 or (value, error) == (check.log_evidence, 0.02)


def test_modes_need_a_chain(two_modes):
    sampler = SMCSampler(300, 4, two_modes, vectorize=True)
    with pytest.raises(ValueError, match="call run_mcmc first"):
        sampler.verdict  # noqa: B018
    sampler.run_mcmc(None, 0)
    with pytest.raises(ValueError, match="one step or more"):
        sampler.modes  # noqa: B018


@pytest.mark.parametrize("crossed", [0.0, 1.0])
def test_errors_of_shares_are_those_of_the_stages_until_moves_cross(crossed, rng):
    """Two modes 20 apart with shares .25 and .75: a share has sqrt(.1875) of the error, and the mean 20 times this."""
    parents = np.repeat(np.arange(200), 2)
    first = np.where(rng.random(400) < crossed, rng.permutation(400) < 100, parents < 50)
    chain = (rng.standard_normal((400, 2)) + np.where(first, 20.0, 0.0)[:, None])[None]
    for stated, used in ((0.2, 0.2), (np.inf, 1.0)):
        (_, small) = find_clusters(chain, np.arange(400), parents, stated)
        alone = np.sqrt(small.share * (1.0 - small.share))
        (between,) = error_between_modes(chain, chain[:, :, :1], parents, stated)
        if crossed:
            assert (
                small.share_error < np.hypot(alone / 20.0, 0.4 * used * alone) and between < 20.0 * 0.4 * used * alone
            )
        else:
            assert small.share_error == pytest.approx(np.hypot(alone / np.sqrt(399), used * alone), rel=1e-2)
            assert between == pytest.approx(20.0 * used * alone, rel=0.02)
    one = chain[:, ~first]
    each = np.arange(one.shape[1])
    assert find_clusters(one, each, each, np.inf)[0].share_error == 0.0
    assert np.all(error_between_modes(one, one, each, np.inf) < 1e-12)
