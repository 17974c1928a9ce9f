"""Alarms: each one on runs that are wrong and on runs that are right."""

import re
import warnings

import numpy as np
import pytest
from scipy import stats

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.estimates.importance import EvidenceCheck
from samplers.judgement.checks import check_evidence, check_likelihood, check_prior
from tests.covering import covering
from tests.statistics import analytic_posteriors as analytic


def _check(log_evidence, error=0.05, effective=200.0, shape=0.3):
    return EvidenceCheck(log_evidence, error, effective, shape, 500)


@pytest.mark.parametrize(
    ("check", "severities"),
    [
        (_check(-12.9), []),
        (_check(-6.9), ["care"]),
        (_check(-10.9, effective=5.0, shape=0.9), []),
        (_check(-8.9, effective=5.0, shape=0.9), ["wrong"]),
    ],
)
def test_evidences_that_differ_speak_against_a_run_if_the_check_has_uneven_weights(check, severities):
    found = check_evidence(-10.0, 0.1, check, lambda: 0.2)
    assert [each.severity for each in found] == severities
    for doubt in found:
        assert doubt.message.index("more walkers") < doubt.message.index("log_prior is a function of your own")


@pytest.mark.parametrize(
    ("error", "check", "several", "doubted"),
    [
        (0.5, None, False, True),
        (0.38, None, False, True),
        (0.34, None, True, False),
        (0.5, _check(-10.0), False, False),
        (0.5, _check(-10.0), True, True),  # of the stages, which give the modes their shares
        (0.5, _check(-10.0, shape=0.9), False, True),
    ],
)
def test_a_large_error_of_the_evidence_is_reported(error, check, several, doubted):
    found = check_evidence(-10.0, error, check, lambda: several)
    assert [(doubt.severity == "wrong", "standard error of the log-evidence" in doubt.message) for doubt in found] == [
        (False, True)
    ] * doubted


@pytest.mark.parametrize(("Sampler", "walkers", "seed"), [(TMCMCSampler, 500, 1), (SMCSampler, 250, 80)])
def test_run_that_does_not_reach_heavy_tails_says_so(Sampler, walkers, seed):
    """Annealing by moves ends with tenfold standard deviations on a Student t in a wide box; nothing said so before."""
    posterior = analytic.student(seed)
    sampler = Sampler(
        walkers,
        posterior.ndim,
        posterior,
        vectorize=True,
        seed=seed,
        **({"recycle": False} if Sampler is SMCSampler else {}),
    )
    with pytest.warns(SamplingWarning):
        sampler.run_mcmc(None, 1)
    assert abs(sampler.log_evidence - posterior.log_evidence) > 4.0 * sampler.log_evidence_error
    assert sampler.verdict.status != "converged"


