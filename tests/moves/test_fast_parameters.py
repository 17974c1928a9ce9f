"""Sweeps over fast parameters: correct posterior, other parameters unchanged, no additional simulations."""

import emcee
import numpy as np
import pytest
from emcee.model import Model
from scipy import stats

from samplers import SMCSampler, TMCMCSampler
from samplers.moves.population_moves import RandomWalkMove, WithFastSweeps
from tests.contract.targets import Gaussian
from tests.statistics.test_posteriors import deviations, evidence_deviation, runs, within


class NormalInverseGamma:
    """Mean and standard deviation of a sample under the conjugate prior, with known posterior and evidence.

    The prior of the variance is inverse gamma (2, 1). The prior of the mean is normal with mean zero and that variance.
    """

    ndim = 2
    fast_parameters = (1,)

    def __init__(self, n=12):
        y = stats.norm.ppf((np.arange(n) + 0.5) / n, 0.8, 0.4)
        self.n, self.centre, self.square = n, y.mean(), np.sum((y - y.mean()) ** 2)
        self.shape = 2.0 + 0.5 * n
        self.scale = 1.0 + 0.5 * self.square + 0.5 * n / (1.0 + n) * self.centre**2
        self.mean = n * self.centre / (1.0 + n)
        variance = stats.invgamma(self.shape, scale=self.scale)
        self.variance, self.median = variance.mean(), np.sqrt(variance.median())
        # evidence by Bayes' rule, evaluated at one point
        at = np.array([0.7, 0.5])
        posterior = variance.logpdf(0.25) + np.log(1.0) + stats.norm.logpdf(0.7, self.mean, 0.5 / np.sqrt(1.0 + n))
        self.log_evidence = self.log_likelihood(at) + self.log_prior(at) - np.log(2 * 0.5) - posterior

    def log_prior(self, x):
        mean, sd = x[..., 0], x[..., 1]
        with np.errstate(all="ignore"):
            variance = sd * sd
            log_prior = stats.invgamma.logpdf(variance, 2.0) + np.log(2.0 * sd) + stats.norm.logpdf(mean, 0.0, sd)
        return np.where(sd > 0.0, log_prior, -np.inf)[()]

    def log_likelihood(self, x):
        mean, sd = x[..., 0], x[..., 1]
        square = self.square + self.n * (mean - self.centre) ** 2
        return -self.n * np.log(np.sqrt(2 * np.pi) * sd) - 0.5 * square / sd**2

    def __call__(self, x):
        return self.log_prior(x) + self.log_likelihood(x)

    def sample_prior(self, n, rng):
        sd = np.sqrt(1.0 / rng.gamma(2.0, size=n))
        return np.column_stack([sd * rng.standard_normal(n), sd])


class Noisy(Gaussian):
    fast_parameters = (0, 2)


MODES = {
    "recycling": {},
    "moves": {"recycle": False},
    "walk": {"moves": RandomWalkMove(), "min_moves": 6, "max_moves": 15},
    "stretch": {"moves": emcee.moves.StretchMove(), "min_moves": 8, "max_moves": 20},
    "tmcmc": {"Sampler": TMCMCSampler},
    "leaders": {"Sampler": TMCMCSampler, "chains": "leaders", "burn_in": 3, "moves": RandomWalkMove()},
}


# ---------------------------------------------------------------- the right posterior


@pytest.mark.parametrize(
    "mode", [pytest.param(m, marks=() if m in ("recycling", "moves", "tmcmc") else pytest.mark.slow) for m in MODES]
)
def test_conjugate_sample(mode, seed):
    posterior = NormalInverseGamma()
    samplers = runs(posterior, seed, **MODES[mode])
    assert all(isinstance(move, WithFastSweeps) for s in samplers for move in s._moves)
    assert within(deviations(samplers, posterior.mean, lambda x: x[:, 0]), samplers)
    assert within(deviations(samplers, posterior.variance, lambda x: x[:, 1] ** 2), samplers)
    assert within(deviations(samplers, 0.5, lambda x: x[:, 1] < posterior.median), samplers)
    assert within(evidence_deviation(samplers, posterior.log_evidence), samplers)


