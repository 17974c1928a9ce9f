"""Two modes of equal mass and different width: the narrow one holds little of the tempered target, and is kept."""

import warnings

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from samplers import SMCSampler, TMCMCSampler
from samplers.tempering import recycling
from tests.statistics import analytic_runs

NDIM = 10
WIDTHS = np.array([0.01, 0.0125])  # a ratio of volumes of 9


class TwoModes:
    """Standard normal prior; Gaussian modes at unit distance in a random direction. The evidence is 1."""

    ndim = NDIM

    def __init__(self, seed):
        random = np.random.RandomState(seed)
        away = random.standard_normal(NDIM)
        middle = 0.5 * random.standard_normal(NDIM)
        self.centres = middle + np.array([[-0.5], [0.5]]) * away / np.linalg.norm(away)

    def log_prior(self, x):
        return multivariate_normal(np.zeros(NDIM)).logpdf(x)

    def sample_prior(self, n, random):
        return random.standard_normal((n, NDIM))

    def parts(self, x):
        return np.stack(
            [multivariate_normal(c, w**2).logpdf(x) for c, w in zip(self.centres, WIDTHS, strict=True)] + np.log(0.5)
        )

    def __call__(self, x):
        return np.logaddexp(*self.parts(x))


def run(seed):
    posterior = TwoModes(seed)
    sampler = SMCSampler(500, NDIM, posterior, vectorize=True, seed=seed, recycle=True)
    return finish(sampler, posterior)


def finish(sampler, posterior):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sampler.run_mcmc(None, 1)
    return sampler, float(np.mean(np.diff(posterior.parts(sampler.get_chain(flat=True)), axis=0) < 0.0))


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_the_narrow_mode_is_kept(seed):
    sampler, share = run(seed)
    error = np.hypot(sampler.log_evidence_error, 0.03)
    assert abs(sampler.log_evidence) < 4.0 * error
    assert share == pytest.approx(0.5, abs=0.1)


def test_without_components_for_basins_it_is_lost(monkeypatch):
    """Negative control: the target is one that the plain mixture gets wrong."""
    monkeypatch.setattr(recycling, "find_basins", lambda *points: None)
    sampler, share = run(2)
    assert share < 0.05 and sampler.log_evidence == pytest.approx(np.log(0.5), abs=0.1)


@pytest.mark.slow
def test_moves_keep_the_narrow_mode():
    posterior = TwoModes(2)
    sampler, share = finish(TMCMCSampler(500, NDIM, posterior, vectorize=True, seed=2), posterior)
    assert abs(sampler.log_evidence) < 4.0 * sampler.log_evidence_error + 0.1
    assert share == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize(("explores", "found"), [(True, True), (False, False)])
def test_a_mode_that_is_met_at_the_end_is_explored(explores, found, monkeypatch):
    """One draw of the last round before the check hits the flank of the narrow mode."""
    monkeypatch.setattr(recycling, "DRAWS_SHARE", 0)
    if not explores:
        monkeypatch.setattr(recycling, "find_basins", lambda *points: None)
    result = analytic_runs.run(analytic_runs.Cell("two", 100.0, "SMC", 500), 4, 1, {})
    assert (min(result["shares"]) > 0.15) == found
