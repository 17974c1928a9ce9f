"""Posteriors whose answer is known: the samplers must give it within four standard errors over seeds."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

from samplers import SMCSampler, TMCMCSampler
from samplers.moves.population_moves import MixtureMove, RandomWalkMove
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL
from tests.contract.targets import Box, Gaussian
from tests.statistics.analytic_posteriors import gaussian

MODES = {
    "default": {"recycle": True},
    "moves": {"recycle": False},
    "constant": RAMANCHA_2022_CONSTANT,
    "literal": RAMANCHA_2022_LITERAL,
    "tmcmc": {"Sampler": TMCMCSampler},
    "leaders": {"Sampler": TMCMCSampler, "chains": "leaders", "burn_in": 3, "moves": RandomWalkMove()},
    "published tmcmc": {"Sampler": TMCMCSampler, **CHING_CHEN_2007},
}
EXACT = [mode for mode in MODES if mode != "published tmcmc"]  # that one collapses


recycling, moves = pytest.param(True, id="recycling"), pytest.param(False, id="moves")
slow_recycling = pytest.param(True, id="recycling", marks=pytest.mark.slow)
slow_moves = pytest.param(False, id="moves", marks=pytest.mark.slow)


def runs(posterior, seed, count=8, nwalkers=200, nsteps=4, Sampler=SMCSampler, **kwargs):
    """Independent runs of one posterior."""
    samplers = []
    for k in range(count):
        sampler = Sampler(nwalkers, posterior.ndim, posterior, vectorize=True, seed=[seed, k], **kwargs)
        sampler.run_mcmc(None, nsteps)
        samplers.append(sampler)
    return samplers


def deviations(samplers, truth, function=lambda x: x):
    """(mean over runs - truth) in standard errors, the error from the scatter of the runs."""
    means = np.array([np.mean(function(s.get_chain(flat=True)), axis=0) for s in samplers])
    return (means.mean(axis=0) - truth) / (means.std(axis=0, ddof=1) / np.sqrt(len(samplers)))


def within(deviation, samplers, sigmas=4.0):
    """Four standard errors of a normal, widened to the same probability of Student's t for so few runs."""
    bound = stats.t(len(samplers) - 1).isf(stats.norm.sf(sigmas))
    return bool(np.all(np.abs(deviation) < bound))


def evidence_deviation(samplers, truth):
    values = np.array([s.log_evidence for s in samplers])
    return (values.mean() - truth) / (values.std(ddof=1) / np.sqrt(len(values)))


@pytest.mark.parametrize("mode", [pytest.param(m, marks=pytest.mark.slow) if m == "constant" else m for m in EXACT])
def test_conjugate_gaussian(mode, seed):
    posterior = Gaussian(3, sd=0.1)
    samplers = runs(posterior, seed, **MODES[mode])
    assert within(deviations(samplers, posterior.mean), samplers)
    spread = deviations(samplers, posterior.sd**2, lambda x: (x - posterior.mean) ** 2)
    assert within(spread, samplers)
    assert within(evidence_deviation(samplers, posterior.log_evidence), samplers)


@pytest.mark.parametrize(
    "moves",
    [
        RandomWalkMove(),
        RandomWalkMove(scale=1.0),
        [(MixtureMove(), 0.5), (RandomWalkMove(), 0.5)],
        MixtureMove(),
    ],
    ids=["walk", "short walk", "weighted", "mixture"],
)
def test_every_kernel(moves, seed):
    posterior = Gaussian(2, sd=0.2)
    samplers = runs(posterior, seed, moves=moves, min_moves=8, max_moves=20)
    assert within(deviations(samplers, posterior.mean), samplers)
    assert within(deviations(samplers, posterior.sd**2, lambda x: (x - posterior.mean) ** 2), samplers)
    assert within(evidence_deviation(samplers, posterior.log_evidence), samplers)


class WrongMove(MixtureMove):
    """The proposals without their Hastings ratios: draws too narrow a posterior."""

    def _draw(self, coords, random):
        proposed, factors = super()._draw(coords, random)
        return proposed, 0.0 * factors


def test_a_wrong_kernel_is_caught(seed):
    """Negative control: the criterion of these tests can fail."""
    posterior = Gaussian(3, sd=0.1)
    samplers = runs(posterior, seed, moves=WrongMove())
    spread = deviations(samplers, posterior.sd**2, lambda x: (x - posterior.mean) ** 2)
    assert not within(spread, samplers)


@pytest.mark.parametrize("recycle", [recycling, slow_moves])
def test_two_modes(recycle, seed):
    """Weights 1:2, ten standard deviations apart."""
    centres, sd, weights = np.array([[1.0, 1.0, 1.0], [2.0, 1.0, 1.5]]), 0.1, np.array([1.0, 2.0]) / 3

    def log_likelihood(x):
        parts = [
            np.log(w) + np.sum(stats.norm.logpdf(x, c, sd), axis=-1) for w, c in zip(weights, centres, strict=True)
        ]
        return np.logaddexp(*parts)

    samplers = runs(Box([0, 0, 0], [3, 3, 3], log_likelihood), seed, nwalkers=300, nsteps=2, recycle=recycle)
    assert within(deviations(samplers, 2 / 3, lambda x: x[:, 0] > 1.5), samplers)
    assert within(evidence_deviation(samplers, -3 * np.log(3)), samplers)