class Still(emcee.moves.Move):
    """An expensive move that never moves."""

    def propose(self, model, state):
        return state, np.zeros(len(state.coords), dtype=bool)


def target(x):
    """Log density of two coordinates, the spread of the second depending on the first; blobs identify the points."""
    return stats.norm.logpdf(x[:, 0]) + stats.norm.logpdf(x[:, 1], x[:, 0], np.exp(0.5 * x[:, 0])), x.copy()


@pytest.fixture
def ensemble(rng):
    """Exact draws of `target` as a state, and the model that moves need."""
    first = rng.normal(size=20_000)
    first[:2] = -0.0, 5e-324
    x = np.column_stack([first, rng.normal(first, np.exp(0.5 * first))])
    log_prob, blobs = target(x)
    state = emcee.State(x, log_prob=log_prob, blobs=blobs, copy=True)
    return state, Model(None, target, map, np.random.RandomState(rng.integers(2**31)))


def test_fast_sweeps_alone_keep_the_target_and_the_other_coordinates(ensemble):
    """Exact draws remain exact, the slow coordinate keeps every bit, and values and blobs stay with their points."""
    state, model = ensemble
    start = state.coords.copy()
    move = WithFastSweeps(Still(), [1], sweeps=10)
    move.calibrate(start[:500] * np.array([1.2, 0.7]), np.full(500, 1 / 500))  # the fit may be wrong
    state, accepted = move.propose(model, state)
    assert not accepted.any()  # the flags are those of the expensive move
    assert state.coords[:, 0].tobytes() == start[:, 0].tobytes()
    assert np.mean(state.coords[:, 1] != start[:, 1]) > 0.9
    np.testing.assert_array_equal(state.blobs, state.coords)
    np.testing.assert_array_equal(state.log_prob, target(state.coords)[0])
    z = (state.coords[:, 1] - start[:, 0]) * np.exp(-0.5 * start[:, 0])
    assert stats.kstest(z, "norm").pvalue > 1e-4
    assert stats.ks_2samp(state.coords[:10_000, 1], start[10_000:, 1]).pvalue > 1e-4


def test_fast_sweeps_follow_the_covariance_given_the_other_coordinates(rng):
    """It is narrower than the marginal one by factors of 1000 and 2, and correlated: other steps hardly move."""
    root, slope = np.array([[1e-3, 0.0], [95.0, 31.0]]), np.array([1.0, 0.02])
    slow, z = rng.normal(size=(400, 2)) * np.array([1.0, 1e4]), rng.normal(size=(400, 2))
    coords = np.column_stack([slow, slow * slope + z @ root.T])

    def score(x):
        return np.linalg.solve(root, (x[:, 2:] - x[:, :2] * slope).T).T

    def log_prob(x):
        return -0.5 * np.sum(score(x) ** 2, axis=1), None

    move = WithFastSweeps(Still(), [2, 3], sweeps=1)
    move.calibrate(coords, np.full(400, 1 / 400))
    state = emcee.State(coords, log_prob=log_prob(coords)[0], copy=True)
    for _ in range(60):
        state, accepted = move.propose(Model(None, log_prob, map, np.random.RandomState(rng.integers(2**31))), state)
        move.tune(state, accepted)
    left = [np.corrcoef(before, after)[0, 1] for before, after in zip(z.T, score(state.coords).T, strict=True)]
    assert np.max(np.abs(left)) < 0.3


@pytest.mark.parametrize("fast", [(3,), (-1,), (0, 7), (0.5,), ("sigma",)])
def test_invalid_indices(fast):
    posterior = Noisy()
    posterior.fast_parameters = fast
    with pytest.raises(ValueError, match="fast_parameters must be indices of parameters"):
        SMCSampler(50, 3, posterior)