@pytest.mark.parametrize(
    "posterior",
    [
        analytic.gaussian(1),
        analytic.bounds(1),
        analytic.banana(1),
        analytic.rotated_banana(6),
        analytic.student(1),
    ]
    + [analytic.modes(4, 2, 4, 10.0, 3.0, 1.0, "normal"), analytic.rough(1, 1.0)],
)
def test_posteriors_that_are_followed_are_not_doubted(posterior):
    sampler = SMCSampler(250, posterior.ndim, posterior, vectorize=True, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", SamplingWarning)
        sampler.run_mcmc(None, 1)
    assert sampler.verdict.status == "converged"


@pytest.mark.slow
@pytest.mark.parametrize(("Sampler", "settings"), [(SMCSampler, {"recycle": False}), (TMCMCSampler, {})])
def test_shares_of_modes_that_the_moves_do_not_connect_have_their_errors(Sampler, settings):
    """150 walkers in 11 dimensions: founders state errors of .03 to .05. A share that is off by .12 is doubted."""
    off, stated, means, silent = [], [], [], 0
    for seed in range(24):
        posterior = analytic.modes(seed, 2, 11, 15.0, 2.0, 1.0, "box")
        sampler = Sampler(150, 11, posterior, vectorize=True, seed=seed, **settings)
        with warnings.catch_warnings(record=True):
            sampler.run_mcmc(None, 1)
        chain, modes = sampler.get_chain(flat=True), sampler.modes
        found = np.max(np.abs(posterior.responsibilities(chain).mean(axis=0) - posterior.shares))
        silent += found > 0.12 and sampler.verdict.status == "converged"
        if len(modes) == 2:  # with few points in many dimensions, two modes may look like one
            off.append(found)
            stated.append(modes[0].share_error)
            means.append((chain.mean(axis=0) - posterior.mean) / sampler.mean_error())
    ratio = np.sqrt(np.mean(np.square(off)) / np.mean(np.square(stated)))
    assert len(off) >= 16 and 0.25 < ratio < 1.3  # 2 with the errors by founders
    assert np.sqrt(np.mean(np.square(means))) < 1.3
    assert silent <= 1  # of 30, 1 with this proposal and with the one before


LOG_PRIOR = np.array([-1.0, -7.3, -900.0, -2.0])
INF = np.inf


@pytest.mark.parametrize(
    "values",
    [[0.0] * 4, [-37.25] * 4, [-1e10] * 4, [-1e300] * 4, [-1e10, np.nan, -1e10, -1e10], [-1e10, -INF, -1e10, -1e10],
     [-3.2, -INF, -3.2, -3.2], [-1e10, -1e10 + 1e-6, -1e10, -1e10]],
)  # fmt: skip
def test_one_log_likelihood_at_all_first_points_is_doubted(values):
    """Beside -inf, it may be the likelihood of uniform errors."""
    (doubt,) = check_likelihood(np.array(values) + LOG_PRIOR, LOG_PRIOR)
    assert f"The log-likelihood is {values[0]:.6g} at all" in doubt.message
    assert (doubt.severity == "wrong") == np.isfinite(values).all()


@pytest.mark.parametrize(
    "values",
    [[0.0, 0.0, -INF, 0.0], [0.0, 0.0, 0.0, -1e-3], [-1e300, -1e300, -3.0, -1e300], [-INF, -INF, -3.0, -INF],
     [-2.0, -2.5, -2.0, -2.0]],
    ids=["indicator", "weak data", "penalties", "one possible point", "steps"],
)  # fmt: skip
def test_log_likelihoods_that_differ_raise_no_doubt(values):
    assert check_likelihood(np.array(values) + LOG_PRIOR, LOG_PRIOR) == []


class Plateau:
    """Standard normal prior in two dimensions; the log-likelihood is `value` unless the first parameter exceeds `edge`,
    where the data speak of it, or the likelihood is 1 if `certain`."""

    ndim = 2

    def __init__(self, value, edge=INF, certain=False):
        self.value, self.edge, self.certain = value, edge, certain

    def log_prior(self, coords):
        return stats.norm.logpdf(coords).sum(axis=-1)

    def sample_prior(self, n, random):
        return random.standard_normal((n, 2))

    def __call__(self, coords):
        inside = coords[..., 0] > self.edge
        fit = np.where(self.certain, 0.0, -0.5 * np.square(coords).sum(axis=-1))
        return self.log_prior(coords) + np.where(inside, fit, self.value)


@pytest.mark.parametrize(("Sampler", "vectorize"), [(SMCSampler, True), (TMCMCSampler, False)])
@pytest.mark.parametrize(("value", "edge"), [(0.0, INF), (-1e10, INF), (-1e10, 5.0)], ids=["flat", "all", "far corner"])
def test_a_plateau_at_all_draws_of_the_prior_is_not_usable_and_is_named(Sampler, value, edge, vectorize):
    sampler = Sampler(60, 2, Plateau(value, edge), vectorize=vectorize, seed=1)
    with pytest.warns(SamplingWarning, match=re.escape(f"log-likelihood is {value:.6g} at all 60 points")):
        sampler.run_mcmc(None, 1)
    assert sampler.verdict.status == "not usable" and "draws of the prior" in str(sampler.verdict)


@pytest.mark.parametrize(
    ("Sampler", "settings"), [(SMCSampler, {"recycle": True}), (SMCSampler, {"recycle": False}), (TMCMCSampler, {})]
)
def test_nearly_minus_infinity_at_all_draws_is_an_error_as_minus_infinity_is(Sampler, settings):
    for value in (-INF, -1e300, -5e29):
        with pytest.raises(ValueError, match="no point|starting points"):
            Sampler(60, 2, Plateau(value), vectorize=True, seed=1, **settings).run_mcmc(None, 1)


@pytest.mark.parametrize(
    ("Sampler", "certain", "value"), covering([SMCSampler, TMCMCSampler], [False, True], [-1e10, -1e300], strength=1)
)
def test_penalties_at_a_part_of_the_draws_are_a_hard_edge(Sampler, certain, value):
    """Above 0.5, with or without data: 69 % of the draws have the penalty."""
    posterior = Plateau(value, 0.5, certain)
    expected = stats.norm.logsf(0.5) if certain else np.log(0.5) + stats.norm.logsf(np.sqrt(0.5))
    log_evidences = []
    for seed in range(12):
        sampler = Sampler(100, 2, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 1)
        assert "began with" not in str(sampler.verdict) and sampler.get_chain()[..., 0].min() > 0.5
        log_evidences.append(sampler.log_evidence)
    error = np.std(log_evidences, ddof=1) / np.sqrt(12)
    assert abs(np.mean(log_evidences) - expected) < stats.t(11).isf(1e-5) * error


@pytest.mark.parametrize(
    ("sides", "log_prior", "said"),
    [([5.5, 10.0], 0.0, True), ([0.1, 0.2], 0.0, True), ([5.5, 10.0], -np.log(55.0), False), ([1.0] * 8, 0.0, False)],
)
def test_a_prior_of_0_inside_a_box_is_not_normalised(sides, log_prior, said, rng):
    """As in most scripts for emcee; a unit cube is."""
    for _ in range(50):
        coords = rng.uniform(0.0, sides, size=(32, len(sides)))
        found = check_prior(coords, np.full(32, log_prior))
        assert [finding.severity for finding in found] == ["care"] * said
    assert not said or f"off by about {np.log(np.prod(sides)):+.0f}"[:-1] in found[0].text


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_a_script_for_emcee_that_keeps_its_prior_is_warned_of_the_evidence(Sampler):
    def log_prior(x):
        return 0.0 if np.all((x > 0.0) & (x < 10.0)) else -INF

    sampler = Sampler(200, 2, lambda x: log_prior(x) - 0.5 * np.sum((x - 5.0) ** 2), log_prior_fn=log_prior, seed=1)
    with pytest.warns(SamplingWarning, match=r"off by about \+4.6. Return -log"):
        sampler.run_mcmc(np.random.default_rng(1).uniform(0.0, 10.0, (200, 2)), 2)
    assert sampler.verdict.status == "usable"
    assert abs(sampler.log_evidence - np.log(2.0 * np.pi)) < 4.0 * sampler.log_evidence_error