@pytest.mark.parametrize("mode", [pytest.param("default", marks=pytest.mark.slow), "moves", "tmcmc"])
def test_edges_of_a_truncated_prior(mode, seed):
    """The posterior is a half-normal with its mode on the edge, times an exponential that piles up at another."""

    def log_likelihood(x):
        return -0.5 * (x[..., 0] / 0.05) ** 2 - 20.0 * x[..., 1]

    samplers = runs(Box([0, 0], [1, 1], log_likelihood), seed, **MODES[mode])
    half_normal, exponential = stats.halfnorm(scale=0.05), stats.truncexpon(b=20, scale=1 / 20)
    assert within(deviations(samplers, [half_normal.mean(), exponential.mean()]), samplers)
    assert within(
        deviations(samplers, 0.1, lambda x: x < np.array([half_normal.ppf(0.1), exponential.ppf(0.1)])), samplers
    )
    truth = np.log(0.05 * np.sqrt(np.pi / 2)) + np.log((1 - np.exp(-20.0)) / 20)
    assert within(evidence_deviation(samplers, truth), samplers)


def test_a_corner_in_eight_dimensions(seed):
    """Exponentials a hundred times shorter than the box, all at its corner; one run, some 600 independent points."""
    posterior = Box(np.zeros(8), np.ones(8), lambda x: 8 * np.log(100) - 100.0 * np.sum(x, axis=-1))
    sampler = runs(posterior, seed, count=1, nwalkers=500)[0]
    chain = sampler.get_chain(flat=True)
    assert np.all(np.abs(100 * chain.mean(axis=0) - 1) < 5 / np.sqrt(600))
    assert abs(sampler.log_evidence) < 4 * sampler.log_evidence_error


def test_flat_likelihood(seed):
    """Nothing is learnt: one stage, the prior comes back; by moves, the evidence is exact and so says its error."""
    posterior = Box([0, -2], [1, 5], lambda x: 0.0 * x[..., 0] - 1234.5)
    samplers = runs(posterior, seed, recycle=False)
    for sampler in samplers:
        assert len(sampler.ladder) == 1
        assert sampler.log_evidence == pytest.approx(-1234.5, abs=1e-9)
        assert sampler.ladder[-1].log_evidence_error == pytest.approx(0, abs=1e-9)
        assert abs(sampler.log_evidence_check.log_evidence + 1234.5) < 4.5 * sampler.log_evidence_check.error
    assert within(deviations(samplers, [0.5, 1.5]), samplers)


@pytest.mark.parametrize("recycle", [recycling, slow_moves])
def test_very_informative_likelihood(recycle, seed):
    """The posterior is a hundred thousand times narrower than the prior."""
    posterior = Gaussian(2, sd=1e-5)
    samplers = runs(posterior, seed, count=6, recycle=recycle)
    assert within(deviations(samplers, posterior.mean), samplers)
    assert within(evidence_deviation(samplers, posterior.log_evidence), samplers)


@pytest.mark.parametrize("recycle", [slow_recycling, moves])
def test_dead_regions(recycle, seed):
    """Where the model fails the likelihood is zero: 70 % of the box."""
    posterior = Box([0, 0], [1, 1], lambda x: np.where(x[..., 0] > 0.3, -np.inf, -10.0 * x[..., 1]))
    samplers = runs(posterior, seed, recycle=recycle)
    assert within(deviations(samplers, [0.15, stats.truncexpon(b=10, scale=0.1).mean()]), samplers)
    assert within(evidence_deviation(samplers, np.log(0.3 * (1 - np.exp(-10.0)) / 10)), samplers)


# ---------------------------------------------------------------- invariances


@cache
def plain_run(mode, seed):
    """One run of the Gaussian, the reference of all invariances; tests only read it."""
    return runs(Gaussian(3), seed, count=1, **MODES[mode])[0]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("offset", [-5000.0, 5000.0])
def test_a_constant_changes_no_draw(mode, offset, seed):
    plain, shifted = plain_run(mode, seed), runs(Gaussian(3, offset=offset), seed, count=1, **MODES[mode])[0]
    assert np.array_equal(plain.get_chain(), shifted.get_chain())
    assert [s.beta for s in plain.ladder] == [s.beta for s in shifted.ladder]
    assert shifted.log_evidence - plain.log_evidence == pytest.approx(offset, abs=1e-8)
    assert shifted.log_evidence_error == pytest.approx(plain.log_evidence_error, rel=1e-6)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("unit", [1e-4, 2.0**14])
def test_units_change_no_draw(mode, unit, seed):
    plain, scaled = plain_run(mode, seed), runs(Gaussian(3, unit=unit), seed, count=1, **MODES[mode])[0]
    if np.log2(unit).is_integer():  # then scaling itself rounds nothing
        assert np.array_equal(plain.get_chain() * unit, scaled.get_chain())
    assert np.allclose(plain.get_chain() * unit, scaled.get_chain(), rtol=1e-8)
    assert [s.moves for s in plain.ladder] == [s.moves for s in scaled.ladder]
    assert scaled.log_evidence == pytest.approx(plain.log_evidence, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("ndim", "walkers", "most"), [(30, 500, 60_000), (40, 1000, 150_000)])
def test_many_parameters_are_recycled(ndim, walkers, most):
    """Moves need 0.42 and 1.14 million evaluations; a check above the earlier points is no reason for them."""
    posterior = gaussian(1, ndim, width=0.02)
    sampler = SMCSampler(walkers, ndim, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 1)
    samples = sampler.get_chain(flat=True)
    assert sampler.evaluations < most
    assert abs(sampler.log_evidence - posterior.log_evidence) < 4.0 * sampler.log_evidence_error
    assert np.all(np.abs(samples.mean(axis=0) - posterior.mean) < 4.5 * sampler.mean_error())
    np.testing.assert_allclose(samples.std(axis=0), posterior.sd, rtol=0.15)
